"""Several processes, each with devices of its own, in one computation."""

import re
import zlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from ._devices import Devices, is_concrete_array


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
    told = re.sub("0x[0-9a-f]+", "", str(structure))  # without addresses, which differ
    digest = zlib.crc32(told.encode())
    for leaf in leaves:
        digest = zlib.crc32(_bytes(leaf), digest)
    return digest


def _bytes(leaf: Any) -> bytes:
    if jnp.issubdtype(getattr(leaf, "dtype", float), jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    if isinstance(leaf, jax.Array | np.ndarray):
        array = np.ascontiguousarray(leaf)
        return f"{array.shape}{array.dtype}".encode() + array.tobytes()
    return re.sub("0x[0-9a-f]+", "", repr(leaf)).encode()
