from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxquad.models._parameters import align

from ._anti_windup import AntiWindup
from ._measurement_filter import Filtered, filtered, Transition
from ._per_axis import fit, full_shape, matched
from ._setpoint import Setpoint


class PIDState(NamedTuple):
    """What a PID remembers from the last sample."""

    integral: Float[Array, " axes *ensemble"]  # units of the command; see `PIDLaw`
    rate: Float[Array, " axes *ensemble"]  # filtered, without the sample to come, rad/s
    started: Float[Array, ""]  # 0 before the first sample, then 1
    filtered: Filtered | None = None  # of the measurement, where it is filtered


class PIDLaw(eqx.Module):
    """A `PID` with its filter of the measurement computed: what a loop runs, sample by sample.

    Without that filter the state's integral is ahead by half a sample, by the trapezoidal rule.
    """

    gains: Mapping[str, Float[Array, "..."]]
    transition: Transition | None
    anti_windup: AntiWindup | None
    ensemble: tuple[int, ...] = eqx.field(static=True)
    dt: float = eqx.field(static=True)

    def init(
        self,
        like: Float[Array, " axes *ensemble"],
        measurement: Float[Array, " axes *ensemble"] | None = None,
    ) -> PIDState:
        zero = jnp.zeros(full_shape(like, self.ensemble), like.dtype)
        first = zero if measurement is None else zero + align(measurement, zero)
        smooth = None if self.transition is None else (first, zero)
        return PIDState(zero, zero, jnp.zeros((), like.dtype), smooth)

    def step(
        self, state: PIDState, reference: Any, measurement: Float[Array, " axes *ensemble"]
    ) -> tuple[PIDState, Float[Array, " axes *ensemble"]]:
        reference = matched(reference, measurement, state.integral)
        gain = lambda name: fit(self.gains[name], measurement)
        angle = reference.angle if isinstance(reference, Setpoint) else reference
        smooth, seen = state.filtered, measurement
        if self.transition is not None and smooth is not None:
            smooth = filtered(self.transition, smooth, measurement)
            seen = smooth[0]
        half = 0.5 * self.dt * gain("ki") * (angle - seen)
        if smooth is None:
            integral, ahead = state.integral + state.started * half, half
        else:
            integral, ahead = state.integral + 2 * half, jnp.zeros_like(half)
        memory, rate = self._rate(state, reference, measurement, smooth)
        wanted = gain("kp") * (gain("proportional_weight") * angle - seen)
        wanted = wanted + integral + gain("kd") * rate
        if isinstance(reference, Setpoint):
            wanted = wanted + gain("feedforward") * reference.acceleration
        command = jnp.clip(wanted, -gain("limit"), gain("limit"))
        growth = integral + ahead - state.integral
        if self.anti_windup is not None:
            growth = self.anti_windup(growth, wanted, command, self.dt)
        started = jnp.ones_like(state.started)
        return PIDState(state.integral + growth, memory, started, smooth), command

    def _rate(self, state, reference, measurement, smooth):
        """What the filter of the derivative remembers, and the filtered rate of the error."""
        keep = jnp.exp(-self.dt * fit(self.gains["filter"], measurement))
        sharp = (1 - keep) / self.dt
        differenced = measurement if smooth is None else jnp.zeros_like(measurement)
        if isinstance(reference, Setpoint):
            # Half a sample back, where the difference of the measurements is.
            ahead = reference.rate - 0.5 * self.dt * reference.acceleration
            change, given = -differenced, (1 - keep) * ahead
        else:
            weight = fit(self.gains["derivative_weight"], measurement)
            change = weight * reference - differenced
            given = jnp.zeros_like(measurement)
        rate = state.started * (state.rate + sharp * change + given)
        memory = keep * rate - sharp * change
        return memory, rate if smooth is None else rate - smooth[1]
