import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ._clock import clock_start, JITTER, nonuniformity, show_times, TimeUnit, window
from ._edit import combine
from ._errors import located, ReadError, RecordError, RecordWarning, unknown_name
from ._record import as_tuple, check_distinct, Hold, Record
from ._repair import check_ranges, repair_values, Valid, within
from ._resample import Channel, resample
from ._timebase import signal_names, Timebases
from ._turns import without_turns
from ._units import known_unit
from .formats import load_signals


class ChannelSummary(NamedTuple):
    """One channel of a file: NaN for its rate and times where it has no usable time base.

    **Arguments:**

    - `name`: of the channel.
    - `samples`: their number.
    - `rate`: Hz, without gaps.
    - `start`: s.
    - `stop`: s.
    - `minimum`: of the finite values.
    - `maximum`: likewise.
    - `unit`: empty where unknown.
    """

    name: str
    samples: int
    rate: float
    start: float
    stop: float
    minimum: float
    maximum: float
    unit: str

    def __str__(self) -> str:
        start = clock_start(np.array([self.start]))
        clock = f"{self.rate:.5g} Hz, t = {show_times(self.start, self.stop, start=start)}"
        extent = f"{self.minimum:.4g} .. {self.maximum:.4g} {self.unit}".rstrip()
        return f"{self.name}: {self.samples} samples, {clock}, {extent}"


def channels(
    path: str | Path,
    *,
    time: str | None = None,
    time_unit: TimeUnit | None = None,
    dt: float | int | None = None,
) -> list[ChannelSummary]:
    """List the channels that `read` can take from a file.

    **Arguments:**

    - `path`: the file, of any format that `read` knows.
    - `time`, `time_unit`, `dt`: as in `read`.

    **Returns:** a `ChannelSummary` for each channel, which prints as one line.

    **Raises:**

    - `ReadError`: where the file is missing, damaged or of an unknown format.
    """
    signals = load_signals(path)
    try:
        timebases = Timebases(signals, time, time_unit, dt)
    except ReadError as error:
        raise located(error, path) from error
    return [_summary(timebases, name) for name in signal_names(signals, time, dt)]


def _summary(timebases: Timebases, name: str) -> ChannelSummary:
    values = timebases.values(name)
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (np.nan, np.nan)
    try:
        clock = timebases.extent(name)
    except RecordError:  # A list of channels is also for finding out what is wrong with a file.
        clock = np.nan, np.nan, np.nan
    return ChannelSummary(name, len(values), *clock, low, high, timebases.unit(name))


Mixes = Mapping[str, Mapping[str, float | int]]
Selection = str | Sequence[str] | Mixes


def read(
    path: str | Path,
    *,
    inputs: Selection,
    outputs: Selection,
    references: Selection | None = None,
    sample_rate: float | int | None = None,
    start: float | int | None = None,
    stop: float | int | None = None,
    time: str | None = None,
    time_unit: TimeUnit | None = None,
    dt: float | int | None = None,
    time_factor: float | int | None = None,
    max_gap: float | int | None = None,
    units: Mapping[str, str] | None = None,
    hold: Hold = None,
    valid: Valid | None = None,
) -> Record:
    """Read a record from a log: ArduPilot, PX4, Betaflight, Crazyflie, or a table of arrays.

    The format is recognised by the first bytes of the file, else by its name: DataFlash .bin and
    .log, ULog, blackbox .bbl and .bfl or the tables of blackbox_decode, Crazyflie uSD, ROS 2 bags,
    MAT of versions 5 to 7.3, HDF5, Parquet, .npz, .npy, .csv. `channels` lists what a file holds.

    **Arguments:**

    - `path`: the file; for a ROS 2 bag also its folder.
    - `inputs`, `outputs`, `references`: channel names, or new names with weighted sums of channels,
        as `{"roll": {"motor[0]": -1, "motor[1]": 1}}`. The columns of a 2-D array `x` are `x[0]`,
        `x[1]`, ...
    - `sample_rate`: of the record, in Hz. By default channels that share one uniform time base
        are kept bit by bit; others are resampled (see `resample`) to the lowest of their own rates,
        rounded to three digits.
    - `start`, `stop`: first and last time in s of the file's own time, which the record keeps.
        Where that is a date, they may count from the log's start, as messages do.
    - `time`: the array with the time stamps, where the format does not define them, or those with
        seconds and nanoseconds, as `"sec+nanosec"`. The time stamps of `x` are `t_x`, else those
        that `time` names, else t, time, time_s, timestamp or such a pair in the same struct, in
        those around it, in the whole file, else those of its topic (`imu_time` for `imu_x`), else
        the first column of its matrix if that rises steadily.
    - `time_unit`: of the time stamps. `None` means what the file says, else s, and then refuses
        steps of 0.25 and more, which may be milliseconds.
    - `dt`: the sampling interval in s of a table without time stamps, whose rows are equally
        spaced. Its time begins at 0.
    - `time_factor`: of the time stamps, where their clock is known to run slow or fast; `start`,
        `stop` and the record are in the corrected time. 85/84 for logs of a Crazyflie's micro-SD
        card whose firmware is older than August 2026.
    - `max_gap`: the longest gap that is interpolated, in s: of time stamps (see `resample`), and of
        values that are not finite, which by default are refused.
    - `units`: channel name of the record -> unit, for figures and tables; by default those of the
        log.
    - `hold`: how long the plant's input keeps each value, in s, as in `Record`: 0 for what was
        measured, the loop's period for a command. A record at a higher sample rate than that of the
        hold shows straight lines where the input had steps: its hold is unknown.
    - `valid`: channel name of the file -> lowest and highest value that can be true. Others count
        as missing, and are interpolated up to `max_gap`, as in `Record`.

    **Returns:** a `Record`. Overflows of the time counter are undone, up to 1 % of time stamps that
    repeat or go back are dropped with their rows, and angles that jump by a turn (360, 2 pi) go on
    instead, each with a `RecordWarning`.

    **Raises:**

    - `ReadError`: where the file is missing, damaged or of an unknown format, or lacks a channel.
    - `RecordError`: where the data are unusable: gaps, NaN, an empty range.

    !!! Example

        ```python
        record = jq.read("log15.npz", inputs="M", outputs="q", references="x0", start=50, stop=76)
        ```
    """
    roles = [_mixes(inputs), _mixes(outputs), _mixes(references or ())]
    names = list(dict.fromkeys(name for role in roles for mix in role.values() for name in mix))
    channels = _channels(path, names, time, time_unit, dt, time_factor)
    check_ranges(valid or {}, names)
    channels, repaired = _repaired(channels, valid or {}, max_gap)
    span = _shared_grid(channels, start, stop) if sample_rate is None else None
    if span is not None:
        stamps = channels[0].time[span]
        values = np.stack([channel.values[span] for channel in channels], axis=1)
    else:
        rate = _slowest(channels) if sample_rate is None else sample_rate
        stamps, values = resample(channels, rate, start=start, stop=stop, max_gap=max_gap)
    columns = dict(zip(names, values.T, strict=True))
    logged = {channel.name: channel.unit for channel in channels}
    units = _all_units(units or {}, logged, roles)
    return Record(
        stamps,
        *(_blend(role, columns, stamps.size) for role in roles),
        input_names=tuple(roles[0]),
        output_names=tuple(roles[1]),
        reference_names=tuple(roles[2]),
        input_units=[units[name] for name in roles[0]],
        output_units=[units[name] for name in roles[1]],
        reference_units=[units[name] for name in roles[2]],
        source=str(path),
        hold=hold if span is not None else _after_resampling(hold, stamps),
        time_unit="s",
        repaired=within(repaired, stamps[0], stamps[-1]),
    )


def _repaired(
    channels: Sequence[Channel], valid: Valid, max_gap: float | int | None
) -> tuple[list[Channel], dict[str, Float[np.ndarray, " repaired"]]]:
    """The channels with values filled in where that is asked for, and when (s), by channel."""
    whole, times = [], {}
    for each in channels:
        found = repair_values(each.name, each.time, each.values, valid.get(each.name), max_gap)
        whole.append(_continuous(Channel(each.name, each.time, found.values, each.unit)))
        times[each.name] = found.times
    return whole, times


def _continuous(channel: Channel) -> Channel:
    """The channel, an angle without its jumps of a turn."""
    values, jumps, period = without_turns(channel.values, known_unit(channel.unit) or channel.unit)
    if not jumps:
        return channel
    turn = "360" if period == 360 else "2 pi"
    times = "once" if jumps == 1 else f"{jumps} times"
    warnings.warn(
        f"channel {channel.name!r} jumps by {turn} {times}, as an angle does at the end of its "
        f"range: it is taken as one that goes on.",
        RecordWarning,
        stacklevel=4,
    )
    return Channel(channel.name, channel.time, values, channel.unit)


def _after_resampling(hold: Hold, stamps: Float[np.ndarray, " samples"]) -> Hold:
    """Input and output pass through one filter, so that a hold within a sample stays what it is."""
    longest = 1.01 * (stamps[1] - stamps[0])
    return None if isinstance(hold, int | float) and hold > longest else hold


def _all_units(
    given: Mapping[str, str], logged: Mapping[str, str], roles: Sequence[Mixes]
) -> dict[str, str]:
    """Those given, else the log's where the channels of a mix agree."""
    mixes = {name: mix for role in roles for name, mix in role.items()}
    for name in given:
        if name not in mixes:
            raise RecordError(f"a unit is given for {name!r}: {unknown_name(name, mixes)}")
        _check_contradiction(name, given[name], mixes[name], logged)
    units = {
        name: {logged[source] for source in mix} if _keeps_units(mix) else {""}
        for name, mix in mixes.items()
    }
    agreed = {name: unit.pop() if len(unit) == 1 else "" for name, unit in units.items()}
    return agreed | dict(given)


def _keeps_units(mix: Mapping[str, float | int]) -> bool:
    """Whether a mix is in the unit of its channels: a single channel's factor may convert it."""
    return len(mix) > 1 or all(abs(weight) == 1 for weight in mix.values())


def _check_contradiction(
    name: str, given: str, mix: Mapping[str, float | int], logged: Mapping[str, str]
) -> None:
    """Raise RecordError for another unit than the log's of a channel that is taken as it is."""
    (source, weight), *others = mix.items()
    said, stated = known_unit(given), known_unit(logged[source])
    if said and stated and said != stated and weight == 1 and not others:
        raise RecordError(
            f"the unit of {name!r} is given as {given}, but the log says {logged[source]}: leave "
            f"it out («units=»), or multiply the channel by the factor between the two."
        )


def _mixes(selection: Selection) -> Mixes:
    if isinstance(selection, Mapping):
        return selection
    names = as_tuple(selection)
    check_distinct(names)
    return {name: {name: 1.0} for name in names}


def _channels(
    path: str | Path,
    names: Sequence[str],
    time: str | None,
    time_unit: TimeUnit | None,
    dt: float | int | None,
    time_factor: float | int | None,
) -> list[Channel]:
    signals = load_signals(path)
    if not names:
        raise ReadError(f"{path}: no channels are named. Name them («inputs=», «outputs=»).")
    try:
        timebases = Timebases(signals, time, time_unit, dt, time_factor)
        return [timebases.channel(name) for name in names]
    except ReadError as error:
        raise located(error, path) from error


def _slowest(channels: Sequence[Channel]) -> float:
    return float(f"{min(channel.rate for channel in channels):.3g}")


def _shared_grid(
    channels: Sequence[Channel], start: float | int | None, stop: float | int | None
) -> slice | None:
    time = channels[0].time
    if not all(np.array_equal(time, channel.time) for channel in channels):
        return None
    span = window(time, start, stop)
    return span if nonuniformity(time[span]) <= JITTER else None


def _blend(
    role: Mixes, columns: Mapping[str, np.ndarray], samples: int
) -> Float[np.ndarray, "samples channels"]:
    mixed = [combine(name, mix, columns.__getitem__) for name, mix in role.items()]
    return np.stack(mixed, axis=1) if mixed else np.empty((samples, 0))
