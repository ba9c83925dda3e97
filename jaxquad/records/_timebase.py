import re
import warnings
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from ._channel import (
    Channel,
    check_unit,
    doubt_of_seconds,
    FEWEST,
    Number,
    PER_SECOND,
    repair_time,
    RepairedTime,
    TimeUnit,
    unwrap,
)
from ._errors import listed, ReadError, RecordError, RecordWarning, unknown_name
from ._log import Signal, Signals


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


class _Stamps(NamedTuple):
    seconds: np.ndarray  # of each row of the table, NaN where the time base is blank
    wraps: int  # overflows that were undone


class Timebases:
    """The channels of a log, `names`, and their time bases, each repaired once.

    The columns of a matrix `x` are `x[0]`, `x[1]`, ... The time base of an array is the first that
    exists of: its own, `t_<array>`; the one named `time`; t, time, time_s, timestamp, ... or
    seconds and nanoseconds in the same struct, in those around it, in the whole file; those of its
    topic (`imu_time` for `imu_x`); the first column of a matrix if that rises in steps of nearly
    one size. Seconds and nanoseconds are `sec+nsec`.
    """

    def __init__(
        self,
        signals: Signals,
        time: str | None,
        time_unit: TimeUnit | None,
        dt: Number | None = None,
        time_factor: Number | None = None,
    ):
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
        self._structs: dict[str, str] = {}  # `imu.` or "": imu.time, or imu.stamp.sec+...nanosec
        self._topics: dict[str, str] = {}  # `imu_`: imu_time
        self._find_clocks()
        self._columns: dict[str, tuple[str, int | None]] = {}  # of all arrays: array and column
        self.names: dict[str, tuple[str, int | None]] = {}  # of the channels alone
        stamps = self._time_names()
        for array, signal in signals.arrays.items():
            matrix = signal.values
            columns = {array: (array, None)}
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
                if name not in self._columns and name not in signals.arrays:
                    raise ReadError(f"time base {name!r}: {unknown_name(name, signals.arrays)}")
        self._read: dict[str, _Stamps] = {}
        self._repaired: dict[tuple[str, bytes], RepairedTime] = {}
        self._rates: dict[tuple[str, bytes], float] = {}

    def channel(self, name: str) -> Channel:
        """The named channel with its time stamps, in s.

        Raises ReadError for an unknown channel and for one without a time base of its length,
        and warns with RecordWarning of time stamps that had to be repaired.
        """
        values, stamps = self.values(name), self._repaired_time(name)[1]
        values = values if stamps.kept is None else values[stamps.kept]
        return Channel(name, stamps.time, values, self.unit(name))

    def extent(self, name: str) -> tuple[float, float, float]:
        """Rate in Hz, first and last time in s of a channel; raises as `channel` does."""
        base, stamps = self._repaired_time(name)
        if base not in self._rates:
            self._rates[base] = self.channel(name).rate
        return self._rates[base], float(stamps.time[0]), float(stamps.time[-1])

    def values(self, name: str) -> np.ndarray:
        """The values of a channel in its unit, without its time stamps."""
        return self._column(*self._place(name))

    def unit(self, name: str) -> str:
        """The unit of a channel; a whole title has it in its name."""
        return "" if name in self._signals.titles else self._arrays[self._place(name)[0]].unit

    def _place(self, name: str) -> tuple[str, int | None]:
        """The array and the column of a channel, by its name or by its whole title."""
        short = name if name in self.names else self._signals.titles.get(name, name)
        if short not in self.names:
            raise ReadError(unknown_name(name, self.names))
        return self.names[short]

    def _column(self, array: str, column: int | None) -> np.ndarray:
        signal = self._arrays[array]
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
            stamps = _Stamps(np.arange(count) * float(self._dt), 0)
        else:
            stamps = self._stamps(base)
            if len(stamps.seconds) != count:
                raise ReadError(
                    f"channel {name!r} has {len(values)} samples, but its time base {base!r} has "
                    f"{len(stamps.seconds)}. Name another time base («time=»), or save the "
                    f"channel's own as {'t_' + array!r}."
                )
        key = (f"{base} {len(values)}", key[1]) if base == _COUNTED else key
        if key in self._repaired:
            return key, self._repaired[key]
        seconds = stamps.seconds if rows is None else stamps.seconds[rows]
        blank = 0 if rows is None else int(np.count_nonzero(~np.isfinite(seconds)))
        if blank > 0.01 * seconds.size:
            raise ReadError(
                f"in {blank} of the {seconds.size} rows in which channel {name!r} has a value, its "
                f"time base {base!r} is blank. Name the channel's own time base («time=»)."
            )
        repaired = self._repaired[key] = repair_time(seconds)
        times = "once" if stamps.wraps == 1 else f"{stamps.wraps} times"
        overflow = f"the counter overflowed {times}; this was undone" if stamps.wraps else ""
        for text in filter(None, (overflow, repaired.remark)):
            warnings.warn(f"time base {base!r}: {text}.", RecordWarning, stacklevel=2)
        return key, repaired

    def _base(self, array: str) -> str:
        clock = self._arrays[array].clock
        if not clock or self._time is not None:
            return _COUNTED if self._dt is not None else self._search_base(array)
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
        return clock

    def _search_base(self, array: str) -> str:
        """The time stamps of an array where the log does not define them; warns of a choice."""
        struct, dot, field = array.rpartition(".")
        its_own = f"{struct}{dot}t_{field}"
        if self._time is None:
            base = self._clock_by_name(array)
        else:
            base = its_own if its_own in self._arrays else self._time
        from_column = not base and _begins_with_clock(self._arrays[array])
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
        if stamps is not None:  # Others that are called like a time base, and hold something else.
            struct, dot, field = base.rpartition(".")
            names = [f"{struct}{dot}{n}" for n in _SHARED if field in _SHARED and n != field]
            alike = [n for n in names if n in self._arrays]
            alike = [n for n in alike if len(self._arrays[n].values) == len(stamps.values)]
            other = [n for n in alike if not np.array_equal(self._arrays[n].values, stamps.values)]
            if other:
                warnings.warn(
                    f"the time stamps are taken from {base!r}; {', '.join(map(repr, other))}, of "
                    f"the same length, is not used. Name the right one («time=»).",
                    RecordWarning,
                    stacklevel=2,
                )
        if base == f"{array}[0]":
            warnings.warn(
                f"the time stamps are taken from {base!r}, which rises from row to row. Name "
                f"another channel («time=»), or give the sampling interval («dt=»).",
                RecordWarning,
                stacklevel=2,
            )
        return base

    def _stamps(self, base: str) -> _Stamps:
        if base not in self._read:
            clock = self._signals.clocks.get(base)
            stamps, wraps = self._count(base) if clock is None else (clock, 0)
            stamps = stamps if self._factor == 1 else self._factor * stamps
            self._read[base] = _Stamps(stamps, wraps)
        return self._read[base]

    def _count(self, base: str) -> _Stamps:
        """The time stamps of arrays that the log does not define as a clock."""
        parts = self._parts(base)
        if len(parts) == 2:
            places = [self._columns[part] for part in parts]
            seconds, nanoseconds = (
                _in_rows(self._column(*place), self._arrays[place[0]].rows) for place in places
            )
            if len(seconds) != len(nanoseconds):
                raise ReadError(
                    f"the time base {base!r} is of {len(seconds)} seconds and {len(nanoseconds)} "
                    f"nanoseconds: name two channels of one length («time=SECONDS+NANOSECONDS»)."
                )
            return _Stamps(seconds + 1e-9 * nanoseconds.astype(np.float64), 0)
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
        doubt = doubt_of_seconds(seconds) if unit is None else ""
        if doubt:
            raise ReadError(f"the time base {base!r} {doubt}.")
        return _Stamps(_in_rows(seconds, signal.rows), wraps)

    def _parts(self, base: str) -> list[str]:
        """A channel, or those of seconds and of nanoseconds."""
        return [base] if base in self._columns or base.count("+") != 1 else base.split("+")

    def _find_clocks(self) -> None:
        """The best name of a time base in each struct, and the first one of each topic."""
        ranks: dict[str, tuple[int, str]] = {}
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
        self._structs = {prefix: base for prefix, (_, base) in ranks.items()}

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

    def _time_names(self) -> set[str]:
        """The arrays that hold time stamps rather than a channel."""
        arrays, stamps = self._arrays, set()
        for name in arrays:
            struct, dot, field = name.rpartition(".")
            if field.startswith("t_") and f"{struct}{dot}{field.removeprefix('t_')}" in arrays:
                stamps.add(name)
        if self._time is not None:
            return stamps | set(self._time.split("+"))
        stamps |= {name for name in arrays if _CLOCK.fullmatch(name)}
        pairs = (base.split("+") for base in self._structs.values() if "+" in base)
        stamps |= {part for pair in pairs for part in pair} & set(arrays)
        if self._topics:
            stamps |= {self._clock_by_name(name) for name in arrays} & set(self._topics.values())
        return stamps


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
