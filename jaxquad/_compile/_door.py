"""What the package asks of the compilers, and what it gets where they are not there."""

import functools as ft
import warnings
from collections.abc import Callable
from types import ModuleType
from typing import Any, Literal, NamedTuple

import jax
from jaxtyping import PyTree

from . import _plain


@ft.cache
def compilers() -> ModuleType:
    """`jaxquad._xla`; without it, or with a JAX that lacks what it needs, plain scans."""
    try:
        import jaxquad._xla as xla
    except (ImportError, AttributeError) as error:  # JAX's interfaces to its compiler may move.
        _plain.reason = f"this JAX ({jax.__version__}) lacks what kernels are made with ({error})"
        warnings.warn(f"loops take longer than they could: {_plain.reason}", stacklevel=2)
        return _plain
    return xla


class Engine(NamedTuple):
    """What loops are compiled with. It changes how long they take, and no result."""

    platform: str
    one_kernel: bool  # whether a loop of plain arithmetic becomes one kernel
    vector_bits: int | None  # of a jit with `compiler_options()`; None for the compiler's choice
    why_not: str | None  # why no loop becomes a kernel
    left_plain: tuple[str, ...]  # what did not become a kernel in this process, and why


def engine(kernel: Literal["auto", "off"] | None = None) -> Engine:
    """Tell what loops are compiled with, and choose it.

    On a CPU a time loop is compiled as one kernel, which makes the gradient of a single flight 25
    times faster (2.4 times with jaxlib 0.12, which runs plain loops better). This relies on
    internals of XLA. It is on for the versions of jaxlib that the tests ran on; with any other, a
    child process tries it once, and its answer is kept in the user's cache folder (not with
    `JAXQUAD_CACHE=off` in the environment). Loops with operations that a kernel cannot hold, or
    with too many or too large ones, are compiled plain. On an NVIDIA GPU the loop of an ensemble of
    more than 512 members is one kernel, made by the NVRTC that `jax[cuda13]` brings.

    Where `jq.simulate`, `jq.evaluate` and the like are called outside of `jax.jit`, a kernel that
    does not compile is compiled plain, with a warning. Within a `jax.jit` of your own that cannot
    be done: if it fails in XLA, call `jq.engine(kernel="off")` and file an issue.

    **Arguments:**

    - `kernel`: `"off"` compiles all loops plain from then on, as `JAXQUAD_KERNEL=off` in the
        environment does; `"auto"` makes kernels of those that can be; `None` leaves it as it is.

    **Returns:**

    An `Engine`: platform, whether loops become kernels and why not, and what was left plain.

    **Raises:**

    - `ValueError`: `kernel`, or `JAXQUAD_KERNEL`, is another word.
    """
    if kernel is not None:
        compilers().set_kernel(kernel)
    reason = compilers().why_plain()
    bits = compiler_options().get("xla_cpu_prefer_vector_width")
    return Engine(jax.default_backend(), reason is None, bits, reason, compilers().left_plain())


def compiler_options() -> dict[str, Any]:
    """What to give `jax.jit(..., compiler_options=...)` around a loop; empty where nothing helps.

    On a CPU, 512-bit vectors; warns, once, if this XLA does not know the option.
    """
    return compilers().compiler_options()


def brief_options() -> dict[str, Any]:
    """`compiler_options()` for programs that take longer to compile than they run."""
    return compilers().brief_options()


def hasty_options() -> dict[str, Any]:
    """For programs without loops over time that run a few times: hardly any optimisation."""
    return compilers().hasty_options()


def no_fuse(function: Callable[..., PyTree], *args: PyTree) -> PyTree:
    """`function(*args)` as a call that the CPU's compiler does not fuse with what is around it."""
    return compilers().no_fuse(function, *args)


FEW = 32  # elements, from which on a call costs less than recomputing them five times


def evaluate_once(function: Callable[..., PyTree], *, least: int = 1024) -> Callable[..., PyTree]:
    """The same function, in which expensive operations on large arrays are not recomputed.

    A response with its slopes by five parameters, for many members at many frequencies, takes less
    than half the time with it. Arrays are large from `least` elements on. What is called by
    `no_fuse` stays a call where its result is of 1024 elements or more.

    Complex quotients become products with one reciprocal, which loses them where a denominator's
    square overflows or underflows (1e-154 to 1e154): the result is then not finite. On other
    devices than the CPU, the function itself.
    """
    return compilers().evaluate_once(function, least=least)
