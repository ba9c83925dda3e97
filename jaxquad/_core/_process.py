"""What a process is set to: double precision where single gives wrong numbers, and one thread."""

import contextlib
import functools as ft
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import threadpoolctl
from jaxtyping import Array


class PrecisionError(ValueError):
    """Spectra and fits need 64-bit numbers, and JAX is set to 32."""


def enable_x64() -> None:
    """Let JAX compute with 64-bit numbers; call it before any array is created.

    Fits and gradients for tuning need them. Importing jaxquad never sets this by itself.
    """
    jax.config.update("jax_enable_x64", True)


def require_x64(what: str) -> None:
    """Raise a `PrecisionError` unless JAX runs with 64-bit numbers."""
    if not jax.config.read("jax_enable_x64"):
        raise PrecisionError(
            f"{what} needs float64, but JAX runs in float32: call jaxquad.enable_x64() "
            "before any array is created, or set JAX_ENABLE_X64=1"
        )


def require_float64(what: str, array: Array | np.ndarray) -> None:
    """Raise a `PrecisionError` if `array` was created in single precision."""
    require_x64(what)
    if array.dtype in (jnp.float32, jnp.complex64):
        raise PrecisionError(
            f"{what} is {array.dtype}: create it after "
            "jaxquad.enable_x64(), or convert it with jnp.asarray(x, float)"
        )


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Within it, NumPy's and SciPy's BLAS has one thread, in the whole process.

    The environment's OPENBLAS_NUM_THREADS and its kin count only before NumPy is imported.
    """
    with _libraries().limit(limits=1, user_api="blas"):
        yield


_LARGEST = 24 << 20  # bytes


def keep_freed_memory(size: int) -> None:
    """Have glibc keep what arrays leave: to return it and to ask again is a tenth of a fit's time.

    `size` is of all arrays at a time, in bytes. It keeps twice as much as the largest block that it
    was given back at once (mallopt(3)).
    """
    np.empty(min(size, _LARGEST), np.uint8)


@ft.cache  # to look for them takes as long as a small fit
def _libraries() -> threadpoolctl.ThreadpoolController:
    import scipy.linalg.lapack  # SciPy has a BLAS of its own, and only loaded ones are limited

    del scipy
    return threadpoolctl.ThreadpoolController()
