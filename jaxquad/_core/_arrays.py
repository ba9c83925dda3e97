from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike


def as_float(x: ArrayLike | Sequence[Any]) -> Array:
    """`x` as an array of the default float type (a list of integers too)."""
    return jnp.asarray(x, dtype=jnp.result_type(float))


def as_float_or_none(x: ArrayLike | Sequence[Any] | None) -> Array | None:
    return None if x is None else as_float(x)


def align(parameter: Array, state: Array) -> Array:
    """`parameter` with axes of length one appended, to broadcast over the ensemble of `state`."""
    missing = state.ndim - parameter.ndim
    if missing < 0:
        raise ValueError(
            f"A parameter of shape {parameter.shape} belongs to an ensemble, but the state has "
            f"shape {state.shape}: give the state the same trailing axis, as init() does."
        )
    return parameter.reshape(parameter.shape + (1,) * missing)


def is_concrete(x: Array) -> bool:
    """Whether `x` has values to check, which a tracer under jit, vmap or grad has not."""
    return not isinstance(x, Tracer)


def is_zero(x: Array) -> bool:
    """Whether `x` is known to be 0 everywhere."""
    return is_concrete(x) and not np.any(np.asarray(x))  # jnp would trace even a constant


def require_vector(name: str, value: Array, length: int) -> None:
    if value.ndim == 0 or value.shape[0] != length:
        raise ValueError(
            f"{name} has shape {value.shape}, but it must be ({length},), or ({length}, members) "
            "for an ensemble: give one value for each axis."
        )


def require_finite(name: str, value: Array) -> None:
    _require(name, value, np.isfinite, "finite", "look for the NaN or inf in it")


def require_positive(name: str, value: Array, remedy: str) -> None:
    _require(name, value, lambda x: (x > 0) & np.isfinite(x), "above 0 and finite", remedy)


def require_nonnegative(name: str, value: Array, remedy: str) -> None:
    _require(name, value, lambda x: (x >= 0) & np.isfinite(x), "0 or above and finite", remedy)


def _require(
    name: str, value: Array, valid: Callable[[np.ndarray], np.ndarray], limit: str, remedy: str
) -> None:
    if is_concrete(value) and not np.all(valid(np.asarray(value))):
        raise ValueError(f"{name} is {value}, but it must be {limit}: {remedy}.")
