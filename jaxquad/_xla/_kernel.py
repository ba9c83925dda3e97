"""A whole time loop as one compiled kernel on a CPU.

XLA's CPU runtime dispatches every small operation of a loop by itself, which costs more than the
arithmetic of one vehicle does. A call with two attributes becomes one kernel instead. They are
internal to XLA: on other devices, for computations that such a kernel cannot hold, and where JAX
or XLA does not know them, the loop is compiled as any other.
"""

import functools as ft
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree


try:
    from ._marks import enter, leave
except Exception:  # JAX's interfaces to its compiler are not stable ones: they may be elsewhere.
    enter = leave = None


def as_one_kernel(function: Callable[..., PyTree], *args: PyTree) -> PyTree:
    """`function(*args)`, compiled as one kernel if it can be; the arguments are arrays.

    So are its derivatives: what is differentiated is marked where it enters and where it leaves,
    and each mark is the transpose of the other.
    """
    if enter is None or leave is None:
        _say_so()
        return function(*args)

    def jaxquad_kernel(*args: PyTree) -> PyTree:
        return function(*args)

    entered = jax.tree.map(_marked(enter), args)
    return jax.tree.map(_marked(leave), jax.jit(jaxquad_kernel)(*entered))


def has_kernels() -> bool:
    """Whether this JAX has what a kernel is marked with."""
    return enter is not None and leave is not None


@ft.cache
def _say_so() -> None:
    if jax.default_backend() == "cpu":
        message = "loops take several times as long: this JAX lacks what makes them one kernel"
        warnings.warn(f"{message} (jax {jax.__version__})", stacklevel=2)


def _marked(mark: Any) -> Callable[[Array], Array]:
    return lambda x: mark.bind(x) if jnp.issubdtype(x.dtype, jnp.floating) else x
