from collections.abc import Mapping

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._linear import LinearController


def linear_pid(gains: Mapping[str, Float[Array, ""]], dt: float) -> LinearController:
    """A PID of one axis without its limit; the states are the integral and the filtered rate."""
    kp, ki, kd = gains["kp"], gains["ki"], gains["kd"]
    keep = jnp.exp(-dt * gains["filter"])
    sharp = (1 - keep) / dt
    weight = gains["derivative_weight"]
    one, zero = jnp.ones_like(kp), jnp.zeros_like(kp)
    half = 0.5 * dt * ki
    back = (keep - 1) * sharp  # what a sample of the angle leaves in the filter
    return LinearController(
        A=jnp.stack([jnp.stack([one, zero]), jnp.stack([zero, keep])]),
        reference_in=jnp.stack([2 * half, back * weight]),
        measurement_in=jnp.stack([-2 * half, -back]),
        C=jnp.stack([one, kd]),
        reference_through=kp * gains["proportional_weight"] + half + kd * sharp * weight,
        measurement_through=-kp - half - kd * sharp,
        dt=dt,
    )
