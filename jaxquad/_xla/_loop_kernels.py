"""What the kernels of a time loop are made of: a sample in lanes, forward and in reverse.

One kernel is the loop and one its reverse pass. Each thread of a kernel runs one member from the
first sample to the last, with its numbers in registers. The forward kernel can keep the carry of
every segment's first sample. The reverse kernel takes segments from the last to the first: it
computes a segment's carries again, writes them to memory, and goes back over them.
"""

import functools as ft
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.typing import DTypeLike
from jaxtyping import Array

from ._lane_arithmetic import EXPRESSIONS
from ._lane_moves import RULES
from ._lanes import as_cells, Cells, cells_of, Lane, Lanes, NotInLanes, numbers
from ._segments import Segments


T = TypeVar("T")
Flat = list[Array]
Shaped = jax.ShapeDtypeStruct


class Loop(NamedTuple):
    """Samples of a step for `members`, which is a jaxpr of (consts, carry, now)."""

    step: ClosedJaxpr
    consts: int
    carry: int
    members: int
    segments: Segments

    @property
    def count(self) -> int:
        """Samples."""
        return self.segments.count

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
    return numbers(aval.shape, loop.members)


def in_lanes(loop: Loop, jaxpr: ClosedJaxpr, *, leave_sums: bool = False) -> ClosedJaxpr:
    """A jaxpr of arrays as one of their lanes. Raises `NotInLanes` for what they do not hold."""
    lanes = Lanes(loop.members, RULES, leave_sums=leave_sums)
    given, shapes = [], []
    for aval in _shaped(jaxpr.in_avals):
        shapes.append(lanes.small(aval.shape))
        given += [jax.ShapeDtypeStruct((), aval.dtype)] * size(loop, aval)

    def flat(*args: Lane) -> list[Lane]:
        parts = split(args, *map(math.prod, shapes))
        cells = [cells_of(part, shape) for part, shape in zip(parts, shapes, strict=False)]
        out = lanes.evaluate(jaxpr.jaxpr, jaxpr.consts, cells)
        return [lane for x in out for lane in _listed(x)]

    made = jax.make_jaxpr(flat)(*given)
    unknown = {x.primitive.name for x in made.jaxpr.eqns} - EXPRESSIONS.keys()
    if unknown:
        raise NotInLanes(f"{', '.join(sorted(unknown))} of a member's numbers")
    return made


def _listed(x: Cells) -> list[Lane]:
    return as_cells(x).reshape(-1).tolist()


@ft.lru_cache(maxsize=16)
def step_in_lanes(loop: Loop) -> ClosedJaxpr:
    return in_lanes(loop, loop.step)


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
    return in_lanes(loop, jaxpr, leave_sums=True)


def reverse_wanted(loop: Loop, which: tuple[bool, ...]) -> tuple[bool, ...]:
    """What one sample is differentiated by: the carry too, whose first is one of many."""
    first, last = loop.consts, loop.consts + loop.carry
    avals = loop.given
    return tuple(is_float(x.dtype) if first <= k < last else which[k] for k, x in enumerate(avals))


def bounds(loop: Loop) -> list[str]:
    """The first sample of a segment, and the first after it."""
    length = loop.segments.length
    last = f"first + {length}"
    return [
        f"const int first = segment * {length};",
        f"const int end = {last} < {loop.count} ? {last} : {loop.count};",
    ]
