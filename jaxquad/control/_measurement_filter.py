import jax.numpy as jnp
from jaxtyping import Array, Float

from ._per_axis import fit


Transition = Float[Array, "2 2 ..."]
Filtered = tuple[Array, Array]  # the filtered angle in rad and its rate in rad/s


def butterworth(bandwidth: Float[Array, "..."], dt: float) -> Transition:
    """What is left after `dt` of a second-order Butterworth filter's error, and of its rate.

    Of v'' + sqrt(2) w v' + w^2 v = w^2 y with w = `bandwidth` in rad/s: exp(A dt), in closed form.
    """
    slow = bandwidth / jnp.sqrt(2.0).astype(bandwidth.dtype)  # both parts of the poles
    decay, turn = jnp.exp(-slow * dt), slow * dt
    cosine, sine = decay * jnp.cos(turn), decay * jnp.sin(turn)
    rows = [[cosine + sine, sine / slow], [-2 * slow * sine, cosine - sine]]
    return jnp.stack([jnp.stack(row) for row in rows])


def filtered(
    transition: Transition, before: Filtered, measurement: Float[Array, " axes *ensemble"]
) -> Filtered:
    """A sample later, exactly for a measurement that was held over the sample before it."""
    (aa, ar), (ra, rr) = [[fit(gain, measurement) for gain in row] for row in transition]
    away, rate = before[0] - measurement, before[1]
    return measurement + aa * away + ar * rate, ra * away + rr * rate
