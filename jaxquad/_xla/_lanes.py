"""The arithmetic of one sample without its arrays: what a kernel on an accelerator can hold.

A step is written for arrays [3, members] and the like. A thread of a kernel has the numbers of one
member, and keeps them in registers: there are no arrays to stack, slice or multiply. Here every
array becomes a NumPy array of *lanes*, one number of that member each. The step's jaxpr is
evaluated on these: what moves numbers is done while tracing, and only arithmetic between lanes
remains.

The members' axis is kept as one of length 1, so that axes have the same numbers in both. Where a
sum over it is allowed, it stays undone: the result has each member's share of it.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

from ._cuda import EXPRESSIONS, FUNCTIONS, TYPES
from ._switch import MOST_CELLS


Lane = Any  # traced (), or a NumPy scalar
Cells = np.ndarray  # of lanes; the shape of an array whose members' axis has the length 1
Shape = tuple[int, ...]
Rule = Callable[..., Cells | list[Cells]]  # of (lanes, equation, cells of each argument)
RULES: dict[str, Rule] = {}  # for what is no arithmetic

NUMBERS = [np.dtype(x) for x in TYPES]
_MOST_OPERATIONS = 20_000  # between lanes; above, compiling takes minutes


class NotInLanes(Exception):
    """What of a step cannot be written in lanes, in words that follow "does not hold"."""


class Lanes:
    """Evaluates jaxprs for `members` in lanes, by `RULES` for what is no arithmetic."""

    def __init__(self, members: int, *, leave_sums: bool):
        self.members = members
        self.leave_sums = leave_sums  # over the members: they stay undone
        self.count = 0

    def small(self, shape: Shape) -> Shape:
        """The shape of the cells of an array."""
        if shape.count(self.members) > 1:
            raise NotInLanes(f"an array {shape} with two axes as long as the ensemble")
        cells = tuple(1 if n == self.members else n for n in shape)
        if math.prod(cells) > MOST_CELLS or 0 in cells:
            raise NotInLanes(f"an array {shape}")
        return cells

    def evaluate(self, jaxpr: Jaxpr, consts: Sequence[Any], args: Sequence[Cells]) -> list[Cells]:
        values = {v: self._constant(c) for v, c in zip(jaxpr.constvars, consts, strict=True)}
        values.update(zip(jaxpr.invars, args, strict=True))
        read = lambda v: self._literal(v) if isinstance(v, Literal) else values[v]
        for equation in jaxpr.eqns:
            results = self._apply(equation, [read(v) for v in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def _literal(self, literal: Literal) -> Cells:
        kind = literal.aval.dtype  # pyright: ignore[reportAttributeAccessIssue]
        return self._constant(np.asarray(literal.val, kind))

    def _constant(self, value: Any) -> Cells:
        if isinstance(value, np.ndarray) and value.dtype == object:
            return value
        if isinstance(value, Tracer) or self.members in np.shape(value):
            raise NotInLanes(f"a constant of the shape {np.shape(value)}")
        numbers = np.asarray(value)
        self.small(numbers.shape)
        return cells_of([x for x in numbers.reshape(-1)], numbers.shape)

    def _apply(self, equation: JaxprEqn, args: list[Cells]) -> list[Cells]:
        name, params = equation.primitive.name, equation.params
        if name in CALLS:
            called = params[CALLS[name]]
            first = called.eqns[0] if called.eqns else None
            if first is not None and first.primitive.name == "name":
                # What a kernel computes in place of a function, which tells its name first.
                if in_its_place := FUNCTIONS.get(first.params["name"], ()):
                    [x] = args
                    self.count += x.size * len(in_its_place)
                    pairs = ([f.bind(lane) for lane in x.reshape(-1)] for f in in_its_place)
                    return [cells_of(lanes, x.shape) for lanes in pairs]
            return self.call(called, args)
        if name in _KEPT:
            return args
        for v in equation.outvars:
            # What has no derivative may have a cotangent without numbers, which nothing reads.
            if v.aval.dtype not in (*NUMBERS, jax.dtypes.float0):  # pyright: ignore[reportAttributeAccessIssue]
                raise NotInLanes(f"{name} of {v.aval}")
        if name in EXPRESSIONS:
            shape = self.small(equation.outvars[0].aval.shape)  # pyright: ignore
            rows = zip(*(np.broadcast_to(x, shape).reshape(-1) for x in args), strict=True)
            return [cells_of([self._operation(equation, row) for row in rows], shape)]
        if name not in RULES:
            raise NotInLanes(f"{name} of {', '.join(str(v.aval) for v in equation.invars)}")
        results = RULES[name](self, equation, *args)
        return results if isinstance(results, list) else [results]

    def call(self, jaxpr: ClosedJaxpr | Jaxpr, args: Sequence[Cells]) -> list[Cells]:
        closed = isinstance(jaxpr, ClosedJaxpr)
        return self.evaluate(*((jaxpr.jaxpr, jaxpr.consts) if closed else (jaxpr, ())), args)

    def _operation(self, equation: JaxprEqn, row: Sequence[Lane]) -> Lane:
        """Done at once where all numbers are known while tracing, as indices and masks are."""
        name = equation.primitive.name
        if name in _KNOWN and all(isinstance(x, np.generic) for x in row):
            kind = equation.outvars[0].aval.dtype  # pyright: ignore[reportAttributeAccessIssue]
            with np.errstate(all="ignore"):
                return np.dtype(kind).type(_KNOWN[name](*row))
        self.count += 1
        if self.count > _MOST_OPERATIONS:
            raise NotInLanes(f"more than {_MOST_OPERATIONS} operations in a sample")
        return equation.primitive.bind(*row, **equation.params)

    def fold(self, name: str, lanes: Sequence[Lane]) -> Lane:
        """The sum, the product, ... of some lanes, by halves."""
        while len(lanes) > 1:
            pairs = zip(lanes[0::2], lanes[1::2], strict=False)
            odd = lanes[-1:] if len(lanes) % 2 else ()
            lanes = [*(self.pair(name, *pair) for pair in pairs), *odd]
        return lanes[0]

    def pair(self, name: str, a: Lane, b: Lane) -> Lane:
        """What a reduction does with two numbers."""
        self.count += 1
        are_constants = isinstance(a, np.generic) and isinstance(b, np.generic)
        return _PAIRS[name][0 if are_constants else 1](a, b)

    def is_members(self, shape: Shape, axis: int | np.integer) -> bool:
        return shape[axis] == self.members


def numbers(shape: Shape, members: int) -> int:
    """Those of one member in an array."""
    return math.prod(n for n in shape if n != members)


def cells_of(lanes: Sequence[Lane], shape: Shape) -> Cells:
    out = np.empty(len(lanes), object)
    for k, lane in enumerate(lanes):  # NumPy would look into what is assigned at once
        out[k] = lane
    return out.reshape(shape)


def as_cells(x: Any) -> Cells:
    """NumPy hands out what an array without axes holds, in place of the array."""
    return x if isinstance(x, np.ndarray) and x.dtype == object else cells_of([x], ())


CALLS = {  # and where the called jaxpr is
    "jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr", "checkpoint": "jaxpr",
    "remat2": "jaxpr",
}  # fmt: skip
_KEPT = set("copy copy_p stop_gradient optimization_barrier enter_kernel leave_kernel name".split())


_PAIRS: dict[str, tuple[Callable, Callable]] = {
    "reduce_sum": (np.add, jax.lax.add),
    "reduce_prod": (np.multiply, jax.lax.mul),
    "reduce_max": (np.maximum, jax.lax.max),
    "reduce_min": (np.minimum, jax.lax.min),
    "reduce_and": (np.bitwise_and, jax.lax.bitwise_and),
    "reduce_or": (np.bitwise_or, jax.lax.bitwise_or),
}


_KNOWN: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "lt": np.less, "le": np.less_equal,
    "gt": np.greater, "ge": np.greater_equal, "eq": np.equal, "ne": np.not_equal,
    "and": np.bitwise_and, "or": np.bitwise_or, "not": np.invert, "neg": np.negative,
    "max": np.maximum, "min": np.minimum, "convert_element_type": lambda x: x,
    "select_n": lambda which, *cases: cases[int(which)],
    "clamp": lambda low, x, high: np.minimum(np.maximum(low, x), high),
}  # fmt: skip


# What moves numbers or adds them up, done on cells while tracing.
_LONGEST = 64  # iterations of a loop within a sample


def _rule(*names: str) -> Callable:
    def register(rule: Callable) -> Callable:
        RULES.update(dict.fromkeys(names, rule))
        return rule

    return register


def _shape(equation: JaxprEqn, place: int = 0) -> Shape:
    return equation.invars[place].aval.shape  # pyright: ignore[reportAttributeAccessIssue]


def _result(equation: JaxprEqn) -> Shape:
    return equation.outvars[0].aval.shape  # pyright: ignore[reportAttributeAccessIssue]


@_rule("broadcast_in_dim")
def _broadcast(lanes: Lanes, equation: JaxprEqn, x: Cells) -> Cells:
    shape = lanes.small(_result(equation))
    places = [1] * len(shape)
    for axis, place in enumerate(equation.params["broadcast_dimensions"]):
        places[place] = x.shape[axis]
    return np.broadcast_to(x.reshape(places), shape)


@_rule("reshape", "squeeze", "expand_dims")
def _reshape(lanes: Lanes, equation: JaxprEqn, x: Cells) -> Cells:
    before, after = _shape(equation), _result(equation)
    ahead = [s.index(lanes.members) if lanes.members in s else None for s in (before, after)]
    if (ahead[0] is None) != (ahead[1] is None) or (
        ahead[0] is not None and math.prod(before[: ahead[0]]) != math.prod(after[: ahead[1]])
    ):
        raise NotInLanes(f"a reshape of {before} to {after}, across the members")
    return x.reshape(lanes.small(after))


@_rule("transpose")
def _transpose(lanes: Lanes, equation: JaxprEqn, x: Cells) -> Cells:
    return x.transpose(equation.params["permutation"])


@_rule("rev")
def _reverse(lanes: Lanes, equation: JaxprEqn, x: Cells) -> Cells:
    return np.flip(x, _other_axes(lanes, equation, equation.params["dimensions"]))


@_rule("concatenate")
def _concatenate(lanes: Lanes, equation: JaxprEqn, *parts: Cells) -> Cells:
    [axis] = _other_axes(lanes, equation, (equation.params["dimension"],))
    lanes.small(_result(equation))
    return np.concatenate(parts, axis)


@_rule("stack")
def _stack(lanes: Lanes, equation: JaxprEqn, *parts: Cells) -> Cells:
    lanes.small(_result(equation))
    return np.stack(parts, equation.params["axis"])


@_rule("unstack")
def _unstack(lanes: Lanes, equation: JaxprEqn, x: Cells) -> list[Cells]:
    [axis] = _other_axes(lanes, equation, (equation.params["axis"],))
    return [as_cells(part) for part in np.moveaxis(x, axis, 0)]


@_rule("split")
def _split(lanes: Lanes, equation: JaxprEqn, x: Cells) -> list[Cells]:
    [axis] = _other_axes(lanes, equation, (equation.params["axis"],))
    return np.split(x, np.cumsum(equation.params["sizes"])[:-1], axis)


@_rule("slice")
def _slice(lanes: Lanes, equation: JaxprEqn, x: Cells) -> Cells:
    shape, params = _shape(equation), equation.params
    steps = params["strides"] or (1,) * len(shape)
    parts = []
    bounds = zip(params["start_indices"], params["limit_indices"], steps, strict=True)
    for axis, part in enumerate(bounds):
        if lanes.is_members(shape, axis):
            _require(part == (0, lanes.members, 1), "a slice of the members")
            part = (0, 1, 1)
        parts.append(slice(*part))
    return x[tuple(parts)]


@_rule("pad")
def _pad(lanes: Lanes, equation: JaxprEqn, x: Cells, value: Cells) -> Cells:
    shape = _shape(equation)
    for axis, (low, high, gap) in enumerate(equation.params["padding_config"]):
        if lanes.is_members(shape, axis):
            _require((low, high, gap) == (0, 0, 0), "members that are padded")
            continue
        row = np.take(x, [0], axis).shape
        rows = [cells_of([value.item()] * math.prod(row), row)]
        spaced = [y for k in range(x.shape[axis]) for y in [np.take(x, [k], axis), *rows * gap]]
        spaced = spaced[: len(spaced) - gap] if gap else spaced
        spaced = rows * max(low, 0) + spaced[max(-low, 0) :] + rows * max(high, 0)
        x = np.concatenate(spaced[: len(spaced) - max(-high, 0)], axis)
    return x


@_rule("dynamic_slice")
def _dynamic_slice(lanes: Lanes, equation: JaxprEqn, x: Cells, *starts: Cells) -> Cells:
    sizes = equation.params["slice_sizes"]
    return x[_window(lanes, _shape(equation), sizes, starts)]


@_rule("dynamic_update_slice")
def _update(lanes: Lanes, equation: JaxprEqn, x: Cells, new: Cells, *starts: Cells) -> Cells:
    out = x.copy()
    out[_window(lanes, _shape(equation), _shape(equation, 1), starts)] = new
    return out


def _window(lanes: Lanes, shape: Shape, sizes: Shape, starts: Sequence[Cells]) -> tuple:
    """Where a slice lies whose start is known while tracing."""
    parts = []
    for axis, (size, start) in enumerate(zip(sizes, starts, strict=True)):
        if lanes.is_members(shape, axis):
            _require(size == shape[axis], "a slice of the members")
            parts.append(slice(None))
            continue
        first = start.item()
        _require(isinstance(first, np.generic), "an index that is known only when it runs")
        first = min(max(int(first), 0), shape[axis] - size)
        parts.append(slice(first, first + size))
    return tuple(parts)


@_rule("iota")
def _iota(lanes: Lanes, equation: JaxprEqn) -> Cells:
    shape, axis = _result(equation), equation.params["dimension"]
    _require(not lanes.is_members(shape, axis), "the members' numbers")
    rest = lanes.small(shape)
    row = cells_of(list(np.arange(shape[axis], dtype=equation.params["dtype"])), (shape[axis],))
    return np.moveaxis(
        np.broadcast_to(row, (*rest[:axis], *rest[axis + 1 :], rest[axis])), -1, axis
    )


@_rule("empty", "empty2")
def _empty(lanes: Lanes, equation: JaxprEqn) -> Cells:
    """What a loop fills."""
    zeros = np.zeros((), equation.outvars[0].aval.dtype)  # pyright: ignore
    return np.broadcast_to(cells_of([zeros[()]], ()), lanes.small(_result(equation)))


@_rule("reduce_sum", "reduce_prod", "reduce_max", "reduce_min", "reduce_and", "reduce_or")
def _reduce(lanes: Lanes, equation: JaxprEqn, x: Cells) -> Cells:
    name, axes = equation.primitive.name, equation.params["axes"]
    if not (lanes.leave_sums and name == "reduce_sum"):
        _other_axes(lanes, equation, axes)
    kept = [axis for axis in range(x.ndim) if axis not in axes]
    shape = tuple(x.shape[axis] for axis in kept)
    rows = x.transpose(*kept, *axes).reshape(math.prod(shape), -1)
    return cells_of([lanes.fold(name, list(row)) for row in rows], shape)


@_rule("cumsum")
def _accumulate(lanes: Lanes, equation: JaxprEqn, x: Cells) -> Cells:
    [axis], out = _other_axes(lanes, equation, (equation.params["axis"],)), np.empty_like(x)
    turned = (lambda a: np.flip(a, axis)) if equation.params["reverse"] else (lambda a: a)
    rows, totals = (np.moveaxis(turned(a), axis, 0) for a in (x, out))
    for k, row in enumerate(rows):
        if k:
            pairs = zip(np.ravel(as_cells(totals[k - 1])), np.ravel(as_cells(row)), strict=True)
            row = cells_of([lanes.pair("reduce_sum", *pair) for pair in pairs], np.shape(row))
        totals[k] = row
    return out


@_rule("dot_general")
def _dot(lanes: Lanes, equation: JaxprEqn, a: Cells, b: Cells) -> Cells:
    (shared_a, shared_b), (batch_a, batch_b) = equation.params["dimension_numbers"]
    if not lanes.leave_sums:
        _other_axes(lanes, equation, shared_a)
    kind = equation.outvars[0].aval.dtype  # pyright: ignore[reportAttributeAccessIssue]
    a, free_a = _matrices(a, batch_a, shared_a)
    b, free_b = _matrices(b, batch_b, shared_b)
    batch = tuple(a.shape[: len(batch_a)])
    a, b = (x.reshape(math.prod(batch), -1, math.prod(x.shape[-n:] or (1,)) if n else 1)
            for x, n in ((a, len(shared_a)), (b, len(shared_b))))  # fmt: skip
    product = lambda x, y: lanes.fold(
        "reduce_sum", [lanes.pair("reduce_prod", p, q) for p, q in zip(x, y, strict=True)]
    )
    products = [product(x, y).astype(kind) for m, n in zip(a, b, strict=True) for x in m for y in n]
    return cells_of(products, (*batch, *free_a, *free_b))


def _matrices(x: Cells, batch: Sequence[int], shared: Sequence[int]) -> tuple[Cells, Shape]:
    free = [axis for axis in range(x.ndim) if axis not in (*batch, *shared)]
    return x.transpose(*batch, *free, *shared), tuple(x.shape[axis] for axis in free)


@_rule("cond")
def _cond(lanes: Lanes, equation: JaxprEqn, index: Cells, *args: Cells) -> list[Cells]:
    """All branches, of which each member takes one: they are arithmetic."""
    branches = [lanes.call(branch, args) for branch in equation.params["branches"]]
    choice = index.item()
    if isinstance(choice, np.generic):
        return branches[min(max(int(choice), 0), len(branches) - 1)]
    chosen = branches[0]
    for k, branch in enumerate(branches[1:], 1):
        takes = choice if choice.dtype == bool else jax.lax.ge(choice, choice.dtype.type(k))
        selected = []
        for new, old in zip(branch, chosen, strict=True):
            pairs = zip(new.reshape(-1), old.reshape(-1), strict=True)
            row = [jax.lax.select(takes, *pair) for pair in pairs]
            selected.append(cells_of(row, new.shape))
        chosen = selected
    return chosen


@_rule("scan")
def _scan(lanes: Lanes, equation: JaxprEqn, *args: Cells) -> list[Cells]:
    """A loop of a few iterations, one after the other."""
    params, length = equation.params, equation.params["length"]
    _require(length <= _LONGEST, f"a loop of {length} iterations within a sample")
    # Its names for the numbers of constants and carries differ between JAX versions. What is
    # scanned has one axis less in the body.
    rank, body = lambda v: len(v.aval.shape), params["jaxpr"].jaxpr
    alike = lambda outer, inner: sum(rank(a) == rank(b) for a, b in zip(outer, inner, strict=True))
    m = alike(equation.outvars, body.outvars)
    n = alike(equation.invars, body.invars) - m
    consts, carry, xs = args[:n], list(args[n : n + m]), args[n + m :]
    stored: list[list[Cells]] = []
    order = range(length - 1, -1, -1) if params["reverse"] else range(length)
    for k in order:
        out = lanes.call(params["jaxpr"], [*consts, *carry, *(as_cells(x[k]) for x in xs)])
        carry = out[:m]
        stored.append(out[m:])
    rows = stored[::-1] if params["reverse"] else stored
    return [*carry, *(np.stack(column) for column in zip(*rows, strict=True))]


def _other_axes(
    lanes: Lanes, equation: JaxprEqn, axes: Sequence[int | np.integer]
) -> tuple[int, ...]:
    """The axes, none of which is that of the members."""
    shape, name = _shape(equation), equation.primitive.name
    _require(not any(lanes.is_members(shape, axis) for axis in axes), f"{name} over the members")
    return tuple(map(int, axes))


def _require(condition: bool, otherwise: str) -> None:
    if not condition:
        raise NotInLanes(otherwise)
