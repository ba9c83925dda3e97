"""Statements of CUDA C for a jaxpr of scalars."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Var

from ._cuda_sincos import SINCOS
from ._lane_arithmetic import EXPRESSIONS, TYPES


Source = Mapping[Var, JaxprEqn]  # of what it is the result


# Of the operations that CUDA C has no sign and no function for.
PRELUDE = (
    """
#define NOT_A_NUMBER __int_as_float(0x7fffffff)
template <int N, typename T> __device__ T integer_power(T x) {
    if constexpr (N < 0) return 1 / integer_power<-N>(x);
    else if constexpr (N == 0) return 1;
    else if constexpr (N % 2) return x * integer_power<N - 1>(x);
    else return integer_power<N / 2>(x * x);
}
// A member that is nan stays nan: the maximum of CUDA would hide it.
template <typename T> __device__ T larger(T a, T b) { return a > b || a != a ? a : b; }
template <typename T> __device__ T smaller(T a, T b) { return a < b || a != a ? a : b; }
// What passes a limit, in reverse; with one instruction less than a compiler finds.
template <typename T> __device__ T within(T low, T x, T high, T then) {
    return x > low && x < high ? then : 0;
}
#if __CUDA_ARCH__ >= 800
template <> __device__ float within(float low, float x, float high, float then) {
    float y;
    asm("{ .reg .pred p; setp.gt.f32 p, %1, %2; setp.lt.and.f32 p, %1, %3, p; "
        "selp.f32 %0, %4, 0f00000000, p; }"
        : "=f"(y) : "f"(x), "f"(low), "f"(high), "f"(then));
    return y;
}
template <> __device__ float larger(float a, float b) {
    float c;
    asm("max.NaN.f32 %0, %1, %2;" : "=f"(c) : "f"(a), "f"(b));
    return c;
}
template <> __device__ float smaller(float a, float b) {
    float c;
    asm("min.NaN.f32 %0, %1, %2;" : "=f"(c) : "f"(a), "f"(b));
    return c;
}
#endif
// Memory on its way to a warp: `rows` of its numbers, each `apart` from the one before.
template <typename T> __device__ void fetch(const T *first, int rows, int apart) {
#ifdef __CUDA_ARCH__
    constexpr int lines = sizeof(T) / 4, bytes = 128;
    for (int k = threadIdx.x % 32; k < rows * lines; k += 32) {
        const char *place = (const char *)(first + k / lines * apart) + k % lines * bytes;
        asm volatile("prefetch.global.L1 [%0];" :: "l"(place));
    }
#endif
}
"""
    + SINCOS
)


def type_of(kind: np.dtype) -> str:
    """The type in C."""
    return TYPES[kind.name]


def number(value: Any, kind: np.dtype) -> str:
    """A constant in C, to the last bit."""
    if kind.kind == "b":
        return "true" if value else "false"
    if kind.kind in "iu":
        return f"({type_of(kind)}){int(value)}LL"
    x = float(value)
    if np.isfinite(x):
        text = x.hex()
    else:
        text = "NOT_A_NUMBER" if np.isnan(x) else "1e308 * 10" if x > 0 else "-1e308 * 10"
    return f"({type_of(kind)})({text})"


def statements(jaxpr: ClosedJaxpr, args: Sequence[str], prefix: str) -> tuple[list[str], list[str]]:
    """The lines that compute a jaxpr of scalars, and what its results are called.

    The arguments are called `args`; what is new begins with the `prefix`.
    """
    return _Writer(prefix).write(jaxpr, args)


class _Writer:
    def __init__(self, prefix: str):
        self.prefix = prefix
        self.lines: list[str] = []

    def write(self, jaxpr: ClosedJaxpr, args: Sequence[str]) -> tuple[list[str], list[str]]:
        body = jaxpr.jaxpr
        names = dict(zip(body.invars, args, strict=True))
        for v, value in zip(body.constvars, jaxpr.consts, strict=True):
            names[v] = number(value, v.aval.dtype)  # pyright: ignore[reportAttributeAccessIssue]
        source = {v: equation for equation in body.eqns for v in equation.outvars}
        for equation in _in_order(body.outvars, source):
            self._statement(equation, names, source)
        return self.lines, [_name(v, names) for v in body.outvars]

    def _statement(self, equation: JaxprEqn, names: dict[Var, str], source: Source) -> None:
        name, given = _shortened(equation, source)
        [out] = equation.outvars
        kind = type_of(out.aval.dtype)  # pyright: ignore[reportAttributeAccessIssue]
        text = EXPRESSIONS[name](kind, equation.params, *(_name(v, names) for v in given))
        names[out] = f"{self.prefix}{len(self.lines)}"
        self.lines.append(f"const {kind} {names[out]} = {text};")


def _in_order(results: Sequence[Any], source: Source) -> list[JaxprEqn]:
    """Each equation just before the first result that needs it.

    A compiler keeps the order of a long text to some degree: numbers that are computed late are
    held in registers for a shorter time.
    """
    found: dict[int, JaxprEqn] = {}
    for v in results:
        open_ = [source[v]] if isinstance(v, Var) and v in source else []
        while open_:
            given = _shortened(open_[-1], source)[1]
            needs = [source[x] for x in given if isinstance(x, Var) and x in source]
            missing = [x for x in needs if id(x) not in found]
            if missing:
                open_.append(missing[0])
            else:
                equation = open_.pop()
                found[id(equation)] = equation
    return list(found.values())


def _shortened(equation: JaxprEqn, source: Source) -> tuple[str, list]:
    """The name in `EXPRESSIONS` of what an operation is, and what that is given.

    Small groups, as derivatives make them, are one expression.
    """
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
    given = [above[1], above[0], below[1], *then]
    return ("within", given) if len({v.aval.dtype for v in given}) == 1 else None


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


def _name(v: Any, names: dict[Var, str]) -> str:
    if isinstance(v, Literal):
        return number(v.val, v.aval.dtype)  # pyright: ignore[reportAttributeAccessIssue]
    return names[v]
