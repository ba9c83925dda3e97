"""The channels of a file, and the time stamps of each."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from ._channel import (
    Channel,
    check_unit,
    clock_start,
    Number,
    PER_SECOND,
    repair_time,
    RepairedTime,
    require_seconds,
    show_times,
    TimeUnit,
    unwrap,
)
from ._log import (
    FEWEST,
    listed,
    located,
    ReadError,
    RecordError,
    Signal,
    Signals,
    unknown_name,
    warn,
)
from .formats import load_signals


_SHARED = ("t", "time", "time_s", "timestamp", "Time", "Timestamp", "TIME")
_UNIT_OF_NAME: dict[str, TimeUnit] = {  # as exporters of ROS bags and ground stations name them
    "__time": "s", "%time": "ns", "rosbagTimestamp": "ns", "timestamp_s": "s",
    **{f"{name}_{unit}": unit for name in ("time", "timestamp") for unit in ("ms", "us", "ns")},
}  # fmt: skip
_KNOWN = (*_SHARED, *_UNIT_OF_NAME, "stamp")
_PARTNERS = {"sec": ("nsec", "nanosec"), "secs": ("nsecs",), "Sec": ("Nsec",)}  # s and ns
_HEADER = r"(?:header[./_])?(?:stamp[./_])?"
_SECONDS = re.compile(rf"((?:.*?[./])??){_HEADER}(secs?)", re.IGNORECASE)
_CLOCK = re.compile(rf"((?:.*?[./])??)(?:header[./_])?({'|'.join(map(re.escape, _KNOWN))})")
_TOPIC = re.compile(r"(.+_)(t|time|timestamp|stamp|Time)")
_COUNTED = "rows"  # the time base where dt says how far apart they are


class ChannelSummary(NamedTuple):
    """One channel of a file: NaN for its rate and times where it has no usable time base."""

    name: str
    samples: int
    rate: float  # Hz, without gaps
    start: float  # s
    stop: float  # s
    minimum: float  # of the finite values
    maximum: float
    unit: str  # empty where unknown

    def __str__(self) -> str:
        start = clock_start(np.array([self.start]))
        clock = f"{self.rate:.5g} Hz, t = {show_times(self.start, self.stop, start=start)}"
        extent = f"{self.minimum:.4g} .. {self.maximum:.4g} {self.unit}".rstrip()
        return f"{self.name}: {self.samples} samples, {clock}, {extent}"


def channels(
    path: str | Path, *, time: str | None = None, time_unit: TimeUnit | None = None,
    dt: Number | None = None,
) -> list[ChannelSummary]:  # fmt: skip
    """List the channels that `read` can take from a file.

    **Arguments:**

    - `path`: the file, of any format that `read` knows.
    - `time`, `time_unit`, `dt`: as in `read`.

    **Returns:** a `ChannelSummary` for each channel, which prints as one line.

    **Raises:**

    - `ReadError`: where the file is missing, damaged or of an unknown format.
    """
    timebases = timebases_of(path, time, time_unit, dt)
    summaries = []
    for name in timebases.names:
        values = timebases.values(name)
        is_finite = np.isfinite(values)
        finite = values if is_finite.all() else values[is_finite]  # a long one is not copied
        low, high = (float(finite.min()), float(finite.max())) if finite.size else (np.nan, np.nan)
        try:
            clock = timebases.extent(name)
        except RecordError:  # A list of channels is also for finding out what is wrong with a file.
            clock = np.nan, np.nan, np.nan
        unit = timebases.unit(name)
        summaries.append(ChannelSummary(name, len(values), *clock, low, high, unit))
    return summaries


def timebases_of(
    path: str | Path, time: str | None = None, time_unit: TimeUnit | None = None,
    dt: Number | None = None,
) -> "Timebases":  # fmt: skip
    """Those of a file. Raises ReadError, which names it."""
    signals = load_signals(path)
    try:
        return Timebases(signals, time, time_unit, dt)
    except ReadError as error:
        raise located(error, path) from error


Place = tuple[str, int | None]  # an array, and its column


class Timebases:
    """The channels of a log, `names`, and their time bases, each repaired once.

    `read` tells how the time base of an array is found. Seconds and nanoseconds are `sec+nsec`.
    """

    def __init__(
        self, signals: Signals, time: str | None, time_unit: TimeUnit | None,
        dt: Number | None = None, time_factor: Number | None = None,
    ):  # fmt: skip
        check_unit(time_unit)
        if time_factor is not None and not 0.5 <= time_factor <= 2:
            raise RecordError(
                f"time_factor is {time_factor:g}: give a number near 1, from 0.5 to 2; units of "
                f"time are for time_unit («time_unit=»)."
            )
        if dt is not None and not 0 < dt < np.inf:
            raise RecordError(f"dt is {dt:g}: give the sampling interval in s, above 0 («dt=»).")
        if dt is not None and (time is not None or time_unit is not None):
            raise RecordError(
                f"dt is {dt:g} s, and a time base is named as well: keep one of them («dt=», "
                "«time=»)."
            )
        self._signals, self._arrays, self._dt = signals, signals.arrays, dt
        self._unit: TimeUnit | None = time_unit
        self._factor = 1.0 if time_factor is None else float(time_factor)
        self._time = None if time is None else signals.titles.get(time, time)
        # The best name of a time base in each struct, and the first one of each topic.
        ranks: dict[str, tuple[int, str]] = {}
        self._topics: dict[str, str] = {}  # `imu_`: imu_time
        for name in self._arrays:
            prefix, rank, base = "", 0, ""
            if match := _CLOCK.fullmatch(name):
                prefix, rank, base = match[1], _KNOWN.index(match[2]), name
            elif match := _SECONDS.fullmatch(name):
                partners = (name.removesuffix(match[2]) + p for p in _PARTNERS.get(match[2], ()))
                partner = next((other for other in partners if other in self._arrays), None)
                if partner is not None:
                    prefix, rank, base = match[1], len(_KNOWN), f"{name}+{partner}"
            if base and (rank, base) < ranks.get(prefix, (len(_KNOWN) + 1, "")):
                ranks[prefix] = rank, base
            elif not base and (topic := _TOPIC.fullmatch(name)):
                self._topics.setdefault(topic[1], name)
        # `imu.` or "": imu.time, or imu.stamp.sec+imu.stamp.nanosec
        self._structs = {prefix: base for prefix, (_, base) in ranks.items()}
        self._columns: dict[str, Place] = {}  # of all arrays
        self.names: dict[str, Place] = {}  # of the channels alone
        arrays, stamps = self._arrays, set()  # of what holds time stamps rather than a channel
        for name in arrays:
            struct, dot, field = name.rpartition(".")
            if field.startswith("t_") and f"{struct}{dot}{field.removeprefix('t_')}" in arrays:
                stamps.add(name)
        if self._time is not None:
            stamps |= set(self._time.split("+"))
        else:
            stamps |= {name for name in arrays if _CLOCK.fullmatch(name)}
            pairs = (base.split("+") for base in self._structs.values() if "+" in base)
            stamps |= {part for pair in pairs for part in pair} & set(arrays)
            if self._topics:
                bases = {self._clock_by_name(name) for name in arrays}
                stamps |= bases & set(self._topics.values())
        for array, signal in self._arrays.items():
            matrix = signal.values
            columns: dict[str, Place] = {array: (array, None)}
            if matrix.ndim > 1:
                columns = {f"{array}[{i}]": (array, i) for i in range(matrix.shape[1])}
            self._columns |= columns
            if not signal.clock and array in stamps:
                continue
            clocked = time is not None or dt is not None or self._clock_by_name(array)
            if not clocked and _begins_with_clock(signal):
                columns = {name: place for name, place in columns.items() if place[1] != 0}
            self.names |= columns
        if self._time is not None:
            self.names.pop(self._time, None)
            for name in self._parts(self._time):
                if name not in self._columns and name not in self._arrays:
                    raise ReadError(f"time base {name!r}: {unknown_name(name, self._arrays)}")
        self._read: dict[str, tuple[np.ndarray, int]] = {}
        self._repaired: dict[tuple[str, bytes], RepairedTime] = {}
        self._rates: dict[tuple[str, bytes], float] = {}

    def channel(self, name: str) -> Channel:
        """The named channel with its time stamps, in s; warns of those that were repaired."""
        values, (stamps, kept, _) = self.values(name), self._repaired_time(name)[1]
        values = values if kept is None else values[kept]
        return Channel(name, stamps, values, self.unit(name))

    def extent(self, name: str) -> tuple[float, float, float]:
        """Rate in Hz, first and last time in s of a channel; raises as `channel` does."""
        base, (stamps, _, _) = self._repaired_time(name)
        if base not in self._rates:
            self._rates[base] = self.channel(name).rate
        return self._rates[base], float(stamps[0]), float(stamps[-1])

    def values(self, name: str) -> np.ndarray:
        """The values of a channel in its unit, without its time stamps."""
        return self._column(self._place(name))

    def unit(self, name: str) -> str:
        """The unit of a channel; a whole title has it in its name."""
        return "" if name in self._signals.titles else self._arrays[self._place(name)[0]].unit

    def _place(self, name: str) -> Place:
        """Of a channel, by its name or by its whole title."""
        short = name if name in self.names else self._signals.titles.get(name, name)
        if short not in self.names:
            raise ReadError(unknown_name(name, self.names))
        return self.names[short]

    def _column(self, place: Place) -> np.ndarray:
        signal, column = self._arrays[place[0]], place[1]
        values = signal.values if column is None else signal.values[:, column]
        if signal.scale == 1.0:
            return values
        return values.astype(np.float64) * signal.scale  # where short ones would overflow

    def _repaired_time(self, name: str) -> tuple[tuple[str, bytes], RepairedTime]:
        """The time base of a channel, of the channel's length."""
        values, array = self.values(name), self._place(name)[0]
        base, rows = self._base(array), self._arrays[array].rows
        count = len(values) if rows is None else rows.size
        key = base, b"" if rows is None else rows.tobytes()
        if self._dt is not None and base == _COUNTED:
            seconds, wraps = np.arange(count) * float(self._dt), 0
            key = f"{base} {len(values)}", key[1]
        else:
            if base not in self._read:
                clock = self._signals.clocks.get(base)
                seconds, wraps = self._count(base) if clock is None else (clock, 0)
                seconds = seconds if self._factor == 1 else self._factor * seconds
                self._read[base] = seconds, wraps
            seconds, wraps = self._read[base]
            if len(seconds) != count:
                raise ReadError(
                    f"channel {name!r} has {len(values)} samples, but its time base {base!r} has "
                    f"{len(seconds)}. Name another time base («time=»), or save the "
                    f"channel's own as {'t_' + array!r}."
                )
        if key in self._repaired:
            return key, self._repaired[key]
        seconds = seconds if rows is None else seconds[rows]
        blank = 0 if rows is None else int(np.count_nonzero(~np.isfinite(seconds)))
        if blank > 0.01 * seconds.size:
            raise ReadError(
                f"in {blank} of the {seconds.size} rows in which channel {name!r} has a value, its "
                f"time base {base!r} is blank. Name the channel's own time base («time=»)."
            )
        repaired = self._repaired[key] = repair_time(seconds)
        times = "once" if wraps == 1 else f"{wraps} times"
        overflow = f"the counter overflowed {times}; this was undone" if wraps else ""
        for text in filter(None, (overflow, repaired[2])):
            warn(f"time base {base!r}: {text}.")
        return key, repaired

    def _base(self, array: str) -> str:
        """The time stamps of an array; warns of a choice where the log does not define them."""
        signal = self._arrays[array]
        if signal.clock and self._time is None:
            if self._dt is not None:
                raise ReadError(
                    f"dt is {self._dt:g} s, but the log gives the time of {array!r}: leave dt out "
                    f"(«dt=»), or name another time base («time=»)."
                )
            if self._unit not in (None, "s"):
                raise ReadError(
                    f"time_unit is {self._unit!r}, but the log gives the time of {array!r} in s: "
                    f"leave the unit out («time_unit=»), or name another time base («time=»)."
                )
            return signal.clock
        if self._dt is not None:
            return _COUNTED
        struct, dot, field = array.rpartition(".")
        its_own = f"{struct}{dot}t_{field}"
        if self._time is None:
            base = self._clock_by_name(array)
        else:
            base = its_own if its_own in self._arrays else self._time
        from_column = not base and _begins_with_clock(signal)
        base = f"{array}[0]" if from_column else base
        if not base:
            raise ReadError(
                f"no time base for {array!r}: none of {its_own}, {', '.join(_SHARED)} is among the "
                f"arrays {listed(self._arrays)}. Name the array with the time stamps («time=»), or "
                f"the two with seconds and nanoseconds («time=SECONDS+NANOSECONDS»), or give the "
                f"sampling interval of equally spaced rows in s («dt=»)."
            )
        stamps = self._arrays.get(base)
        if stamps is not None and stamps.values.ndim != 1 and not from_column:
            raise ReadError(
                f"the time base {base!r} has shape {stamps.values.shape}: it must be one column "
                f"(«time={base}[0]»)."
            )
        if base in self._read or self._time is not None:
            return base
        doubt = ""
        if stamps is not None:  # Others that are called like a time base, and hold something else.
            struct, dot, field = base.rpartition(".")
            names = [f"{struct}{dot}{n}" for n in _SHARED if field in _SHARED and n != field]
            alike = [n for n in names if n in self._arrays]
            alike = [n for n in alike if len(self._arrays[n].values) == len(stamps.values)]
            other = [n for n in alike if not np.array_equal(self._arrays[n].values, stamps.values)]
            if other:
                doubt = (
                    f"; {', '.join(map(repr, other))}, of the same length, is not used. Name the "
                    f"right one («time=»)."
                )
        if base == f"{array}[0]":
            doubt = (
                ", which rises from row to row. Name another channel («time=»), or give the "
                "sampling interval («dt=»)."
            )
        if doubt:
            warn(f"the time stamps are taken from {base!r}{doubt}")
        return base

    def _count(self, base: str) -> tuple[np.ndarray, int]:
        """Stamps (s) that the log does not define as a clock, NaN where blank; overflows undone."""
        parts = self._parts(base)
        if len(parts) == 2:
            places = [self._columns[part] for part in parts]
            seconds, nanoseconds = (
                _in_rows(self._column(place), self._arrays[place[0]].rows) for place in places
            )
            if len(seconds) != len(nanoseconds):
                raise ReadError(
                    f"the time base {base!r} is of {len(seconds)} seconds and {len(nanoseconds)} "
                    f"nanoseconds: name two channels of one length («time=SECONDS+NANOSECONDS»)."
                )
            return seconds + 1e-9 * nanoseconds.astype(np.float64), 0
        array, column = self._columns[base]
        signal = self._arrays[array]
        counter, wraps = unwrap(signal.values if column is None else signal.values[:, column])
        stated: TimeUnit | None = signal.unit if signal.unit in PER_SECOND else None  # pyright: ignore[reportAssignmentType]
        if stated and self._unit not in (None, stated) and array in self._signals.titles.values():
            raise ReadError(
                f"time_unit is {self._unit!r}, but the header says that {array!r} is in {stated}: "
                f"leave the unit out («time_unit=»), or correct the header."
            )
        unit = self._unit or stated or _UNIT_OF_NAME.get(re.split(r"[./]", array)[-1])
        seconds = counter.astype(np.float64) / PER_SECOND[unit or "s"]
        require_seconds(f"the time base {base!r}", seconds, unit, ReadError)
        return _in_rows(seconds, signal.rows), wraps

    def _parts(self, base: str) -> list[str]:
        """A channel, or those of seconds and of nanoseconds."""
        return [base] if base in self._columns or base.count("+") != 1 else base.split("+")

    def _clock_by_name(self, array: str) -> str:
        """The time base that a name gives to an array; empty where none does."""
        struct, dot, field = array.rpartition(".")
        its_own = f"{struct}{dot}t_{field}"
        if its_own in self._arrays:
            return its_own
        for prefix in (*_prefixes(array, r"[./]"), ""):
            if prefix in self._structs:
                return self._structs[prefix]
        topics = (self._topics.get(prefix, array) for prefix in _prefixes(array, "_"))
        return next((base for base in topics if base != array), "")


def _prefixes(name: str, separator: str) -> Iterator[str]:
    """`a.b.` and `a.` for `a.b.c`."""
    for mark in reversed(list(re.finditer(separator, name))):
        yield name[: mark.end()]


def _begins_with_clock(signal: Signal) -> bool:
    """Whether the first column of a matrix is a clock, as Simulink's `To File` writes it."""
    matrix = signal.values
    if matrix.ndim != 2 or matrix.shape[1] < 2 or len(matrix) < FEWEST:
        return False
    steps = np.diff(matrix[:, 0].astype(np.float64))
    if not np.isfinite(steps).all() or not (steps > 0).all():
        return False
    return bool(np.mean(np.abs(steps / np.median(steps) - 1) < 0.5) > 0.9)


def _in_rows(values: np.ndarray, rows: Bool[np.ndarray, " rows"] | None) -> np.ndarray:
    """The values of a column with blank cells at their rows, NaN elsewhere."""
    if rows is None:
        return values
    table = np.full(rows.size, np.nan)
    table[rows] = values
    return table
