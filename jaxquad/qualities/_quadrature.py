"""Integrals over frequency between the points of a logarithmic grid."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def nodes_between(
    omega: Float[Array, " frequencies"], order: int
) -> tuple[
    Float[Array, "intervals nodes"],
    Float[Array, "intervals nodes"],
    Float[Array, "intervals nodes"],
]:
    """Frequencies, places from 0 to 1, and weights in ln(omega) of Gauss' rule in each interval."""
    nodes, weights = (jnp.asarray(x, omega.dtype) for x in np.polynomial.legendre.leggauss(order))
    low, width = jnp.log(omega)[:-1, None], jnp.diff(jnp.log(omega))[:, None]
    part = jnp.broadcast_to(((nodes + 1) / 2)[None], (omega.size - 1, order))
    return jnp.exp(low + width * part), part, width * (weights / 2)[None]


def power_law(
    low: Float[Array, "intervals 1"],
    high: Float[Array, "intervals 1"],
    part: Float[Array, "intervals nodes"],
) -> Float[Array, "intervals nodes"]:
    """Values between two ends, straight in logarithms; straight where an end is 0."""
    positive = (low > 0) & (high > 0)
    a, b = (jnp.where(positive, x, 1.0) for x in (low, high))
    return jnp.where(
        positive,
        jnp.exp((1 - part) * jnp.log(a) + part * jnp.log(b)),
        (1 - part) * low + part * high,
    )


def logarithmic_mean(
    low: Float[Array, " intervals"], high: Float[Array, " intervals"]
) -> Float[Array, " intervals"]:
    """The mean of an exponential between its ends; half the sum where an end is 0."""
    positive = (low > 0) & (high > 0)
    a, b = (jnp.where(positive, x, 1.0) for x in (low, high))
    growth = jnp.log(b / a)
    flat = jnp.abs(growth) < 1e-4
    safe = jnp.where(flat, 1.0, growth)
    mean = a * jnp.where(flat, 1 + growth / 2 + growth**2 / 6, jnp.expm1(safe) / safe)
    return jnp.where(positive, mean, (low + high) / 2)
