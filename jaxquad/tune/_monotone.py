"""Rows that fall from each to the next, as free numbers: a cumulative softplus."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


_SHARPNESS = 20.0
FLATTEST = 0.05  # nepers from knot to knot that a start is given at least: a flat one has no slope


def falling(z: Float[Array, "knots columns"]) -> Float[Array, "knots columns"]:
    """The first row as it is, each further one softplus(20 z) / 20 below the last."""
    drops = jax.nn.softplus(_SHARPNESS * z[1:]) / _SHARPNESS
    return z[:1] - jnp.concatenate([jnp.zeros_like(z[:1]), jnp.cumsum(drops, axis=0)])


def falling_inverse(
    values: Float[np.ndarray, "knots columns"],
) -> Float[np.ndarray, "knots columns"]:
    """The z whose `falling` is nearest to `values`, in which rows that do not fall are flat."""
    drops = np.maximum(values[:-1] - values[1:], FLATTEST)
    return np.concatenate([values[:1], np.log(np.expm1(_SHARPNESS * drops)) / _SHARPNESS])
