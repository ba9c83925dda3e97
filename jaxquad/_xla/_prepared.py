"""Programs of arrays alone, found by all else that is in the arguments.

`eqx.filter_jit` takes arguments apart and puts results together in Python, each leaf by itself,
which takes as long as a flight of some hundred samples.
"""

import functools as ft
import logging
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree


_KEPT = 256  # programs of a function
_ARRAYS = jax.Array, np.ndarray, np.generic  # as for `eqx.is_array`


class Prepared:
    """`jax.jit` of `function` by the arrays in its arguments, one for each set of other leaves.

    Arguments are given as `jax.tree.flatten` takes them apart.
    """

    def __init__(self, function: Callable[..., PyTree], options: Callable[[], dict[str, Any]]):
        self._program = ft.lru_cache(_KEPT)(ft.partial(_program, function, options))

    def __call__(self, leaves: Sequence[Any], structure: PyTree) -> PyTree:
        """The result, when it is there: errors of what runs are raised here."""
        arrays, others = _apart(leaves)
        with _Silence():
            found, rest = self._program(structure, others)(arrays)
            if found:
                found[0].block_until_ready()
        return rest.whole(found)

    def lower(self, leaves: Sequence[Any], structure: PyTree) -> jax.stages.Lowered:
        """What the first call with such arguments compiles."""
        arrays, others = _apart(leaves)
        return self._program(structure, others).lower(arrays)


Others = tuple[Any, ...]  # at the places of arrays None, else what is there, with its type


def _apart(leaves: Sequence[Any]) -> tuple[list[Any], Others]:
    arrays = [x for x in leaves if isinstance(x, _ARRAYS)]
    if len(arrays) == len(leaves):
        return arrays, ()
    return arrays, tuple([None if isinstance(x, _ARRAYS) else (type(x), x) for x in leaves])


def _together(arrays: Sequence[Any], others: Others) -> Sequence[Any]:
    given = iter(arrays)
    return [next(given) if x is None else x[1] for x in others] if others else arrays


@jax.tree_util.register_static
class _Rest:
    """All of a result but its arrays."""

    def __init__(self, structure: PyTree, others: Others):
        self._structure, self._others = structure, others

    def whole(self, arrays: Sequence[Any]) -> PyTree:
        return jax.tree.unflatten(self._structure, _together(arrays, self._others))


def _program(
    function: Callable[..., PyTree],
    options: Callable[[], dict[str, Any]],
    structure: PyTree,
    others: Others,
) -> jax.stages.Wrapped:
    def run(arrays: list[Any]) -> tuple[list[Any], _Rest]:
        given = jax.tree.unflatten(structure, _together(arrays, others))
        leaves, form = jax.tree.flatten(function(*given))
        found, rest = _apart(leaves)
        return found, _Rest(form, rest)

    run.__name__ = function.__name__
    return jax.jit(run, compiler_options=options() or None)


_CALLBACKS = logging.getLogger("jax._src.callback")


class _Silence:
    """JAX logs what a callback raises, beside raising it."""

    def __enter__(self) -> None:
        _CALLBACKS.addFilter(self)

    def __exit__(self, *_: object) -> None:
        _CALLBACKS.removeFilter(self)

    def filter(self, record: logging.LogRecord) -> bool:
        return False
