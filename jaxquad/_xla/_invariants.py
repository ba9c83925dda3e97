"""What of a loop's step is the same in every sample, computed once, before the loop.

A compiler does so, too, but not with derivatives: in reverse, every sample would pass its part on
to what the step's constants are made of. Here that is done once, with the sums over all samples.
"""

from collections.abc import Iterable, Sequence
from typing import Any

from jax.extend.core import ClosedJaxpr, Jaxpr, jaxpr_as_fun, JaxprEqn, Var
from jaxtyping import Array

from ._lane_arithmetic import EXPRESSIONS
from ._lanes import CALLS, NUMBERS, numbers


_MORE = 16  # numbers of a member, and arrays, that the loop may take for it beside those before


def without_invariants(
    step: ClosedJaxpr, consts: Sequence[Array], members: int
) -> tuple[ClosedJaxpr, list[Array]]:
    """A step of (consts, carry, now) as one of other consts, which are computed from these."""
    body = step.jaxpr
    own, rest = body.invars[: len(consts)], body.invars[len(consts) :]
    parts = _Parts(body, own)
    each = _used(parts.each, parts.outs)
    read = dict.fromkeys(v for v in (*_read(each), *parts.outs) if isinstance(v, Var))
    needed = [v for v in read if v in parts.once or v in own]
    grown = max(_size(needed, members) - _size(own, members), len(needed) - len(own))
    if grown > _MORE:
        return step, list(consts)
    first = body.replace(invars=own, outvars=needed, eqns=_used(parts.steady, needed))
    within = body.replace(invars=[*needed, *rest], outvars=parts.outs, eqns=each)
    made = jaxpr_as_fun(ClosedJaxpr(first, step.consts))(*consts)
    return ClosedJaxpr(within, step.consts), made


class _Parts:
    """A step's equations, sorted, with one of each that are the same."""

    def __init__(self, body: Jaxpr, own: Sequence[Var]):
        self.steady: list[JaxprEqn] = []  # what is the same in every sample
        self.each: list[JaxprEqn] = []  # what a sample has to compute
        self.once: set[Var] = set()  # results that need not be computed in a sample
        self._still, self._from_own = {*own, *body.constvars}, {*own}
        self._same: dict[Var, Var] = {}
        self._seen: dict[Any, Sequence[Var]] = {}
        for equation in body.eqns:
            self._sort(equation.replace(invars=[self._first(v) for v in equation.invars]))
        self.outs = [self._first(v) for v in body.outvars]

    def _first(self, v: Any) -> Any:
        return self._same.get(v, v) if isinstance(v, Var) else v

    def _sort(self, equation: JaxprEqn) -> None:
        given = [v for v in equation.invars if isinstance(v, Var)]
        if not self._still.issuperset(given):
            self.each.append(equation)
            return
        seen = self._seen.setdefault(_content(equation), equation.outvars)
        if seen is not equation.outvars:
            self._same.update(zip(equation.outvars, seen, strict=True))
            return
        self._still.update(equation.outvars)
        self.steady.append(equation)
        if not self._from_own.isdisjoint(given):
            self._from_own.update(equation.outvars)
            if _computes(equation):
                self.once.update(equation.outvars)
                return
        self.each.append(equation)  # what only moves numbers costs nothing there


def _content(equation: JaxprEqn) -> Any:
    """Equal for operations of equal results; a function may have a derivative of its own."""
    if equation.primitive.name in CALLS:
        return id(equation)
    given = [v if isinstance(v, Var) else (str(v.val), v.aval) for v in equation.invars]
    return equation.primitive, str(equation.params), *given


def _computes(equation: JaxprEqn) -> bool:
    name = equation.primitive.name
    kinds = {v.aval.dtype for v in equation.outvars}  # pyright: ignore[reportAttributeAccessIssue]
    return (name in EXPRESSIONS or name in CALLS) and kinds.issubset(NUMBERS)


def _read(equations: Iterable[JaxprEqn]) -> list[Any]:
    return [v for equation in equations for v in equation.invars]


def _used(equations: Sequence[JaxprEqn], results: Iterable[Any]) -> list[JaxprEqn]:
    """Those on which some results depend."""
    found, open_ = [], {v for v in results if isinstance(v, Var)}
    for equation in reversed(equations):
        if not open_.isdisjoint(equation.outvars):
            found.append(equation)
            open_.update(v for v in equation.invars if isinstance(v, Var))
    return found[::-1]


def _size(variables: Iterable[Var], members: int) -> int:
    shapes = (v.aval.shape for v in variables)  # pyright: ignore[reportAttributeAccessIssue]
    return sum(numbers(shape, members) for shape in shapes)
