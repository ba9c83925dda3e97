from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxquad.models._parameters import as_float, require_finite, require_positive

from ._anti_windup import AntiWindup, Clamping
from ._linear import LinearController
from ._per_axis import (
    ensemble_shape,
    fit,
    full_shape,
    matched,
    pick,
    require_limit,
    require_sample,
    require_shapes,
)
from ._pid_linear import linear_pid
from ._setpoint import Setpoint


class PIDState(NamedTuple):
    """What a PID remembers from the last sample."""

    integral: Float[Array, " axes *ensemble"]  # with the half sample to come, units of the command
    rate: Float[Array, " axes *ensemble"]  # filtered, without the sample to come, rad/s
    started: Float[Array, ""]  # 0 before the first sample, then 1


class PID(eqx.Module):
    """PID control with two degrees of freedom, a filtered derivative and anti-windup, sampled.

    u = kp (proportional_weight r - y) + ki int(r - y)
        + kd s/(1 + s/filter) (derivative_weight r - y),
    exactly for signals that are straight between samples. A `Setpoint` brings its rate, which then
    stands in for derivative_weight r', and its acceleration times `feedforward` (1/b of the plant).

    The command is bounded by `limit`, which must be the tightest one in the loop: what a drive cuts
    off beyond it winds the integral up. Every gain is a scalar, one value per axis, or
    `[axes, *ensemble]`, and differentiable. Source: Åström & Hägglund, Advanced PID Control, ch. 3.
    Raises ValueError for gains that are not finite or fit no common shape, and for a filter, limit
    or dt that is not above 0.
    """

    kp: Float[Array, "..."] = eqx.field(converter=as_float)  # per rad
    ki: Float[Array, "..."] = eqx.field(converter=as_float)  # per rad s
    kd: Float[Array, "..."] = eqx.field(converter=as_float)  # per rad/s
    filter: Float[Array, "..."] = eqx.field(converter=as_float, default=125.0)  # rad/s: 20 Hz
    proportional_weight: Float[Array, "..."] = eqx.field(converter=as_float, default=1.0)
    derivative_weight: Float[Array, "..."] = eqx.field(converter=as_float, default=0.0)
    feedforward: Float[Array, "..."] = eqx.field(converter=as_float, default=0.0)  # per rad/s^2
    limit: Float[Array, "..."] = eqx.field(converter=as_float, default=float("inf"))  # of |u|
    anti_windup: AntiWindup | None = Clamping()  # None: the integral winds up
    dt: float = eqx.field(static=True, default=0.002)  # s

    def __check_init__(self):
        if self.anti_windup is not None and not isinstance(self.anti_windup, AntiWindup):
            raise ValueError(
                f"anti_windup is {self.anti_windup!r}: choose Clamping(), BackCalculation(time) or "
                "None."
            )
        require_sample(self.dt)
        for name, gain in _gains(self).items():
            if name == "limit":
                require_limit(gain)
            elif name == "filter":
                require_positive(name, gain, "give the derivative's bandwidth in rad/s")
            else:
                require_finite(name, gain)
        require_shapes(_gains(self))

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the gains, () for one controller."""
        return ensemble_shape(_gains(self))

    def init(self, like: Float[Array, " axes *ensemble"]) -> PIDState:
        """With an empty integral; shaped as `like` and the ensemble of the gains."""
        zero = jnp.zeros(full_shape(like, self.ensemble), like.dtype)
        return PIDState(zero, zero, jnp.zeros((), like.dtype))

    def step(
        self, state: PIDState, reference: Any, measurement: Float[Array, " axes *ensemble"]
    ) -> tuple[PIDState, Float[Array, " axes *ensemble"]]:
        """One sample: the command to hold until the next one.

        `reference` is a `Setpoint`, or angles in rad without feed-forward. The first sample starts
        the derivative without a kick.
        """
        reference = matched(reference, measurement, state.integral)
        gain = lambda name: fit(getattr(self, name), measurement)
        angle = reference.angle if isinstance(reference, Setpoint) else reference
        half = 0.5 * self.dt * gain("ki") * (angle - measurement)
        integral = state.integral + state.started * half
        memory, rate = self._rate(state, reference, measurement)
        wanted = gain("kp") * (gain("proportional_weight") * angle - measurement)
        wanted = wanted + integral + gain("kd") * rate
        if isinstance(reference, Setpoint):
            wanted = wanted + gain("feedforward") * reference.acceleration
        command = jnp.clip(wanted, -gain("limit"), gain("limit"))
        growth = integral + half - state.integral
        if self.anti_windup is not None:
            growth = self.anti_windup(growth, wanted, command, self.dt)
        started = jnp.ones_like(state.started)
        return PIDState(state.integral + growth, memory, started), command

    def linear(self, axis: int = 0, member: Any = None) -> LinearController:
        """One axis without its limit, exactly; `member` picks one of an ensemble."""
        gains = {name: pick(gain, axis, member) for name, gain in _gains(self).items()}
        return linear_pid(gains, self.dt)

    def _rate(self, state, reference, measurement):
        """What the filter remembers, and the filtered rate of the error."""
        keep = jnp.exp(-self.dt * fit(self.filter, measurement))
        sharp = (1 - keep) / self.dt
        if isinstance(reference, Setpoint):
            # Half a sample back, where the difference of the measurements is.
            ahead = reference.rate - 0.5 * self.dt * reference.acceleration
            change, given = -measurement, (1 - keep) * ahead
        else:
            change = fit(self.derivative_weight, measurement) * reference - measurement
            given = jnp.zeros_like(measurement)
        rate = state.started * (state.rate + sharp * change + given)
        return keep * rate - sharp * change, rate


def _gains(pid: PID) -> dict[str, Array]:
    names = ("kp", "ki", "kd", "filter", "proportional_weight", "derivative_weight")
    return {name: getattr(pid, name) for name in (*names, "feedforward", "limit")}
