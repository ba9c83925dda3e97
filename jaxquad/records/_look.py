from pathlib import Path
from typing import NamedTuple

import numpy as np

from ._errors import RecordError
from ._readers import load_signals
from ._timebase import signal_names, Timebases, TimeUnit


class ChannelSummary(NamedTuple):
    """What a file holds of one channel; NaN where it has no usable time base."""

    name: str
    samples: int
    rate: float  # Hz, gaps not counted
    start: float  # s
    stop: float  # s
    minimum: float
    maximum: float
    unit: str

    def __str__(self) -> str:
        clock = f"{self.rate:.5g} Hz, t = {self.start:.6g} .. {self.stop:.6g} s"
        extent = f"{self.minimum:.4g} .. {self.maximum:.4g} {self.unit}".rstrip()
        return f"{self.name}: {self.samples} samples, {clock}, {extent}"


def channels(
    path: str | Path, *, time: str | None = None, time_unit: TimeUnit | None = None
) -> list[ChannelSummary]:
    """List the channels that `read` can take from a file. Raises ReadError."""
    signals = load_signals(path)
    timebases = Timebases(signals, time, time_unit)
    return [_summary(timebases, name) for name in signal_names(signals, time)]


def _summary(timebases: Timebases, name: str) -> ChannelSummary:
    values = timebases.values(name)
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (np.nan, np.nan)
    try:
        channel = timebases.channel(name)
        clock = channel.rate, float(channel.time[0]), float(channel.time[-1])
    except RecordError:  # A listing is how one finds out what is wrong with a file.
        clock = np.nan, np.nan, np.nan
    return ChannelSummary(name, len(values), *clock, low, high, timebases.unit(name))
