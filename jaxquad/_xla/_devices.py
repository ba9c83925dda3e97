"""Which devices compute an ensemble, and where its results lie."""

import re
import zlib
from collections.abc import Sequence
from typing import TypeGuard

import jax
import jax.numpy as jnp
import numpy as np
from jax import Device
from jaxtyping import PyTree

from jaxquad._core import is_concrete


Devices = tuple[Device, ...]
_FEWEST = {"cpu": 32}  # members that make a device worth its while
_FEWEST_ELSEWHERE = 4096


def asked_devices(devices: int | Sequence | None) -> Devices | None:
    """The devices that a user names. Raises ValueError for those that JAX does not have."""
    if devices is None:
        return None
    if isinstance(devices, int | np.integer):
        return _first(int(devices))
    if devices and all(isinstance(device, jax.Device) for device in devices):
        return tuple(devices)
    raise ValueError(
        f"devices is {devices!r}: give a number, some of jax.devices(), or None for as many as gain"
    )


def _first(count: int) -> Devices:
    local = jax.local_devices()
    if 1 <= count <= len(local):
        return tuple(local[:count])
    raise ValueError(
        f"devices is {count}, but JAX has {len(local)} here ({local[0].platform}): give 1 to "
        f"{len(local)}. More of a CPU's cores become devices by "
        f'jax.config.update("jax_num_cpu_devices", {max(count, 1)}) before the first computation, '
        f"or by JAX_NUM_CPU_DEVICES={max(count, 1)} in the environment: it has no effect later"
    )


def devices_for(members: int, asked: Devices | None) -> Devices:
    """The `asked` devices, or as many of this process's as gain from so many members."""
    if jax.sharding.get_abstract_mesh().manual_axes:  # already within a split computation
        return ()
    if asked is not None:
        return asked
    local = jax.local_devices()
    fewest = _FEWEST.get(local[0].platform, _FEWEST_ELSEWHERE)
    return tuple(local[: members // fewest])


def may_be_several(asked: Devices | None) -> bool:
    """Whether there is anything to split among, before a look at the ensemble."""
    return (jax.local_device_count() if asked is None else len(asked)) > 1


def where_put(tree: PyTree) -> Devices | None:
    """The devices that a user has put data on, or runs by default on; None for no such wish.

    What is the same on several devices comes from a computation on them, and is no wish.
    """
    arrays = [x for x in jax.tree.leaves(tree) if is_concrete_array(x) and x.committed]
    wishes = [x.devices() for x in arrays if len(x.devices()) == 1 or not x.is_fully_replicated]
    default = getattr(jax.config, "jax_default_device", None)
    wishes = wishes or ([{default}] if isinstance(default, jax.Device) else [])
    return tuple(sorted(max(wishes, key=len), key=lambda x: x.id)) if wishes else None


def movable(tree: PyTree, places: Devices | None) -> PyTree:
    """The same, with arrays that are bound to other devices than these bound to none."""
    kept = set(places or ())
    bound = lambda x: is_concrete_array(x) and x.committed and x.devices() != kept
    return jax.tree.map(lambda x: _unbound(x) if bound(x) else x, tree)


def gathered(tree: PyTree) -> PyTree:
    """The results of one program, brought to the default device if they lie on several."""
    first = next(filter(is_concrete_array, jax.tree.leaves(tree)), None)
    if first is None or len(first.devices()) < 2:
        return tree
    return jax.tree.map(lambda x: _unbound(x) if is_concrete_array(x) else x, tree)


def is_concrete_array(x: object) -> TypeGuard[jax.Array]:
    return isinstance(x, jax.Array) and is_concrete(x)


def _unbound(x: jax.Array) -> jax.Array:
    if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
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
    if jax.process_count() == 1 or not _are_concrete(parts):
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


def _are_concrete(tree: PyTree) -> bool:
    arrays = (x for x in jax.tree.leaves(tree) if isinstance(x, jax.Array))
    return all(is_concrete_array(x) for x in arrays)


def _digest(tree: PyTree) -> int:
    leaves, structure = jax.tree.flatten(tree)
    words = re.sub("0x[0-9a-f]+", "", str(structure))  # without addresses, which differ
    digest = zlib.crc32(words.encode())
    for leaf in leaves:
        digest = zlib.crc32(_bytes(leaf), digest)
    return digest


def _bytes(leaf: object) -> bytes:
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    if isinstance(leaf, jax.Array | np.ndarray):
        array = np.ascontiguousarray(leaf)
        return f"{array.shape}{array.dtype}".encode() + array.tobytes()
    return re.sub("0x[0-9a-f]+", "", repr(leaf)).encode()
