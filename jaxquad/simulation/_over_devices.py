"""An ensemble computed on several devices, of one host or of several."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, PyTree

from jaxquad._core import ensemble_shape, mark_members
from jaxquad._xla import (
    asked_devices,
    Devices,
    devices_for,
    may_be_several,
    movable,
    require_same,
    where_put,
)
from jaxquad.loops import Loop

from ._scenario import Scenario


_AXIS = "members"
_PARTS = ("plant", "controller", "drive", "encoder", "delay")
_SHAPED = (jax.Array, np.ndarray, jax.ShapeDtypeStruct)
Run = tuple[Loop, Scenario]
DeviceChoice = int | Sequence[jax.Device] | None  # see `jq.simulate`


def over_devices(
    function: Callable[[PyTree, PyTree], PyTree],
    members: PyTree,
    shared: PyTree = None,
    *,
    devices: DeviceChoice = None,
) -> PyTree:
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
    places = devices_for(count, asked_devices(devices))
    if len(places) < 2:
        return function(members, shared)
    return _split(function, members, shared, count, places)


def placed(loop: Loop, scenario: Scenario, devices: DeviceChoice) -> tuple[Run, Devices | None]:
    """Loop and scenario, and the devices that are asked for, else those their data were put on."""
    asked = asked_devices(devices)
    run = (loop, scenario)
    if not may_be_several(asked):
        return run, asked
    asked = where_put(run) if asked is None else asked
    require_same({name: vars(loop)[name] for name in _PARTS} | {"scenario": scenario}, asked)
    return movable(run, asked), asked


def loop_over_devices(
    function: Callable[[Run, PyTree], PyTree], run: Run, shared: PyTree, asked: Devices | None
) -> PyTree:
    """`function((loop, scenario), shared)`, each device with its members, as `over_devices`."""
    if not may_be_several(asked):
        return function(run, shared)
    ensemble = ensemble_shape(*run)
    count = (1, *ensemble)[-1]
    places = devices_for(count, asked)
    if min(count, len(places)) < 2:
        return function(run, shared)
    theirs, common = eqx.partition(run, mark_members(run, ensemble))
    whole = lambda theirs, both: function(eqx.combine(theirs, both[0]), both[1])
    return _split(whole, theirs, (common, shared), count, places)


def _split(
    function: Callable, members: PyTree, shared: PyTree, count: int, places: Devices
) -> PyTree:
    (members, shared), static = eqx.partition((members, shared), _is_array)
    own = -(-count // len(places))
    padded = jax.tree.map(lambda x: _lengthened(x, own * len(places) - count), members)
    local = lambda *arrays: function(*eqx.combine(arrays, static))
    few = jax.tree.map(lambda x: jax.ShapeDtypeStruct((*x.shape[:-1], own), x.dtype), members)
    results = jax.eval_shape(local, few, shared)
    if _members_of(results, "the result") != own:
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


def _is_array(x: object) -> bool:
    return isinstance(x, jax.Array | np.ndarray)


def _on_last(x: Array | jax.ShapeDtypeStruct) -> PartitionSpec:
    return PartitionSpec(*(None,) * (len(x.shape) - 1), _AXIS)


def _lengthened(x: Array, more: int) -> Array:
    """With the last member repeated `more` times."""
    x = jnp.asarray(x)
    return jnp.concatenate([x, *[x[..., -1:]] * more], axis=-1) if more else x


def _members_of(tree: PyTree, name: str) -> int:
    shapes = [x.shape for x in jax.tree.leaves(tree) if isinstance(x, _SHAPED)]
    if not shapes or len({shape[-1:] for shape in shapes}) > 1 or () in shapes:
        raise ValueError(
            f"the arrays of {name} have the shapes {', '.join(map(str, shapes))}: each needs the "
            "members on its last axis; what all members share belongs into `shared`"
        )
    return shapes[0][-1]
