import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, Key

from jaxquad._core import as_float, on_host, require_finite, whole_samples
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


def as_signal(given: Signal | Excitation | ArrayLike) -> Signal:
    """A signal as it is, of an array of samples, or of a `jq.excitation.Excitation`."""
    if isinstance(given, Signal):
        return given
    if isinstance(given, Excitation):
        return Excited(given)
    if np.ndim(given) == 0:
        raise ValueError(
            f"{given!r} is no signal: write jq.Step({given!r}) for a constant, "
            "jq.simulation.WhiteNoise(...) for noise of that deviation"
        )
    return Samples(given)


def spread(
    shape: Float[np.ndarray, " samples"], amplitude: Float[ArrayLike, "*ensemble"]
) -> Float[Known, " samples *ensemble"]:
    """A waveform times the amplitude of each member."""
    known = on_host(amplitude) if isinstance(amplitude, jax.Array) else np.asarray(amplitude)
    column = np.asarray(shape, known.dtype).reshape((-1,) + (1,) * known.ndim)
    return column * known[None]


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
