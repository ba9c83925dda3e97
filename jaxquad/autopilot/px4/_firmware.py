from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad._core import as_float, broadcast_gain, per_member, require_positive
from jaxquad.control import Reference, Setpoint

from .._filters import FilterChain, PT1, Section
from .._law import (
    AngleLoop,
    bounded,
    filter_gyro,
    FirmwareLoop,
    gyro_rest,
    low_pass_share,
    require_gains,
    require_gyro_rate,
    Signal,
    split_reference,
    sum_of,
    Terms,
)


_FADED = np.deg2rad(400.0)  # rad/s of error at which the integral no longer grows


class PX4Rate(FirmwareLoop):
    """PX4's rate loop: rates in rad/s in, the normalised torque set-point out.

        u = K P e + I - K D y' + FF r,    I += (1 - (e / 400 deg/s)^2) K I_gain T e afterwards

    The derivative is taken and low-passed at the gyro's rate, and acts on the measurement alone.
    The integral stops where the allocator gave less than was asked for (`applied`). Source:
    docs/autopilots.md.

    !!! example

        ```python
        law = PX4Rate(p=0.15, i=0.2, d=0.003, gyro=FilterChain((Butterworth(40.0),), 8000.0))
        ```

    **Arguments:** (each number is a scalar, one value per axis, or `[axes, *ensemble]`)

    - `p`, `i`, `d`, `k`, `ff`: MC_xRATE_P, _I, _D, _K, _FF; ff is not multiplied by k.
    - `gyro`: filters at the gyro's rate: notches and IMU_GYRO_CUTOFF (40 Hz).
    - `derivative_hz`: IMU_DGYRO_CUTOFF, 0 is off.
    - `torque_hz`: MC_YAW_TQ_CUTOFF on yaw (2 Hz), 0 is off and belongs on roll and pitch.
    - `integral_limit`: MC_xR_INT_LIM.
    - `dt`: of the rate loop in s, 1/IMU_GYRO_RATEMAX.

    **Raises:**

    - `ValueError`: a gain is not finite, the gyro's rate is no multiple of 1/dt, or a filter lies
        beyond half of its rate.
    """

    p: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    i: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    d: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    k: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=1.0)
    ff: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    gyro: FilterChain = FilterChain()
    derivative_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=20.0)
    torque_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    integral_limit: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.3)
    dt: float = eqx.field(static=True, default=1 / 400)  # s

    def __check_init__(self):
        limits = {
            "integral_limit": self.integral_limit,
            "derivative_hz": self.derivative_hz,
            "torque_hz": self.torque_hz,
        }
        require_gains(self.dt, {**self.gains(), "k": self.k, "ff": self.ff}, limits)
        require_gyro_rate(self.gyro, self.dt)

    def interval(self) -> float:
        return self.dt

    def gains(self) -> dict[str, Array]:
        return {"p": self.p, "i": self.i, "d": self.d}

    @property
    def _derivative(self) -> tuple[Section, ...]:
        """The difference at the gyro's rate and its low-pass."""
        rate_hz = self.gyro.rate_hz if self.gyro.filters else 1 / self.dt
        slope = jnp.full((), rate_hz, self.p.dtype)
        return (
            Section(slope, -slope, jnp.zeros_like(slope)),
            *PT1(self.derivative_hz).sections(rate_hz),
        )

    @property
    def _gyro(self) -> FilterChain:
        return self.gyro if self.gyro.filters else FilterChain((), 1 / self.dt)

    def rest(self, zero: Signal) -> dict[str, PyTree]:
        gyro = gyro_rest(self._gyro, zero, *self._derivative)
        return {"gyro": gyro, "integral": zero, "torque": zero}

    def advance(
        self,
        memory: Mapping[str, PyTree],
        excess: Signal,
        reference: Reference,
        measurement: Signal,
    ) -> tuple[dict[str, PyTree], Signal, Terms]:
        at = lambda gain: broadcast_gain(gain, measurement)
        r, _ = split_reference(reference, measurement, self.dt)
        derivative = self._derivative
        gyro, (y, slope) = filter_gyro(
            self._gyro, self.dt, memory["gyro"], measurement, *derivative
        )
        error, k, integral = r - y, at(self.k), memory["integral"]
        terms = {
            "P": k * at(self.p) * error, "I": integral,
            "D": -k * at(self.d) * slope, "F": at(self.ff) * r,
        }  # fmt: skip
        open = jnp.where(excess > _UNALLOCATED, jnp.minimum(error, 0.0), error)
        open = jnp.where(excess < -_UNALLOCATED, jnp.maximum(open, 0.0), open)
        fade = jnp.maximum(0.0, 1 - (open / _FADED) ** 2)
        grown = integral + fade * k * at(self.i) * open * self.dt
        share = low_pass_share(self.torque_hz, self.dt, measurement)
        torque = memory["torque"] + share * (sum_of(terms) - memory["torque"])
        next = {
            "gyro": gyro, "integral": bounded(grown, self.integral_limit), "torque": torque,
        }  # fmt: skip
        return next, torque, terms


_UNALLOCATED = 1e-6  # of the normalised torque, above which the axis counts as saturated


class PX4Attitude(AngleLoop):
    """PX4's attitude loop around a rate loop: angles in rad in, normalised torque out.

    The rate's set-point is `p` times the error of the angle, plus a `Setpoint`'s rate, within
    `rate_limit`. There is no integral and no derivative of the angle. The rate that the inner loop
    sees is the difference of the measured angles over a sample. Source: docs/autopilots.md.

    **Arguments:** (each number is a scalar, one value per axis, or `[axes, *ensemble]`)

    - `rate`: the `PX4Rate` inside.
    - `p`: MC_ROLL_P, MC_PITCH_P, MC_YAW_P in 1/s.
    - `rate_limit`: MC_xRATE_MAX in rad/s, 220 deg/s by default.

    **Raises:**

    - `ValueError`: `p` or the limit is not above 0.
    """

    rate: PX4Rate
    p: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=4.0)
    rate_limit: Float[Array, "..."] = per_member(
        rank=1, converter=as_float, default=np.deg2rad(220.0)
    )

    def __check_init__(self):
        require_positive("p", self.p, "give 1/s")
        require_positive("rate_limit", self.rate_limit, "give rad/s")

    def outer_gains(self) -> dict[str, Array]:
        return {"p": self.p}

    def inner(self) -> FirmwareLoop:
        return self.rate

    def outer_rest(self, zero: Signal) -> dict[str, PyTree]:
        return {}

    def wanted_rate(
        self, memory: Mapping[str, PyTree], reference: Reference, angle: Signal, rate: Signal
    ) -> tuple[dict[str, PyTree], Signal]:
        aim = reference.angle if isinstance(reference, Setpoint) else reference
        wanted = broadcast_gain(self.p, angle) * (aim - angle)
        if isinstance(reference, Setpoint):
            wanted = wanted + reference.rate
        return {}, bounded(wanted, self.rate_limit)
