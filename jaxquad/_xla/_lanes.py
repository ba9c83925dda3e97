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
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Primitive

from ._lane_arithmetic import EXPRESSIONS, folded, FUNCTIONS, pair, TYPES


Lane = Any  # traced (), or a NumPy scalar
Cells = np.ndarray  # of lanes; the shape of an array whose members' axis has the length 1
Shape = tuple[int, ...]
Rule = Callable[..., Cells | list[Cells]]  # of (lanes, equation, cells of each argument)

NUMBERS = [np.dtype(x) for x in TYPES]
MOST_CELLS = 512  # of one array: a kernel keeps them in registers
_MOST_OPERATIONS = 20_000  # between lanes; above, compiling takes minutes


class NotInLanes(Exception):
    """What of a step cannot be written in lanes, in words that follow "does not hold"."""


class Lanes:
    """Evaluates jaxprs for `members` in lanes, by `rules` for what is no arithmetic."""

    def __init__(self, members: int, rules: Mapping[str, Rule], *, leave_sums: bool):
        self.members, self.rules = members, rules
        self.leave_sums = leave_sums  # over the members: they stay undone
        self.count = 0

    def small(self, shape: Shape) -> Shape:
        """The shape of the cells of an array."""
        if shape.count(self.members) > 1:
            raise NotInLanes(f"an array {shape} with two axes as long as the ensemble")
        found = tuple(1 if n == self.members else n for n in shape)
        if math.prod(found) > MOST_CELLS or 0 in found:
            raise NotInLanes(f"an array {shape}")
        return found

    def evaluate(self, jaxpr: Jaxpr, consts: Sequence[Any], args: Sequence[Cells]) -> list[Cells]:
        values = {v: self._constant(c) for v, c in zip(jaxpr.constvars, consts, strict=True)}
        values.update(zip(jaxpr.invars, args, strict=True))
        read = lambda v: self._literal(v) if isinstance(v, Literal) else values[v]
        for equation in jaxpr.eqns:
            found = self._apply(equation, [read(v) for v in equation.invars])
            values.update(zip(equation.outvars, found, strict=True))
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
            in_its_place = _known_function(called)
            if in_its_place:
                return [self._each(operation, *args) for operation in in_its_place]
            return self.call(called, args)
        if name in _KEPT:
            return args
        for v in equation.outvars:
            # What has no derivative may have a cotangent without numbers, which nothing reads.
            if v.aval.dtype not in (*NUMBERS, jax.dtypes.float0):  # pyright: ignore[reportAttributeAccessIssue]
                raise NotInLanes(f"{name} of {v.aval}")
        if name in EXPRESSIONS:
            shape = self.small(equation.outvars[0].aval.shape)  # pyright: ignore
            return [self._arithmetic(equation, args, shape)]
        if name not in self.rules:
            raise NotInLanes(f"{name} of {', '.join(str(v.aval) for v in equation.invars)}")
        found = self.rules[name](self, equation, *args)
        return found if isinstance(found, list) else [found]

    def call(self, jaxpr: ClosedJaxpr | Jaxpr, args: Sequence[Cells]) -> list[Cells]:
        closed = isinstance(jaxpr, ClosedJaxpr)
        return self.evaluate(*((jaxpr.jaxpr, jaxpr.consts) if closed else (jaxpr, ())), args)

    def _arithmetic(self, equation: JaxprEqn, args: Sequence[Cells], shape: Shape) -> Cells:
        columns = [np.broadcast_to(x, shape).reshape(-1) for x in args]
        rows = zip(*columns, strict=True)
        return cells_of([self._operation(equation, row) for row in rows], shape)

    def _operation(self, equation: JaxprEqn, row: Sequence[Lane]) -> Lane:
        known = folded(equation, row)
        if known is not None:
            return known
        self.count += 1
        if self.count > _MOST_OPERATIONS:
            raise NotInLanes(f"more than {_MOST_OPERATIONS} operations in a sample")
        return equation.primitive.bind(*row, **equation.params)

    def _each(self, operation: Primitive, x: Cells) -> Cells:
        self.count += x.size
        return cells_of([operation.bind(lane) for lane in x.reshape(-1)], x.shape)

    def fold(self, name: str, lanes: Sequence[Lane]) -> Lane:
        """The sum, the product, ... of some lanes, by halves."""
        while len(lanes) > 1:
            pairs = zip(lanes[0::2], lanes[1::2], strict=False)
            odd = lanes[-1:] if len(lanes) % 2 else ()
            lanes = [*(self.pair(name, *pair) for pair in pairs), *odd]
        return lanes[0]

    def pair(self, name: str, a: Lane, b: Lane) -> Lane:
        self.count += 1
        return pair(name, a, b)

    def is_members(self, shape: Shape, axis: int | np.integer) -> bool:
        return shape[axis] == self.members


def _known_function(jaxpr: ClosedJaxpr | Jaxpr) -> tuple[Primitive, ...]:
    """What a kernel computes in place of a function, which tells its name first."""
    first = jaxpr.eqns[0] if jaxpr.eqns else None
    if first is None or first.primitive.name != "name":
        return ()
    return FUNCTIONS.get(first.params["name"], ())


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
