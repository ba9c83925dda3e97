from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxquad._core import (
    align,
    as_float,
    as_float_or_none,
    broadcast_gain,
    ensemble_shape,
    is_concrete,
    match_reference,
    per_member,
    pick_gain,
    require_all_positive,
    require_below_sampling,
    require_common_shape,
    require_finite,
    require_limit,
    require_positive,
    require_sample_interval,
    signal_shape,
)

from ._protocols import (
    AntiWindup,
    Gain,
    LinearController,
    Member,
    Reference,
    Setpoint,
    Signal,
    Transform,
)


class Clamping(eqx.Module):
    """Anti-windup that stops the integral while it drives a saturated command beyond its limit."""

    def __call__(self, growth: Signal, wanted: Signal, bounded: Signal, dt: float) -> Signal:
        return jnp.where((wanted - bounded) * growth > 0, jnp.zeros_like(growth), growth)


class BackCalculation(eqx.Module):
    """Anti-windup by which the integral follows the bounded command with a tracking time.

    Source: Åström & Hägglund, Advanced PID Control, section 3.5.

    **Arguments:** `time`: the tracking time in s, usually between kd/kp and kp/ki.

    **Raises:** `ValueError`: the time is not above 0.
    """

    time: Gain = per_member(rank=1, converter=as_float)  # s; usually between kd/kp and kp/ki

    def __check_init__(self):
        require_positive("The tracking time", self.time, "give seconds, usually kd/kp to kp/ki")

    def __call__(self, growth: Signal, wanted: Signal, bounded: Signal, dt: float) -> Signal:
        share = -dt / broadcast_gain(self.time, bounded)
        follow = -jnp.expm1(share)  # a sample's part, whatever the time
        return growth + follow * (bounded - wanted)


Transition = Float[Array, "2 2 ..."]
Filtered = tuple[Array, Array]  # the filtered angle in rad and its rate in rad/s


def butterworth(bandwidth: Gain, dt: float) -> Transition:
    """What is left after `dt` of a second-order Butterworth filter's error, and of its rate.

    Of v'' + sqrt(2) w v' + w^2 v = w^2 y with w = `bandwidth` in rad/s: exp(A dt), in closed form.
    """
    slow = bandwidth / jnp.sqrt(2.0).astype(bandwidth.dtype)  # both parts of the poles
    decay, turn = jnp.exp(-slow * dt), slow * dt
    cosine, sine = decay * jnp.cos(turn), decay * jnp.sin(turn)
    rows = [[cosine + sine, sine / slow], [-2 * slow * sine, cosine - sine]]
    return jnp.stack([jnp.stack(row) for row in rows])


def filtered(transition: Transition, before: Filtered, measurement: Signal) -> Filtered:
    """A sample later, exactly for a measurement that was held over the sample before it."""
    (aa, ar), (ra, rr) = [[broadcast_gain(gain, measurement) for gain in row] for row in transition]
    away, rate = before[0] - measurement, before[1]
    return measurement + aa * away + ar * rate, ra * away + rr * rate


class PIDState(NamedTuple):
    """What a PID remembers from the last sample."""

    integral: Signal  # units of the command; see `PIDLaw`
    rate: Signal  # filtered, without the sample to come, rad/s
    started: Float[Array, ""]  # 0 before the first sample, then 1
    filtered: Filtered | None = None  # of the measurement, where it is filtered


class PIDLaw(eqx.Module):
    """A `PID` with its filter of the measurement computed, for a loop to run sample by sample.

    Without that filter the state's integral is ahead by half a sample, by the trapezoidal rule.
    """

    gains: Mapping[str, Gain] = per_member(rank=1)
    transition: Transition | None = per_member(rank=3)
    anti_windup: AntiWindup | None
    dt: float = eqx.field(static=True)

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the gains, () for one controller."""
        return ensemble_shape(self)

    def init(self, like: Signal, measurement: Signal | None = None) -> PIDState:
        zero = jnp.zeros(signal_shape(like, self.ensemble), like.dtype)
        first = zero if measurement is None else zero + align(measurement, zero)
        smooth = None if self.transition is None else (first, zero)
        return PIDState(zero, zero, jnp.zeros((), like.dtype), smooth)

    def step(
        self, state: PIDState, reference: Reference, measurement: Signal
    ) -> tuple[PIDState, Signal]:
        reference = match_reference(reference, measurement, state.integral)
        gain = lambda name: broadcast_gain(self.gains[name], measurement)
        angle = reference.angle if isinstance(reference, Setpoint) else reference
        smooth, output = state.filtered, measurement
        if self.transition is not None and smooth is not None:
            smooth = filtered(self.transition, smooth, measurement)
            output = smooth[0]
        half = 0.5 * self.dt * gain("ki") * (angle - output)
        if smooth is None:
            integral, ahead = state.integral + state.started * half, half
        else:
            integral, ahead = state.integral + 2 * half, jnp.zeros_like(half)
        memory, rate = self._rate(state, reference, measurement, smooth)
        wanted = gain("kp") * (gain("proportional_weight") * angle - output)
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
        keep = jnp.exp(-self.dt * broadcast_gain(self.gains["filter"], measurement))
        sharp = (1 - keep) / self.dt
        differenced = measurement if smooth is None else jnp.zeros_like(measurement)
        if isinstance(reference, Setpoint):
            # Half a sample back, where the difference of the measurements is.
            halfway = reference.rate - 0.5 * self.dt * reference.acceleration
            change, ahead = -differenced, (1 - keep) * halfway
        else:
            weight = broadcast_gain(self.gains["derivative_weight"], measurement)
            change = weight * reference - differenced
            ahead = jnp.zeros_like(measurement)
        rate = state.started * (state.rate + sharp * change + ahead)
        memory = keep * rate - sharp * change
        return memory, rate if smooth is None else rate - smooth[1]


class PID(eqx.Module):
    """PID control with two degrees of freedom, a filtered derivative and anti-windup, sampled.

    u = kp (proportional_weight r - y) + ki int(r - y)
        + kd s/(1 + s/filter) (derivative_weight r - y),
    exactly for signals that are straight between samples. The rate of a `Setpoint` replaces
    derivative_weight r'; its acceleration is added times `feedforward`.
    Source: Åström & Hägglund, Advanced PID Control, ch. 3.

    **Arguments:** (each gain is a scalar, one value per axis, or `[axes, *ensemble]`)

    - `kp`, `ki`, `kd`: in units of the command per rad, per rad s and per rad/s.
    - `filter`: the bandwidth of the derivative in rad/s.
    - `proportional_weight`, `derivative_weight`: of the reference.
    - `feedforward`: in units of the command per rad/s^2, 1/b of the plant for all of it.
    - `measurement_filter`: None, or a bandwidth in rad/s below 1/dt. A second-order Butterworth
        filter then gives y and its rate y', so that noise is attenuated in all three terms, and
        `filter` acts on the rate of the reference alone. It is exact for a measurement held over
        the sample before it; the integral is then dt times the sum of the errors.
    - `limit`: of |u|. Give the tightest limit of the loop: where a drive cuts off more, the
        integral winds up.
    - `anti_windup`: `Clamping()`, `BackCalculation(time)`, any other `jq.control.AntiWindup`, or
        None.
    - `dt`: the sample interval in s.

    **Raises:** `ValueError`: a gain is not finite or does not fit the others' shapes; a filter, the
    limit or `dt` is not above 0.
    """

    kp: Gain = per_member(rank=1, converter=as_float)  # per rad
    ki: Gain = per_member(rank=1, converter=as_float)  # per rad s
    kd: Gain = per_member(rank=1, converter=as_float)  # per rad/s
    filter: Gain = per_member(rank=1, converter=as_float, default=125.0)  # rad/s: 20 Hz
    proportional_weight: Gain = per_member(rank=1, converter=as_float, default=1.0)
    derivative_weight: Gain = per_member(rank=1, converter=as_float, default=0.0)
    feedforward: Gain = per_member(rank=1, converter=as_float, default=0.0)  # per rad/s^2
    measurement_filter: Gain | None = per_member(  # rad/s
        rank=1, converter=as_float_or_none, default=None
    )
    limit: Gain = per_member(rank=1, converter=as_float, default=float("inf"))  # of |u|
    anti_windup: AntiWindup | None = Clamping()  # None: the integral winds up
    dt: float = eqx.field(static=True, default=0.002)  # s

    def __check_init__(self):
        if self.anti_windup is not None and not isinstance(self.anti_windup, AntiWindup):
            raise ValueError(
                f"anti_windup is {self.anti_windup!r}: choose Clamping(), BackCalculation(time), "
                "None, or give a function as jq.control.AntiWindup describes it."
            )
        require_sample_interval(self.dt)
        for name, gain in _gains(self).items():
            if name == "limit":
                require_limit(gain)
            elif name in _BANDWIDTHS:
                require_positive(name, gain, _BANDWIDTHS[name])
            else:
                require_finite(name, gain)
        require_common_shape(_gains(self))
        if self.measurement_filter is not None:
            require_below_sampling("measurement_filter", self.measurement_filter, _FASTEST, self.dt)

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the gains, () for one controller."""
        return ensemble_shape(_gains(self), rank=1)

    def prepared(self) -> PIDLaw:
        """The same law with its filter of the measurement computed: what to run in a loop."""
        smooth = self.measurement_filter
        transition = None if smooth is None else butterworth(smooth, self.dt)
        return PIDLaw(_gains(self), transition, self.anti_windup, self.dt)

    def init(self, like: Signal, measurement: Signal | None = None) -> PIDState:
        """With an empty integral; shaped as `like` and the ensemble of the gains.

        A filter of the measurement starts at rest at angle 0, or at `measurement` in rad.
        """
        return self.prepared().init(like, measurement)

    def step(
        self, state: PIDState, reference: Reference, measurement: Signal
    ) -> tuple[PIDState, Signal]:
        """One sample: the command to hold until the next one.

        `reference` is a `Setpoint`, or angles in rad without feed-forward. The first sample starts
        the derivative without a kick.
        """
        return self.prepared().step(state, reference, measurement)

    def linear(self, axis: int = 0, member: Member = None) -> LinearController:
        """One axis without its limit, exactly; `member` picks one of an ensemble.

        The states are the integral, the filtered rate and, of a filtered measurement, the filter's.
        """
        gains = {name: pick_gain(gain, axis, member) for name, gain in _gains(self).items()}
        kp, ki, kd = gains["kp"], gains["ki"], gains["kd"]
        keep = jnp.exp(-self.dt * gains["filter"])
        sharp, half = (1 - keep) / self.dt, 0.5 * self.dt * ki
        weight, one, zero = gains["derivative_weight"], jnp.ones_like(kp), jnp.zeros_like(kp)
        back = (keep - 1) * sharp  # what a sample of the angle leaves in the filter
        bare = LinearController(
            A=jnp.stack([jnp.stack([one, zero]), jnp.stack([zero, keep])]),
            reference_in=jnp.stack([2 * half, back * weight]),
            measurement_in=jnp.stack([-2 * half, -back]),
            C=jnp.stack([one, kd]),
            reference_through=kp * gains["proportional_weight"] + half + kd * sharp * weight,
            measurement_through=-kp - half - kd * sharp,
            dt=self.dt,
        )
        if self.measurement_filter is None:
            return bare
        transition = butterworth(gains["measurement_filter"], self.dt)
        entry = jnp.array([1.0, 0.0], kp.dtype) - transition[:, 0]  # of the measurement
        on_filter = jnp.stack([kp + self.dt * ki, kd])  # u = ... - on_filter (v, v')
        none, zeros = jnp.zeros((2, 2), kp.dtype), jnp.zeros(2, kp.dtype)
        grown = none.at[0, 0].set(-self.dt * ki)  # of the integral, by v
        dot = lambda a, b: jnp.dot(a, b, precision="highest")
        return LinearController(
            A=jnp.block([[bare.A, dot(grown, transition)], [none, transition]]),
            reference_in=jnp.concatenate([bare.reference_in, zeros]),
            measurement_in=jnp.concatenate([dot(grown, entry), entry]),
            C=jnp.concatenate([bare.C, -dot(on_filter, transition)]),
            reference_through=bare.reference_through + 0.5 * self.dt * ki,
            measurement_through=-dot(on_filter, entry),
            dt=self.dt,
        )

    def tunable(self) -> dict[str, Transform | None]:
        """The gains of the three terms, their filters and the weight, where they are not 0."""
        names = ("kp", "ki", "kd", "filter", "proportional_weight", "measurement_filter")
        gains = _gains(self)
        chosen = [name for name in names if name in gains and np.all(np.asarray(gains[name]) != 0)]
        return dict.fromkeys(chosen)


_FASTEST = 1.0  # filter's rad/s times dt: its rate is 8 % low there, and 0 far beyond
_BANDWIDTHS = {
    "filter": "give the derivative's bandwidth in rad/s",
    "measurement_filter": "give rad/s, some ten times the loop's crossover, or None for no filter",
}


def _gains(pid: PID) -> dict[str, Array]:
    smooth = pid.measurement_filter
    return {
        "kp": pid.kp, "ki": pid.ki, "kd": pid.kd, "filter": pid.filter,
        "proportional_weight": pid.proportional_weight,
        "derivative_weight": pid.derivative_weight, "feedforward": pid.feedforward,
        **({} if smooth is None else {"measurement_filter": smooth}), "limit": pid.limit,
    }  # fmt: skip


class PDState(NamedTuple):
    """The last measurement and the filtered derivative of the measurements."""

    measurement: Signal
    rate: Signal
    started: Float[Array, ""]  # 0 before the first sample, then 1


class PD(eqx.Module):
    """Proportional feedback and a filtered derivative, to hold a plant while it is excited.

    command = proportional (reference - measurement) - derivative rate, with the rate from a
    first-order filter.

    **Arguments:**

    - `proportional`, `derivative`: in units of the command per rad and per rad/s, one value per
        axis or `[axes, *ensemble]`.
    - `bandwidth`: of the filter in rad/s.
    - `dt`: the sample interval in s.

    **Raises:** `ValueError`: `dt` or `bandwidth` is not positive.
    """

    proportional: Gain = per_member(rank=1, converter=as_float)  # per rad
    derivative: Gain = per_member(rank=1, converter=as_float)  # per rad/s
    bandwidth: float = eqx.field(static=True, default=125.0)  # 20 Hz
    dt: float = eqx.field(static=True, default=0.002)

    def __check_init__(self):
        require_all_positive(dt=self.dt, bandwidth=self.bandwidth)
        require_common_shape({"proportional": self.proportional, "derivative": self.derivative})

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the gains, () for one controller."""
        return ensemble_shape(self)

    def init(self, like: Signal) -> PDState:
        """At rest; shaped as the measurement `like` and the ensemble of the gains."""
        zero = jnp.zeros(signal_shape(like, self.ensemble), like.dtype)
        return PDState(zero, zero, jnp.zeros((), like.dtype))

    def step(
        self, state: PDState, reference: Reference, measurement: Signal
    ) -> tuple[PDState, Signal]:
        """One sample: the command to hold until the next one.

        **Raises:** `ValueError`: the reference is a `Setpoint`, which a PD cannot feed forward.
        """
        if isinstance(reference, Setpoint):
            raise ValueError(
                "a PD feeds nothing forward, but the reference has a rate or an acceleration: take "
                "a jq.LADRC or jq.PID, or leave them None"
            )
        keep = jnp.exp(jnp.asarray(-self.bandwidth * self.dt, measurement.dtype))
        slope = (measurement - state.measurement) * (state.started / self.dt)
        rate = keep * state.rate + (1 - keep) * slope
        gain = broadcast_gain(self.proportional, measurement)
        damping = broadcast_gain(self.derivative, measurement)
        command = gain * (reference - measurement) - damping * rate
        return PDState(measurement, rate, jnp.ones_like(state.started)), command


def place_pd(
    gain: ArrayLike | Sequence[float], *, natural_frequency: float, damping: float,
    dt: float = 0.002,
) -> PD:  # fmt: skip
    """The `PD` that gives the plant gain/s^2 a natural frequency and a damping ratio.

    **Arguments:**

    - `gain`: in rad/s^2 per unit of command, one value per axis.
    - `natural_frequency`: in rad/s; `damping`: its ratio; `dt`: the sample interval in s.

    **Returns:** The controller.
    """
    gain = as_float(gain)
    if is_concrete(gain):
        gain = np.asarray(gain)  # JAX would compile each operation
    return PD(natural_frequency**2 / gain, 2 * damping * natural_frequency / gain, dt=dt)
