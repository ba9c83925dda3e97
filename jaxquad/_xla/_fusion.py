"""Expensive operations computed once: what a CPU's compiler fuses, it computes for each user anew.

Derivatives share exponentials and quotients with the response. Fused into ten outputs, each of them
computes them again.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import Jaxpr, JaxprEqn, Literal
from jaxtyping import PyTree


Value = Any  # an array, or the number of a literal


def no_fuse(function: Callable[..., PyTree], *args: PyTree) -> PyTree:
    """`function(*args)` as a call that the CPU's compiler does not fuse with what is around it."""

    def run(*args: PyTree) -> PyTree:
        with set_xla_metadata(inlineable="true"):  # `jnp.where` and its like are calls themselves
            return function(*args)

    with set_xla_metadata(inlineable="false"):
        return jax.jit(run)(*args)


_COSTLY = {"exp", "log", "sin", "cos", "tan", "div", "atan2", "sqrt", "rsqrt", "pow", "tanh"}
_INLINED = {"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr"}
_LARGE = 1024  # elements, from which on no call costs more than recomputing


def evaluate_once(function: Callable[..., PyTree], *, least: int) -> Callable[..., PyTree]:
    """See the door's, `jaxquad._compile.evaluate_once`."""
    if jax.default_backend() != "cpu":
        return function

    def run(*args: PyTree) -> PyTree:
        leaves, structure = jax.tree.flatten(args)
        flat = lambda *xs: function(*jax.tree.unflatten(structure, xs))
        closed, shape = jax.make_jaxpr(flat, return_shape=True)(*leaves)
        values = _evaluate(closed.jaxpr, closed.consts, leaves, _Computed(least, {}))
        return jax.tree.unflatten(jax.tree.structure(shape), values)

    return run


class _Computed(NamedTuple):
    """What has been computed, of arrays of so many elements at least."""

    least: int
    values: dict[tuple, tuple[Sequence[Value], list[Value]]]


def _evaluate(
    jaxpr: Jaxpr, consts: Sequence[Value], args: Sequence[Value], computed: _Computed
) -> list[Value]:
    values = dict(zip(jaxpr.constvars, consts, strict=True))
    values.update(zip(jaxpr.invars, args, strict=True))
    read = lambda var: var.val if isinstance(var, Literal) else values[var]
    for equation in jaxpr.eqns:
        results = _apply(equation, [read(var) for var in equation.invars], computed)
        values.update(zip(equation.outvars, results, strict=True))
    return [read(var) for var in jaxpr.outvars]


def _apply(equation: JaxprEqn, args: list[Value], computed: _Computed) -> list[Value]:
    name, params = equation.primitive.name, equation.params
    if name in _INLINED:
        inner = params[_INLINED[name]]
        if _stays_a_call(equation):
            return _remembered(("call", id(inner)), args, computed, lambda: _bind(equation, args))
        return _evaluate(inner.jaxpr, inner.consts, args, computed)
    if equation.primitive.multiple_results:
        return _bind(equation, args)
    return _remembered(
        (name, str(params)), args, computed, lambda: [_single(equation, args, computed)]
    )


def _stays_a_call(equation: JaxprEqn) -> bool:
    """Whether `no_fuse` keeps apart what takes longer than a call."""
    sizes = [var.aval.size for var in equation.outvars]  # pyright: ignore[reportAttributeAccessIssue]
    is_marked = (equation.ctx.xla_metadata or {}).get("inlineable") == "false"
    return is_marked and max(sizes) >= _LARGE


def _remembered(
    what: tuple, args: Sequence[Value], computed: _Computed, compute: Callable[[], list[Value]]
) -> list[Value]:
    """The slopes by each parameter were traced apart: what they share has to be found again."""
    key = (*what, *(_identity(arg) for arg in args))
    if key not in computed.values:
        computed.values[key] = args, compute()  # holding the arguments keeps their ids their own
    return computed.values[key][1]


def _identity(arg: Value) -> Value:
    # Literals are new objects at every place where they stand.
    is_number = isinstance(arg, np.ndarray | np.generic) and arg.ndim == 0
    return (str(arg.dtype), repr(arg.item())) if is_number else id(arg)


def _single(equation: JaxprEqn, args: list[Value], computed: _Computed) -> Value:
    name, params = equation.primitive.name, equation.params
    if equation.outvars[0].aval.size < computed.least:  # pyright: ignore[reportAttributeAccessIssue]
        return _bind(equation, args)[0]
    if name == "div" and jnp.iscomplexobj(args[1]):
        return args[0] * _reciprocal_of(args[1], computed)
    if name == "integer_pow" and params["y"] < 0 and jnp.iscomplexobj(args[0]):
        return jax.lax.integer_pow(_reciprocal_of(args[0], computed), -params["y"])
    if name in _COSTLY:
        return no_fuse(lambda *xs: _bind(equation, xs)[0], *args)
    return _bind(equation, args)[0]


def _bind(equation: JaxprEqn, args: Sequence[Value]) -> list[Value]:
    bound = equation.primitive.get_bind_params(equation.params)
    functions, params = bound if isinstance(bound, tuple) else ((), bound)  # before jax 0.10, both
    with equation.ctx.manager:  # without it `no_fuse` would be lost
        results = equation.primitive.bind(*functions, *args, **params)
    return list(results) if equation.primitive.multiple_results else [results]


def _reciprocal_of(value: Any, computed: _Computed) -> Value:
    return _remembered(("reciprocal",), [value], computed, lambda: [no_fuse(_reciprocal, value)])[0]


def _reciprocal(value: Value) -> Value:
    squared = jnp.real(value) ** 2 + jnp.imag(value) ** 2
    return jax.lax.complex(jnp.real(value) / squared, -jnp.imag(value) / squared)
