"""An ensemble computed by the cores of a CPU, each with a part of the members at a time."""

import math
import threading
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxquad._compile import are_few, Jit, SINGLE
from jaxquad._core import available_cores, ensemble_shape, map_in_threads, mark_members

from ._over_devices import Devices, gathered, may_be_several, Run


_VECTOR, _FEWEST, _USUAL = 16, 32, 128  # members that are computed at once, and of a part
_MOST_PARTS = 64  # beyond which parts grow: each costs a call
_LEAST = 2**15  # samples times members that make a thread worth its while
_ALIGNED = 64  # bytes, for an array that JAX takes over without a copy


def over_cores(
    program: Jit,
    run: Run,
    further: tuple,
    devices: Devices | None,
    check: Callable[[PyTree], None] | None = None,
) -> PyTree:
    """`program(*run, *further, devices)`, whose results have the members on the last axis.

    Parts of the members run side by side where the call is no part of another program, the ensemble
    is worth it and nobody asked for devices; what a part shares with others comes from the first.
    `check` is given the shapes of the whole result before there is room for it.
    """
    part, args = None, (*run, *further, devices)
    leaves, structure = jax.tree.flatten(args)
    members = _members(run, leaves)
    if members >= 2 * _FEWEST:
        part = _part(program, run, further, devices)
    if are_few(members if part is None else part.width):
        program = program.brief
    if part is None:
        return gathered(program.of_flat(args, leaves, structure))
    joined = _Joined(part, check)

    def compute(first: int) -> None:
        joined.put(first, program(*part.cut(run, first), *further, devices))

    firsts = part.firsts()
    if program.is_new(*part.cut(run, 0), *further, devices):
        compute(next(firsts))  # compiled here, once for all threads
    map_in_threads(compute, firsts)
    return joined.whole()


class _Part(NamedTuple):
    """How an ensemble is parted."""

    members: int
    width: int  # members of a part
    own: list[bool]  # which leaves have the members on the last axis

    def firsts(self) -> Iterator[int]:
        """The first member of each part; the last part overlaps the one before."""
        for first in range(0, self.members, self.width):
            yield min(first, self.members - self.width)

    def cut(self, run: Run, first: int) -> Run:
        """The same for the members of a part."""
        leaves, structure = jax.tree.flatten(run)
        theirs = slice(first, first + self.width)
        few = [_cut(x, theirs) if own else x for x, own in zip(leaves, self.own, strict=True)]
        return jax.tree.unflatten(structure, few)


def _part(program: Jit, run: Run, further: tuple, devices: Devices | None) -> _Part | None:
    """None for an ensemble that is computed at once."""
    cores = available_cores()
    alone = jax.default_backend() == "cpu" and not may_be_several(None)
    if devices is not None or not alone or cores < 2:
        return None
    leaves, ensemble = jax.tree.leaves(run), ensemble_shape(*run)
    members, size = (1, *ensemble)[-1], len(run[1].reference) * math.prod(ensemble)
    width, own = _width(members, cores), jax.tree.leaves(mark_members(run, ensemble))
    keys = any(mine and _is_key(x) for x, mine in zip(leaves, own, strict=True))
    if width == members or size * width < _LEAST * members or keys:
        return None
    return _Part(members, width, own) if program.is_outermost(*run, *further) else None


def _members(run: Run, leaves: list) -> int:
    """On the last axis; 1 for a single loop, which its leaves show sooner than an ensemble."""
    few = max(map(_last_axis, leaves)) <= SINGLE
    return 1 if few else (1, *ensemble_shape(*run))[-1]


def _last_axis(x: object) -> int:
    shape = getattr(x, "shape", ())
    return shape[-1] if shape else 0


def _is_key(x: jax.Array) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _width(members: int, cores: int) -> int:
    """Whole vectors of members; the usual number, or a power of two times it, of a large ensemble.

    So ensembles of many sizes share a program.
    """
    share = -(-members // (cores * _VECTOR)) * _VECTOR
    usual = _USUAL
    while usual * _MOST_PARTS < members:
        usual *= 2
    return min(members, max(min(share, usual), _FEWEST))


def _cut(x: jax.Array, theirs: slice) -> jax.Array:
    return jax.device_put(np.asarray(x)[..., theirs])


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

    def whole(self) -> PyTree:
        return jax.tree.unflatten(self._structure, jax.device_put(self._room))

    def _make_room(self, leaves: list[jax.Array]) -> list[np.ndarray | jax.Array]:
        shapes = [self._shape(x) for x in leaves]
        if self._check is not None:
            self._check(jax.tree.unflatten(self._structure, shapes))
        return [_aligned(x) if isinstance(x, jax.ShapeDtypeStruct) else x for x in shapes]

    def _shape(self, leaf: jax.Array) -> jax.Array | jax.ShapeDtypeStruct:
        """Of all members; the leaf itself where it does not have them."""
        if leaf.shape[-1:] != (self._part.width,):
            return leaf
        return jax.ShapeDtypeStruct((*leaf.shape[:-1], self._part.members), leaf.dtype)


def _aligned(shape: jax.ShapeDtypeStruct) -> np.ndarray:
    size = math.prod(shape.shape) * shape.dtype.itemsize
    raw = np.empty(size + _ALIGNED, np.uint8)
    first = -raw.ctypes.data % _ALIGNED
    return raw[first : first + size].view(shape.dtype).reshape(shape.shape)
