import jax
import jax.numpy as jnp
from jaxtyping import Array


class PrecisionError(ValueError):
    """Spectra and fits need 64-bit numbers, and JAX is set to 32."""


def require_x64(what: str) -> None:
    """Raise a `PrecisionError` unless JAX runs with 64-bit numbers."""
    if not jax.config.read("jax_enable_x64"):
        raise PrecisionError(
            f"{what} needs float64, but JAX runs in float32: set JAX_ENABLE_X64=1, or call "
            'jax.config.update("jax_enable_x64", True) before any array is created'
        )


def require_float64(what: str, array: Array) -> None:
    """Raise a `PrecisionError` if `array` was created in single precision."""
    require_x64(what)
    if jnp.asarray(array).dtype in (jnp.float32, jnp.complex64):
        raise PrecisionError(
            f"{what} is {jnp.asarray(array).dtype}: create it after "
            'jax.config.update("jax_enable_x64", True), or convert it with jnp.asarray(x, float)'
        )
