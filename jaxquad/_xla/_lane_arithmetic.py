"""Arithmetic between lanes that Triton compiles, with the nan of `jax.lax`."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import JaxprEqn


Lane = Any  # traced [block] or (), or a NumPy scalar
lax = jax.lax


def _bound(equation: JaxprEqn, *row: Lane) -> Lane:
    return equation.primitive.bind(*row, **equation.params)


def _larger(a: Lane, b: Lane) -> Lane:
    # The maximum of Triton ignores a nan, which would hide a member that diverges.
    return lax.select((a > b) | (a != a), a, b)


def _smaller(a: Lane, b: Lane) -> Lane:
    return lax.select((a < b) | (a != a), a, b)


def _clamp(_: JaxprEqn, low: Lane, x: Lane, high: Lane) -> Lane:
    return lax.select(x < low, low, lax.select(x > high, high, x))


def _select(_: JaxprEqn, which: Lane, *cases: Lane) -> Lane:
    if which.dtype == bool:
        return lax.select(which, cases[1], cases[0])
    found = cases[0]
    for k, case in enumerate(cases[1:], 1):
        found = lax.select(which >= k, case, found)
    return found


def _round(equation: JaxprEqn, x: Lane) -> Lane:
    away = jnp.sign(x) * jnp.floor(jnp.abs(x) + 0.5)
    if equation.params["rounding_method"] == lax.RoundingMethod.AWAY_FROM_ZERO:
        return away
    halfway = jnp.abs(x) - jnp.floor(jnp.abs(x)) == 0.5
    even = 2 * jnp.floor(away * 0.5) == away
    return lax.select(halfway & ~even, away - jnp.sign(x), away)


_AS_IN_TRITON = """
    abs neg ceil floor exp exp2 expm1 log log1p sqrt square pow cbrt rsqrt sin cos tan asin acos
    atan atan2 sinh cosh tanh asinh acosh atanh add sub mul div rem and or xor not eq ne gt ge lt le
    add_any integer_pow logistic is_finite sign convert_element_type
""".split()
_WRITTEN: dict[str, Callable[..., Lane]] = {
    "max": lambda _, a, b: _larger(a, b),
    "min": lambda _, a, b: _smaller(a, b),
    "clamp": _clamp,
    "select_n": _select,
    "round": _round,
}
ARITHMETIC: dict[str, Callable[..., Lane]] = dict.fromkeys(_AS_IN_TRITON, _bound) | _WRITTEN

_PAIRS: dict[str, Callable[[Lane, Lane], Lane]] = {
    "reduce_sum": lambda a, b: a + b,
    "reduce_prod": lambda a, b: a * b,
    "reduce_max": lambda a, b: _larger(a, b),
    "reduce_min": lambda a, b: _smaller(a, b),
    "reduce_and": lambda a, b: a & b,
    "reduce_or": lambda a, b: a | b,
}


def reduction(name: str) -> Callable[[Lane, Lane], Lane]:
    """What a reduction does with two numbers."""
    return _PAIRS[name]


_KNOWN: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "lt": np.less, "le": np.less_equal,
    "gt": np.greater, "ge": np.greater_equal, "eq": np.equal, "ne": np.not_equal,
    "and": np.bitwise_and, "or": np.bitwise_or, "not": np.invert, "neg": np.negative,
    "max": np.maximum, "min": np.minimum, "convert_element_type": lambda x: x,
    "select_n": lambda which, *cases: cases[int(which)],
    "clamp": lambda low, x, high: np.minimum(np.maximum(low, x), high),
}  # fmt: skip


def folded(equation: JaxprEqn, row: Sequence[Lane]) -> np.generic | None:
    """The result where all numbers are known while tracing, as indices and masks are."""
    name = equation.primitive.name
    if name not in _KNOWN or not all(isinstance(x, np.generic) for x in row):
        return None
    kind = equation.outvars[0].aval.dtype  # pyright: ignore[reportAttributeAccessIssue]
    with np.errstate(all="ignore"):
        return np.dtype(kind).type(_KNOWN[name](*row))
