import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Key

from ._loop import AXES, Scenario
from ._noise import gauss_markov


def excite(
    signal: Float[ArrayLike, " samples *ensemble"],
    *,
    key: Key[Array, ""],
    dt: float,
    axis: str = "roll",
    torque_noise: float = 0.0,
    torque_corner: float = 2.0,
    sensor_noise: float = 0.0,
) -> Scenario:
    """An identification experiment: level flight with `signal` (V) injected into one axis.

    The axis feels a Gauss-Markov torque of standard deviation `torque_noise` (N m) and bandwidth
    `torque_corner` (rad/s), and its angle is measured with white `sensor_noise` (rad). A signal
    with a trailing axis makes an ensemble, every member with noise of its own.
    """
    if axis not in AXES:
        raise ValueError(f"axis {axis!r}: choose one of {', '.join(AXES)}")
    levels = jnp.asarray([torque_noise, torque_corner, sensor_noise], dtype=float)
    return _scenario(jnp.asarray(signal, dtype=float), key, levels, dt, AXES.index(axis))


@eqx.filter_jit
def _scenario(signal, key, levels, dt, axis) -> Scenario:
    torque_key, sensor_key = jax.random.split(key)
    torque = gauss_markov(torque_key, signal.shape, deviation=levels[0], corner=levels[1], dt=dt)
    jitter = levels[2] * jax.random.normal(sensor_key, signal.shape, signal.dtype)
    still = jnp.zeros((signal.shape[0], len(AXES), *signal.shape[1:]), signal.dtype)
    injection, disturbance, noise = (still.at[:, axis].set(x) for x in (signal, torque, jitter))
    return Scenario(still, injection, disturbance, noise)
