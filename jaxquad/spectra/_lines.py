"""Narrow lines in a spectrum, such as those of motors and propellers."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad.records import Record


_SECONDS = 0.5  # of a window: motors change their speed little meanwhile
_SHORTEST, _LONGEST = 64, 4096  # samples of a window
_MOST = 200  # windows that are looked at
_STANDS = 13.0  # dB above the floor: noise alone gets there once in a million
_ALSO = 8.0  # dB, of a harmonic, in the median of all windows
_OFTEN = 0.5  # share of the windows

_Levels = Float[np.ndarray, "windows frequencies"]  # dB


class SpectralLine(NamedTuple):
    """The strongest narrow line of a channel, as `find_line` returns it.

    **Attributes:**

    - `omega`: rad/s, median of the windows in which it stands out.
    - `low`, `high`: rad/s, between which it lies in 90 % of these windows.
    - `height`: dB above its surroundings, median.
    - `share`: of the windows in which it stands out.
    - `harmonics`: which multiples of it stand out, too.
    - `follows`: rank correlation with another channel, -1 to 1; nan without one.
    """

    omega: float
    low: float
    high: float
    height: float
    share: float
    harmonics: tuple[int, ...]
    follows: float


def find_line(
    record: Record, channel: str, *, above: float = 0.0, over: str | None = None
) -> SpectralLine | None:
    """Find the strongest narrow line in the spectrum of a channel.

    In each window of half a second the line is the frequency that is highest above the running
    median of its surroundings. Motors and propellers make lines with harmonics that follow the
    throttle; a resonance of the frame stays where it is.

    **Arguments:**

    - `record`: what was flown.
    - `channel`: whose spectrum.
    - `above`: rad/s, below which no line is looked for, such as the top of the identified band.
    - `over`: a channel that the line may follow, such as the throttle.

    **Returns:** a `SpectralLine`; None where none stands 13 dB out of half of the windows.
    """
    size = int(2 ** np.round(np.log2(np.clip(_SECONDS / record.dt, _SHORTEST, _LONGEST))))
    if size > record.samples:
        return None
    starts = np.arange(0, record.samples - size + 1, size // 2)
    places = starts[:: -(-starts.size // _MOST), None] + np.arange(size)
    omega = 2 * np.pi * np.fft.rfftfreq(size, record.dt)
    excess = _excess(record.channel(channel)[places])
    searched = np.where(omega > above, excess, -np.inf)
    bins = np.argmax(searched, axis=1)
    heights = np.max(searched, axis=1)
    stands = heights > _STANDS
    if np.mean(stands) < _OFTEN:
        return None
    lines = omega[bins[stands]]
    low, middle, high = np.percentile(lines, [5, 50, 95])
    follows = np.nan
    if over is not None:
        levels = record.channel(over)[places].mean(axis=1)[stands]
        follows = 0.0
        if np.ptp(lines) and np.ptp(levels):  # Spearman's, without a correction for ties
            ranks = [
                np.argsort(np.argsort(x, kind="stable"), kind="stable") for x in (lines, levels)
            ]
            follows = float(np.asarray(np.corrcoef(ranks)).flat[1])
    return SpectralLine(
        float(middle), float(low), float(high), float(np.median(heights[stands])),
        float(np.mean(stands)), _harmonics(excess[stands], bins[stands]), float(follows),
    )  # fmt: skip


def _excess(parts: Float[np.ndarray, "windows size"]) -> _Levels:
    """How far the power stands out of the running median around it."""
    size = parts.shape[1]
    taper = np.hanning(size)
    spectra = np.fft.rfft((parts - parts.mean(axis=1, keepdims=True)) * taper, axis=1)
    level = 10 * np.log10(np.maximum(np.abs(spectra) ** 2, 1e-300))
    reach = max(8, size // 32)
    padded = np.pad(level, ((0, 0), (reach, reach)), mode="reflect")
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=1)
    excess = level - np.median(around, axis=2)
    excess[:, :4] = -np.inf  # the mean, and what a taper makes of a trend
    return excess


def _harmonics(excess: _Levels, bins: np.ndarray) -> tuple[int, ...]:
    multiples, rows = [], np.arange(len(bins))
    for multiple in (2, 3, 4):
        near = multiple * bins[:, None] + np.arange(-multiple, multiple + 1)
        if np.median(near[:, -1]) >= excess.shape[1]:
            break
        level = excess[rows[:, None], np.minimum(near, excess.shape[1] - 1)].max(axis=1)
        multiples += [multiple] if np.median(level) > _ALSO else []
    return tuple(multiples)
