"""Small groups of operations, as derivatives make them, that CUDA C does in one expression."""

from collections.abc import Mapping
from typing import Any

from jax.extend.core import JaxprEqn, Literal, Var


Source = Mapping[Var, JaxprEqn]  # of what it is the result


def shortened(equation: JaxprEqn, source: Source) -> tuple[str, list]:
    """The name in `EXPRESSIONS` of what an operation is, and what that is given."""
    name = equation.primitive.name
    rule = _RULES.get(name)
    found = None if rule is None else rule(equation.invars, source)
    return (name, equation.invars) if found is None else found


def _slope_of_clamp(given: list, source: Source) -> tuple[str, list] | None:
    """`then` where low < x < high, else 0."""
    which, zero, *then = given
    one, other = _given_to("and", which, source) or (None, None)
    above, below = _given_to("gt", one, source), _given_to("lt", other, source)
    if not (_is_zero(zero) and above and below and above[0] is below[0] and len(then) == 1):
        return None
    return "within", [above[1], above[0], below[1], *then]


def _slope_of_extreme(given: list, source: Source) -> tuple[str, list] | None:
    """1, 1/2 where both are as large, or 0: JAX writes it as a quotient of two choices."""
    choices = [_given_to("select_n", v, source) for v in given]
    numbers = [v for choice in choices for v in choice[1:]]
    if len(numbers) != 4 or not all(isinstance(v, Literal) for v in numbers):
        return None
    return "quotient_of_choices", [v for choice in choices for v in choice]


_RULES = {"select_n": _slope_of_clamp, "div": _slope_of_extreme}


def _is_zero(v: Any) -> bool:
    return isinstance(v, Literal) and not isinstance(v.val, bool) and bool(v.val == 0)


def _given_to(name: str, v: Any, source: Source) -> list:
    """The arguments of the operation of that name that `v` is the result of; none of another."""
    equation = source.get(v) if isinstance(v, Var) else None
    return equation.invars if equation is not None and equation.primitive.name == name else []
