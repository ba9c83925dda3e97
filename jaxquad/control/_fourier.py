"""Inertia, damping and lag in flight by a recursive Fourier transform."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad._core import (
    as_float,
    broadcast_gain,
    is_concrete,
    require_all_positive,
    require_nonnegative,
    require_positive,
    signal_shape,
)

from ._lock_in import (
    AbstractInertia,
    empty_past,
    Equation,
    LastEstimate,
    motion,
    NoProbe,
    Past,
    ProbeState,
    ProbeTones,
)
from ._protocols import Signal


Tones = Float[Array, " tones axes *ensemble"]
NUISANCES = ("offset", "damping", "lag")
STAGES = 3  # of each filter: the window t^2 exp(-3 t / forgetting)
NOISE_MEMORY = 2.0  # times `forgetting`
# Independent values in the mean power of white noise behind this window over that memory: with
# r(s) = exp(-s) (1 + s + s^2 / 3), the window's correlation, 2 / integral(exp(-s / 6) r(s)^2 / 6).
FREEDOM = 8.3  # degrees of freedom
FEWEST = 8.0  # degrees of freedom of a noise power that is used
CLOSEST = 1.5 * STAGES / (2 * np.pi)  # over `forgetting`, Hz: a correlation of 0.11 in power


class Parameters(NamedTuple):
    """Coefficients of the equation of motion by their names, each with its standard deviation."""

    values: dict[str, Signal]
    deviations: dict[str, Signal]  # infinite where the data do not determine the value


class FourierState(NamedTuple):
    past: Past
    stages: tuple[Float[Array, " parts signals tones axes *ensemble"], ...]
    power: Tones  # of the residuals, (rad/s^2)^2
    freedom: Tones  # 1 where the power is that of a full memory
    elapsed: Signal  # s, since the transform began
    values: Float[Array, " coefficients axes *ensemble"]
    variances: Float[Array, " coefficients axes *ensemble"]
    last: LastEstimate
    probe: ProbeState


class FourierInertia(AbstractInertia):
    """Equation error in the frequency domain by a recursive Fourier transform with forgetting.

    Acceleration, torque and rate pass the same complex filters, one for each of the `frequencies`:
    Fourier transforms over a window t^2 exp(-3 t / forgetting) that begins at the latest sample
    and whose mean age is `forgetting`. The filtered equation of motion is therefore as exact as
    the sampled one. At each sample weighted least squares over all frequencies gives K =
    torque_gain / inertia and the `nuisance` terms:

    angle'' = K u - damping angle' - lag K u' + offset.

    The weight of a frequency is the inverse power of the residuals there and at both neighbours,
    over the last 2 `forgetting`: the noise may have any colour that is smooth over three
    frequencies. The standard deviation
    allows for the degrees of freedom of these powers (Meier 1953). It does not cover disturbances
    that feedback correlates with the command: excite by tones, or by a reference, well above them.
    After a change of the inertia the estimate has moved by half after 0.9 `forgetting`.

    An estimate counts with K above 3 of its standard deviations and a damping that is not below 0
    by one: in a loop that nothing but noise moves, the controller reads as a plant with a negative
    one, as does a lag that is not given. Otherwise the last inertia stays, and its relative
    deviation grows by `drift` per root second. The transform begins anew when the test tones start.
    Source: Morelli, "Real-time parameter estimation in the frequency domain" (2000), whose window
    exp(-t / forgetting) lets the noise at its end leak into all frequencies.

    **Arguments:**

    - `torque_gain`: in N m per unit of command; `nominal`: the design's inertia in kg m^2. Both are
        scalars, one value per axis, or `[axes, *ensemble]`.
    - `frequencies`: in Hz, rising; two more than there are coefficients, or more.
    - `forgetting`: in s, the mean age of what the transform weighs.
    - `nuisance`: any of "offset", "damping" and "lag". The last is a small delay of the torque
        beside `lag` and `delay`, to first order.
    - `lag`, `delay`: of the torque behind the command, in s, where they are known.
    - `measured`: "angle" in rad, or "rate" in rad/s.
    - `tones`: the test signal, `ProbeTones(..)`; by default none.
    - `trust`: the relative deviation up to which an estimate is trusted; `drift`: in 1/sqrt(s);
        `dt`: in s.

    **Raises:** `ValueError`: the frequencies are too few, too close or too high, a value is not
    positive, or an option is unknown.
    """

    noise_freedom = FREEDOM  # of the power at one frequency
    fewest_freedom = FEWEST  # of the powers at three

    frequencies: Float[Array, " tones"] = eqx.field(converter=as_float)  # Hz
    forgetting: Float[Array, ""] = eqx.field(converter=as_float, default=3.0, kw_only=True)  # s
    nuisance: tuple[str, ...] = eqx.field(static=True, default=("offset", "damping"), kw_only=True)
    lag: Float[Array, ""] = eqx.field(converter=as_float, default=0.0, kw_only=True)  # s
    delay: Float[Array, ""] = eqx.field(converter=as_float, default=0.0, kw_only=True)  # s
    measured: str = eqx.field(static=True, default="angle", kw_only=True)
    tones: ProbeTones | NoProbe = eqx.field(default=NoProbe(), kw_only=True)

    def __check_init__(self):
        require_all_positive(dt=self.dt)
        require_positive("forgetting", self.forgetting, "give s, 3 periods of the lowest tone")
        require_nonnegative("lag", self.lag, "give s")
        require_nonnegative("delay", self.delay, "give s")
        wrong = set(self.nuisance) - set(NUISANCES)
        if wrong or len(set(self.nuisance)) != len(self.nuisance):
            raise ValueError(
                f"nuisance is {self.nuisance}: choose each of 'offset', 'damping' and 'lag' at "
                "most once."
            )
        if self.measured not in ("angle", "rate"):
            raise ValueError(f"measured is {self.measured!r}: give 'angle' or 'rate'.")
        fewest = len(self.nuisance) + 3
        if self.frequencies.ndim != 1 or self.frequencies.size < fewest:
            raise ValueError(
                f"frequencies have the shape {self.frequencies.shape}: give {fewest} or more, two "
                "beside as many as there are coefficients."
            )
        if not (is_concrete(self.frequencies) and is_concrete(self.forgetting)):
            return
        hertz, closest = np.asarray(self.frequencies), CLOSEST / float(self.forgetting)
        if not np.diff(hertz, prepend=0.0).min() >= closest or not hertz[-1] < 0.25 / self.dt:
            raise ValueError(
                f"frequencies are {hertz} Hz: let them rise by {closest:.3g} Hz or more, from "
                f"there to below {0.25 / self.dt:g} Hz, or give a longer forgetting."
            )

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Names of what is estimated: the nuisance terms, then "gain", K."""
        return (*self.nuisance, "gain")

    def init(self, like: Signal) -> FourierState:
        """Before the first sample; shaped as the measurement `like` and as the ensemble."""
        like = jnp.zeros(signal_shape(like, self.ensemble), like.dtype)
        tones, count = self.frequencies.size, len(self.coefficients)
        stage = jnp.zeros((2, 4, tones, *like.shape), like.dtype)
        power = jnp.zeros((tones, *like.shape), like.dtype)
        values = jnp.zeros((count, *like.shape), like.dtype)
        return FourierState(
            empty_past(like), (stage,) * STAGES, power, power, like, values, values + jnp.inf,
            self._start(like), self.tones.init(like),
        )  # fmt: skip

    def update(self, state: FourierState, command: Signal, measurement: Signal) -> FourierState:
        """Add the command held during the last sample and the angle, or the rate, at its end."""
        past, now = self._equation(state.past, command, measurement)
        terms = (jnp.ones_like(measurement), now.rate, now.torque, now.acceleration)
        # A smooth start, without which the noise of the first angles would be a step of the rate.
        elapsed, forgetting = state.elapsed, self._cast(self.forgetting, state.elapsed)
        fade = now.valid * _smooth_step(elapsed / forgetting)
        filters = [self._cast(x, state.power) for x in self.filters()]
        stages = self._transform(state.stages, fade[None] * jnp.stack(terms), filters)
        rows = self._rows(stages[-1], filters)
        weights = self._weights(state, rows[-1])
        values, inverse, determined = _solve(rows, weights)

        left = rows[-1] - sum(v[None, None] * x for v, x in zip(values, rows, strict=False))
        hat = sum(
            inverse[i, j][None] * jnp.sum(rows[i] * rows[j], axis=0)
            for i in range(len(values))
            for j in range(len(values))
        )  # fmt: skip
        filled = _smooth_step((elapsed / forgetting - 0.5) / 1.5)  # of the window's energy
        elapsed = elapsed + now.valid * self.dt
        follow = self.dt / (NOISE_MEMORY * self._cast(self.forgetting, hat))
        power = state.power + follow * (jnp.sum(left**2, axis=0) - state.power)
        free = filled[None] * jnp.clip(1 - weights * hat / 2, 0, 1)
        freedom = state.freedom + follow * (free - state.freedom)

        count = FREEDOM * jnp.mean(_neighbourhood(freedom), axis=0)
        enough = count > FEWEST
        spread = 1 + 4 / jnp.where(enough, count, 1)  # of weights that are estimates themselves
        variances = jnp.stack([
            jnp.where(enough & ok, spread * inverse[k, k], jnp.inf)
            for k, ok in enumerate(determined)
        ])  # fmt: skip
        last = self._renew(state, values, variances)
        probe = self.tones.step(state.probe, self._assess(last))
        keep = 1 - (1 - state.probe.exciting) * probe.exciting  # 0 where the tones start
        stages = tuple(keep[None, None, None] * stage for stage in stages)
        power, freedom, elapsed = keep[None] * power, keep[None] * freedom, keep * elapsed
        return FourierState(
            past, stages, power, freedom, elapsed, jnp.stack(values), variances, last, probe
        )

    def parameters(self, state: FourierState) -> Parameters:
        """The `coefficients` at the latest sample, in SI units: K in rad/s^2 per unit of command,
        damping in 1/s, offset in rad/s^2, lag in s."""
        values = dict(zip(self.coefficients, state.values, strict=True))
        variances = dict(zip(self.coefficients, state.variances, strict=True))
        if "lag" in values:
            gain, some = values["gain"], values["gain"] != 0
            per_gain = jnp.where(some, 1 / jnp.where(some, gain, 1), jnp.inf)
            values["lag"] = jnp.where(some, values["lag"] * per_gain, 0)
            variances["lag"] = variances["lag"] * per_gain**2
        return Parameters(values, {name: jnp.sqrt(x) for name, x in variances.items()})

    def probe(self, state: FourierState) -> Signal:
        """The test signal to add to the next command."""
        return self.tones.signal(state.probe, self.dt)

    def _cast(self, x, like):
        """A scalar setting, or one value for each frequency, in the rank and type of `like`."""
        x = x.astype(like.dtype)
        return x.reshape(x.shape + (1,) * (like.ndim - x.ndim))

    def _equation(self, past: Past, command: Signal, measurement: Signal) -> tuple[Past, Equation]:
        """Both sides of the equation of motion in units of the command, not of the torque."""
        one = jnp.ones((), measurement.dtype)
        if self.measured == "angle":
            return motion(past, one, command, measurement, self.dt)
        new = Past(measurement, past.change, command, jnp.minimum(past.samples + 1, 2))
        valid = (past.samples >= 1).astype(measurement.dtype)
        slope, mean = (measurement - past.angle) / self.dt, (measurement + past.angle) / 2
        return new, Equation(slope, command, mean, past.angle, valid)

    @property
    def enter(self) -> Float[Array, ""]:
        """The share of a new sample in each stage of the filters."""
        return -jnp.expm1(-STAGES * self.dt / self.forgetting)

    def filters(self) -> tuple[Float[Array, " tones"], ...]:
        """For each frequency: real and imaginary part of the pole of the filters, rad/s, and both
        parts of exp(-j omega delay) / (1 + j omega lag)."""
        omega, keep = 2 * np.pi * self.frequencies, jnp.exp(-STAGES * self.dt / self.forgetting)
        turn, late, phase = omega * self.dt, omega * self.lag, omega * self.delay
        size = 1 / (1 + late**2)
        return (
            keep * jnp.cos(turn), keep * jnp.sin(turn), omega,
            size * (jnp.cos(phase) - late * jnp.sin(phase)),
            -size * (late * jnp.cos(phase) + jnp.sin(phase)),
        )  # fmt: skip

    def _transform(self, stages, terms, filters):
        """The terms, [parts, signals, tones, ..], after each stage: complex first-order low-passes
        around each frequency."""
        enter = self._cast(self.enter, stages[0][0])
        cosine, sine = (x[None] for x in filters[:2])
        real, imaginary, passed = terms[:, None], jnp.zeros_like(terms[:, None]), []
        for x, y in stages:
            real, imaginary = (
                cosine * x - sine * y + enter * real,
                sine * x + cosine * y + enter * imaginary,
            )
            passed.append(jnp.stack([real, imaginary]))
        return tuple(passed)

    def _rows(self, stage, filters) -> list[Float[Array, " parts tones axes *ensemble"]]:
        """Regressors by the order of `coefficients`, and the acceleration."""
        one, rate, (x, y), acceleration = jnp.moveaxis(stage, 1, 0)
        omega, real, imaginary = filters[2:]
        torque = jnp.stack([real * x - imaginary * y, imaginary * x + real * y])
        slope = jnp.stack([-omega * torque[1], omega * torque[0]])
        terms = {"offset": one, "damping": -rate, "lag": -slope}
        return [*(terms[name] for name in self.nuisance), torque, acceleration]

    def _weights(self, state, acceleration):
        """2 over the power of the noise at each frequency, of two parts."""
        noise = _noise(state.power, state.freedom)
        rounding = jnp.finfo(noise.dtype).eps * jnp.sum(acceleration**2, axis=0)
        return 2 * _inverse(noise + rounding, noise + rounding > 0)

    def _renew(self, state: FourierState, values, variances) -> LastEstimate:
        """The inertia of a gain well above 0 and of a plant, with the tones on; else the last."""
        gain, variance = values[-1], variances[-1]
        informed = (gain > 0) & (9 * variance < gain**2) & (state.probe.exciting > 0)
        if "damping" in self.nuisance:
            k = self.nuisance.index("damping")
            informed = informed & ((values[k] > 0) | (values[k] ** 2 < variances[k]))
        relative = jnp.where(informed, variance, 0) * _inverse(gain, informed) ** 2
        inertia = broadcast_gain(self.torque_gain, gain) * _inverse(gain, informed)
        last, zero = state.last, jnp.zeros_like(gain)
        return LastEstimate(
            jnp.where(informed, inertia, last.inertia),
            jnp.where(informed, relative * inertia**2, last.variance),
            jnp.where(informed, zero, last.age + self.drift**2 * self.dt),
            jnp.where(informed, zero + 1, last.informed),
        )


def _inverse(x, safe):
    return jnp.where(safe, 1 / jnp.where(safe, x, 1), 0)


def _neighbourhood(x: Tones) -> Float[Array, " inner axes *ensemble"]:
    """The sum over each frequency and both neighbours, without the first and the last."""
    return x[:-2] + x[1:-1] + x[2:]


def _noise(power: Tones, freedom: Tones) -> Tones:
    """The mean power at each frequency and both neighbours, these brought to it along a power law.

    The law is that of the neighbours' powers, of which a part of the mean keeps it defined; the
    mean of what such a law brings together is low by 2 over its degrees of freedom. The outer two
    frequencies take the law and the mean of those beside them.
    """
    total, free = _neighbourhood(power), _neighbourhood(freedom)
    low, high = (
        (power[at] + 0.1 * total) * _inverse(freedom[at] + 0.1 * free, free > 0)
        for at in (slice(None, -2), slice(2, None))
    )
    some = (low > 0) & (high > 0)
    rise = jnp.sqrt(jnp.where(some, high, 1) / jnp.where(some, low, 1))
    inverse = _inverse(free, free > 0)
    level = power[:-2] * rise + power[1:-1] + power[2:] / rise
    level = level * inverse * (1 + 2 / FREEDOM * inverse)
    return jnp.concatenate([level[:1] / rise[:1], level, level[-1:] * rise[-1:]])


def _smooth_step(x: Signal) -> Signal:
    """From 0 at 0 to 1 at 1, without a slope at either."""
    x = jnp.clip(x, 0, 1)
    return x**2 * (3 - 2 * x)


def _solve(rows, weights: Tones):
    """Weighted least squares of the last of the `rows` on all others, by sweeps.

    Returns values, the inverse of the normal matrix by pairs of indices, and which values the data
    determine; entry by entry, which compiles to one pass over the ensemble.
    """
    count, eps = len(rows) - 1, 64 * jnp.finfo(weights.dtype).eps
    pairs = [(i, j) for i in range(count + 1) for j in range(i, count + 1)]
    products = {(i, j): jnp.sum(weights[None] * rows[i] * rows[j], axis=(0, 1)) for i, j in pairs}
    left, determined = products, []
    for k in range(count):
        safe = left[k, k] > eps * products[k, k]
        inverse = _inverse(left[k, k], safe)
        column = [left[min(i, k), max(i, k)] for i in range(count + 1)]
        swept = {(i, j): left[i, j] - column[i] * column[j] * inverse for i, j in pairs}
        swept |= {(min(i, k), max(i, k)): column[i] * inverse for i in range(count + 1)}
        left = swept | {(k, k): -inverse}
        determined.append(safe)
    inverse = {(i, j): -left[min(i, j), max(i, j)] for i in range(count) for j in range(count)}
    return [left[k, count] for k in range(count)], inverse, determined
