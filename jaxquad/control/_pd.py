from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float


def _as_float(x: ArrayLike | Sequence[Any]) -> Array:
    return jnp.asarray(x, dtype=jnp.result_type(float))


class PDState(NamedTuple):
    """The last measurement and the filtered derivative of the measurements."""

    measurement: Float[Array, " axes *ensemble"]
    rate: Float[Array, " axes *ensemble"]
    started: Float[Array, ""]  # 0 before the first sample, then 1


class PD(eqx.Module):
    """Proportional feedback and filtered-derivative damping: holds a rig while it is excited.

    `command = proportional (reference - measurement) - derivative rate`, with the rate from a
    first-order filter of `bandwidth` (rad/s) at the sample interval `dt` (s).
    """

    proportional: Float[Array, " axes"] = eqx.field(converter=_as_float)  # V/rad
    derivative: Float[Array, " axes"] = eqx.field(converter=_as_float)  # V s/rad
    bandwidth: float = eqx.field(static=True, default=125.0)  # 20 Hz
    dt: float = eqx.field(static=True, default=0.002)

    def __check_init__(self):
        if not (self.dt > 0 and self.bandwidth > 0):
            raise ValueError(
                f"dt {self.dt} s and bandwidth {self.bandwidth} rad/s must both be positive"
            )

    def init(self, like: Float[Array, " axes *ensemble"]) -> PDState:
        """At rest, with arrays shaped as the measurement `like`."""
        zero = jnp.zeros_like(like)
        return PDState(zero, zero, jnp.zeros((), like.dtype))

    def step(
        self,
        state: PDState,
        reference: Float[Array, " axes *ensemble"],
        measurement: Float[Array, " axes *ensemble"],
    ) -> tuple[PDState, Float[Array, " axes *ensemble"]]:
        """One sample: the command to hold until the next one."""
        keep = jnp.exp(jnp.asarray(-self.bandwidth * self.dt, measurement.dtype))
        slope = (measurement - state.measurement) * (state.started / self.dt)
        rate = keep * state.rate + (1 - keep) * slope
        shape = (-1,) + (1,) * (measurement.ndim - 1)
        proportional, derivative = self.proportional.reshape(shape), self.derivative.reshape(shape)
        command = proportional * (reference - measurement) - derivative * rate
        return PDState(measurement, rate, jnp.ones_like(state.started)), command


def place_pd(
    gain: ArrayLike | Sequence[Any],
    *,
    natural_frequency: float,
    damping: float,
    dt: float = 0.002,
) -> PD:
    """The `PD` that gives gain/s^2 per axis this natural frequency (rad/s) and damping ratio.

    `gain` in rad/s^2 per unit of command.
    """
    gain = _as_float(gain)
    return PD(natural_frequency**2 / gain, 2 * damping * natural_frequency / gain, dt=dt)
