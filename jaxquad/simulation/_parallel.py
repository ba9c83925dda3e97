"""An ensemble computed on several devices or hosts, by the cores of a CPU, or slice by slice."""

import math
import re
import threading
import zlib
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Device
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, ArrayLike, Int, PyTree

from jaxquad._compile import are_few, Jit, SINGLE
from jaxquad._core import (
    available_cores,
    ensemble_shape,
    is_concrete,
    map_in_threads,
    mark_members,
)
from jaxquad.loops import Loop

from ._scenario import Scenario


Devices = tuple[Device, ...]
_FEWEST = {"cpu": 32}  # members that make a device worth its while
_FEWEST_ELSEWHERE = 4096
_AXIS = "members"
_PARTS = ("plant", "controller", "drive", "encoder", "delay")
_SHAPED = (jax.Array, np.ndarray, jax.ShapeDtypeStruct)
Run = tuple[Loop, Scenario]
DeviceChoice = int | Sequence[jax.Device] | None  # see `jq.simulate`


def over_devices(
    function: Callable[[PyTree, PyTree], PyTree], members: PyTree, shared: PyTree = None, *,
    devices: DeviceChoice = None,
) -> PyTree:  # fmt: skip
    """`function(members, shared)`, with each device computing its part of the members.

    Members must not feel each other in the function: take means and quantiles of its result.
    Differentiable; the gradient with respect to `shared` is the sum over devices. To be called
    under `jax.jit`. Where the members are no multiple of the devices, the last member fills the
    gap, and its copies are dropped.

    **Arguments:**

    - `function`: every array of its result has the members on its last axis.
    - `members`: every array has the members on its last axis.
    - `shared`: the same on every device.
    - `devices`: those of `jq.simulate`.

    **Raises:** ValueError for devices that JAX does not have, and for arrays that do not have the
    members on the last axis.
    """
    count = _members_of(members, "members")
    places = devices_for(count, devices)
    if len(places) < 2:
        return function(members, shared)
    return _split(function, members, shared, count, places)


def in_slices(
    function: Callable[[Int[Array, " at_once"]], PyTree], members: int, *, at_once: int
) -> PyTree:
    """`function(indices)` of a few members at a time, its results joined on the last axis.

    For ensembles that do not fit the memory together: what is drawn in the function, such as the
    noise of each member, exists for one slice only. Every call is given equally many indices, so
    that it compiles once; where they run out, the last is repeated, and what that gives is dropped.

        fly = lambda few: jq.evaluate(few.loop(ladrc), few.flight(scenario))
        found = jq.simulation.in_slices(lambda k: fly(members.take(k)), members.size, at_once=4096)

    A loop in Python whose results wait in the host's memory. It saves none under `jax.grad`: for
    the gradient of a mean, sum those of its slices.

    **Arguments:**

    - `function`: of indices; all its results have the members last, as `Metrics` have.
    - `members`: how many there are.
    - `at_once`: how many indices a call gets.

    **Raises:** ValueError for counts below 1 and for results of other shapes.
    """
    if members < 1 or at_once < 1:
        raise ValueError(f"{members} members, {at_once} at once: give 1 or more of both")
    at_once = min(members, at_once)

    def part_of(x: ArrayLike, left: int) -> np.ndarray:
        values = np.asarray(x)
        if values.shape[-1:] != (at_once,):
            raise ValueError(
                f"a result has the shape {values.shape}, but the {at_once} members of a slice "
                "belong on its last axis: return what each member gives, and nothing that they "
                "share"
            )
        return values[..., :left]

    parts = []
    for first in range(0, members, at_once):
        indices = np.minimum(np.arange(first, first + at_once), members - 1)
        part = function(jnp.asarray(indices))
        parts.append(jax.tree.map(lambda x, left=members - first: part_of(x, left), part))
    return jax.tree.map(lambda *xs: jnp.asarray(np.concatenate(xs, axis=-1)), *parts)


def placed(loop: Loop, scenario: Scenario, devices: DeviceChoice) -> tuple[Run, Devices | None]:
    """Loop and scenario, and the devices that are asked for, else those their data were put on."""
    chosen = asked_devices(devices)
    run = (loop, scenario)
    if not may_be_several(chosen):
        return run, chosen
    chosen = where_put(run) if chosen is None else chosen
    require_same({name: vars(loop)[name] for name in _PARTS} | {"scenario": scenario}, chosen)
    # What is bound to other devices than these is bound to none.
    bound = lambda x: is_concrete_array(x) and x.committed and x.devices() != set(chosen or ())
    return jax.tree.map(lambda x: _unbound(x) if bound(x) else x, run), chosen


def loop_over_devices(
    function: Callable[[Run, PyTree], PyTree], run: Run, shared: PyTree, chosen: Devices | None
) -> PyTree:
    """`function((loop, scenario), shared)`, each device with its members, as `over_devices`."""
    if not may_be_several(chosen):
        return function(run, shared)
    ensemble = ensemble_shape(*run)
    count = (1, *ensemble)[-1]
    places = devices_for(count, chosen)
    if min(count, len(places)) < 2:
        return function(run, shared)
    theirs, common = eqx.partition(run, mark_members(run, ensemble))
    joined = lambda theirs, both: function(eqx.combine(theirs, both[0]), both[1])
    return _split(joined, theirs, (common, shared), count, places)


def _split(
    function: Callable, members: PyTree, shared: PyTree, count: int, places: Devices
) -> PyTree:
    is_array = lambda x: isinstance(x, jax.Array | np.ndarray)
    (members, shared), static = eqx.partition((members, shared), is_array)
    per_device = -(-count // len(places))
    more = per_device * len(places) - count  # the last member is repeated
    longer = lambda x: jnp.concatenate([x, *[x[..., -1:]] * more], axis=-1) if more else x
    padded = jax.tree.map(lambda x: longer(jnp.asarray(x)), members)
    local = lambda *arrays: function(*eqx.combine(arrays, static))
    few = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct((*x.shape[:-1], per_device), x.dtype), members
    )
    results = jax.eval_shape(local, few, shared)
    if _members_of(results, "the result") != per_device:
        raise ValueError("the result does not have the members of its arguments on the last axis")
    mesh = Mesh(np.array(places), (_AXIS,))
    run = jax.shard_map(
        local,
        mesh=mesh,
        in_specs=(jax.tree.map(_on_last, members), PartitionSpec()),
        out_specs=jax.tree.map(_on_last, results),
        check_vma=False,  # A kernel's marks do not tell on which axes they vary.
    )
    out = run(padded, shared)
    if any(place.process_index != places[0].process_index for place in places):
        out = jax.lax.with_sharding_constraint(out, NamedSharding(mesh, PartitionSpec()))
    return jax.tree.map(lambda x: x[..., :count], out)


def _on_last(x: Array | jax.ShapeDtypeStruct) -> PartitionSpec:
    return PartitionSpec(*(None,) * (len(x.shape) - 1), _AXIS)


def _members_of(tree: PyTree, name: str) -> int:
    shapes = [x.shape for x in jax.tree.leaves(tree) if isinstance(x, _SHAPED)]
    if not shapes or len({shape[-1:] for shape in shapes}) > 1 or () in shapes:
        raise ValueError(
            f"the arrays of {name} have the shapes {', '.join(map(str, shapes))}: each needs the "
            "members on its last axis; what all members share belongs into `shared`"
        )
    return shapes[0][-1]


def asked_devices(devices: int | Sequence | None) -> Devices | None:
    """The devices that a user names. Raises ValueError for those that JAX does not have."""
    if devices is None:
        return None
    if isinstance(devices, int | np.integer):
        local = jax.local_devices()
        if 1 <= devices <= len(local):
            return tuple(local[: int(devices)])
        most = max(int(devices), 1)
        raise ValueError(
            f"devices is {devices}, but JAX has {len(local)} here ({local[0].platform}): give 1 to "
            f"{len(local)}. More of a CPU's cores become devices by "
            f'jax.config.update("jax_num_cpu_devices", {most}) before the first computation, '
            f"or by JAX_NUM_CPU_DEVICES={most} in the environment: it has no effect later"
        )
    if devices and all(isinstance(device, jax.Device) for device in devices):
        return tuple(devices)
    raise ValueError(
        f"devices is {devices!r}: give a number, some of jax.devices(), or None for as many as gain"
    )


def devices_for(members: int, devices: DeviceChoice) -> Devices:
    """Those that a user names, or as many of this process's as gain from so many members."""
    chosen = asked_devices(devices)
    if jax.sharding.get_abstract_mesh().manual_axes:  # already within a split computation
        return ()
    if chosen is not None:
        return chosen
    local = jax.local_devices()
    fewest = _FEWEST.get(local[0].platform, _FEWEST_ELSEWHERE)
    return tuple(local[: members // fewest])


def may_be_several(chosen: Devices | None) -> bool:
    """Whether there is anything to split among, before a look at the ensemble."""
    return (jax.local_device_count() if chosen is None else len(chosen)) > 1


def where_put(tree: PyTree) -> Devices | None:
    """The devices that a user has put data on, or runs by default on; None for no such wish.

    What is the same on several devices comes from a computation on them, and is no wish.
    """
    arrays = [x for x in jax.tree.leaves(tree) if is_concrete_array(x) and x.committed]
    wishes = [x.devices() for x in arrays if len(x.devices()) == 1 or not x.is_fully_replicated]
    default = getattr(jax.config, "jax_default_device", None)
    wishes = wishes or ([{default}] if isinstance(default, jax.Device) else [])
    return tuple(sorted(max(wishes, key=len), key=lambda x: x.id)) if wishes else None


def gathered(tree: PyTree) -> PyTree:
    """The results of one program, brought to the default device if they lie on several."""
    first = next(filter(is_concrete_array, jax.tree.leaves(tree)), None)
    if first is None or len(first.devices()) < 2:
        return tree
    return jax.tree.map(lambda x: _unbound(x) if is_concrete_array(x) else x, tree)


def is_concrete_array(x: object) -> TypeGuard[jax.Array]:
    return isinstance(x, jax.Array) and is_concrete(x)


def _unbound(x: jax.Array) -> jax.Array:
    if _is_key(x):
        return jax.random.wrap_key_data(
            _unbound(jax.random.key_data(x)), impl=jax.random.key_impl(x)
        )
    return jnp.asarray(np.asarray(x))


def require_same(parts: dict[str, PyTree], places: Devices | None) -> None:
    """Raises ValueError, in every process, unless all were given the same numbers.

    Only for devices of all processes, and not under jit, vmap or grad: the numbers are not known.
    """
    if places is None or len({place.process_index for place in places}) < jax.process_count():
        return
    arrays = [x for x in jax.tree.leaves(parts) if isinstance(x, jax.Array)]
    if jax.process_count() == 1 or not all(map(is_concrete_array, arrays)):
        return
    from jax.experimental.multihost_utils import process_allgather

    mine = np.array([_digest(part) for part in parts.values()], np.uint32)
    everyone = np.asarray(process_allgather(mine)).reshape(-1, len(parts))
    wrong = np.any(everyone != everyone[0], axis=0)
    names = [name for name, bad in zip(parts, wrong, strict=True) if bad]
    if names:
        raise ValueError(
            f"the processes were not given the same {' and '.join(names)}: each passes the whole "
            "ensemble, so draw it from one key, or read one file"
        )


def _digest(tree: PyTree) -> int:
    leaves, structure = jax.tree.flatten(tree)
    words = lambda x: re.sub("0x[0-9a-f]+", "", str(x)).encode()  # without addresses, which differ
    digest = zlib.crc32(words(structure))
    for leaf in leaves:
        if isinstance(leaf, jax.Array | np.ndarray):
            array = np.ascontiguousarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)
            content = f"{array.shape}{array.dtype}".encode() + array.tobytes()
        else:
            content = words(repr(leaf))
        digest = zlib.crc32(content, digest)
    return digest


_VECTOR, _FEWEST_OF_PART, _USUAL = 16, 32, 128  # members that are computed at once, and of a part
_MOST_PARTS = 64  # beyond which parts grow: each costs a call
_LEAST = 2**15  # samples times members that make a thread worth its while
_ALIGNED = 64  # bytes, for an array that JAX takes over without a copy


def over_cores(
    program: Jit, run: Run, further: tuple, devices: Devices | None,
    check: Callable[[PyTree], None] | None = None,
) -> PyTree:  # fmt: skip
    """`program(*run, *further, devices)`, whose results have the members on the last axis.

    Parts of the members run side by side where the call is no part of another program, the ensemble
    is worth it and nobody asked for devices; what a part shares with others comes from the first.
    `check` is given the shapes of the whole result before there is room for it.
    """
    part, args = None, (*run, *further, devices)
    leaves, structure = jax.tree.flatten(args)
    # A single loop is seen by its leaves sooner than by its ensemble.
    widest = max((getattr(x, "shape", None) or (0,))[-1] for x in leaves)
    members = 1 if widest <= SINGLE else (1, *ensemble_shape(*run))[-1]
    if members >= 2 * _FEWEST_OF_PART:
        part = _part(program, run, further, devices)
    if are_few(members if part is None else part.width):
        program = program.brief
    if part is None:
        return gathered(program.of_flat(args, leaves, structure))
    joined = _Joined(part, check)

    def compute(first: int) -> None:
        joined.put(first, program(*part.cut(run, first), *further, devices))

    last = part.members - part.width  # the last part overlaps the one before
    firsts = (min(first, last) for first in range(0, part.members, part.width))
    if program.is_new(*part.cut(run, 0), *further, devices):
        compute(next(firsts))  # compiled here, once for all threads
    map_in_threads(compute, firsts)
    return joined.on_device()


class _Part(NamedTuple):
    members: int
    width: int  # members of a part
    varies: list[bool]  # which leaves have the members on the last axis

    def cut(self, run: Run, first: int) -> Run:
        """The same for the members of a part."""
        leaves, structure = jax.tree.flatten(run)
        cut = lambda x: jax.device_put(np.asarray(x)[..., first : first + self.width])
        few = [cut(x) if varies else x for x, varies in zip(leaves, self.varies, strict=True)]
        return jax.tree.unflatten(structure, few)


def _part(program: Jit, run: Run, further: tuple, devices: Devices | None) -> _Part | None:
    """None for an ensemble that is computed at once."""
    cores = available_cores()
    alone = jax.default_backend() == "cpu" and not may_be_several(None)
    if devices is not None or not alone or cores < 2:
        return None
    leaves, ensemble = jax.tree.leaves(run), ensemble_shape(*run)
    members, size = (1, *ensemble)[-1], len(run[1].reference) * math.prod(ensemble)
    # Whole vectors of members; the usual number, or a power of two times it, of a large ensemble:
    # so ensembles of many sizes share a program.
    share = -(-members // (cores * _VECTOR)) * _VECTOR
    usual = _USUAL
    while usual * _MOST_PARTS < members:
        usual *= 2
    width = min(members, max(min(share, usual), _FEWEST_OF_PART))
    varies = jax.tree.leaves(mark_members(run, ensemble))
    keys = any(mine and _is_key(x) for x, mine in zip(leaves, varies, strict=True))
    if width == members or size * width < _LEAST * members or keys:
        return None
    return _Part(members, width, varies) if program.is_outermost(*run, *further) else None


def _is_key(x: jax.Array | np.ndarray) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


class _Joined:
    """The results of all members, to which each part adds its own."""

    def __init__(self, part: _Part, check: Callable[[PyTree], None] | None):
        self._part, self._check, self._lock = part, check, threading.Lock()
        self._structure = jax.tree.structure(None)
        self._room: list[np.ndarray | jax.Array] = []

    def put(self, first: int, result: PyTree) -> None:
        leaves, structure = jax.tree.flatten(result)
        with self._lock:
            if not self._room:
                self._structure = structure
                self._room = self._make_room(leaves)
        for room, leaf in zip(self._room, leaves, strict=True):
            if isinstance(room, np.ndarray):
                room[..., first : first + self._part.width] = np.asarray(leaf)

    def on_device(self) -> PyTree:
        return jax.tree.unflatten(self._structure, jax.device_put(self._room))

    def _make_room(self, leaves: list[jax.Array]) -> list[np.ndarray | jax.Array]:
        """For all members; a leaf itself where it does not have them."""
        width, members = self._part.width, self._part.members
        shapes = [
            jax.ShapeDtypeStruct((*x.shape[:-1], members), x.dtype)
            if x.shape[-1:] == (width,)
            else x
            for x in leaves
        ]
        if self._check is not None:
            self._check(jax.tree.unflatten(self._structure, shapes))
        return [_aligned(x) if isinstance(x, jax.ShapeDtypeStruct) else x for x in shapes]


def _aligned(shape: jax.ShapeDtypeStruct) -> np.ndarray:
    size = math.prod(shape.shape) * shape.dtype.itemsize
    raw = np.empty(size + _ALIGNED, np.uint8)
    first = -raw.ctypes.data % _ALIGNED
    return raw[first : first + size].view(shape.dtype).reshape(shape.shape)
