"""ArduPilot's rate and angle loops."""

from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad._core import as_float, broadcast_gain, per_member, require_positive
from jaxquad.control import Reference, Setpoint

from .._filters import FilterChain, PT1
from .._law import (
    AngleLoop,
    bounded,
    filter_gyro,
    FirmwareLoop,
    gyro_rest,
    low_pass_share,
    RateLoop,
    require_gains,
    require_gyro_rate,
    Signal,
    split_reference,
    Terms,
)


class ArduPilotRate(RateLoop):
    """ArduPilot's rate loop (AC_PID of Copter): rates in rad/s in, ROut of -1 to 1 out.

    The target is low-passed (FLTT), then the error (FLTE), then the derivative of the filtered
    error (FLTD), so the D term acts on the target too. The integral is used at once, and shrinks
    only where the mixer was limited at the last sample (`applied`). Not modelled: SMAX, notches of
    target and error, and the throttle's gain boost. Source: docs/autopilots.md.

    !!! example

        ```python
        law = ArduPilotRate(0.135, 0.135, 0.0036, gyro=FilterChain((Butterworth(20.0),), 2000.0))
        ```

    **Arguments:** (each number is a scalar, one value per axis, or `[axes, *ensemble]`)

    - `p`, `i`, `d`, `ff`, `d_ff`: ATC_RAT_xxx_P, _I, _D, _FF, _D_FF.
    - `gyro`: filters at the gyro's rate: harmonic notches and INS_GYRO_FILTER (20 Hz).
    - `target_hz`, `error_hz`, `derivative_hz`: _FLTT, _FLTE, _FLTD; 0 is off.
    - `integral_limit`: _IMAX; `pd_limit`: _PDMX, of |P + D|, inf is off.
    - `dt`: in s, 1/SCHED_LOOP_RATE.

    **Raises:**

    - `ValueError`: a gain is not finite, the gyro's rate is no multiple of 1/dt, or a filter lies
        beyond half of its rate.
    """

    firmware: ClassVar[str] = "ardupilot"
    feed_forward: ClassVar[tuple[str, ...]] = ("ff", "d_ff")
    p: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    i: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    d: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    ff: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    d_ff: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    gyro: FilterChain = FilterChain()
    target_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=20.0)
    error_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    derivative_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=20.0)
    integral_limit: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.5)
    pd_limit: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=float("inf"))
    dt: float = eqx.field(static=True, default=1 / 400)  # s

    def __check_init__(self):
        limits = {
            "target_hz": self.target_hz,
            "error_hz": self.error_hz,
            "derivative_hz": self.derivative_hz,
            "integral_limit": self.integral_limit,
            "pd_limit": self.pd_limit,
        }
        require_gains(self.dt, {**self.gains(), "ff": self.ff, "d_ff": self.d_ff}, limits)
        require_gyro_rate(self.gyro, self.dt)

    def derivative_chain(self, axis: int) -> FilterChain:
        cutoff = float(np.broadcast_to(self.derivative_hz, (3,))[axis])
        return FilterChain((PT1(cutoff),) if cutoff > 0 else (), 1 / self.dt)

    def gains(self) -> dict[str, Array]:
        return {"p": self.p, "i": self.i, "d": self.d}

    def rest(self, zero: Signal) -> dict[str, PyTree]:
        signals = dict.fromkeys(("target", "error", "slope", "integral"), zero)
        return {"gyro": gyro_rest(self.gyro, zero), **signals}

    def advance(
        self,
        memory: Mapping[str, PyTree],
        excess: Signal,
        reference: Reference,
        measurement: Signal,
    ) -> tuple[dict[str, PyTree], Signal, Terms]:
        at = lambda gain: broadcast_gain(gain, measurement)
        share = lambda cutoff: low_pass_share(cutoff, self.dt, measurement)
        r, _ = split_reference(reference, measurement, self.dt)
        gyro, (y, _) = filter_gyro(self.gyro, self.dt, memory["gyro"], measurement)
        target = memory["target"] + share(self.target_hz) * (r - memory["target"])
        error = memory["error"] + share(self.error_hz) * (target - y - memory["error"])
        raw = (error - memory["error"]) / self.dt
        slope = memory["slope"] + share(self.derivative_hz) * (raw - memory["slope"])
        integral = self._integrated(memory["integral"], excess, at(self.i) * error * self.dt)
        p, d = self._within_limit(at(self.p) * error, at(self.d) * slope)
        ahead = at(self.ff) * target + at(self.d_ff) * (target - memory["target"]) / self.dt
        terms = {"P": p, "I": integral, "D": d, "F": ahead}
        next = {
            "gyro": gyro, "target": target, "error": error, "slope": slope, "integral": integral,
        }  # fmt: skip
        return next, p + d + integral + ahead, terms

    def _integrated(self, integral, excess, growth):
        """A limited mixer lets the integral shrink only."""
        limited = jnp.abs(excess) > 1e-6
        growing = limited & (integral * growth >= 0)
        return bounded(integral + jnp.where(growing, 0.0, growth), self.integral_limit)

    def _within_limit(self, p, d):
        limit, both = broadcast_gain(self.pd_limit, p), jnp.abs(p + d)
        beyond = both > limit
        scale = jnp.where(beyond, limit, 1.0) / jnp.where(beyond, both, 1.0)
        return p * scale, d * scale


class ArduPilotAttitude(AngleLoop):
    """ArduPilot's angle loop around a rate loop: angles in rad in, ROut out.

    The rate's target is `p` times the error of the angle, beyond a_max/p^2 the root of it that a
    deceleration a_max needs, plus the rate of a `Setpoint` (what input shaping gives); it is used
    one loop later. The rate that the inner loop sees is the difference of the measured angles over
    a sample. Source: docs/autopilots.md.

    **Arguments:** (each number is a scalar, one value per axis, or `[axes, *ensemble]`)

    - `rate`: the `ArduPilotRate` inside.
    - `p`: ATC_ANG_xxx_P in 1/s.
    - `acceleration_limit`: half of ATC_ACCEL_x_MAX in rad/s^2; the default is 550 deg/s^2.
    - `rate_limit`: ATC_RATE_x_MAX in rad/s; inf is none.

    **Raises:**

    - `ValueError`: `p` or a limit is not above 0.
    """

    rate: ArduPilotRate
    p: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=4.5)
    acceleration_limit: Float[Array, "..."] = per_member(
        rank=1, converter=as_float, default=np.deg2rad(550.0)
    )
    rate_limit: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=float("inf"))

    def __check_init__(self):
        require_positive("p", self.p, "give 1/s")
        require_positive("acceleration_limit", self.acceleration_limit, "give rad/s^2")

    def outer_gains(self) -> dict[str, Array]:
        return {"p": self.p}

    def inner(self) -> FirmwareLoop:
        return self.rate

    def outer_rest(self, zero: Signal) -> dict[str, PyTree]:
        return {"wanted": zero}

    def wanted_rate(
        self, memory: Mapping[str, PyTree], reference: Reference, angle: Signal, rate: Signal
    ) -> tuple[dict[str, PyTree], Signal]:
        aim = reference.angle if isinstance(reference, Setpoint) else reference
        wanted = bounded(self._rate_of(aim - angle), self.rate_limit)
        if isinstance(reference, Setpoint):
            wanted = wanted + reference.rate
        return {"wanted": wanted}, memory["wanted"]

    def _rate_of(self, error: Signal) -> Signal:
        """The square-root controller: linear for small errors, then the braking parabola."""
        p, most = (broadcast_gain(x, error) for x in (self.p, self.acceleration_limit))
        edge = most / p**2
        size = jnp.abs(error)
        far = size > edge
        root = jnp.sqrt(2 * most * (jnp.where(far, size, edge) - edge / 2))
        braking = jnp.sign(error) * jnp.minimum(root, size / self.dt)
        return jnp.where(far, braking, jnp.minimum(p, 1 / self.dt) * error)
