"""What the kernels of a time loop are made of: its samples in lanes, and arrays as they see them.

Pallas makes one kernel of the loop and one of its reverse pass. Each program of a kernel runs one
block of members from the first sample to the last, with their numbers in registers. The forward
kernel can keep the carry of every segment's first sample. The
reverse kernel takes segments from the last to the first: it computes a segment's carries again,
writes them to memory, and goes back over them.
"""

import functools as ft
import math
from collections.abc import Callable, Container, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.typing import DTypeLike
from jaxtyping import Array

from ._lane_moves import RULES
from ._lanes import as_cells, Cells, cells_of, Lane, Lanes


BLOCK, _WARPS = 64, 2  # members of a program, one for each of its threads
T = TypeVar("T")
Flat = list[Array]
Shaped = jax.ShapeDtypeStruct
Ref = Any  # to memory of a kernel


class Loop(NamedTuple):
    """`count` samples of a step for `members`, which is a jaxpr of (consts, carry, now)."""

    step: ClosedJaxpr
    consts: int
    carry: int
    members: int
    count: int
    interpret: bool

    @property
    def given(self) -> list[Shaped]:
        """Shapes and types of the step's arguments."""
        return _shaped(self.step.in_avals)

    @property
    def out(self) -> list[Shaped]:
        """Those of the step's results."""
        return _shaped(self.step.out_avals)

    @property
    def avals(self) -> tuple[list[Shaped], list[Shaped], list[Shaped]]:
        """Those of consts, carry and one sample of the signals."""
        consts, carry, now = split(self.given, self.consts, self.carry)
        return consts, carry, now

    @property
    def results(self) -> tuple[list[Shaped], list[Shaped]]:
        """Those of the carry, and of what one sample stores."""
        carry, stored = split(self.out, self.carry)
        return carry, stored

    @property
    def segment(self) -> int:
        """Samples between two carries that are kept."""
        return math.isqrt(max(self.count - 1, 0)) + 1

    @property
    def segments(self) -> int:
        return -(-self.count // self.segment)


def _shaped(avals: Sequence[Any]) -> list[Shaped]:
    return [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in avals]


def split(items: Sequence[T], *lengths: int) -> list[list[T]]:
    """The first of these lengths, the next, and the rest."""
    bounds = [0, *np.cumsum(lengths).tolist(), len(items)]
    return [list(items[a:b]) for a, b in zip(bounds, bounds[1:], strict=False)]


def is_float(kind: DTypeLike) -> bool:
    return jnp.issubdtype(kind, jnp.floating)


def is_wide(loop: Loop, aval: Shaped) -> bool:
    """Whether an array has the members' axis."""
    return loop.members in aval.shape


def size(loop: Loop, aval: Shaped) -> int:
    """The numbers of one member."""
    return math.prod(n for n in aval.shape if n != loop.members)


def pack(
    loop: Loop,
    x: Array,
    aval: Shaped,
    *,
    timed: bool = False,
    wide: bool = False,
    fill: float | None = None,
) -> Array:
    """Members last, and as many as blocks hold; numbers of each member in one row.

    With `wide`, what has no members' axis is repeated for each. The last member fills the last
    block, or `fill` does.
    """
    own = is_wide(loop, aval)
    if own:
        x = jnp.moveaxis(x, timed + aval.shape.index(loop.members), -1)
    elif wide:
        x = jnp.broadcast_to(x[..., None], (*x.shape, loop.members))
    last = (loop.members,) if own or wide else ()
    x = x.reshape(*x.shape[:timed], size(loop, aval), *last)
    x = x.astype(memory_type(x.dtype))
    missing = -loop.members % BLOCK
    if last and missing:
        gap = jnp.repeat(x[..., -1:], missing, axis=-1)
        gap = gap if fill is None else jnp.full_like(gap, fill)
        x = jnp.concatenate([x, gap], axis=-1)
    return x


def unpack(loop: Loop, x: Array, aval: Shaped, *, timed: bool = False) -> Array:
    """The array itself. What has no members' axis is that of the first member."""
    shape = tuple(n for n in aval.shape if n != loop.members)
    x = x[..., : loop.members].reshape(*x.shape[:timed], *shape, loop.members).astype(aval.dtype)
    if not is_wide(loop, aval):
        return x[..., 0]
    return jnp.moveaxis(x, -1, timed + aval.shape.index(loop.members))


def memory_type(kind: np.dtype) -> np.dtype:
    return np.dtype(np.int32) if kind.kind == "b" else kind


def blocks_of(*lengths: int) -> pl.BlockSpec:
    """All of the first axes, and a program's members of the last."""
    return pl.BlockSpec((*lengths, BLOCK), lambda i: (*(0,) * len(lengths), i))


def _whole(*lengths: int) -> pl.BlockSpec:
    return pl.BlockSpec(lengths, lambda i: (0,) * len(lengths))


def spec_of(loop: Loop, aval: Shaped, *, timed: bool = False, wide: bool = False) -> pl.BlockSpec:
    lengths = (*(loop.count,) * timed, size(loop, aval))
    return (blocks_of if wide or is_wide(loop, aval) else _whole)(*lengths)


def out_like(loop: Loop, *lengths: int, dtype: np.dtype) -> Shaped:
    return jax.ShapeDtypeStruct((*lengths, -(-loop.members // BLOCK) * BLOCK), dtype)


def _load(ref: Ref, aval: Shaped, *place: Lane) -> list[Lane]:
    """The numbers of an array at a place in its first axes: lanes, or scalars if all share them."""
    rest = (slice(None),) * (len(ref.shape) - len(place) - 1)
    found = [ref[(*place, k, *rest)] for k in range(ref.shape[len(place)])]
    return [x != 0 for x in found] if aval.dtype == bool else found


def _store(ref: Ref, lanes: Sequence[Lane], *place: Lane) -> None:
    for k, lane in enumerate(lanes):
        ref[(*place, k, slice(None))] = lane.astype(ref.dtype)


def load_all(refs: Sequence[Ref], avals: Sequence[Shaped], *place: Lane) -> list[Lane]:
    pairs = zip(refs, avals, strict=True)
    return [lane for ref, aval in pairs for lane in _load(ref, aval, *place)]


def store_all(refs: Sequence[Ref], lanes: Sequence[Lane], *place: Lane) -> None:
    parts = split(lanes, *(ref.shape[len(place)] for ref in refs))
    for ref, part in zip(refs, parts, strict=False):
        _store(ref, part, *place)


def in_lanes(
    loop: Loop, jaxpr: ClosedJaxpr, carry: Container[int], *, leave_sums: bool = False
) -> ClosedJaxpr:
    """A jaxpr of arrays as one of their lanes. Raises `NotInLanes` for what cannot be written so.

    The arguments in `carry` have a number for each member, whatever their shape.
    """
    lanes = Lanes(loop.members, BLOCK, RULES, leave_sums=leave_sums)
    given, shapes = [], []
    for k, aval in enumerate(_shaped(jaxpr.in_avals)):
        shapes.append(lanes.small(aval.shape))
        shape = (BLOCK,) if k in carry or is_wide(loop, aval) else ()
        given += [jax.ShapeDtypeStruct(shape, aval.dtype)] * size(loop, aval)

    def flat(*args: Lane) -> list[Lane]:
        parts = split(args, *(math.prod(shape) for shape in shapes))
        cells = [cells_of(part, shape) for part, shape in zip(parts, shapes, strict=False)]
        out = lanes.evaluate(jaxpr.jaxpr, jaxpr.consts, cells)
        return [lanes.wide(lane) for x in out for lane in _listed(x)]

    return jax.make_jaxpr(flat)(*given)


def _listed(x: Cells) -> list[Lane]:
    return as_cells(x).reshape(-1).tolist()


@ft.lru_cache(maxsize=16)
def step_in_lanes(loop: Loop) -> ClosedJaxpr:
    first = loop.consts
    return in_lanes(loop, loop.step, range(first, first + loop.carry))


@ft.lru_cache(maxsize=16)
def reverse_in_lanes(loop: Loop, which: tuple[bool, ...]) -> ClosedJaxpr:
    """From (consts, carry, now, cotangents) to the cotangents of those in `which` and the carry."""
    step = jaxpr_as_fun(loop.step)
    out = [x for x in loop.out if is_float(x.dtype)]
    wanted = reverse_wanted(loop, which)

    def back(*args: Array) -> list[Array]:
        given, cotangents = split(args, len(loop.given))

        def moved(*some: Array) -> list[Array]:
            fresh = iter(some)
            whole = [next(fresh) if w else x for w, x in zip(wanted, given, strict=True)]
            return [x for x in step(*whole) if is_float(x.dtype)]

        _, pull = jax.vjp(moved, *(x for w, x in zip(wanted, given, strict=True) if w))
        return list(pull(cotangents))

    jaxpr = jax.make_jaxpr(back)(*loop.given, *out)
    first, cotangents = loop.consts, len(loop.given)
    wide = {*range(first, first + loop.carry), *range(cotangents, cotangents + len(out))}
    return in_lanes(loop, jaxpr, wide, leave_sums=True)


def reverse_wanted(loop: Loop, which: tuple[bool, ...]) -> tuple[bool, ...]:
    """What one sample is differentiated by: the carry too, whose first is one of many."""
    first, last = loop.consts, loop.consts + loop.carry
    avals = loop.given
    return tuple(is_float(x.dtype) if first <= k < last else which[k] for k, x in enumerate(avals))


def evaluated(jaxpr: ClosedJaxpr, *parts: Sequence[Lane]) -> list[Lane]:
    return jaxpr_as_fun(jaxpr)(*(lane for part in parts for lane in part))


def call(loop: Loop, kernel: Callable, args: Flat, specs: list, outs: list, out_specs: list):
    return pl.pallas_call(
        kernel,
        grid=(-(-loop.members // BLOCK),),
        in_specs=specs,
        out_specs=out_specs,
        out_shape=outs,
        interpret=loop.interpret,
        compiler_params=triton.CompilerParams(num_warps=_WARPS),
    )(*args)


def bounds(loop: Loop, k: Lane) -> tuple[Lane, Lane]:
    first = k * np.int32(loop.segment)
    return first, jnp.minimum(first + np.int32(loop.segment), np.int32(loop.count))


def kept_avals(loop: Loop) -> list[Shaped]:
    carry = loop.avals[1]
    return [out_like(loop, loop.segments, size(loop, x), dtype=memory_type(x.dtype)) for x in carry]
