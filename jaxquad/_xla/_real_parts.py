"""Complex arithmetic as real arithmetic, which kernels hold and CPUs compute eight at a time.

XLA keeps the two parts of a complex number side by side, divides them one by one, and hands sines
and arctangents to a library that takes one number at a time.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal
from jaxtyping import Array, PyTree

from ._vector_functions import arctan2, sincos


Part = Any  # a real array or number; None stands for zeros


class Pair(NamedTuple):
    """A complex number."""

    real: Part
    imag: Part


Value = Any  # a real array or number, or a Pair


class NotInRealPartsError(Exception):
    """An operation that has to stay complex, or that a library computes, or a loop."""


def in_real_parts(function: Callable[..., PyTree], *args: PyTree) -> PyTree:
    """`function(*args)`, real at both ends, with complex numbers within computed as two real ones.

    What is computed twice is computed once. Raises `NotInRealPartsError` where an operation is not
    known here: those that a library computes, loops, and some functions of complex numbers.
    Quotients become products with one reciprocal, which loses them where a denominator's square
    overflows or underflows (1e-154 to 1e154): the result is then not finite.
    """
    leaves, structure = jax.tree.flatten(args)
    flat = lambda *xs: function(*jax.tree.unflatten(structure, xs))
    closed, shape = jax.make_jaxpr(flat, return_shape=True)(*leaves)
    found = _Evaluation().run(closed, leaves)
    return jax.tree.unflatten(jax.tree.structure(shape), found)


class _Evaluation:
    """Of one function. Slopes by several parameters share much: what is known is found again."""

    def __init__(self):
        self.known: dict[tuple, tuple[list[Value], list[Value]]] = {}

    def run(self, closed: ClosedJaxpr | Jaxpr, args: Sequence[Value]) -> list[Value]:
        jaxpr, consts = (
            (closed.jaxpr, closed.consts) if isinstance(closed, ClosedJaxpr) else (closed, ())
        )
        values = dict(zip(jaxpr.constvars, map(_split_number, consts), strict=True))
        values.update(zip(jaxpr.invars, args, strict=True))
        read = lambda v: _split_number(v.val) if isinstance(v, Literal) else values[v]
        for equation in jaxpr.eqns:
            found = self._apply(equation, [read(v) for v in equation.invars])
            values.update(zip(equation.outvars, found, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def _apply(self, equation: JaxprEqn, args: list[Value]) -> list[Value]:
        name, params = equation.primitive.name, equation.params
        if name in _INLINED:
            return self.run(params[_INLINED[name]], args)
        key = (name, str(params), *map(_identity, args))
        if key not in self.known:
            found = _compute(equation, args)
            self.known[key] = args, found  # holding the arguments keeps their ids their own
        return self.known[key][1]


def _compute(equation: JaxprEqn, args: list[Value]) -> list[Value]:
    name = equation.primitive.name
    complex_ends = any(_is_complex(v) for v in (*equation.invars, *equation.outvars))
    if not complex_ends:
        return _compute_real(equation, args)
    if name in _MOVES:
        return [_move(equation, args)]
    if name not in _COMPLEX:
        raise NotInRealPartsError(name)
    given = [equation.params["y"]] if name == "integer_pow" else []
    found = _COMPLEX[name](*args, *given)
    return [_zeros_like(equation.outvars[0]) if found is None else found]


def _compute_real(equation: JaxprEqn, args: list[Value]) -> list[Value]:
    name, params = equation.primitive.name, equation.params
    if name in _FASTER and equation.outvars[0].aval.dtype == np.float64:  # pyright: ignore
        return [_FASTER[name](*args)]
    if name == "broadcast_in_dim" and not isinstance(args[0], jax.Array) and not np.ndim(args[0]):
        return [np.full(params["shape"], args[0])]  # so that zeros are known as such
    if name not in _MOVES and name not in _REAL:
        raise NotInRealPartsError(name)
    return [equation.primitive.bind(*args, **params)]


def _move(equation: JaxprEqn, args: list[Value]) -> Pair:
    """What moves numbers, done to both parts."""
    params, parts = dict(equation.params), []
    kind = equation.outvars[0].aval.dtype  # pyright: ignore[reportAttributeAccessIssue]
    if "new_dtype" in params:
        params["new_dtype"] = np.zeros(0, kind).real.dtype
    for k in (0, 1):
        mine = [_part_of(v, x, k) for v, x in zip(equation.invars, args, strict=True)]
        if all(x is None for x in mine):
            parts.append(None)
            continue
        pairs = zip(equation.invars, mine, strict=True)
        filled = [_zeros_like(v) if x is None else x for v, x in pairs]
        parts.append(equation.primitive.bind(*filled, **params))
    return Pair(*parts)


def _zeros_like(variable: Any) -> Array:
    return jnp.zeros(variable.aval.shape, np.zeros(0, variable.aval.dtype).real.dtype)


def _part_of(variable: Any, value: Value, k: int) -> Part:
    """An index or a condition is the same for both parts; a real number has one of them."""
    if isinstance(value, Pair):
        return value[k]
    is_number = np.issubdtype(variable.aval.dtype, np.floating)
    return None if k == 1 and is_number else value


def _is_complex(variable: Any) -> bool:
    return np.issubdtype(variable.aval.dtype, np.complexfloating)


def _split_number(value: Any) -> Value:
    if not np.iscomplexobj(value):
        return value
    return Pair(_unless_zero(np.real(value)), _unless_zero(np.imag(value)))


def _unless_zero(part: Part) -> Part:
    known = part is not None and not isinstance(part, jax.Array)
    return None if known and not np.any(part) else part


def _identity(value: Value) -> Value:
    if isinstance(value, Pair):
        return tuple(map(_identity, value))
    is_number = value is not None and not isinstance(value, jax.Array) and not np.ndim(value)
    return (str(np.asarray(value).dtype), repr(value)) if is_number else id(value)


def _add(a: Part, b: Part) -> Part:
    return b if a is None else a if b is None else a + b


def _subtract(a: Part, b: Part) -> Part:
    return a if b is None else -b if a is None else a - b


def _multiply(a: Part, b: Part) -> Part:
    return None if a is None or b is None else a * b


def _product(a: Pair, b: Pair) -> Pair:
    real = _subtract(_multiply(a.real, b.real), _multiply(a.imag, b.imag))
    return Pair(real, _add(_multiply(a.real, b.imag), _multiply(a.imag, b.real)))


def _power_of_size(a: Pair) -> Part:
    return _add(_multiply(a.real, a.real), _multiply(a.imag, a.imag))


def _reciprocal(a: Pair) -> Pair:
    power = _power_of_size(a)
    if power is None:
        raise NotInRealPartsError("a quotient by zero")
    inverse = 1 / power
    return Pair(_multiply(a.real, inverse), _negative(_multiply(a.imag, inverse)))


def _negative(a: Part) -> Part:
    return None if a is None else -a


def _power(a: Pair, exponent: int) -> Pair:
    if exponent < 0:
        return _power(_reciprocal(a), -exponent)
    if exponent < 2:
        return a if exponent else Pair(jnp.ones_like(_add(a.real, a.imag)), None)
    half = _power(a, exponent // 2)
    whole = _product(half, half)
    return _product(whole, a) if exponent % 2 else whole


def _exponential(a: Pair) -> Pair:
    if a.imag is None:
        raise NotInRealPartsError("an exponential of a real number")
    size = None if a.real is None else jnp.exp(a.real)
    sine, cosine = sincos(a.imag)
    return Pair(cosine, sine) if size is None else Pair(size * cosine, size * sine)


def _logarithm(a: Pair) -> Pair:
    if a.real is None or a.imag is None:
        raise NotInRealPartsError("a logarithm of a real number")
    return Pair(0.5 * jnp.log(_power_of_size(a)), arctan2(a.imag, a.real))


def _join(real: Part, imag: Part) -> Pair:
    return Pair(_unless_zero(real), _unless_zero(imag))


_COMPLEX = {
    "add": lambda a, b: Pair(_add(a.real, b.real), _add(a.imag, b.imag)),
    "add_any": lambda a, b: Pair(_add(a.real, b.real), _add(a.imag, b.imag)),
    "sub": lambda a, b: Pair(_subtract(a.real, b.real), _subtract(a.imag, b.imag)),
    "neg": lambda a: Pair(_negative(a.real), _negative(a.imag)),
    "mul": _product,
    "div": lambda a, b: _product(a, _reciprocal(b)),
    "integer_pow": _power,
    "square": lambda a: _product(a, a),
    "exp": _exponential,
    "log": _logarithm,
    "abs": lambda a: jnp.sqrt(_power_of_size(a)),
    "real": lambda a: a.real,
    "imag": lambda a: a.imag,
    "conj": lambda a: Pair(a.real, _negative(a.imag)) if isinstance(a, Pair) else Pair(a, None),
    "complex": _join,
}
_FASTER = {"sin": lambda x: sincos(x)[0], "cos": lambda x: sincos(x)[1], "atan2": arctan2}
_MOVES = set(
    """
    broadcast_in_dim concatenate convert_element_type copy dynamic_slice expand_dims pad reduce_sum
    reshape rev select_n slice squeeze stack stop_gradient transpose
    """.split()
)
_REAL = set(
    """
    abs add add_any and ceil clamp div eq exp exp2 expm1 floor ge gt integer_pow iota is_finite le
    log log1p logistic lt max min mul name ne neg not or pow reduce_max reduce_min round rsqrt sign
    sqrt square sub tanh
    """.split()
)
_INLINED = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
}
