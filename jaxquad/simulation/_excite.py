import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key

from jaxquad.records import AXES

from ._disturbances import gauss_markov
from ._scenario import Scenario


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
    _check(signal, dt, torque_noise, torque_corner, sensor_noise)
    levels = jnp.asarray([torque_noise, torque_corner, sensor_noise], dtype=float)
    return _scenario(jnp.asarray(signal, dtype=float), key, levels, dt, AXES.index(axis))


def _check(
    signal: Float[ArrayLike, " samples *ensemble"],
    dt: float,
    torque_noise: float,
    torque_corner: float,
    sensor_noise: float,
) -> None:
    shape = np.shape(signal)
    if not shape or shape[0] < 2 or not np.all(np.isfinite(np.asarray(signal))):
        raise ValueError(
            f"a signal of shape {shape} in V: give at least 2 finite samples, for instance the "
            ".signal of jq.sweep(...)"
        )
    for name, value, least in (
        ("dt", dt, 0.0),
        ("torque_corner", torque_corner, 0.0),
        ("torque_noise", torque_noise, -1e-300),
        ("sensor_noise", sensor_noise, -1e-300),
    ):
        if not least < value < np.inf:
            bound = "above 0" if least == 0 else "0 or above"
            raise ValueError(f"{name} is {value}: it is {bound} and finite")


@eqx.filter_jit
def _scenario(signal, key, levels, dt, axis) -> Scenario:
    torque_key, sensor_key = jax.random.split(key)
    torque = gauss_markov(torque_key, signal.shape, deviation=levels[0], corner=levels[1], dt=dt)
    jitter = levels[2] * jax.random.normal(sensor_key, signal.shape, signal.dtype)
    still = jnp.zeros((signal.shape[0], len(AXES), *signal.shape[1:]), signal.dtype)
    injection, disturbance, noise = (still.at[:, axis].set(x) for x in (signal, torque, jitter))
    return Scenario(still, injection, disturbance, noise)
