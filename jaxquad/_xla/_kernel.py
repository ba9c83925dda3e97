"""A whole time loop as one compiled kernel on a CPU.

XLA's CPU runtime dispatches every small operation of a loop by itself, which costs more than the
arithmetic of one vehicle does. A call with two attributes becomes one kernel instead. They are
internal to XLA, so they are used only where the installed version is known to take them, and what
goes in is bounded; all else is compiled as any other program.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.extend
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ._accelerator import why_no_device_kernels
from ._canary import why_not_trusted
from ._marks import enter, leave
from ._switch import device_kernels, is_off, plain_loops, warn_once


def as_one_kernel(function: Callable[..., PyTree], *args: PyTree) -> PyTree:
    """`function(*args)`, compiled as one kernel if it can be; the arguments are arrays.

    So are its derivatives: what is differentiated is marked where it enters and where it leaves,
    and each mark is the transpose of the other.
    """
    if why_no_kernels() is not None:
        return function(*args)

    def jaxquad_kernel(*args: PyTree) -> PyTree:
        return function(*args)

    entered = jax.tree.map(_marked(enter), args)
    return jax.tree.map(_marked(leave), jax.jit(jaxquad_kernel)(*entered))


def why_no_kernels() -> str | None:
    """Why loops are compiled plain here; None if they become kernels."""
    if is_off():
        return "switched off"
    if jax.default_backend() != "cpu":
        return f"the platform is {jax.default_backend()}, and kernels are for CPUs"
    if device_kernels.value != "auto":
        return "kernels of a GPU are being tried"
    return why_not_trusted()


def why_plain() -> str | None:
    """Why loops are compiled plain here; None if they become kernels, of a CPU or of a GPU."""
    reason = why_no_kernels()
    return None if why_no_device_kernels() is None else reason


_failed: set[object] = set()


def or_plain(name: str, kind: Callable[[], object], run: Callable[[], PyTree]) -> PyTree:
    """`run()`; with plain loops, and a warning, where it does not compile with kernels.

    The next one of its `kind` is run with plain loops at once.
    """
    if _failed and why_plain() is None and kind() in _failed:
        with plain_loops(True):
            return run()
    try:
        return run()
    except eqx.EquinoxRuntimeError:  # raised by what runs: it did compile
        raise
    except jax.errors.JaxRuntimeError as error:
        if why_plain() is not None:
            raise
        with plain_loops(True):
            result = run()  # If the kernel is not at fault, this raises too.
        _failed.add(kind())
        reason = str(error).strip().splitlines()[0][:200]
        warn_once(f"{name} did not compile as one kernel ({reason})")
        return result


def _marked(mark: jax.extend.core.Primitive) -> Callable[[Array], Array]:
    return lambda x: mark.bind(x) if jnp.issubdtype(x.dtype, jnp.floating) else x
