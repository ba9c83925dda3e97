import jax.numpy as jnp
from jaxtyping import Array, Float

from ._parameters import align


_CREEP = 0.01  # rad/s, at which the torque reaches 76 % of its level


def friction(
    coulomb: Float[Array, "..."], rate: Float[Array, " axes *ensemble"]
) -> Float[Array, " axes *ensemble"]:
    """Dry-friction torque in N m at `rate` in rad/s, smoothed so that it has a gradient."""
    return -align(coulomb, rate) * jnp.tanh(rate / _CREEP)
