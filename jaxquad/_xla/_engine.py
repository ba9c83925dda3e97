"""How loops are compiled where the library owns the outermost jit."""

import functools as ft
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from jaxquad._core import is_concrete

from ._kernel import has_kernels


class Engine(NamedTuple):
    """What loops are compiled with here."""

    platform: str
    one_kernel: bool  # a loop is one kernel of plain vector code, if it is plain arithmetic
    vector_bits: int | None  # of a jit with `compiler_options()`; None for the compiler's choice


_WIDEST = {"xla_cpu_prefer_vector_width": 512}  # bits; LLVM takes half of what a CPU can, unasked


class Jit:
    """`eqx.filter_jit` of a function that loops, with the compiler's options for loops.

    JAX takes options of an outermost jit only: within another, such as a user's, this one has none,
    and `compiler_options()` are there to be given to that one.
    """

    def __init__(self, function: Callable[..., PyTree]):
        ft.update_wrapper(self, function)
        self._plain = eqx.filter_jit(function)
        self._function = function

    @ft.cached_property
    def _tuned(self) -> Any:
        options = compiler_options()
        given: dict[str, Any] = {"compiler_options": options} if options else {}
        return eqx.filter_jit(self._function, **given)

    def __call__(self, *args: PyTree) -> PyTree:
        if not _is_outermost(args):
            return self._plain(*args)
        return self._tuned(*args)

    def lower(self, *args: PyTree) -> Any:
        return (self._tuned if _is_outermost(args) else self._plain).lower(*args)


def compiler_options() -> dict[str, int]:
    """What to give `jax.jit(..., compiler_options=...)` around a loop; empty where nothing helps.

    On a CPU, 512-bit vectors; warns, once, if this XLA does not know the option.
    """
    return dict(_known()) if jax.default_backend() == "cpu" else {}


def engine() -> Engine:
    """How fast loops can be here: a CPU's XLA may lack what makes them so. It changes no result."""
    platform = jax.default_backend()
    bits = compiler_options().get("xla_cpu_prefer_vector_width")
    return Engine(platform, platform == "cpu" and has_kernels(), bits)


@ft.cache
def _known() -> tuple[tuple[str, int], ...]:
    try:
        jax.jit(lambda: 0, compiler_options=_WIDEST).lower().compile()
    except Exception as error:
        warnings.warn(
            f"loops run up to a tenth slower: this jaxlib refuses {_WIDEST} ({error})", stacklevel=2
        )
        return ()
    return tuple(_WIDEST.items())


def _is_outermost(args: PyTree) -> bool:
    # Within another jit even a constant is traced.
    arrays = filter(eqx.is_array, (jnp.zeros(()), *jax.tree.leaves(args)))
    return all(map(is_concrete, arrays))
