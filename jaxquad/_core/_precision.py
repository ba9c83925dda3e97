"""Double precision where single gives wrong numbers."""

import jax
import jax.numpy as jnp
import numpy as np
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
