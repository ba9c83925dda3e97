from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class LinearController(eqx.Module):
    """One axis of a controller without limits: x[k+1] = A x + Br r + By y, u = C x + Dr r + Dy y.

    r is the angle of the set-point, y the measurement of the same sample, in rad; u the command
    that is held until the next one. By and Dy carry the sign of the feedback.
    """

    A: Float[Array, "states states"]
    reference_in: Float[Array, " states"]  # Br
    measurement_in: Float[Array, " states"]  # By
    C: Float[Array, " states"]
    reference_through: Float[Array, ""]  # Dr
    measurement_through: Float[Array, ""]  # Dy
    dt: float = eqx.field(static=True)  # s


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
