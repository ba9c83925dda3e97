"""A whole time loop as one compiled kernel on a CPU.

XLA's CPU runtime dispatches every small operation of a loop by itself, which costs more than the
arithmetic of one vehicle does. A call with two attributes becomes one kernel instead. They are
internal to XLA, so they are used only where the installed version is known to take them, and what
goes in is bounded; all else is compiled as any other program.
"""

import sys
from collections.abc import Callable

import jax
import jax.extend
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ._canary import why_not_trusted
from ._switch import device_kernels, is_off, warn_once


try:
    from ._kernel_limits import WIDEST
    from ._marks import enter, leave
except (ImportError, AttributeError) as error:  # JAX's interfaces to its compiler may move.
    enter = leave = None
    WIDEST = sys.maxsize
    _MISSING = f"this JAX ({jax.__version__}) lacks what kernels are made with ({error})"
else:
    _MISSING = None


def as_one_kernel(function: Callable[..., PyTree], *args: PyTree) -> PyTree:
    """`function(*args)`, compiled as one kernel if it can be; the arguments are arrays.

    So are its derivatives: what is differentiated is marked where it enters and where it leaves,
    and each mark is the transpose of the other.
    """
    if enter is None or leave is None or why_no_kernels() is not None:
        return function(*args)

    def jaxquad_kernel(*args: PyTree) -> PyTree:
        return function(*args)

    entered = jax.tree.map(_marked(enter), args)
    return jax.tree.map(_marked(leave), jax.jit(jaxquad_kernel)(*entered))


def apart_in_reverse(function: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """`function` of a kernel, which is kernels of its own where it is computed again and reversed.

    Two cores compile these two at once, and the time of both grows faster than their operations.
    """

    def jaxquad_block(*args: PyTree) -> PyTree:
        return function(*args)

    return jax.jit(jaxquad_block)


def why_no_kernels() -> str | None:
    """Why loops are compiled plain here; None if they become kernels."""
    if is_off():
        return "switched off"
    if jax.default_backend() != "cpu":
        return f"the platform is {jax.default_backend()}, and kernels are for CPUs"
    if device_kernels.value != "auto":
        return "kernels of a GPU are being tried"
    if _MISSING is not None:
        warn_once(_MISSING)
        return _MISSING
    return why_not_trusted()


def most_numbers() -> int:
    """Of an array in a kernel's arithmetic; where there are no kernels, any number."""
    return WIDEST - 1 if why_no_kernels() is None else sys.maxsize


def _marked(mark: jax.extend.core.Primitive) -> Callable[[Array], Array]:
    return lambda x: mark.bind(x) if jnp.issubdtype(x.dtype, jnp.floating) else x
