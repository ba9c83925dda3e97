import functools as ft

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._window import coefficients


_POINTS = 32  # times to the shortest window, on which overlaps are summed
_APART = 8  # windows' resolutions beyond which a tapered window shows nothing of a frequency


class Placement(eqx.Module):
    """Where the windows of an estimate lie in the records, laid end to end with gaps."""

    starts: Float[np.ndarray, " windows"]  # s
    lengths: Float[np.ndarray, " windows"]  # s
    times: Float[np.ndarray, " times"]  # s; close enough that no two frequencies alias
    dt: float = eqx.field(static=True)  # s
    shape: str = eqx.field(static=True)

    def at(self, times: Float[Array, " times"]) -> Float[Array, "windows times"]:
        """Values of all windows, scaled so that a sum over `self.times` is one over samples."""
        level, cosine = coefficients(self.shape)
        into = (times[None, :] - self.starts[:, None]) / self.lengths[:, None]
        values = level - cosine * jnp.cos(2 * np.pi * into)
        step = (self.times[1] - self.times[0]) / self.dt
        return jnp.where((into >= 0) & (into < 1), values, 0.0) * jnp.sqrt(step)


def place_windows(
    groups: tuple[tuple[int, tuple[int, ...]], ...], shape: str, dt: float, band: float
) -> Placement:
    """Windows of several lengths (samples) and their starts; `band` is what omega spans, rad/s."""
    starts = np.concatenate([np.asarray(mine, float) for _, mine in groups]) * dt
    lengths = np.concatenate([np.full(len(mine), float(n)) for n, mine in groups]) * dt
    shortest, end = lengths.min(), np.max(starts + lengths)
    rate = band / (2 * np.pi) + 2 * _APART / shortest
    step = 1 / max(rate, _POINTS / shortest)
    times = np.arange(starts.min(), end, min(step, (end - starts.min()) / 2))
    return Placement(starts, lengths, times, dt, shape)


@ft.lru_cache(maxsize=16)
def overlaps(
    groups: tuple[tuple[int, tuple[int, ...]], ...], shape: str
) -> Float[np.ndarray, "windows windows"]:
    """What two windows share: the sum over samples of their product."""
    level, cosine = coefficients(shape)
    step = max(min(length for length, _ in groups) / _POINTS, 1.0)
    last = max(mine[-1] + length for length, mine in groups)
    times = np.arange(min(mine[0] for _, mine in groups), last, step)
    rows = []
    for length, mine in groups:
        into = (times[None, :] - np.asarray(mine)[:, None]) / length
        inside = (into >= 0) & (into < 1)
        rows.append(np.where(inside, level - cosine * np.cos(2 * np.pi * into), 0.0))
    values = np.concatenate(rows)
    return step * (values @ values.T)
