"""Functions that are written anew each time, a lambda in a loop, compiled once."""

import functools as ft
from collections.abc import Callable, Sequence

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, jaxpr_as_fun
from jaxtyping import PyTree


_KEPT = 256  # programs


def run_shared(
    function: Callable[..., PyTree], calls: Sequence[tuple[PyTree, ...]]
) -> list[PyTree]:
    """`function(*call)` of each call, by a program that all functions of the same operations share.

    `jax.jit` compiles each function object anew, and keeps what a global or a closure held when it
    was traced. Here a function is traced each time, once for all calls, which takes some
    milliseconds. The calls have equal shapes.
    """
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*calls[0])
    structure = jax.tree.structure(shape)
    if _holds_constants(closed.jaxpr):
        run, first = jax.jit(jaxpr_as_fun(closed)), ()
    else:
        run, first = _program(_Text(closed.jaxpr)), (closed.consts,)
    return [jax.tree.unflatten(structure, run(*first, *jax.tree.leaves(call))) for call in calls]


class _Text:
    """Operations, equal where they read the same; constants are arguments beside them."""

    def __init__(self, jaxpr: Jaxpr):
        self.jaxpr = jaxpr
        self._key = str(jaxpr)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Text) and self._key == other._key


@ft.lru_cache(maxsize=_KEPT)
def _program(text: _Text) -> Callable[..., list]:
    def run(consts, *leaves):
        return jaxpr_as_fun(ClosedJaxpr(text.jaxpr, consts))(*leaves)

    return jax.jit(run)


def _holds_constants(jaxpr: Jaxpr) -> bool:
    """Whether an inner function carries arrays, which the text does not show."""
    inner = [
        part
        for equation in jaxpr.eqns
        for value in equation.params.values()
        for part in (value if isinstance(value, tuple | list) else (value,))
    ]
    closed = [part for part in inner if isinstance(part, ClosedJaxpr)]
    return any(each.consts or _holds_constants(each.jaxpr) for each in closed)
