"""What the kernels of a time loop are made of: a sample in lanes, forward and in reverse.

One kernel is the loop and one its reverse pass. Each thread of a kernel runs one member from the
first sample to the last, with its numbers in registers. The forward kernel can keep the carry of
every segment's first sample. The reverse kernel takes segments from the last to the first: it
computes a segment's carries again, writes them to memory, and goes back over them.
"""

import functools as ft
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun, JaxprEqn, Var
from jax.typing import DTypeLike
from jaxtyping import Array

from ._cuda import EXPRESSIONS
from ._lanes import as_cells, CALLS, cells_of, Lane, Lanes, NotInLanes, NUMBERS, numbers


# The reverse kernel computes the samples between two kept carries once more. In the memory that a
# processor of the GPU shares among its threads their carries cost next to nothing, but few have
# room there: so carries are kept as often as a part of the device's memory allows. Where that is
# not often enough, they are kept every sqrt(samples) samples, and put down in the device's memory.
# What a thread holds from sample to sample goes to the shared memory first where its registers have
# no room for it, as in double precision.

_LEAST = 2  # samples: a carry is then written in less time than a sample takes
_SHARE = 0.15  # of the device's free memory, for what is kept: a program may have some loops
BLOCKS = 2  # that a processor runs at once, by their registers
_OF_DRIVER = 1024  # bytes of a block that are the driver's
# Bytes of shared memory of a processor, by compute capability; 64 KB are everywhere.
_SHARED = {"8.0": 164, "8.7": 164, "9.0": 228, "10.0": 228, "10.3": 228, "8.6": 100, "8.9": 100}
_SHARED |= {"12.0": 100, "12.1": 100}
_KILOBYTE = 1024
_HELD = 170  # of 255 registers, that leave room for a sample's own numbers


class Segments(NamedTuple):
    """Of a loop of `count` samples."""

    count: int
    length: int  # samples, of all but the last
    are_shared: bool  # whether a segment's carries lie in shared memory
    shared: int = 0  # bytes of a thread there, for numbers of eight bytes that it holds

    @property
    def number(self) -> int:
        return -(-self.count // self.length)


def segments_of(count: int, carry: int, members: int, block: int, shared: int = 0) -> Segments:
    """For `members` whose carry has so many bytes; `shared` are those that `held_bytes` found."""
    room = _memory()[0]
    most = (_shared_by_block() - shared * block) // max(carry * block, 1)
    length = max(_LEAST, math.ceil(count * carry * members / (_SHARE * room))) if room else count
    if length <= min(most, count):
        return Segments(count, length, True, shared)
    return Segments(count, math.isqrt(max(count - 1, 0)) + 1, False, shared)


def held_bytes(in_registers: int, of_eight: int, block: int) -> int:
    """Bytes of a thread, of those in numbers of eight bytes, that go to shared memory; 0 where
    registers have room for all, and where that memory has none."""
    registers = in_registers // 4
    return of_eight if registers > _HELD and of_eight * block <= _shared_by_block() else 0


def _shared_by_block() -> int:
    return _memory()[1] // BLOCKS - _OF_DRIVER


def _memory() -> tuple[int, int]:
    """Bytes that are free on this machine's GPU, and shared ones; 0 where there is no GPU."""
    try:
        device = jax.local_devices(backend="gpu")[0]
    except RuntimeError:  # a program for another machine
        return 0, 0
    stats = device.memory_stats() or {}
    free = stats.get("bytes_limit", 0) - stats.get("bytes_in_use", 0)
    return free, _KILOBYTE * _SHARED.get(str(device.compute_capability), 64)


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
        return self.segments.count

    @property
    def inputs(self) -> list[Shaped]:
        """Shapes and types of the step's arguments."""
        return _shaped(self.step.in_avals)

    @property
    def out(self) -> list[Shaped]:
        """Those of the step's results."""
        return _shaped(self.step.out_avals)

    @property
    def avals(self) -> tuple[list[Shaped], list[Shaped], list[Shaped]]:
        """Those of consts, carry and one sample of the signals."""
        consts, carry, now = split(self.inputs, self.consts, self.carry)
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
    lanes = Lanes(loop.members, leave_sums=leave_sums)
    shapes_of_lanes, shapes = [], []
    for aval in _shaped(jaxpr.in_avals):
        shapes.append(lanes.small(aval.shape))
        shapes_of_lanes += [jax.ShapeDtypeStruct((), aval.dtype)] * size(loop, aval)

    def flat(*args: Lane) -> list[Lane]:
        parts = split(args, *map(math.prod, shapes))
        cells = [cells_of(part, shape) for part, shape in zip(parts, shapes, strict=False)]
        out = lanes.evaluate(jaxpr.jaxpr, jaxpr.consts, cells)
        return [lane for x in out for lane in as_cells(x).reshape(-1).tolist()]

    lanes_jaxpr = jax.make_jaxpr(flat)(*shapes_of_lanes)
    unknown = {x.primitive.name for x in lanes_jaxpr.jaxpr.eqns} - EXPRESSIONS.keys()
    if unknown:
        raise NotInLanes(f"{', '.join(sorted(unknown))} of a member's numbers")
    return lanes_jaxpr


@ft.lru_cache(maxsize=16)
def step_in_lanes(loop: Loop) -> ClosedJaxpr:
    return in_lanes(loop, loop.step)


@ft.lru_cache(maxsize=16)
def reverse_in_lanes(loop: Loop, which: tuple[bool, ...]) -> ClosedJaxpr:
    """From (consts, carry, now, cotangents) to the cotangents of those in `which` and the carry."""
    step = jaxpr_as_fun(loop.step)
    out = [x for x in loop.out if is_float(x.dtype)]
    # The carry too, whose first is one of many.
    first, last = loop.consts, loop.consts + loop.carry
    pairs = enumerate(loop.inputs)
    wanted = [is_float(x.dtype) if first <= k < last else which[k] for k, x in pairs]

    def back(*args: Array) -> list[Array]:
        inputs, cotangents = split(args, len(loop.inputs))

        def moved(*some: Array) -> list[Array]:
            fresh = iter(some)
            values = [next(fresh) if w else x for w, x in zip(wanted, inputs, strict=True)]
            return [x for x in step(*values) if is_float(x.dtype)]

        _, pull = jax.vjp(moved, *(x for w, x in zip(wanted, inputs, strict=True) if w))
        return list(pull(cotangents))

    jaxpr = jax.make_jaxpr(back)(*loop.inputs, *out)
    return in_lanes(loop, jaxpr, leave_sums=True)


def bounds(loop: Loop) -> list[str]:
    """The first sample of a segment, and the first after it."""
    length = loop.segments.length
    last = f"first + {length}"
    return [
        f"const int first = segment * {length};",
        f"const int end = {last} < {loop.count} ? {last} : {loop.count};",
    ]


# What of a loop's step is the same in every sample, computed once, before the loop.
#
# A compiler does so, too, but not with derivatives: in reverse, every sample would pass its part on
# to what the step's constants are made of. Here that is done once, with the sums over all samples.

_MORE = 16  # numbers of a member, and arrays, that the loop may take for it beside those before


def without_invariants(
    step: ClosedJaxpr, consts: Sequence[Array], members: int
) -> tuple[ClosedJaxpr, list[Array]]:
    """A step of (consts, carry, now) as one of other consts, which are computed from these."""
    body = step.jaxpr
    constants, rest = body.invars[: len(consts)], body.invars[len(consts) :]
    steady: list[JaxprEqn] = []  # what is the same in every sample, each once
    in_sample: list[JaxprEqn] = []  # what a sample has to compute
    before: set[Var] = set()  # results that need not be computed in a sample
    still, from_own = {*constants, *body.constvars}, {*constants}
    same: dict[Any, Var] = {}
    first_of: dict[Any, Sequence[Var]] = {}
    for equation in body.eqns:
        equation = equation.replace(invars=[_first(v, same) for v in equation.invars])
        read = [v for v in equation.invars if isinstance(v, Var)]
        if not still.issuperset(read):
            in_sample.append(equation)
            continue
        first = first_of.setdefault(_content(equation), equation.outvars)
        if first is not equation.outvars:
            same.update(zip(equation.outvars, first, strict=True))
            continue
        still.update(equation.outvars)
        steady.append(equation)
        if not from_own.isdisjoint(read):
            from_own.update(equation.outvars)
            name = equation.primitive.name
            kinds = {v.aval.dtype for v in equation.outvars}  # pyright: ignore[reportAttributeAccessIssue]
            if (name in EXPRESSIONS or name in CALLS) and kinds.issubset(NUMBERS):
                before.update(equation.outvars)
                continue
        in_sample.append(equation)  # what only moves numbers costs nothing there
    outs = [_first(v, same) for v in body.outvars]
    per_sample = _used(in_sample, outs)
    read = dict.fromkeys(
        v
        for v in (*(v for equation in per_sample for v in equation.invars), *outs)
        if isinstance(v, Var)
    )
    needed = [v for v in read if v in before or v in constants]
    grown = max(_size(needed, members) - _size(constants, members), len(needed) - len(constants))
    if grown > _MORE:
        return step, list(consts)
    first = body.replace(invars=constants, outvars=needed, eqns=_used(steady, needed))
    within = body.replace(invars=[*needed, *rest], outvars=outs, eqns=per_sample)
    computed = jaxpr_as_fun(ClosedJaxpr(first, step.consts))(*consts)
    return ClosedJaxpr(within, step.consts), computed


def _first(v: Any, same: Mapping[Any, Var]) -> Any:
    return same.get(v, v) if isinstance(v, Var) else v


def _content(equation: JaxprEqn) -> Any:
    """Equal for operations of equal results; a function may have a derivative of its own."""
    if equation.primitive.name in CALLS:
        return id(equation)
    operands = [v if isinstance(v, Var) else (str(v.val), v.aval) for v in equation.invars]
    return equation.primitive, str(equation.params), *operands


def _used(equations: Sequence[JaxprEqn], results: Iterable[Any]) -> list[JaxprEqn]:
    """Those on which some results depend."""
    used, open_ = [], {v for v in results if isinstance(v, Var)}
    for equation in reversed(equations):
        if not open_.isdisjoint(equation.outvars):
            used.append(equation)
            open_.update(v for v in equation.invars if isinstance(v, Var))
    return used[::-1]


def _size(variables: Iterable[Var], members: int) -> int:
    shapes = (v.aval.shape for v in variables)  # pyright: ignore[reportAttributeAccessIssue]
    return sum(numbers(shape, members) for shape in shapes)
