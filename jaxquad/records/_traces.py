"""Channels as a log has them, to be drawn: with their time stamps, and with their extremes."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ._channel import Channel
from ._log import RecordError, RecordWarning
from ._timebase import timebases_of


def traces(path: str | Path, names: Sequence[str]) -> list[Channel]:
    """Read channels with their own time stamps, neither resampled nor filled.

    **Arguments:**

    - `path`: the file, of any format that `read` knows.
    - `names`: of the channels; those that the file lacks, or that have no time base, are left out.

    **Returns:** a `Channel` for each: `time` in s and `values`, of equal length.

    **Raises:**

    - `ReadError`: where the file is missing, damaged or of an unknown format.
    """
    timebases = timebases_of(path)
    shown = []
    for name in names:
        try:
            with warnings.catch_warnings():  # of repaired stamps, which a drawing shows
                warnings.simplefilter("ignore", RecordWarning)
                shown.append(timebases.channel(name))
        except RecordError:
            continue
    return shown


def envelope(
    channel: Channel, start: float, stop: float, points: int
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """A part of a channel in at most about `points` points that keep all its extremes.

    From `start` to `stop` in s, with a sample beyond each end. Where there are more samples, each
    of `points / 2` equal numbers of samples is its lowest and its highest value, in their order in
    time. Not finite values are left out, as gaps (NaN) between their neighbours.
    """
    time, values = channel.time, channel.values
    first = max(int(np.searchsorted(time, start)) - 1, 0)
    last = min(int(np.searchsorted(time, stop, side="right")) + 1, time.size)
    time, values = time[first:last], np.asarray(values[first:last], np.float64)
    count = max(points // 2, 1)
    if time.size <= 2 * count:
        return time, values
    size = -(-time.size // count)
    edges = np.arange(0, time.size, size)
    lows, highs = np.fmin.reduceat(values, edges), np.fmax.reduceat(values, edges)
    bucket = np.repeat(np.arange(edges.size), size)[: time.size]
    at_low, at_high = (_first_in(bucket, values == ends[bucket], edges) for ends in (lows, highs))
    rows = np.sort(np.stack([at_low, at_high], axis=1), axis=1).ravel()
    return time[rows], values[rows]


def _first_in(bucket: np.ndarray, hits: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """The first row of each bucket that is a hit, its first row where none is (all NaN)."""
    rows = edges.copy()
    at = np.flatnonzero(hits)[::-1]
    rows[bucket[at]] = at
    return rows
