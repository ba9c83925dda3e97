import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key


def gauss_markov(
    key: Key[Array, ""],
    shape: tuple[int, ...],
    *,
    deviation: float | Float[Array, ""],
    corner: float | Float[Array, ""],
    dt: float,
) -> Float[Array, "samples ..."]:
    """Stationary first-order Gauss-Markov noise along the first axis, such as gusts of torque.

    `deviation` is its standard deviation, `corner` its bandwidth in rad/s.
    """
    white = jax.random.normal(key, shape, dtype=float)
    keep = jnp.exp(jnp.asarray(-corner * dt))
    drive = deviation * jnp.sqrt(1 - keep**2)

    def advance(level, kick):
        return keep * level + drive * kick, level

    return jax.lax.scan(advance, deviation * white[0], jnp.roll(white, -1, axis=0))[1]
