from pathlib import Path
from typing import NamedTuple

import numpy as np

from ._errors import RecordError
from ._formats import load_arrays
from ._timebase import Arrays, signal_names, timed_channels, TimeUnit


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
    arrays = load_arrays(path)
    return [_summary(arrays, name, time, time_unit) for name in signal_names(arrays, time)]


def _summary(
    arrays: Arrays, name: str, time: str | None, time_unit: TimeUnit | None
) -> ChannelSummary:
    array, column = signal_names(arrays, time)[name]
    values = arrays[array] if column is None else arrays[array][:, column]
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (np.nan, np.nan)
    try:
        [channel] = timed_channels(arrays, [name], time=time, time_unit=time_unit)
        clock = channel.rate, float(channel.time[0]), float(channel.time[-1])
    except RecordError:  # A listing is how one finds out what is wrong with a file.
        clock = np.nan, np.nan, np.nan
    return ChannelSummary(name, len(values), *clock, low, high, "")
