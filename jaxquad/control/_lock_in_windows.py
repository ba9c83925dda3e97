from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int


BESIDE = 2  # periods a window: the nearest that a Hann window keeps apart from the tone


class WindowSums(NamedTuple):
    correlations: Float[Array, " windows parts lines signals axes *ensemble"]
    whole: Float[Array, " windows axes *ensemble"]  # 1 while nothing was missing
    index: Int[Array, ""]  # sample within the first window


class LockInWindows(eqx.Module):
    """Two staggered Hann windows and the sines that they correlate with, by counted samples."""

    frequencies: tuple[float, ...] = eqx.field(static=True)  # Hz
    window: float = eqx.field(static=True)  # s
    dt: float = eqx.field(static=True)  # s

    def __check_init__(self):
        samples = self.window / self.dt
        if abs(samples - round(samples)) > 1e-6 * samples or not 100 <= samples <= 40000:
            raise ValueError(
                f"a window of {self.window} s holds {samples:g} samples of {self.dt} s: give it "
                "a whole number of samples from 100 to 40000"
            )
        for frequency in self.frequencies:
            self._require_whole(frequency)
        apart = np.diff(sorted(self.periods))
        if np.any(apart < 2 * BESIDE):
            raise ValueError(
                f"tones of {self.frequencies} Hz are closer than {2 * BESIDE / self.window:g} Hz, "
                f"what a window of {self.window} s can tell apart: give a longer window"
            )

    def _require_whole(self, frequency):
        periods = frequency * self.window
        if abs(periods - round(periods)) > 1e-6 * periods:
            raise ValueError(
                f"a tone of {frequency} Hz makes {periods:g} periods in a window of {self.window} "
                f"s: give a whole number, such as {max(round(periods), 5) / self.window:g} Hz"
            )
        if not 5 <= round(periods) <= self.samples / 10:
            raise ValueError(
                f"a tone of {frequency} Hz makes {periods:g} periods in a window of {self.window} "
                f"s: give it from 5 to {self.samples // 10}"
            )

    @property
    def samples(self) -> int:
        return round(self.window / self.dt)

    @property
    def periods(self) -> np.ndarray:
        """Of each tone in a window."""
        return np.array([round(f * self.window) for f in self.frequencies])

    def phase(self, index: Int[Array, ""]) -> Float[Array, " tones"]:
        """Of the tones in cycles."""
        return _cycles(self.periods, index, self.samples)

    def square(self, signal: Float[Array, " axes *ensemble"]) -> Float[Array, " tones *ones"]:
        """w^2 in (rad/s)^2, as the second difference of a sampled sine shows it."""
        w = 2 / self.dt * np.sin(np.pi * self.periods / self.samples)
        return jnp.asarray(w**2, signal.dtype).reshape((-1,) + (1,) * signal.ndim)

    def init(self, like: Float[Array, " axes *ensemble"]) -> WindowSums:
        lines = 3 * len(self.frequencies)
        correlations = jnp.zeros((2, 2, lines, 2, *like.shape), like.dtype)
        whole = jnp.zeros((2, *like.shape), like.dtype)
        return WindowSums(correlations, whole, jnp.zeros((), jnp.int32))

    def add(
        self,
        sums: WindowSums,
        signals: Float[Array, " signals axes *ensemble"],
        heard: Float[Array, " axes *ensemble"],
    ) -> WindowSums:
        """One more sample, `heard` 0 where its window is not to count."""
        place = self._place(sums.index)
        going = _over((place > 0).astype(signals.dtype), sums.correlations)
        weights = self._weights(sums.index, place).astype(signals.dtype)
        weights = weights.reshape(weights.shape + (1,) * signals.ndim)
        correlations = going * sums.correlations + weights * signals[None, None, None]
        whole = jnp.where(_over(place == 0, sums.whole), 1, sums.whole) * heard[None]
        return WindowSums(correlations, whole, (sums.index + 1) % self.samples)

    def ends(self, sums: WindowSums) -> Bool[Array, ""]:
        """Whether the last sample ended one of the windows."""
        return jnp.any(self._place(sums.index) == 0)

    def ended(self, sums: WindowSums) -> tuple[Array, Array]:
        """Its correlations [parts, tones, places, signals, ...] and whether it counts."""
        first = sums.index == 0
        chosen, whole = (jnp.where(first, x[0], x[1]) for x in (sums.correlations, sums.whole))
        return chosen.reshape(2, len(self.frequencies), 3, *chosen.shape[2:]), whole

    def _place(self, index):
        """Of the sample within each window."""
        return (index + jnp.array([0, self.samples // 2], jnp.int32)) % self.samples

    def _weights(self, index, place):
        """Hann windows times cosine and sine of every line: [windows, parts, lines]."""
        lines = (self.periods[:, None] + np.array([-BESIDE, 0, BESIDE])).reshape(-1)
        angle = 2 * jnp.pi * _cycles(lines, index, self.samples)
        hann = jnp.sin(jnp.pi * _ratio(place, self.samples)) ** 2
        return hann[:, None, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)])[None]


def _cycles(periods, index, samples):
    """Phases in cycles, exact however long the flight."""
    return _ratio((jnp.asarray(periods, jnp.int32) * index) % samples, samples)


def _ratio(count, samples):
    return count.astype(jnp.result_type(float)) / samples


def _over(x, like):
    return x.reshape(x.shape + (1,) * (like.ndim - x.ndim))
