"""Betaflight's PID, its proposed ADRC, its angle mode, and what changes them in flight."""

import dataclasses
from typing import ClassVar, Literal, TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from jaxquad._core import as_float, broadcast_gain, per_member, require_positive
from jaxquad.control import Reference, Setpoint

from .._filters import Filter, FilterChain, PT2, PT3
from .._law import (
    Advance,
    AngleLoop,
    bounded,
    DEGREES,
    Memories,
    RateLoop,
    Signal,
    split_reference,
    sum_of,
)


SMOOTH_HZ = 50.0  # of the set-point in ANGLE mode
_BOOSTED = 50.0  # deg/s of set-point, up to which anti-gravity's boost of P is whole
P_SCALE, I_SCALE, D_SCALE, F_SCALE = 0.032029, 0.244381, 0.000529, 0.013754e-2  # per unit of CLI


class ItermRelax(eqx.Module):
    """Betaflight's iterm_relax: the integral grows less while the set-point moves fast.

    With h the size of the set-point behind a first-order high-pass, in deg/s, the error that is
    integrated is e max(0, 1 - h/threshold) ("setpoint"), or what the error between the low-passed
    set-point and the gyro has beyond h ("gyro").

    **Arguments:**

    - `cutoff_hz`: iterm_relax_cutoff.
    - `threshold`: in deg/s; 40, in angle mode 8.
    - `share`: 1 on the axes that it acts on, 0 on others (iterm_relax RP: [1, 1, 0]).
    - `kind`: iterm_relax_type.
    - `growth_only`: whether it acts only where the integral would grow (RP_INC, RPY_INC).
    """

    cutoff_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=15.0)
    threshold: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=40.0)
    share: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=1.0)
    kind: Literal["setpoint", "gyro"] = eqx.field(static=True, default="setpoint")
    growth_only: bool = eqx.field(static=True, default=False)

    def error(self, slow: Signal, r: Signal, y: Signal, integral: Signal) -> Signal:
        """What is integrated, in deg/s; `slow` is the low-passed set-point."""
        error, fast = r - y, jnp.abs(r - slow)
        threshold, share = (broadcast_gain(x, r) for x in (self.threshold, self.share))
        if self.kind == "setpoint":
            relaxed = error * jnp.maximum(0.0, 1 - fast / threshold)
        else:
            beyond = slow - y
            relaxed = beyond - jnp.clip(beyond, -fast, fast)
        if self.growth_only:
            relaxed = jnp.where(integral * error < 0, error, relaxed)
        return error + share * (relaxed - error)


class DMax(eqx.Module):
    """Betaflight's D_MAX: the D gain rises from d to `ceiling` in fast moves; 1 for small signals.

    The factor is 1 + (ceiling/d - 1) g, g the low-passed maximum of |delta| behind a low-pass times
    `gyro_gain` and of the set-point's speed times `setpoint_gain`, both in deg/s^2; at most
    ceiling/d.

    **Arguments:**

    - `ceiling`: d_max, in the unit of d.
    - `gyro_gain`: 8e-5 d_max_gain / 35; `setpoint_gain`: 8e-5 d_max_advance / 35.
    - `range`, `smooth`: the low-pass of delta, a pt2 at 85 Hz, and that of the factor, 35 Hz.
    """

    ceiling: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    gyro_gain: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    setpoint_gain: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=8e-5)
    range: tuple[Filter, ...] | None = None
    smooth: tuple[Filter, ...] | None = None

    def chains(self, dt: float) -> tuple[FilterChain, FilterChain]:
        """The low-pass of delta and that of the factor."""
        range = (PT2(85.0),) if self.range is None else self.range
        smooth = (PT2(35.0),) if self.smooth is None else self.smooth
        return FilterChain(range, 1 / dt), FilterChain(smooth, 1 / dt)

    def factor(
        self, dt: float, memory: tuple[PyTree, PyTree], delta: Signal, speed: Signal, d: Array
    ) -> tuple[tuple[PyTree, PyTree], Signal]:
        """Of the D gain, 1 or above."""
        chains = self.chains(dt)
        state, quick = chains[0].step(memory[0], delta)
        base = broadcast_gain(d, delta)
        most = broadcast_gain(self.ceiling, delta) / jnp.where(base > 0, base, 1.0)
        most = jnp.where(base > 0, jnp.maximum(most, 1.0), 1.0)
        of_gyro = jnp.abs(quick) * broadcast_gain(self.gyro_gain, delta)
        of_setpoint = jnp.abs(speed) * broadcast_gain(self.setpoint_gain, delta)
        smooth, share = chains[1].step(memory[1], jnp.maximum(of_gyro, of_setpoint))
        return (state, smooth), jnp.minimum(1 + (most - 1) * share, most)


class BetaflightRate(RateLoop):
    """What the rate laws of Betaflight have in common: the filters of the gyro, and its sticks."""

    firmware: ClassVar[str] = "betaflight"
    feed_forward: ClassVar[tuple[str, ...]] = ("f",)
    of_sticks: ClassVar[bool] = True
    if TYPE_CHECKING:

        @property
        def filters(self) -> tuple[Filter, ...]: ...  # of the gyro, at the loop's rate

    def gyro_chains(self) -> list[FilterChain]:
        return [self.gyro, FilterChain(self.filters, 1 / self.dt)] if self.filters else [self.gyro]

    def without_gyro_filters(self) -> "BetaflightRate":
        return dataclasses.replace(self, gyro=FilterChain(), filters=())


class BetaflightPID(BetaflightRate):
    """Betaflight's rate loop: rates in rad/s in, the sum of P, I, D and F in pidsum units out.

        Sum = Kp e + I - Kd d/dt (filtered gyro) + Kf d/dt (set-point),    e = set-point - gyro

    in deg/s with Kp = 0.032029 p, Ki = 0.244381 i, Kd = 0.000529 d, Kf = 0.013754 f / 100. The
    integral is used at once (backward Euler). The sum is what a log's `axisSum` holds. Anti-gravity
    and the fading of the integral at the mixer's limits are numbers of the moment, which a replay
    gives (`FlownBetaflight.at`). Not modelled: absolute control, and the smoothing of the sticks,
    which is before the set-point. Source: docs/autopilots.md.

    !!! example

        ```python
        law = BetaflightPID(p=45, i=80, d=30, dterm=(PT1(105.0),), dt=1 / 4000)
        ```

    **Arguments:** (each number is a scalar, one value per axis, or `[axes, *ensemble]`)

    - `p`, `i`, `d`, `f`: in the CLI's units, not rounded.
    - `gyro`: filters at the gyro's rate (gyro_lpf2), `filters`: those at the loop's rate 1/dt (RPM
        notches, gyro_lpf1, dynamic notches), `dterm`: those of the D term, at 1/dt too.
    - `integral_factor`: of i; the firmware has 2.5 on yaw.
    - `p_lowpass_hz`: of the P term; the firmware has yaw_lowpass_hz on yaw, 0 is off.
    - `relax`: an `ItermRelax`; `d_max`: a `DMax`; None is off.
    - `tpa`: factor of the D term by the throttle, see `tpa_factor`; `tpa_p`: of the P term.
    - `f_share`: factor of F; 0 for centred sticks where feedforward_transition is above 0.
    - `accelerator`: what anti-gravity adds to Ki; `p_boost`: to P, as a share of it; both are 0 at
        steady throttle.
    - `integral_share`: of what the integral grows by; below 1 near the mixer's limits until 4.5.
    - `limit`: pidsum_limit; `integral_limit`: of the I term.
    - `dt`: of the PID loop in s.
    """

    limits: ClassVar[tuple[str, ...]] = ("limit", "integral_limit")
    p: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    i: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    d: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    f: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    gyro: FilterChain = FilterChain()
    filters: tuple[Filter, ...] = ()
    dterm: tuple[Filter, ...] = ()
    integral_factor: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=1.0)
    p_lowpass_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    relax: ItermRelax | None = None
    d_max: DMax | None = None
    tpa: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=1.0)
    tpa_p: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=1.0)
    f_share: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=1.0)
    accelerator: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    p_boost: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    integral_share: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=1.0)
    limit: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=500.0)
    integral_limit: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=400.0)
    dt: float = eqx.field(static=True, default=1 / 4000)  # s

    def __check_init__(self):
        self._chains()  # refuses what lies beyond half of the loop's rate

    def _chains(self) -> tuple[FilterChain, FilterChain]:
        """The filters of the rate and of its derivative, at the loop's rate."""
        return FilterChain(self.filters, 1 / self.dt), FilterChain(self.dterm, 1 / self.dt)

    def derivative_chain(self, axis: int) -> FilterChain:
        return FilterChain(self.dterm, 1 / self.dt)

    def levelled(self) -> "BetaflightPID":
        """Inside of an angle loop, the integral is held from a fifth of the speed on."""
        if self.relax is None:
            return self
        relax = dataclasses.replace(self.relax, threshold=0.2 * self.relax.threshold)
        return dataclasses.replace(self, relax=relax)

    def deflected(self) -> "BetaflightPID":
        return dataclasses.replace(self, f_share=jnp.ones_like(self.f_share))

    def holds_integral(self, axis: int) -> bool:
        return self.relax is not None and float(np.broadcast_to(self.relax.share, (3,))[axis]) > 0

    def d_ceiling(self, axis: int) -> float:
        if self.d_max is None:
            return 1.0
        base, most = (float(np.broadcast_to(x, (3,))[axis]) for x in (self.d, self.d_max.ceiling))
        return max(1.0, most / base) if base > 0 else 1.0

    def rest(self, zero: Signal) -> dict[str, PyTree]:
        filters, dterm = self._chains()
        memory = {
            "gyro": self.gyro_rest(zero), "filters": filters.init(zero),
            "dterm": dterm.init(zero), "reference": zero, "p": zero, "integral": zero, "d": zero,
        }  # fmt: skip
        if self.relax is not None:
            memory["slow"] = zero
        if self.d_max is not None:
            memory["d_max"] = tuple(x.init(zero) for x in self.d_max.chains(self.dt))
        return memory

    def advance(
        self, memory: Memories, excess: Signal, reference: Reference, measurement: Signal
    ) -> Advance:
        at = lambda gain: broadcast_gain(gain, measurement)
        r, speed = split_reference(reference, memory["reference"], self.dt)
        gyro, (smooth, _) = self.filter_gyro(memory["gyro"], DEGREES * measurement)
        filters, dterm = self._chains()
        next = {"gyro": gyro, "reference": r}
        next["filters"], y = filters.step(memory["filters"], smooth)
        next["dterm"], next["d"] = dterm.step(memory["dterm"], y)
        pulled = P_SCALE * at(self.p) * at(self.tpa_p) * (DEGREES * r - y)
        next["p"] = self.low_passed(self.p_lowpass_hz, memory["p"], pulled)
        error = DEGREES * r - y
        if self.relax is not None:
            next["slow"] = self.low_passed(self.relax.cutoff_hz, memory["slow"], DEGREES * r)
            error = self.relax.error(next["slow"], DEGREES * r, y, memory["integral"])
        ki = I_SCALE * at(self.i) * at(self.integral_factor) + at(self.accelerator)
        grown = ki * self.dt * at(self.integral_share) * error
        next["integral"] = bounded(memory["integral"] + grown, self.integral_limit)
        boost = 1 + at(self.p_boost) / jnp.maximum(jnp.abs(DEGREES * r) / _BOOSTED, 1.0)
        delta, factor = (memory["d"] - next["d"]) / self.dt, jnp.ones_like(y)
        if self.d_max is not None:
            at_speed = DEGREES * speed
            next["d_max"], factor = self.d_max.factor(
                self.dt, memory["d_max"], delta, at_speed, self.d
            )
        terms = {
            "P": next["p"] * boost, "I": next["integral"],
            "D": D_SCALE * at(self.d) * at(self.tpa) * factor * delta,
            "F": F_SCALE * at(self.f) * at(self.f_share) * DEGREES * speed,
        }  # fmt: skip
        return next, bounded(sum_of(terms), self.limit), terms


class BetaflightADRC(BetaflightRate):
    """The ADRC proposed for Betaflight (pull request 15400): rates in rad/s in, pidsum units out.

    An observer of y'' = b u + f, y the rate in deg/s, estimates y, y' and f by forward Euler:

        z1 += T (z2 - 3 wo e),  z2 += T (z3 + b u - 3 wo^2 e),  z3 += -T (sigma z3 + wo^3 e)
        b u = wc^2 (r - z1) - 2 wc z2 - z3,    e = z1 - y before the update

    where u in the observer is the command that reached the mixer. In the air: the gate before
    liftoff is not modelled. wo is at most 0.5/T. Source: docs/autopilots.md.

    **Arguments:** (each number is a scalar, one value per axis, or `[axes, *ensemble]`)

    - `wc`, `wo`: adrc_wc, adrc_wo in rad/s.
    - `b0`: adrc_b0 in deg/s^3 per unit of pidsum, see `adrc_b0`.
    - `f`: feed-forward as in `BetaflightPID`.
    - `gyro`, `filters`: as in `BetaflightPID`; `lowpass`: adrc_gyro_lpf_hz, a pt2 at 150 Hz.
    - `setpoint_lowpass_hz`: adrc_td_hz, 0 is off.
    - `b0_scale`: of b0 by the throttle.
    - `forgetting`: adrc_sigma_decay / 10 in 1/s.
    - `limit`: pidsum_limit; `dt`: in s.
    """

    tuned: ClassVar[tuple[str, ...]] = ("wc", "wo", "b0")
    limits: ClassVar[tuple[str, ...]] = ("limit",)
    wc: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=60.0)
    wo: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=100.0)
    b0: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=2000.0)
    f: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    gyro: FilterChain = FilterChain()
    filters: tuple[Filter, ...] = ()
    lowpass: tuple[Filter, ...] | None = None
    setpoint_lowpass_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    b0_scale: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=1.0)
    forgetting: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.3)
    limit: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=500.0)
    dt: float = eqx.field(static=True, default=1 / 4000)  # s

    def __check_init__(self):
        for name, gain in self.gains().items():
            require_positive(name, gain)
        self._chain()  # refuses what lies beyond half of the loop's rate

    def _chain(self) -> FilterChain:
        lowpass = (PT2(150.0),) if self.lowpass is None else self.lowpass
        return FilterChain((*self.filters, *lowpass), 1 / self.dt)

    def rest(self, zero: Signal) -> dict[str, PyTree]:
        return {
            "gyro": self.gyro_rest(zero), "filters": self._chain().init(zero),
            "reference": zero, "slow": zero, "z": (zero, zero, zero), "command": zero,
        }  # fmt: skip

    def advance(
        self, memory: Memories, excess: Signal, reference: Reference, measurement: Signal
    ) -> Advance:
        at = lambda gain: broadcast_gain(gain, measurement)
        r, speed = split_reference(reference, memory["reference"], self.dt)
        gyro, (smooth, _) = self.filter_gyro(memory["gyro"], DEGREES * measurement)
        filters, y = self._chain().step(memory["filters"], smooth)
        slow = self.low_passed(self.setpoint_lowpass_hz, memory["slow"], DEGREES * r)
        b, wc = at(self.b0) * at(self.b0_scale), at(self.wc)
        z, wo, dt = memory["z"], jnp.minimum(at(self.wo), 0.5 / self.dt), self.dt
        drive, error, most = b * (memory["command"] - excess), z[0] - y, at(self.limit) * b
        first = z[0] + dt * (z[1] - 3 * wo * error)
        second = z[1] + dt * (z[2] + drive - 3 * wo**2 * error)
        third = z[2] - dt * (at(self.forgetting) * z[2] + wo**3 * error)
        z = (
            jnp.clip(first, -8000.0, 8000.0), jnp.clip(second, -1e5, 1e5),
            jnp.clip(third, -most, most),
        )  # fmt: skip
        terms = {
            "P": wc**2 * (slow - z[0]) / b, "I": -z[2] / b, "D": -2 * wc * z[1] / b,
            "F": F_SCALE * at(self.f) * DEGREES * speed,
        }  # fmt: skip
        command = bounded(sum_of(terms), self.limit)
        next = {"gyro": gyro, "filters": filters, "reference": r, "slow": slow}
        return {**next, "z": z, "command": command}, command, terms


def adrc_b0(gain: Float[ArrayLike, "..."], lag: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
    """b0 of `BetaflightADRC` in deg/s^3 per pidsum, of an identified plant gain/(s (lag s + 1)).

    Differentiable: `fit.derived` propagates the covariance of gain and lag.

    **Arguments:**

    - `gain`: from the sum that the mixer gets over 1000 to the angular acceleration, in rad/s^2.
    - `lag`: of the motors in s.
    """
    return DEGREES * as_float(gain) / (1000 * as_float(lag))


def tpa_factor(
    throttle: Float[ArrayLike, "..."], rate: float = 65.0, breakpoint: float = 0.35
) -> Float[Array, "..."]:
    """Betaflight's throttle PID attenuation at a throttle of 0 to 1.

    It is 1 up to the `breakpoint`, (tpa_breakpoint - 1000)/1000, then falls by `rate` percent
    (tpa_rate) at full throttle.
    """
    above = jnp.clip((as_float(throttle) - breakpoint) / (1 - breakpoint), 0.0, 1.0)
    return 1 - rate / 100 * above


def dynamic_cutoff(
    throttle: Float[ArrayLike, "..."], low_hz: float, high_hz: float, expo: float = 5.0
) -> Float[Array, "..."]:
    """The cutoff in Hz of Betaflight's dynamic low-passes at a throttle of 0 to 1.

    `expo` is gyro_lpf1_dyn_expo or dterm_lpf1_dyn_expo; 0 is the curve of versions before 4.3.
    """
    throttle = as_float(throttle)
    if expo == 0:
        return jnp.maximum(1.5 * throttle * (1 - throttle**2 / 3) * high_hz, low_hz)
    return low_hz + (high_hz - low_hz) * (throttle * (1 - throttle) * expo / 10 + throttle)


class BetaflightAngle(AngleLoop):
    """Betaflight's angle mode around a rate loop: angles in rad in, pidsum units out.

    The rate's set-point is level/10 times the error of the angle, through a pt3 at 50 Hz.
    Feed-forward is off, and the relaxation of the integral begins at 8 deg/s. Source:
    docs/autopilots.md.

    **Arguments:**

    - `rate`: the `BetaflightPID` inside.
    - `level`: angle_p_gain, 50 is 5 1/s.

    **Raises:** `ValueError`: the level is not above 0.
    """

    outer: ClassVar[tuple[str, ...]] = ("level",)
    rate: BetaflightPID
    level: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=50.0)

    def __check_init__(self):
        require_positive("level", self.level, "give angle_p_gain, 50 by default")

    @property
    def _smooth(self) -> FilterChain:
        return FilterChain((PT3(SMOOTH_HZ),), 1 / self.dt)

    def inner(self) -> BetaflightPID:
        return dataclasses.replace(self.rate.levelled(), f=jnp.zeros_like(self.rate.f))

    def outer_rest(self, zero: Signal) -> dict[str, PyTree]:
        return {"smooth": self._smooth.init(zero)}

    def wanted_rate(
        self, memory: Memories, aim: Setpoint, angle: Signal, rate: Signal
    ) -> tuple[dict[str, PyTree], Signal]:
        level = broadcast_gain(self.level, angle) / 10
        smooth, wanted = self._smooth.step(memory["smooth"], level * (aim.angle - angle))
        return {"smooth": smooth}, wanted
