"""Signals of one axis on a clock: arrays, excitations, sums, and set-points of references."""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, Key

from jaxquad._core import as_float, on_host, require_all_positive, require_finite, whole_samples
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
        return Motion(value, *(_total_or_none(*both) for both in rates))


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
    """The signal as wide as `members`."""
    missing = len(members) - (signal.ndim - 1)
    aligned = signal.reshape(signal.shape[:1] + (1,) * missing + signal.shape[1:])
    return widened(aligned, signal.shape[:1] + members)


def widened(x: Float[Known, "..."], shape: tuple[int, ...]) -> Float[Known, "..."]:
    """`x` broadcast to a shape."""
    return (jnp if isinstance(x, jax.Array) else np).broadcast_to(x, shape)


def _total_or_none(a: Known | None, b: Known | None) -> Known | None:
    if a is None or b is None:
        return b if a is None else a
    return _total(a, b)


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


class Ramp(Signal):
    """From `before` to `after` at a constant rate.

    **Arguments:**

    - `after`, `before`: in the unit of what it is given for (a reference: rad); one value, or one
        per member.
    - `within`: s that the change lasts.
    - `at`: s from the start.

    **Raises:**

    - `ValueError`: a value is not finite, or `within` is not above 0.
    """

    after: Float[Array, "..."] = eqx.field(converter=as_float)
    within: float = eqx.field(static=True, kw_only=True)  # s
    before: Float[Array, "..."] = eqx.field(converter=as_float, default=0.0, kw_only=True)
    at: float = eqx.field(static=True, default=0.0, kw_only=True)  # s

    def __check_init__(self):
        require_all_positive(within=self.within)
        require_finite("after", self.after)
        require_finite("before", self.before)

    def sample(self, clock: Clock, key: Key[Array, ""] | None) -> Motion:
        share = _progress(clock, self.at, self.within)
        change = on_host(self.after) - on_host(self.before)
        moving = (share >= 0) & (share < 1)
        value = _between(np.clip(share, 0, 1), self.before, self.after)
        return Motion(value, spread(moving / self.within, change))


class SmoothStep(Signal):
    """From `before` to `after` with the least jerk.

    The polynomial s^3 (10 - 15 s + 6 s^2) starts and ends at rest, with no acceleration (Flash and
    Hogan, 1985). Its rate and acceleration are exact, for feed-forward.

    **Arguments:**

    - `after`, `before`: in the unit of what it is given for (a reference: rad); one value, or one
        per member.
    - `within`: s that the change lasts.
    - `at`: s from the start.

    **Raises:**

    - `ValueError`: a value is not finite, or `within` is not above 0.
    """

    after: Float[Array, "..."] = eqx.field(converter=as_float)
    within: float = eqx.field(static=True, kw_only=True)  # s
    before: Float[Array, "..."] = eqx.field(converter=as_float, default=0.0, kw_only=True)
    at: float = eqx.field(static=True, default=0.0, kw_only=True)  # s

    def __check_init__(self):
        require_all_positive(within=self.within)
        require_finite("after", self.after)
        require_finite("before", self.before)

    def sample(self, clock: Clock, key: Key[Array, ""] | None) -> Motion:
        s = np.clip(_progress(clock, self.at, self.within), 0, 1)
        change = on_host(self.after) - on_host(self.before)
        rate = 30 * s**2 * (1 - s) ** 2 / self.within
        acceleration = 60 * s * (1 - s) * (1 - 2 * s) / self.within**2
        return Motion(
            _between(s**3 * (10 - 15 * s + 6 * s**2), self.before, self.after),
            spread(rate, change),
            spread(acceleration, change),
        )


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


class ReferenceModel(Signal):
    """A signal seen through wn^2 / (s^2 + 2 zeta wn s + wn^2), from rest at zero.

    What a pilot's command model does: the set-point becomes one that the vehicle can follow, with
    the rate and acceleration for feed-forward. Exact for a signal held between samples.

    **Arguments:**

    - `signal`: the set-point as it is asked for, a `Signal` or a number.
    - `natural_frequency`: wn in rad/s.
    - `damping`: zeta, without unit; 1 does not overshoot.

    **Raises:**

    - `ValueError`: wn or zeta is not above 0.
    """

    signal: Signal = eqx.field(converter=as_signal)
    natural_frequency: float = eqx.field(static=True, kw_only=True)  # rad/s
    damping: float = eqx.field(static=True, default=1.0, kw_only=True)

    def __check_init__(self):
        require_all_positive(natural_frequency=self.natural_frequency, damping=self.damping)

    @property
    def random(self) -> bool:
        return self.signal.random

    def sample(self, clock: Clock, key: Key[Array, ""] | None) -> Motion:
        from scipy.linalg import expm

        command = self.signal.sample(clock, key).value
        stiffness, friction = self.natural_frequency**2, 2 * self.damping * self.natural_frequency
        model = [[0.0, 1.0, 0.0], [-stiffness, -friction, stiffness], [0.0, 0.0, 0.0]]
        advance = np.asarray(expm(clock.dt * np.array(model))[:2], command.dtype)
        angle, rate = _follow(advance, command)
        return Motion(angle, rate, stiffness * (command - angle) - friction * rate)


@jax.jit
def _follow(
    advance: Float[Array, "2 3"], command: Float[Array, " samples *ensemble"]
) -> tuple[Float[Array, " samples *ensemble"], Float[Array, " samples *ensemble"]]:
    def sample(state, now):
        joined = jnp.concatenate([state, now[None]])
        return jnp.tensordot(advance, joined, 1, precision="highest"), (state[0], state[1])

    start = jnp.zeros((2, *command.shape[1:]), command.dtype)
    return jax.lax.scan(sample, start, command)[1]


def _progress(clock: Clock, at: float, within: float) -> Float[np.ndarray, " samples"]:
    return clock.since(at) / clock.count("within", within, fewest=1)


def _between(
    share: Float[np.ndarray, " samples"],
    before: Float[Array, "..."],
    after: Float[Array, "..."],
) -> Float[Known, " samples *ensemble"]:
    members = np.broadcast_shapes(before.shape, after.shape)
    start, end = (widened(on_host(x), members) for x in (before, after))
    return spread(1 - share, start) + spread(share, end)
