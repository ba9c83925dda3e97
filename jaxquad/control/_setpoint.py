from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Setpoint(NamedTuple):
    """A reference with its derivatives, for feed-forward."""

    angle: Float[Array, " axes *ensemble"]  # rad
    rate: Float[Array, " axes *ensemble"]  # rad/s
    acceleration: Float[Array, " axes *ensemble"]  # rad/s^2


def as_setpoint(reference: Any) -> Setpoint:
    """`reference` itself, or, of a bare array of angles, a set-point without feed-forward."""
    if isinstance(reference, Setpoint):
        return reference
    return Setpoint(reference, jnp.zeros_like(reference), jnp.zeros_like(reference))
