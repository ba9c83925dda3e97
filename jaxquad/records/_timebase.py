import re
import warnings
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ._clock import (
    check_unit,
    doubt_of_seconds,
    PER_SECOND,
    repair,
    RepairedTime,
    steady,
    TimeUnit,
    unwrap,
)
from ._errors import listed, ReadError, RecordError, RecordWarning, unknown_name
from ._log import Signal, Signals
from ._resample import Channel


_SHARED = ("t", "time", "time_s", "timestamp", "Time", "Timestamp", "TIME")
_UNIT_OF_NAME: Mapping[str, TimeUnit] = {  # as exporters of ROS bags and ground stations name them
    "__time": "s", "%time": "ns", "rosbagTimestamp": "ns", "timestamp_s": "s",
    **{f"{name}_{unit}": unit for name in ("time", "timestamp") for unit in ("ms", "us", "ns")},
}  # fmt: skip
_KNOWN = (*_SHARED, *_UNIT_OF_NAME, "stamp")
_PARTNERS = {"sec": ("nsec", "nanosec"), "secs": ("nsecs",), "Sec": ("Nsec",)}  # s and ns
_HEADER = r"(?:header[./_])?(?:stamp[./_])?"
_SECONDS = re.compile(rf"((?:.*?[./])??){_HEADER}(secs?)", re.IGNORECASE)
_CLOCK = re.compile(rf"((?:.*?[./])??)(?:header[./_])?({'|'.join(map(re.escape, _KNOWN))})")
_TOPIC = re.compile(r"(.+_)(t|time|timestamp|stamp|Time)")


def signal_names(
    signals: Signals, time: str | None, dt: float | int | None = None
) -> dict[str, tuple[str, int | None]]:
    """Channel name -> array and column; the columns of `x` are `x[0]`, `x[1]`, ..."""
    names, clocks = {}, _clocks(signals.arrays)
    time = _named(signals, time)
    stamps = _time_names(signals.arrays, clocks, time)
    for name, signal in signals.arrays.items():
        if not signal.clock and name in stamps:
            continue
        columns = _columns_of(name, signal)
        alone = time is None and dt is None and not _named_clock(signals.arrays, name, clocks)
        if alone and _has_own_clock(signal):
            del columns[f"{name}[0]"]
        names |= columns
    return {name: place for name, place in names.items() if name != time}


def _named(signals: Signals, time: str | None) -> str | None:
    """The time base, by its name or by its whole title."""
    return None if time is None else signals.titles.get(time, time)


def _columns_of(name: str, signal: Signal) -> dict[str, tuple[str, int | None]]:
    if signal.values.ndim == 1:
        return {name: (name, None)}
    return {f"{name}[{i}]": (name, i) for i in range(signal.values.shape[1])}


_Stamps = tuple[np.ndarray, int]  # in s, and how many overflows were undone


class Timebases:
    """The time bases of a log, each repaired once."""

    def __init__(
        self,
        signals: Signals,
        time: str | None,
        time_unit: TimeUnit | None,
        dt: float | int | None = None,
        time_factor: float | int | None = None,
    ):
        check_unit(time_unit)
        _check_factor(time_factor)
        _check_dt(dt, time, time_unit)
        self._signals, self._time, self._dt = signals, _named(signals, time), dt
        self._unit: TimeUnit | None = time_unit
        self._factor = 1.0 if time_factor is None else float(time_factor)
        self._names = signal_names(signals, time, dt)
        self._every = _all_names(signals)
        self._clocks = _clocks(signals.arrays)
        for name in () if self._time is None else self._parts(self._time):
            if name not in self._every and name not in signals.arrays:
                raise ReadError(f"time base {name!r}: {unknown_name(name, signals.arrays)}")
        self._read: dict[str, _Stamps] = {}
        self._repaired: dict[tuple[str, bytes], RepairedTime] = {}
        self._rates: dict[tuple[str, bytes], float] = {}

    def channel(self, name: str) -> Channel:
        """The named channel with its time stamps, in s.

        Raises ReadError for an unknown channel and for one without a time base of its length,
        and warns with RecordWarning of time stamps that had to be repaired.
        """
        values, stamps = self.values(name), self._checked(name)[1]
        kept = values if stamps.kept is None else values[stamps.kept]
        return Channel(name, stamps.time, kept, self.unit(name))

    def extent(self, name: str) -> tuple[float, float, float]:
        """Rate in Hz, first and last time in s of a channel; raises as `channel` does."""
        base, stamps = self._checked(name)
        if base not in self._rates:
            self._rates[base] = self.channel(name).rate
        return self._rates[base], float(stamps.time[0]), float(stamps.time[-1])

    def _checked(self, name: str) -> tuple[tuple[str, bytes], RepairedTime]:
        """The time base of a channel, of the channel's length."""
        values, array = self.values(name), self._place(name)[0]
        base, rows = self._base(array), self._signals.arrays[array].rows
        if self._dt is not None and base == _COUNTED:
            count = len(values) if rows is None else rows.size
            stamps: _Stamps = (np.arange(count) * float(self._dt), 0)
        else:
            stamps = self._stamps(base)
            whole = len(stamps[0])
            if whole != (len(values) if rows is None else rows.size):
                raise ReadError(
                    f"channel {name!r} has {len(values)} samples, but its time base {base!r} has "
                    f"{whole}. Name another time base («time=»), or save the channel's own as "
                    f"{'t_' + array!r}."
                )
        key = base, b"" if rows is None else rows.tobytes()
        key = (f"{base} {len(values)}", key[1]) if base == _COUNTED else key
        if key not in self._repaired:
            self._repaired[key] = self._repair(base, stamps, _held(name, base, stamps[0], rows))
        return key, self._repaired[key]

    def values(self, name: str) -> np.ndarray:
        """The values of a channel in its unit, without its time stamps."""
        array, column = self._place(name)
        return column_values(self._signals.arrays[array], column)

    def unit(self, name: str) -> str:
        """The unit of a channel; a whole title has it in its name."""
        titled = name in self._signals.titles
        return "" if titled else self._signals.arrays[self._place(name)[0]].unit

    def _place(self, name: str) -> tuple[str, int | None]:
        """The array and the column of a channel, by its name or by its whole title."""
        known = name if name in self._names else self._signals.titles.get(name, name)
        if known not in self._names:
            raise ReadError(unknown_name(name, self._names))
        return self._names[known]

    def _base(self, array: str) -> str:
        known = self._signals.arrays[array].clock
        if known and self._time is None:
            self._check_known(array)
            return known
        if self._dt is not None:
            return _COUNTED
        base = time_array(self._signals, array, self._time, self._clocks)
        if base not in self._read and self._time is None:
            self._warn_of_others(base)
            if base == f"{array}[0]":
                warnings.warn(
                    f"the time stamps are taken from {base!r}, which rises from row to row. Name "
                    f"another channel («time=»), or give the sampling interval («dt=»).",
                    RecordWarning,
                    stacklevel=2,
                )
        return base

    def _check_known(self, array: str) -> None:
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

    def _warn_of_others(self, base: str) -> None:
        """Of arrays beside the time base that are called like one, and hold something else."""
        arrays = self._signals.arrays
        if base not in arrays:
            return
        struct, dot, field = base.rpartition(".")
        names = [f"{struct}{dot}{name}" for name in _SHARED if field in _SHARED and name != field]
        alike = [
            n for n in names if n in arrays and len(arrays[n].values) == len(arrays[base].values)
        ]
        other = [n for n in alike if not np.array_equal(arrays[n].values, arrays[base].values)]
        if other:
            warnings.warn(
                f"the time stamps are taken from {base!r}; {', '.join(map(repr, other))}, of the "
                f"same length, is not used. Name the right one («time=»).",
                RecordWarning,
                stacklevel=2,
            )

    def _repair(self, base: str, stamps: _Stamps, held: np.ndarray) -> RepairedTime:
        repaired = repair(held)
        times = "once" if stamps[1] == 1 else f"{stamps[1]} times"
        overflow = f"the counter overflowed {times}; this was undone" if stamps[1] else ""
        for text in filter(None, (overflow, repaired.remark)):
            warnings.warn(f"time base {base!r}: {text}.", RecordWarning, stacklevel=2)
        return repaired

    def _stamps(self, base: str) -> _Stamps:
        """For each row of the table, NaN where the time base is blank."""
        if base not in self._read:
            clock = self._signals.clocks.get(base)
            stamps, wraps = (clock, 0) if clock is not None else self._counted(base)
            self._read[base] = (stamps if self._factor == 1 else self._factor * stamps, wraps)
        return self._read[base]

    def _counted(self, base: str) -> _Stamps:
        parts = self._parts(base)
        if len(parts) == 2:
            seconds, nanoseconds = (self._column(part, raw=False) for part in parts)
            if len(seconds) != len(nanoseconds):
                raise ReadError(
                    f"the time base {base!r} is of {len(seconds)} seconds and {len(nanoseconds)} "
                    f"nanoseconds: name two channels of one length («time=SECONDS+NANOSECONDS»)."
                )
            return seconds + 1e-9 * nanoseconds.astype(np.float64), 0
        array, _ = self._every[base]
        signal = self._signals.arrays[array]
        counter, wraps = unwrap(self._column(base, raw=True))
        stated: TimeUnit | None = signal.unit if signal.unit in PER_SECOND else None  # pyright: ignore[reportAssignmentType]
        named = _UNIT_OF_NAME.get(re.split(r"[./]", array)[-1])
        if stated and self._unit not in (None, stated) and array in self._signals.titles.values():
            raise ReadError(
                f"time_unit is {self._unit!r}, but the header says that {array!r} is in {stated}: "
                f"leave the unit out («time_unit=»), or correct the header."
            )
        return _in_rows(_seconds(base, counter, self._unit or stated or named), signal.rows), wraps

    def _parts(self, base: str) -> list[str]:
        """A channel, or those of seconds and of nanoseconds."""
        return [base] if base in self._every or base.count("+") != 1 else base.split("+")

    def _column(self, name: str, *, raw: bool) -> np.ndarray:
        array, column = self._every[name]
        signal = self._signals.arrays[array]
        values = column_values(signal, column, raw=raw)
        return values if raw else _in_rows(values, signal.rows)


_COUNTED = "rows"  # the time base where dt says how far apart they are


def _check_factor(factor: float | int | None) -> None:
    if factor is not None and not 0.5 <= factor <= 2:
        raise RecordError(
            f"time_factor is {factor:g}: give a number near 1, from 0.5 to 2; units of time are "
            f"for time_unit («time_unit=»)."
        )


def _check_dt(dt: float | int | None, time: str | None, unit: TimeUnit | None) -> None:
    if dt is None:
        return
    if not 0 < dt < np.inf:
        raise RecordError(f"dt is {dt:g}: give the sampling interval in s, above 0 («dt=»).")
    if time is not None or unit is not None:
        raise RecordError(
            f"dt is {dt:g} s, and a time base is named as well: keep one of them («dt=», «time=»)."
        )


def _in_rows(values: np.ndarray, rows: Bool[np.ndarray, " rows"] | None) -> np.ndarray:
    """The values of a column with blank cells at their rows, NaN elsewhere."""
    if rows is None:
        return values
    whole = np.full(rows.size, np.nan)
    whole[rows] = values
    return whole


def _held(
    name: str, base: str, stamps: np.ndarray, rows: Bool[np.ndarray, " rows"] | None
) -> np.ndarray:
    """The time stamps of the rows in which a channel has a value."""
    if rows is None:
        return stamps
    held = stamps[rows]
    blank = int(np.count_nonzero(~np.isfinite(held)))
    if blank > 0.01 * held.size:
        raise ReadError(
            f"in {blank} of the {held.size} rows in which channel {name!r} has a value, its time "
            f"base {base!r} is blank. Name the channel's own time base («time=»)."
        )
    return held


def column_values(signal: Signal, column: int | None, *, raw: bool = False) -> np.ndarray:
    """One column in its unit; `raw` as in the file."""
    values = signal.values if column is None else signal.values[:, column]
    if raw or signal.scale == 1.0:
        return values
    return values.astype(np.float64) * signal.scale  # where short ones would overflow


class _Clocks(NamedTuple):
    """Time bases by what the names of their channels begin with."""

    structs: Mapping[str, str]  # `imu.` or "": imu.time, or imu.header.stamp.sec+...nanosec
    topics: Mapping[str, str]  # `imu_`: imu_time


def _clocks(arrays: Mapping[str, Signal]) -> _Clocks:
    structs: dict[str, tuple[int, str]] = {}
    topics: dict[str, str] = {}
    for name in arrays:
        prefix, rank, base = _clock_in(arrays, name)
        if base and (rank, base) < structs.get(prefix, (len(_KNOWN) + 1, "")):
            structs[prefix] = rank, base
        elif not base and (topic := _TOPIC.fullmatch(name)):
            topics.setdefault(topic[1], name)
    return _Clocks({prefix: base for prefix, (_, base) in structs.items()}, topics)


def _clock_in(arrays: Mapping[str, Signal], name: str) -> tuple[str, int, str]:
    """The struct that a name gives the time of, how good a name it is, and the time base."""
    if found := _CLOCK.fullmatch(name):
        return found[1], _KNOWN.index(found[2]), name
    if not (found := _SECONDS.fullmatch(name)):
        return "", 0, ""
    for partner in _PARTNERS.get(found[2], ()):
        other = f"{name.removesuffix(found[2])}{partner}"
        if other in arrays:
            return found[1], len(_KNOWN), f"{name}+{other}"
    return "", 0, ""


def _enclosing(name: str) -> Iterator[str]:
    """The structs around a channel: `a.b.` and `a.` and "" for `a.b.c`."""
    for mark in reversed(list(re.finditer(r"[./]", name))):
        yield name[: mark.end()]
    yield ""


def _named_clock(arrays: Mapping[str, Signal], array: str, clocks: _Clocks) -> str:
    """The time base that a name gives to an array; empty where none does."""
    struct, dot, field = array.rpartition(".")
    own = f"{struct}{dot}t_{field}"
    if own in arrays:
        return own
    for prefix in _enclosing(array):
        if prefix in clocks.structs:
            return clocks.structs[prefix]
    for mark in reversed(list(re.finditer("_", array))):
        base = clocks.topics.get(array[: mark.end()], array)
        if base != array:
            return base
    return ""


def _time_names(arrays: Mapping[str, Signal], clocks: _Clocks, time: str | None) -> set[str]:
    """The arrays that hold time stamps rather than a channel."""
    own = {name for name in arrays if _is_own_time(arrays, name)}
    if time is not None:
        return own | set(time.split("+"))
    named = {name for name in arrays if _CLOCK.fullmatch(name)}
    pairs = {part for base in clocks.structs.values() if "+" in base for part in base.split("+")}
    used = {_named_clock(arrays, name, clocks) for name in arrays} if clocks.topics else set()
    return own | named | (pairs & set(arrays)) | (used & set(clocks.topics.values()))


def _is_own_time(arrays: Mapping[str, Signal], name: str) -> bool:
    struct, dot, field = name.rpartition(".")
    owner = f"{struct}{dot}{field.removeprefix('t_')}"
    return field.startswith("t_") and owner in arrays


def _has_own_clock(signal: Signal) -> bool:
    """Whether the first column of a matrix is a clock, as Simulink's `To File` writes it."""
    matrix = signal.values
    return matrix.ndim == 2 and matrix.shape[1] > 1 and steady(matrix[:, 0])


def time_array(signals: Signals, array: str, time: str | None, clocks: _Clocks) -> str:
    """The name of the time stamps that belong to `array`.

    The first that exists of: its own, `t_<array>`; the one named `time`; t, time, time_s,
    timestamp, ... or seconds and nanoseconds in the same struct, in those around it, in the whole
    file; those of its topic (`imu_time` for `imu_x`); the first column of a matrix if that rises in
    steps of nearly one size. Seconds and nanoseconds are `sec+nsec`.
    """
    struct, dot, field = array.rpartition(".")
    own = f"{struct}{dot}t_{field}"
    if time is not None:
        found = own if own in signals.arrays else time
    else:
        found = _named_clock(signals.arrays, array, clocks)
    if not found and _has_own_clock(signals.arrays[array]):
        return f"{array}[0]"
    if not found:
        raise ReadError(
            f"no time base for {array!r}: none of {own}, {', '.join(_SHARED)} is among the arrays "
            f"{listed(signals.arrays)}. Name the array with the time stamps («time=»), or the two "
            f"with seconds and nanoseconds («time=SECONDS+NANOSECONDS»), or give the sampling "
            f"interval of equally spaced rows in s («dt=»)."
        )
    matrix = signals.arrays.get(found)
    if matrix is not None and matrix.values.ndim != 1:
        raise ReadError(
            f"the time base {found!r} has shape {matrix.values.shape}: it must be one column "
            f"(«time={found}[0]»)."
        )
    return found


def _all_names(signals: Signals) -> dict[str, tuple[str, int | None]]:
    every = (_columns_of(name, signal) for name, signal in signals.arrays.items())
    return {name: place for names in every for name, place in names.items()}


def _seconds(name: str, stamps: np.ndarray, unit: TimeUnit | None) -> Float[np.ndarray, " samples"]:
    seconds = stamps.astype(np.float64) / PER_SECOND[unit or "s"]
    doubt = doubt_of_seconds(seconds) if unit is None else ""
    if doubt:
        raise ReadError(f"the time base {name!r} {doubt}.")
    return seconds
