"""Signals of one axis on a clock: arrays, excitations, sums, set-points, and disturbances."""

import abc
import functools as ft
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, Key

from jaxquad._core import (
    as_float,
    on_host,
    require_all_positive,
    require_finite,
    require_nonnegative,
    whole_samples,
)
from jaxquad.excitation import Excitation


class Clock(NamedTuple):
    """The samples of a scenario: all waveforms are built on their count, in float64."""

    samples: int
    dt: float  # s
    ensemble: tuple[int, ...] = ()  # members that draw their own random numbers

    @property
    def time(self) -> Float[np.ndarray, " samples"]:
        """In s from the start."""
        return self.dt * np.arange(self.samples)

    def count(self, name: str, seconds: float, *, fewest: int = 0) -> int:
        """`seconds` in samples. Raises ValueError unless that is a whole number."""
        return whole_samples(name, seconds, 1 / self.dt, fewest=fewest)

    def since(self, at: float) -> Int[np.ndarray, " samples"]:
        """Samples since `at` s, negative before. Raises ValueError for a time outside."""
        start = self.count("at", at)
        if start >= self.samples:
            raise ValueError(
                f"at is {at} s, but the scenario ends before {self.samples * self.dt:.6g} s: "
                "begin earlier or lengthen it"
            )
        return np.arange(self.samples) - start


Known = Array | np.ndarray  # NumPy's where no number is traced: nothing is compiled for it


class Motion(NamedTuple):
    """A sampled signal and its derivatives; None where they are zero."""

    value: Float[Known, " samples *ensemble"]
    rate: Float[Known, " samples *ensemble"] | None = None
    acceleration: Float[Known, " samples *ensemble"] | None = None


class Signal(eqx.Module):
    """Something that happens in time to one axis. Signals can be added: `Step(...) + Sine(...)`."""

    @abc.abstractmethod
    def sample(self, clock: Clock, key: Key[Array, ""] | None) -> Motion:
        """The signal on a clock; `key` draws what is random in it."""

    @property
    def random(self) -> bool:
        return False

    def __add__(self, other: "Signal | Excitation | ArrayLike") -> "Signal":
        return Sum(self, as_signal(other))


class Sum(Signal):
    """Two signals, one on top of the other."""

    first: Signal
    second: Signal

    @property
    def random(self) -> bool:
        return self.first.random or self.second.random

    def sample(self, clock: Clock, key: Key[Array, ""] | None) -> Motion:
        keys = (None, None) if key is None else jax.random.split(key)
        first = self.first.sample(clock, keys[0])
        second = self.second.sample(clock, keys[1])
        value = _total(first.value, second.value)
        rates = (first.rate, second.rate), (first.acceleration, second.acceleration)
        some = ([x for x in both if x is not None] for both in rates)
        return Motion(value, *(ft.reduce(_total, x) if x else None for x in some))


class Samples(Signal):
    """A signal given sample by sample: an array [samples] or [samples, *ensemble]."""

    values: Float[Array, " samples *ensemble"] = eqx.field(converter=as_float)

    def __check_init__(self):
        require_finite("a signal", self.values)

    def sample(self, clock: Clock, key: Key[Array, ""] | None) -> Motion:
        if self.values.shape[0] != clock.samples:
            raise ValueError(
                f"an array of {self.values.shape[0]} samples does not fit the scenario's "
                f"{clock.samples} ({clock.samples * clock.dt:.6g} s of {clock.dt:.6g} s each): "
                "time comes first, then members"
            )
        return Motion(self.values)


class Excited(Signal):
    """A sweep or another test signal, from the start of the scenario, then zeros."""

    excitation: Excitation

    def sample(self, clock: Clock, key: Key[Array, ""] | None) -> Motion:
        rate, signal = self.excitation.sample_rate, self.excitation.signal
        if abs(rate * clock.dt - 1) > 1e-6:
            raise ValueError(
                f"an excitation of {rate:.6g} Hz in a scenario of {1 / clock.dt:.6g} Hz: build it "
                f"with sample_rate={1 / clock.dt:.6g}"
            )
        if np.any(signal[clock.samples :]):
            raise ValueError(
                f"an excitation of {signal.size / rate:.6g} s does not fit the scenario's "
                f"{clock.samples * clock.dt:.6g} s: lengthen the duration"
            )
        kept = signal[: clock.samples]
        return Motion(as_float(np.pad(kept, (0, clock.samples - kept.size))))


def as_signal(value: Signal | Excitation | ArrayLike) -> Signal:
    """A signal as it is, of an array of samples, or of a `jq.excitation.Excitation`."""
    if isinstance(value, Signal):
        return value
    if isinstance(value, Excitation):
        return Excited(value)
    if np.ndim(value) == 0:
        raise ValueError(
            f"{value!r} is no signal: write jq.Step({value!r}) for a constant, "
            "jq.simulation.WhiteNoise(...) for noise of that deviation"
        )
    return Samples(value)


def spread(
    shape: Float[np.ndarray, " samples"], amplitude: Float[ArrayLike, "*ensemble"]
) -> Float[Known, " samples *ensemble"]:
    """A waveform times the amplitude of each member."""
    factors = on_host(amplitude) if isinstance(amplitude, jax.Array) else np.asarray(amplitude)
    column = np.asarray(shape, factors.dtype).reshape((-1,) + (1,) * factors.ndim)
    return column * factors[None]


def fit(signal: Float[Known, "samples ..."], members: tuple[int, ...]) -> Known:
    missing = len(members) - (signal.ndim - 1)
    aligned = signal.reshape(signal.shape[:1] + (1,) * missing + signal.shape[1:])
    return widened(aligned, signal.shape[:1] + members)


def widened(x: Float[Known, "..."], shape: tuple[int, ...]) -> Float[Known, "..."]:
    return (jnp if isinstance(x, jax.Array) else np).broadcast_to(x, shape)


def _total(a: Known, b: Known) -> Known:
    members = np.broadcast_shapes(a.shape[1:], b.shape[1:])
    return fit(a, members) + fit(b, members)


class Step(Signal):
    """From `before` to `after` at the time `at`; a constant by default.

    **Arguments:**

    - `after`, `before`: in the unit of what it is given for (a reference: rad); one value, or one
        per member.
    - `at`: s from the start.

    **Raises:** ValueError for a value that is not finite.
    """

    after: Float[Array, "..."] = eqx.field(converter=as_float)
    before: Float[Array, "..."] = eqx.field(converter=as_float, default=0.0, kw_only=True)
    at: float = eqx.field(static=True, default=0.0, kw_only=True)  # s

    def __check_init__(self):
        require_finite("after", self.after)
        require_finite("before", self.before)

    def sample(self, clock: Clock, key: Key[Array, ""] | None) -> Motion:
        reached = (clock.since(self.at) >= 0).astype(np.float64)
        return Motion(_between(reached, self.before, self.after))


class Ramp(Step):
    """From `before` to `after` at a constant rate.

    **Arguments:** those of `jq.Step`, and

    - `within`: s that the change lasts.

    **Raises:**

    - `ValueError`: a value is not finite, or `within` is not above 0.
    """

    within: float = eqx.field(static=True, kw_only=True)  # s

    def __check_init__(self):
        require_all_positive(within=self.within)

    def sample(self, clock: Clock, key: Key[Array, ""] | None) -> Motion:
        share = self._progress(clock)
        change = on_host(self.after) - on_host(self.before)
        moving = (share >= 0) & (share < 1)
        value = _between(np.clip(share, 0, 1), self.before, self.after)
        return Motion(value, spread(moving / self.within, change))

    def _progress(self, clock: Clock) -> Float[np.ndarray, " samples"]:
        return clock.since(self.at) / clock.count("within", self.within, fewest=1)


class SmoothStep(Ramp):
    """As `Ramp`, with the least jerk.

    The polynomial s^3 (10 - 15 s + 6 s^2) starts and ends at rest, with no acceleration (Flash and
    Hogan, 1985). Its rate and acceleration are exact, for feed-forward.
    """

    def sample(self, clock: Clock, key: Key[Array, ""] | None) -> Motion:
        s = np.clip(self._progress(clock), 0, 1)
        change = on_host(self.after) - on_host(self.before)
        rate = 30 * s**2 * (1 - s) ** 2 / self.within
        acceleration = 60 * s * (1 - s) * (1 - 2 * s) / self.within**2
        value = _between(s**3 * (10 - 15 * s + 6 * s**2), self.before, self.after)
        return Motion(value, spread(rate, change), spread(acceleration, change))


class Sine(Signal):
    """`amplitude` sin(2 pi (t - at) / period + phase) from the time `at` on, zero before.

    **Arguments:**

    - `amplitude`: one value, or one per member.
    - `period`: s, longer than two samples.
    - `phase`: rad.
    - `at`: s from the start.
    """

    amplitude: Float[Array, "..."] = eqx.field(converter=as_float)
    period: float = eqx.field(static=True, kw_only=True)  # s
    phase: float = eqx.field(static=True, default=0.0, kw_only=True)  # rad
    at: float = eqx.field(static=True, default=0.0, kw_only=True)  # s

    def __check_init__(self):
        require_all_positive(period=self.period)
        require_finite("amplitude", self.amplitude)

    def sample(self, clock: Clock, key: Key[Array, ""] | None) -> Motion:
        if self.period <= 2 * clock.dt:
            raise ValueError(
                f"a sine of period {self.period} s in samples of {clock.dt} s: it needs more than "
                "two samples a period, better twenty"
            )
        count, omega = clock.since(self.at), 2 * np.pi / self.period
        angle = omega * clock.dt * count + self.phase
        waves = (np.sin(angle), omega * np.cos(angle), -(omega**2) * np.sin(angle))
        return Motion(*(spread(wave * (count >= 0), self.amplitude) for wave in waves))


def _between(
    share: Float[np.ndarray, " samples"],
    before: Float[Array, "..."],
    after: Float[Array, "..."],
) -> Float[Known, " samples *ensemble"]:
    members = np.broadcast_shapes(before.shape, after.shape)
    start, end = (widened(on_host(x), members) for x in (before, after))
    return spread(1 - share, start) + spread(share, end)


def gauss_markov(
    key: Key[Array, ""], shape: tuple[int, ...], *, deviation: float | Float[Array, ""],
    corner: float | Float[Array, ""], dt: float,
) -> Float[Array, "samples ..."]:  # fmt: skip
    """Stationary first-order Gauss-Markov noise along the first axis, such as gusts of torque.

    `deviation` is its standard deviation, `corner` its bandwidth in rad/s.
    """
    white = jax.random.normal(key, shape, dtype=float)
    return gauss_markov_of(white, deviation=deviation, corner=corner, dt=dt)


def gauss_markov_of(
    white: Float[Array, "samples ..."], *, deviation: float | Float[Array, ""],
    corner: float | Float[Array, ""], dt: float,
) -> Float[Array, "samples ..."]:  # fmt: skip
    """`gauss_markov` that white noise of unit variance drives."""
    keep = jnp.exp(jnp.asarray(-corner * dt))
    drive = deviation * jnp.sqrt(1 - keep**2)

    def advance(level, kick):
        return keep * level + drive * kick, level

    return jax.lax.scan(advance, deviation * white[0], jnp.roll(white, -1, axis=0))[1]


class Pulse(Signal):
    """A pulse, or a train of pulses: `amplitude` for `width` s from the time `at` on.

    As a payload it is picked up and set down.

    **Arguments:**

    - `amplitude`: in the unit of what it is given for (a disturbance: N m, a payload: kg m^2); one
        value, or one per member.
    - `width`: s.
    - `period`: s; the pulse is repeated in every period, by default it is not.
    - `share`: the part of the period that a pulse lasts, instead of `width`; rounded to samples.
    - `at`: s from the start.

    **Raises:** ValueError for a pulse longer than its period, and for both or none of `width` and
    `share`.
    """

    amplitude: Float[Array, "..."] = eqx.field(converter=as_float)
    width: float | None = eqx.field(static=True, default=None, kw_only=True)  # s
    share: float | None = eqx.field(static=True, default=None, kw_only=True)
    period: float | None = eqx.field(static=True, default=None, kw_only=True)  # s
    at: float = eqx.field(static=True, default=0.0, kw_only=True)  # s

    def __check_init__(self):
        require_finite("amplitude", self.amplitude)
        if (self.width is None) == (self.share is None):
            raise ValueError("a pulse has either a width in s or a share of its period: give one")
        if self.period is not None:
            require_all_positive(period=self.period)
        share, width, period = self.share, self.width, self.period
        if share is not None and period is None:
            raise ValueError(f"share is {share} of a period: give the period in s, or a width")
        if share is not None and not 0 < share <= 1:
            raise ValueError(f"share is {share}: a pulse lasts between 0 and 1 of its period")
        if width is not None:
            require_all_positive(width=width)
            if period is not None and width > period:
                raise ValueError(f"a pulse of {width} s is longer than its period of {period} s")

    def sample(self, clock: Clock, key: Key[Array, ""] | None) -> Motion:
        since = clock.since(self.at)
        place, count = since, 0
        if self.period is not None:
            repeated = clock.count("period", self.period, fewest=1)
            place, count = since % repeated, round((self.share or 0.0) * repeated)
        if self.width is not None:
            count = clock.count("width", self.width, fewest=1)
        return Motion(spread(((since >= 0) & (place < count)).astype(np.float64), self.amplitude))


class WhiteNoise(Signal):
    """Independent normal values, each axis and member with its own.

    **Arguments:**

    - `deviation`: standard deviation in the unit of the signal, rad for a measurement.

    **Raises:**

    - `ValueError`: the deviation is below 0.
    """

    deviation: Float[Array, "..."] = eqx.field(converter=as_float)

    def __check_init__(self):
        require_nonnegative("deviation", self.deviation, "it is a standard deviation")

    @property
    def random(self) -> bool:
        return True

    def sample(self, clock: Clock, key: Key[Array, ""] | None) -> Motion:
        if key is None:
            raise ValueError("a gust or noise is drawn at random: give a key=jax.random.key(0)")
        members = jnp.broadcast_shapes(self.deviation.shape, clock.ensemble)
        unit = self._draw_unit(key, (clock.samples, *members), clock.dt)
        return Motion(unit * jnp.broadcast_to(self.deviation, members)[None])

    def _draw_unit(self, key: Key[Array, ""], shape: tuple[int, ...], dt: float) -> Array:
        return jax.random.normal(key, shape, self.deviation.dtype)


class Gust(WhiteNoise):
    """First-order Gauss-Markov noise: stationary from the first sample, exact at the samples.

    The spectrum is that of white noise through K / (s + corner), with K = deviation sqrt(2 corner).
    Each axis and member draws its own.

    **Arguments:**

    - `deviation`: standard deviation in the unit of the signal, N m for a torque.
    - `corner`: bandwidth in rad/s.

    **Raises:**

    - `ValueError`: the deviation is below 0, or the corner is not above 0.
    """

    corner: float = eqx.field(static=True, default=2.0, kw_only=True)  # rad/s

    def __check_init__(self):
        require_all_positive(corner=self.corner)

    def _draw_unit(self, key: Key[Array, ""], shape: tuple[int, ...], dt: float) -> Array:
        return _gauss_markov(key, shape, deviation=1.0, corner=self.corner, dt=dt)


def ceti_gust(gain: ArrayLike, pole: float, *, torque_gain: ArrayLike = 1.0) -> Gust:
    """Control-equivalent turbulence input: white noise through gain / (s + pole).

    The white noise has unit intensity, E[w(t) w(s)] = delta(t - s), so the input has a standard
    deviation of gain / sqrt(2 pole) and the two-sided spectrum gain^2 / (omega^2 + pole^2) per Hz.
    `pole` is in rad/s. With the plant's `torque_gain` (N m per unit of command) `gain` is in units
    of command per sqrt(s), without it in N m per sqrt(s).
    Source: Lusardi et al., J. American Helicopter Society 49 (2004), for a helicopter in hover.
    """
    require_all_positive(pole=pole)
    return Gust(as_float(gain) * as_float(torque_gain) / np.sqrt(2 * pole), corner=pole)


_gauss_markov = eqx.filter_jit(gauss_markov)
