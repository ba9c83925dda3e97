"""Arithmetic between lanes as expressions of CUDA C, with the nan of `jax.lax`."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import JaxprEqn, Primitive


Lane = Any  # traced (), or a NumPy scalar
Expression = Callable[..., str]  # of the result's type, the equation's parameters, and operands
lax = jax.lax

TYPES = {
    "bool": "bool", "float32": "float", "float64": "double", "int32": "int", "int64": "long long",
    "uint32": "unsigned",
}  # fmt: skip
_FLOATS = ("float", "double")


def _between(sign: str) -> Expression:
    return lambda kind, params, a, b: f"{a} {sign} {b}"


def _function(name: str) -> Expression:
    return lambda kind, params, *given: f"{name}({', '.join(given)})"


def _absolute(kind: str, params: dict, x: str) -> str:
    return f"fabs({x})" if kind in _FLOATS else f"{x} < 0 ? -{x} : {x}"


def _remainder(kind: str, params: dict, a: str, b: str) -> str:
    return f"fmod({a}, {b})" if kind in _FLOATS else f"{a} % {b}"


def _select(kind: str, params: dict, which: str, first: str, *cases: str) -> str:
    for k, case in enumerate(cases, 1):
        first = f"({which} >= {k} ? {case} : {first})"
    return first


def _quotient_of_choices(
    kind: str, params: dict, over: str, n0: str, n1: str, under: str, d0: str, d1: str
) -> str:
    return f"{over} ? ({under} ? {n1} / {d1} : {n1} / {d0}) : ({under} ? {n0} / {d1} : {n0} / {d0})"


def _round(kind: str, params: dict, x: str) -> str:
    away = params["rounding_method"] == lax.RoundingMethod.AWAY_FROM_ZERO
    return f"{'round' if away else 'rint'}({x})"


def _converted(kind: str, params: dict, x: str) -> str:
    return f"{x} != 0" if kind == "bool" else f"({kind}){x}"


_SIGNS = {
    "add": "+", "add_any": "+", "sub": "-", "mul": "*", "div": "/", "and": "&", "or": "|",
    "xor": "^", "eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">=",
}  # fmt: skip
_SAME_IN_C = """
    ceil floor exp exp2 expm1 log log1p sqrt cbrt sin cos tan asin acos atan atan2 sinh cosh tanh
    asinh acosh atanh erf erfc
""".split()
_WRITTEN: dict[str, Expression] = {
    "abs": _absolute,
    "clamp": lambda kind, params, low, x, high: f"smaller(larger({x}, {low}), {high})",
    "convert_element_type": _converted,
    "integer_pow": lambda kind, params, x: f"integer_power<{params['y']}>({x})",
    "is_finite": lambda kind, params, x: f"{x} - {x} == 0",
    "logistic": lambda kind, params, x: f"1 / (1 + exp(-{x}))",
    "max": _function("larger"),
    "min": _function("smaller"),
    "neg": lambda kind, params, x: f"-{x}",
    "not": lambda kind, params, x: f"!{x}" if kind == "bool" else f"~{x}",
    "quotient_of_choices": _quotient_of_choices,
    "pow": lambda kind, params, x, y: f"pow({x}, ({kind}){y})",
    "rem": _remainder,
    "round": _round,
    "rsqrt": lambda kind, params, x: f"1 / sqrt({x})",
    "select_n": _select,
    "sign": lambda kind, params, x: f"{x} > 0 ? 1 : {x} < 0 ? -1 : {x}",
    "within": _function("within"),
    "square": lambda kind, params, x: f"{x} * {x}",
}


def _of_one_number(name: str) -> Primitive:
    """An operation of lanes alone, which only CUDA C has a text for."""
    made = Primitive(name)
    made.def_abstract_eval(lambda x: x)
    return made


# In place of what a function does that names its argument so.
FUNCTIONS = {"sincos": (_of_one_number("sine_of"), _of_one_number("cosine_of"))}
EXPRESSIONS: dict[str, Expression] = (
    {name: _between(sign) for name, sign in _SIGNS.items()}
    | {name: _function(name) for name in _SAME_IN_C}
    | {each.name: _function(each.name) for known in FUNCTIONS.values() for each in known}
    | _WRITTEN
)

_PAIRS: dict[str, tuple[Callable, Callable]] = {
    "reduce_sum": (np.add, lax.add),
    "reduce_prod": (np.multiply, lax.mul),
    "reduce_max": (np.maximum, lax.max),
    "reduce_min": (np.minimum, lax.min),
    "reduce_and": (np.bitwise_and, lax.bitwise_and),
    "reduce_or": (np.bitwise_or, lax.bitwise_or),
}


def pair(name: str, a: Lane, b: Lane) -> Lane:
    """What a reduction does with two numbers."""
    known = isinstance(a, np.generic) and isinstance(b, np.generic)
    return _PAIRS[name][0 if known else 1](a, b)


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
