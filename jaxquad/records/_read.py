import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ._channel import (
    Channel,
    check_ranges,
    clock_start,
    JITTER,
    nonuniformity,
    Number,
    repair_values,
    show_times,
    TimeUnit,
    Valid,
    window,
    within,
    without_turns,
)
from ._edit import combine, resample
from ._errors import located, ReadError, RecordError, RecordWarning, unknown_name
from ._firmwares import firmware_log
from ._log import known_unit
from ._record import as_tuple, assemble, check_distinct, Hold, Record
from ._timebase import Timebases
from .formats import load_log, load_signals


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
    dt: Number | None = None,
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
    summaries = []
    for name in timebases.names:
        values = timebases.values(name)
        finite = values[np.isfinite(values)]
        low, high = (float(finite.min()), float(finite.max())) if finite.size else (np.nan, np.nan)
        try:
            clock = timebases.extent(name)
        except RecordError:  # A list of channels is also for finding out what is wrong with a file.
            clock = np.nan, np.nan, np.nan
        unit = timebases.unit(name)
        summaries.append(ChannelSummary(name, len(values), *clock, low, high, unit))
    return summaries


Mixes = Mapping[str, Mapping[str, Number]]
Selection = str | Sequence[str] | Mixes


def read(
    path: str | Path,
    *,
    inputs: Selection,
    outputs: Selection,
    references: Selection | None = None,
    sample_rate: Number | None = None,
    start: Number | None = None,
    stop: Number | None = None,
    time: str | None = None,
    time_unit: TimeUnit | None = None,
    dt: Number | None = None,
    time_factor: Number | None = None,
    max_gap: Number | None = None,
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
    signals = load_signals(path)
    if not names:
        raise ReadError(f"{path}: no channels are named. Name them («inputs=», «outputs=»).")
    try:
        timebases = Timebases(signals, time, time_unit, dt, time_factor)
        logged = [timebases.channel(name) for name in names]
    except ReadError as error:
        raise located(error, path) from error
    check_ranges(valid or {}, names)
    channels, repaired = [], {}
    for channel in logged:
        limits = (valid or {}).get(channel.name)
        values, times = repair_values(channel.name, channel.time, channel.values, limits, max_gap)
        unit = known_unit(channel.unit) or channel.unit
        values, jumps, period = without_turns(values, unit)
        if jumps:
            turn = "360" if period == 360 else "2 pi"
            count = "once" if jumps == 1 else f"{jumps} times"
            warnings.warn(
                f"channel {channel.name!r} jumps by {turn} {count}, as an angle does at the end of "
                f"its range: it is taken as one that goes on.",
                RecordWarning,
                stacklevel=2,
            )
        channels.append(Channel(channel.name, channel.time, values, channel.unit))
        repaired[channel.name] = times
    stamps, span = channels[0].time, None
    if sample_rate is None and all(np.array_equal(stamps, c.time) for c in channels):
        span = window(stamps, start, stop)
    if span is not None and nonuniformity(stamps[span]) <= JITTER:
        stamps = stamps[span]
        table = np.stack([channel.values[span] for channel in channels], axis=1)
    else:
        slowest = min(channel.rate for channel in channels)
        rate = float(f"{slowest:.3g}") if sample_rate is None else sample_rate
        stamps, table = resample(channels, rate, start=start, stop=stop, max_gap=max_gap)
        # Input and output pass through one filter: a hold within a sample stays what it is.
        longest = 1.01 * (stamps[1] - stamps[0])
        hold = None if isinstance(hold, int | float) and hold > longest else hold
    columns = dict(zip(names, table.T, strict=True))
    mixes = {name: mix for role in roles for name, mix in role.items()}
    units = _units(units or {}, {channel.name: channel.unit for channel in channels}, mixes)
    return assemble(
        stamps,
        roles,
        lambda name: combine(name, mixes[name], columns.__getitem__),
        units.__getitem__,
        source=str(path),
        hold=hold,
        repaired=within(repaired, stamps[0], stamps[-1]),
    )


def _mixes(selection: Selection) -> Mixes:
    if isinstance(selection, Mapping):
        return selection
    names = as_tuple(selection)
    check_distinct(names)
    return {name: {name: 1.0} for name in names}


def _units(units: Mapping[str, str], logged: Mapping[str, str], mixes: Mixes) -> dict[str, str]:
    """Those that the user names, else the log's where the channels of a mix agree."""
    for name, unit in units.items():
        if name not in mixes:
            raise RecordError(f"a unit is given for {name!r}: {unknown_name(name, mixes)}")
        (source, weight), *others = mixes[name].items()
        said, stated = known_unit(unit), known_unit(logged[source])
        if said and stated and said != stated and weight == 1 and not others:
            raise RecordError(
                f"the unit of {name!r} is given as {unit}, but the log says {logged[source]}: "
                f"leave it out («units=»), or multiply the channel by the factor between the two."
            )
    agreed = {}
    for name, mix in mixes.items():
        # A single channel's factor may convert its unit.
        converted = len(mix) == 1 and any(abs(weight) != 1 for weight in mix.values())
        shared = {"" if converted else logged[source] for source in mix}
        agreed[name] = shared.pop() if len(shared) == 1 else ""
    return agreed | dict(units)


class Settings(NamedTuple):
    """Firmware and parameters of a log, as text.

    **Arguments:**

    - `vehicle`: ardupilot, px4 or betaflight.
    - `version`: of the firmware, (4, 2, 0); empty where the log does not say.
    - `values`: by name: a Betaflight header's lines, ArduPilot's PARM, PX4's parameters.
    """

    vehicle: str
    version: tuple[int, ...]
    values: Mapping[str, str]


def read_settings(path: str | Path, *, log: str = "", at: Number | None = None) -> Settings:
    """Read the parameters that a log begins with.

    A parameter that was changed in flight has its value of the time `at`; by default its last one
    in ArduPilot's and PX4's logs, and its first one in Betaflight's, which say no more.

    **Arguments:**

    - `path`: a log of Betaflight, ArduPilot or PX4.
    - `log`: of a Betaflight file with several logs, which one: "log2".
    - `at`: in s of the log's own time, for logs of ArduPilot and PX4.

    **Returns:** the `Settings`.

    **Raises:**

    - `ReadError`: the file cannot be read, is of no autopilot, or holds no parameters.
    """
    content = load_log(path)
    later = [change for change in content.changes if at is not None and change.time > at]
    values = {**content.settings, **{change.name: change.before for change in reversed(later)}}
    if log:
        values = {
            k.removeprefix(f"{log} "): x for k, x in values.items() if k.startswith(f"{log} ")
        }
    firmware = firmware_log(content.vehicle)
    if firmware is None or not firmware.settings or not values:
        raise ReadError(
            f"{path}: the file holds no parameters of ArduPilot, PX4 or Betaflight"
            + (f" under {log!r}" if log else "")
            + ": give the log that the autopilot wrote, with its parameters logged."
        )
    text = values.get(firmware.release, content.firmware)
    match = re.search(r"(\d+)\.(\d+)(?:\.(\d+))?", text)
    if text.isdecimal():  # one byte each, as PX4 has them
        version = tuple(int(text) >> shift & 0xFF for shift in (24, 16, 8))
    else:
        version = tuple(int(part or 0) for part in match.groups()) if match else ()
    return Settings(content.vehicle, version, values)
