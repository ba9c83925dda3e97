"""What inertia estimators share: plant, trust, equation of motion, test tones; and the lock-in."""

import functools as ft
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxquad._core import (
    as_float,
    broadcast_gain,
    ensemble_shape,
    per_member,
    require_all_positive,
    require_common_shape,
    require_nonnegative,
    require_positive,
    signal_shape,
)

from ._protocols import Gain, InertiaEstimate, Signal


PLAUSIBLE = 10.0  # times the nominal inertia, or a share of it


class LastEstimate(NamedTuple):
    """An estimate between the samples or windows that renew it."""

    inertia: Signal  # kg m^2
    variance: Signal  # (kg m^2)^2, when it was made
    age: Signal  # relative variance that has come with time
    informed: Signal  # 1 once there was excitation


State = TypeVar("State", bound=Any)  # a NamedTuple with the field `last`, a LastEstimate


class AbstractInertia(eqx.Module):
    """The plant and the rules of trust that all estimators share.

    A plant of the inertia J answers a command u with J angle'' = `torque_gain` u + disturbances.
    """

    torque_gain: Gain = per_member(rank=1, converter=as_float)  # N m per unit of command
    nominal: Gain = per_member(rank=1, converter=as_float)  # kg m^2
    trust: float = eqx.field(static=True, default=0.1, kw_only=True)
    drift: float = eqx.field(static=True, default=0.01, kw_only=True)  # 1/sqrt(s)
    dt: float = eqx.field(static=True, default=0.002, kw_only=True)  # s

    def __check_init__(self):
        remedy = "give N m per unit of command: L Kf of the Hover"
        require_positive("torque_gain", self.torque_gain, remedy)
        require_positive("nominal", self.nominal, "give the design's inertia in kg m^2")
        require_common_shape({"torque_gain": self.torque_gain, "nominal": self.nominal})
        require_all_positive(dt=self.dt)

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the parameters, () for one estimator."""
        return ensemble_shape(self)

    def estimate(self, state: Any) -> InertiaEstimate:
        """The last estimate, with the standard deviation that it has by this sample."""
        return self._assess(state.last)

    def excite(self, state: State) -> State:
        """Put the estimate in doubt, which starts the test signal; the inertia is kept."""
        last = state.last
        return state._replace(last=last._replace(age=jnp.ones_like(last.age)))

    def _start(self, like: Signal) -> LastEstimate:
        """The nominal inertia, before any excitation."""
        zero = jnp.zeros_like(like)
        return LastEstimate(
            jnp.broadcast_to(broadcast_gain(self.nominal, like), like.shape), zero, zero, zero
        )

    def _assess(self, last: LastEstimate) -> InertiaEstimate:
        """100 % of deviation before any excitation; it grows while the estimate ages.

        Trusted with a relative deviation of `trust` and within a factor of 10 of the `nominal`.
        """
        variance = last.variance + last.age * last.inertia**2
        some = variance > 0
        deviation = jnp.where(some, jnp.sqrt(jnp.where(some, variance, 1)), 0)
        informed = last.informed > 0
        deviation = jnp.where(informed, deviation, jnp.abs(last.inertia))
        ratio = last.inertia / broadcast_gain(self.nominal, last.inertia)
        plausible = (ratio > 1 / PLAUSIBLE) & (ratio < PLAUSIBLE)
        sure = informed & plausible & (deviation <= self.trust * last.inertia)
        return InertiaEstimate(last.inertia, deviation, sure.astype(deviation.dtype))


class Past(NamedTuple):
    """What differences need of the samples before."""

    angle: Signal
    change: Signal  # of the angle over the last sample
    command: Signal  # held during it
    samples: Int[Array, ""]  # samples, counted to 2


class Equation(NamedTuple):
    """Both sides of J acceleration = torque at one sample, each centred on the sample before."""

    acceleration: Signal  # rad/s^2
    torque: Signal  # N m
    rate: Signal  # rad/s
    angle: Signal  # rad
    valid: Float[Array, ""]  # 0 for the first two samples, whose differences have no past


def empty_past(like: Signal) -> Past:
    zero = jnp.zeros_like(like)
    return Past(zero, zero, zero, jnp.zeros((), jnp.int32))


def motion(
    past: Past, torque_gain: Gain, command: Signal, measurement: Signal, dt: float
) -> tuple[Past, Equation]:
    """The sampled equation of motion of an angle under held torques, without error:

    (phi_k - 2 phi_{k-1} + phi_{k-2}) / T^2 = (tau_{k-1} + tau_{k-2}) / (2 J).
    """
    change = measurement - past.angle
    equation = Equation(
        (change - past.change) / dt**2,
        broadcast_gain(torque_gain, measurement) * (command + past.command) / 2,
        (change + past.change) / (2 * dt),
        past.angle,
        (past.samples >= 2).astype(measurement.dtype),
    )
    return Past(measurement, change, command, jnp.minimum(past.samples + 1, 2)), equation


class ProbeState(NamedTuple):
    index: Int[Array, ""]  # samples
    exciting: Signal  # 1 while the tones are on


class ProbeTones(eqx.Module):
    """Sines to add to the command while the inertia is in doubt.

    They start when the estimate's relative standard deviation is above `above` and stop when it is
    below `below`: permanent tones of 0.3 V at 2 Hz add two thirds to the ITAE of a step of the
    Hover. An estimator learns only while its tones are on, because without them a closed loop shows
    the controller, not the plant.

    **Arguments:**

    - `frequencies`: in Hz.
    - `amplitude`: of each sine in units of the command, a scalar or one value per axis. 0 says that
        other signals excite the loop all the time.
    - `above`, `below`: relative standard deviations; `above=0` keeps the tones on.

    **Raises:** `ValueError`: a frequency is not positive, or `below` is above `above`.
    """

    frequencies: tuple[float, ...] = eqx.field(static=True, default=(2.0,))  # Hz
    amplitude: Gain = per_member(rank=1, converter=as_float, default=0.3)  # of each sine
    above: float = eqx.field(static=True, default=0.08)
    below: float = eqx.field(static=True, default=0.04)

    def __check_init__(self):
        if not self.frequencies or not all(f > 0 for f in self.frequencies):
            raise ValueError(f"frequencies are {self.frequencies} Hz: give at least one, above 0.")
        if self.above != 0 and not 0 <= self.below <= self.above:
            raise ValueError(
                f"Tones start above {self.above} and stop below {self.below}: give 0 <= below <= "
                "above, or above=0 for permanent tones."
            )
        require_nonnegative("amplitude", self.amplitude, "give units of the command")

    def init(self, like: Signal) -> ProbeState:
        return ProbeState(jnp.zeros((), jnp.int32), jnp.ones_like(like))

    def step(self, state: ProbeState, estimate: InertiaEstimate) -> ProbeState:
        """The state one sample later, switched by the `estimate`."""
        return ProbeState(state.index + 1, self.switch(state.exciting, estimate))

    def switch(self, exciting: Signal, estimate: InertiaEstimate) -> Signal:
        """Whether the tones are on after this sample, 1 or 0."""
        if self.above == 0:
            return jnp.ones_like(exciting)
        deviation, inertia = jax.lax.stop_gradient((estimate.deviation, jnp.abs(estimate.inertia)))
        staying = jnp.where(deviation < self.below * inertia, 0, exciting)
        needed = (deviation > self.above * inertia) | (self._amplitude(exciting) == 0)
        return jnp.where(needed, 1, staying)

    def signal(self, state: ProbeState, dt: float) -> Signal:
        """The sines, where they are on, in units of the command."""
        time = dt * state.index.astype(state.exciting.dtype)
        return self.wave(time * jnp.asarray(self.frequencies, time.dtype), state.exciting)

    def wave(self, phase: Float[Array, " tones"], exciting: Signal) -> Signal:
        """The sines at these phases in cycles."""
        wave = jnp.sum(jnp.sin(2 * jnp.pi * (phase % 1)))
        return self._amplitude(exciting) * wave * exciting

    def _amplitude(self, like):
        amplitude = self.amplitude[None] if self.amplitude.ndim == 0 else self.amplitude
        return broadcast_gain(amplitude, like)


class NoProbe(eqx.Module):
    """No test signal: the estimator uses every sample.

    Only for loops that are excited by other means, an injected signal or a busy reference. Where
    only gusts move the Hover, least squares finds the controller instead of the plant: of 64 loops
    with b0 = 1.6 one in seven trusted an inertia that was up to 40 % off.
    """

    def init(self, like: Signal) -> ProbeState:
        return ProbeState(jnp.zeros((), jnp.int32), jnp.ones_like(like))

    def step(self, state: ProbeState, estimate: InertiaEstimate) -> ProbeState:
        return state

    def signal(self, state: ProbeState, dt: float) -> Signal:
        return jnp.zeros_like(state.exciting)


def solve(
    acceleration: Float[Array, " parts tones places axes *ensemble"],
    torque: Float[Array, " parts tones places axes *ensemble"],
    square: Float[Array, " tones *ones"], *, contrast: float, stiff: bool,
) -> tuple[LastEstimate, Signal]:  # fmt: skip
    """Inertia, and stiffness in N m/rad, from the correlations of both sides with each tone.

    The parts are a tone's cosine and sine; the places a frequency below it, its own, one above.
    At a tone torque / acceleration = J - k / w^2 + j (damping, lag), with w^2 the `square`: the
    real part is used. Beside it there is no tone: the torque that the ratio does not explain there
    is the disturbance, whose power, of four degrees of freedom, gives the variance. A tone counts
    if its acceleration has `contrast` times the power of its neighbours'.
    """
    a, u = acceleration[:, :, 1], torque[:, :, 1]
    power = jnp.sum(a**2, axis=0)
    neighbours = jnp.sum(acceleration[:, :, ::2] ** 2, axis=(0, 2)) / 2
    stands_out = power > contrast * neighbours
    inverse = jnp.where(stands_out, 1 / jnp.where(stands_out, power, 1), 0)
    ratio = jnp.sum(a * u, axis=0) * inverse  # of each tone, kg m^2
    imaginary = (a[0] * u[1] - a[1] * u[0]) * inverse
    x, y = acceleration[:, :, ::2]
    explained = [
        ratio[:, None] * x - imaginary[:, None] * y,
        ratio[:, None] * y + imaginary[:, None] * x,
    ]
    left = torque[:, :, ::2] - jnp.stack(explained)
    noise = jnp.sum(left**2, axis=(0, 2)) / 4
    rounding = 1e-12 * jnp.sum(u**2, axis=0)  # keeps the weights of a perfect record finite
    # 1 / variance of the ratio.
    weight = jnp.where(stands_out, power / jnp.where(stands_out, noise + rounding, 1), 0)
    total = jnp.sum(weight, axis=0)
    some = total > 0
    variance = jnp.where(some, 1 / jnp.where(some, total, 1), 0)
    inertia = jnp.sum(weight * ratio, axis=0) * variance
    none = jnp.zeros_like(inertia)
    if not stiff:
        return LastEstimate(inertia, variance, none, some.astype(inertia.dtype)), none
    # Weighted least squares of the ratios on 1 and -1/w^2.
    away = -1 / square - jnp.sum(weight / -square, axis=0)[None] * variance[None]
    spread = jnp.sum(weight * away**2, axis=0)
    some = spread * variance > 1e-9 / jnp.max(square) ** 2
    inverse = jnp.where(some, 1 / jnp.where(some, spread, 1), 0)
    stiffness = jnp.sum(weight * away * ratio, axis=0) * inverse
    centre = jnp.sum(weight / -square, axis=0) * variance
    inertia, variance = inertia - centre * stiffness, variance + centre**2 * inverse
    return LastEstimate(inertia, variance, none, some.astype(stiffness.dtype)), stiffness


BESIDE = 2  # periods per window: the nearest that a Hann window separates from the tone


class WindowSums(NamedTuple):
    correlations: Float[Array, " windows parts lines signals axes *ensemble"]
    valid: Float[Array, " windows axes *ensemble"]  # 1 while nothing was missing
    index: Int[Array, ""]  # sample within the first window


def _cycles(periods, index, samples):
    """Phases in cycles, exact however long the flight."""
    return _ratio((jnp.asarray(periods, jnp.int32) * index) % samples, samples)


def _ratio(count, samples):
    return count.astype(jnp.result_type(float)) / samples


def _over(x, like):
    return x.reshape(x.shape + (1,) * (like.ndim - x.ndim))


class LockInState(NamedTuple):
    past: Past
    sums: WindowSums
    last: LastEstimate
    stiffness: Signal  # N m/rad
    exciting: Signal  # 1 while the tones are on


class LockInInertia(AbstractInertia):
    """Inertia by a lock-in at its own test tones: torque over acceleration, in phase.

    Both sides of the sampled equation of motion are correlated with each tone over Hann windows of
    `window` seconds; a new window begins each half window. Each tone has a whole number of periods
    in a window. Signals with another whole number, such as a constant torque or the paper's 5 s
    sine, drop out exactly; a motor's lag and damping are in quadrature; the ends of a window, where
    encoder noise would enter, have no weight. A delay of d seconds biases the inertia by
    cos(omega d) - 1, an encoder angles of a count or two by 0.5 to 4 %. A stiffness k leaves
    J - k / omega^2 at one tone; `nuisance=("angle",)` with two tones or more removes it.

    The standard deviation is that of one window, from the disturbance at two periods per window
    beside the tones. It has four degrees of freedom, so that it is known to a third, and it assumes
    a spectrum that is flat from there to the tone. Between windows the relative deviation grows by
    `drift` per root second. Windows count in which the tones were on throughout, and tones of
    `contrast` times the power beside them. After a change of the inertia the first window that
    begins after it counts, one and a half windows later at most.
    Source: docs/control.md.

    **Arguments:**

    - `torque_gain`: in N m per unit of command; `nominal`: the design's inertia in kg m^2. Both are
        scalars, one value per axis, or `[axes, *ensemble]`.
    - `tones`: the test signal.
    - `window`: in s, from 100 to 40000 samples.
    - `nuisance`: () or ("angle",).
    - `contrast`; `trust`: the relative deviation up to which an estimate is trusted; `drift`: in
        1/sqrt(s); `dt`: in s.

    **Raises:** `ValueError`: a tone does not fit the window or the other tones, or a value is not
    positive.
    """

    tones: ProbeTones = eqx.field(default_factory=ProbeTones)
    window: float = eqx.field(static=True, default=5.0)  # s
    nuisance: tuple[str, ...] = eqx.field(static=True, default=())
    contrast: float = eqx.field(static=True, default=10.0)

    def __check_init__(self):
        require_all_positive(dt=self.dt, window=self.window)
        if self.nuisance not in ((), ("angle",)):
            raise ValueError(f"nuisance is {self.nuisance}: give () or ('angle',).")
        if self.nuisance and len(self.tones.frequencies) < 2:
            raise ValueError(
                f"One tone, {self.tones.frequencies} Hz, cannot separate stiffness from inertia: "
                "give ProbeTones two frequencies, or leave the nuisance 'angle' out."
            )
        samples = self.window / self.dt
        if abs(samples - round(samples)) > 1e-6 * samples or not 100 <= samples <= 40000:
            raise ValueError(
                f"A window of {self.window} s holds {samples:g} samples of {self.dt} s: give it "
                "a whole number of samples from 100 to 40000."
            )
        for frequency in self.tones.frequencies:
            periods = frequency * self.window
            if abs(periods - round(periods)) > 1e-6 * periods:
                raise ValueError(
                    f"A tone of {frequency} Hz has {periods:g} periods in a window of "
                    f"{self.window} s: give a whole number, such as "
                    f"{max(round(periods), 5) / self.window:g} Hz."
                )
            if not 5 <= round(periods) <= self.samples / 10:
                raise ValueError(
                    f"A tone of {frequency} Hz has {periods:g} periods in a window of "
                    f"{self.window} s: give it from 5 to {self.samples // 10}."
                )
        spacing = np.diff(sorted(self.periods))
        if np.any(spacing < 2 * BESIDE):
            raise ValueError(
                f"Tones of {self.tones.frequencies} Hz are closer than "
                f"{2 * BESIDE / self.window:g} Hz, the resolution of a window of {self.window} s: "
                "give a longer window."
            )

    @property
    def samples(self) -> int:
        """Of a window."""
        return round(self.window / self.dt)

    @property
    def periods(self) -> np.ndarray:
        """Of each tone in a window."""
        return np.array([round(f * self.window) for f in self.tones.frequencies])

    def init(self, like: Signal) -> LockInState:
        """Before the first sample; shaped as the measurement `like` and as the ensemble."""
        like = zero = jnp.zeros(signal_shape(like, self.ensemble), like.dtype)
        lines = 3 * len(self.tones.frequencies)
        correlations = jnp.zeros((2, 2, lines, 2, *like.shape), like.dtype)
        valid = jnp.zeros((2, *like.shape), like.dtype)
        sums = WindowSums(correlations, valid, jnp.zeros((), jnp.int32))
        return LockInState(empty_past(like), sums, self._start(like), zero, zero + 1)

    def update(self, state: LockInState, command: Signal, measurement: Signal) -> LockInState:
        """Add the command held during the last sample and the angle at its end."""
        past, now = motion(state.past, self.torque_gain, command, measurement, self.dt)
        pair, sums = now.valid * jnp.stack([now.acceleration, now.torque]), state.sums
        place = self._place(sums.index)
        going = _over((place > 0).astype(pair.dtype), sums.correlations)
        # Hann windows times cosine and sine of every line: [windows, parts, lines].
        lines = (self.periods[:, None] + np.array([-BESIDE, 0, BESIDE])).reshape(-1)
        angle = 2 * jnp.pi * _cycles(lines, sums.index, self.samples)
        hann = jnp.sin(jnp.pi * _ratio(place, self.samples)) ** 2
        weights = hann[:, None, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)])[None]
        weights = weights.astype(pair.dtype)
        weights = weights.reshape(weights.shape + (1,) * pair.ndim)
        correlations = going * sums.correlations + weights * pair[None, None, None]
        valid = jnp.where(_over(place == 0, sums.valid), 1, sums.valid) * state.exciting[None]
        sums = WindowSums(correlations, valid, (sums.index + 1) % self.samples)
        aged = state.last._replace(age=state.last.age + self.drift**2 * self.dt)
        last, stiffness = jax.lax.cond(
            jnp.any(self._place(sums.index) == 0),  # the last sample ended one of the windows
            lambda *parts: self._renew(*parts),
            lambda sums, *unchanged: unchanged,
            sums, aged, state.stiffness,
        )  # fmt: skip
        exciting = self.tones.switch(state.exciting, self._assess(last))
        return LockInState(past, sums, last, stiffness, exciting)

    def _place(self, index):
        """Of the sample within each window."""
        return (index + jnp.array([0, self.samples // 2], jnp.int32)) % self.samples

    def _renew(self, sums, last, stiffness):
        """The estimate of the window that has just ended, where it shows one."""
        first = sums.index == 0
        done, valid = (jnp.where(first, x[0], x[1]) for x in (sums.correlations, sums.valid))
        done = done.reshape(2, len(self.tones.frequencies), 3, *done.shape[2:])
        # w^2 in (rad/s)^2, as the second difference of a sampled sine shows it.
        square = (2 / self.dt * np.sin(np.pi * self.periods / self.samples)) ** 2
        square = jnp.asarray(square, valid.dtype).reshape((-1,) + (1,) * valid.ndim)
        new = solve(
            done[:, :, :, 0], done[:, :, :, 1], square,
            contrast=self.contrast, stiff=bool(self.nuisance),
        )  # fmt: skip
        renew = ft.partial(jnp.where, (valid > 0) & (new[0].informed > 0))
        return jax.tree.map(renew, new, (last, stiffness))

    def stiffness(self, state: LockInState) -> Signal:
        """In N m/rad beside the inertia; 0 unless the nuisance is "angle"."""
        return state.stiffness

    def probe(self, state: LockInState) -> Signal:
        """The test signal to add to the next command."""
        phase = _cycles(self.periods, state.sums.index, self.samples)
        return self.tones.wave(phase.astype(state.exciting.dtype), state.exciting)
