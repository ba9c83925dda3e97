import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Encoder(eqx.Module):
    """An optical encoder: angles in steps of one count, with the gradient of the angle itself."""

    counts: int = eqx.field(static=True, default=8192)  # per revolution

    def __check_init__(self):
        if self.counts < 1:
            raise ValueError(f"counts is {self.counts}: an encoder has at least 1 per revolution")

    def __call__(self, angle: Float[Array, "..."]) -> Float[Array, "..."]:
        """The counted angle in rad."""
        step = 2 * jnp.pi / self.counts
        counted = step * jnp.round(angle / step)
        # Straight through: the derivative of the rounding itself is zero or infinite.
        return angle + jax.lax.stop_gradient(counted - angle)
