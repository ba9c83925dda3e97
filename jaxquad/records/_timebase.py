import warnings
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from ._clock import (
    check_unit,
    doubt_of_seconds,
    PER_SECOND,
    repair,
    RepairedTime,
    TimeUnit,
    unwrap,
)
from ._errors import listed, ReadError, RecordWarning, unknown_name
from ._log import Signal, Signals
from ._resample import Channel


_SHARED = ("t", "time", "time_s", "timestamp", "Time", "Timestamp", "TIME")


def signal_names(signals: Signals, time: str | None) -> dict[str, tuple[str, int | None]]:
    """Channel name -> array and column; the columns of `x` are `x[0]`, `x[1]`, ..."""
    names = {}
    for name, signal in signals.arrays.items():
        if not signal.clock and _is_time(signals.arrays, name, time):
            continue
        names |= _columns_of(name, signal)
    return {name: place for name, place in names.items() if name != time}


def _columns_of(name: str, signal: Signal) -> dict[str, tuple[str, int | None]]:
    if signal.values.ndim == 1:
        return {name: (name, None)}
    return {f"{name}[{i}]": (name, i) for i in range(signal.values.shape[1])}


class Timebases:
    """The time bases of a log, each repaired once."""

    def __init__(self, signals: Signals, time: str | None, time_unit: TimeUnit | None):
        check_unit(time_unit)
        self._signals, self._time = signals, time
        self._unit: TimeUnit | None = time_unit
        self._names = signal_names(signals, time)
        self._every = _all_names(signals)
        if time is not None and time not in self._every and time not in signals.arrays:
            raise ReadError(f"time base {time!r}: {unknown_name(time, signals.arrays)}")
        self._repaired: dict[str, RepairedTime] = {}
        self._rates: dict[str, float] = {}

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

    def _checked(self, name: str) -> tuple[str, RepairedTime]:
        """The time base of a channel, of the channel's length."""
        values, array = self.values(name), self._names[name][0]
        base = self._base(array)
        stamps = self._stamps(base)
        whole = stamps.time.size if stamps.kept is None else stamps.kept.size
        if whole != len(values):
            raise ReadError(
                f"channel {name!r} has {len(values)} samples, but its time base {base!r} has "
                f"{whole}. Name another time base (time=, --time), or save the channel's own as "
                f"{'t_' + array!r}."
            )
        return base, stamps

    def values(self, name: str) -> np.ndarray:
        """The values of a channel in its unit, without its time stamps."""
        if name not in self._names:
            raise ReadError(unknown_name(name, self._names))
        array, column = self._names[name]
        return column_values(self._signals.arrays[array], column)

    def unit(self, name: str) -> str:
        return self._signals.arrays[self._names[name][0]].unit

    def _base(self, array: str) -> str:
        known = self._signals.arrays[array].clock
        if known and self._time is None:
            if self._unit not in (None, "s"):
                raise ReadError(
                    f"time_unit is {self._unit!r}, but the log gives the time of {array!r} in s: "
                    f"leave the unit out, or name another time base (time=, --time)."
                )
            return known
        base = time_array(self._signals, array, self._time)
        if base not in self._repaired and self._time is None:
            self._warn_of_others(base)
        return base

    def _warn_of_others(self, base: str) -> None:
        """Of arrays beside the time base that are called like one, and hold something else."""
        arrays = self._signals.arrays
        struct, dot, field = base.rpartition(".")
        names = [f"{struct}{dot}{name}" for name in _SHARED if field in _SHARED and name != field]
        alike = [
            n for n in names if n in arrays and len(arrays[n].values) == len(arrays[base].values)
        ]
        other = [n for n in alike if not np.array_equal(arrays[n].values, arrays[base].values)]
        if other:
            warnings.warn(
                f"the time stamps are taken from {base!r}; {', '.join(map(repr, other))}, of the "
                f"same length, is not used. Name the right one (time=, --time).",
                RecordWarning,
                stacklevel=2,
            )

    def _stamps(self, base: str) -> RepairedTime:
        if base not in self._repaired:
            clock = self._signals.clocks.get(base)
            stamps, wraps = (clock, 0) if clock is not None else self._counted(base)
            self._repaired[base] = repair(stamps)
            remark = self._repaired[base].remark
            times = "once" if wraps == 1 else f"{wraps} times"
            overflow = f"the counter overflowed {times}; this was undone" if wraps else ""
            for text in filter(None, (overflow, remark)):
                warnings.warn(f"time base {base!r}: {text}.", RecordWarning, stacklevel=2)
        return self._repaired[base]

    def _counted(self, base: str) -> tuple[Float[np.ndarray, " samples"], int]:
        array, column = self._every[base]
        signal = self._signals.arrays[array]
        counter, wraps = unwrap(column_values(signal, column, raw=True))
        stated: TimeUnit | None = signal.unit if signal.unit in PER_SECOND else None  # pyright: ignore[reportAssignmentType]
        return _seconds(base, counter, self._unit or stated), wraps


def column_values(signal: Signal, column: int | None, *, raw: bool = False) -> np.ndarray:
    """One column in its unit; `raw` as in the file."""
    values = signal.values if column is None else signal.values[:, column]
    return values if raw or signal.scale == 1.0 else values * signal.scale


def time_array(signals: Signals, array: str, time: str | None) -> str:
    """The name of the time stamps that belong to `array`.

    The first that exists of: its own, `t_<array>`; the one named `time`; t, time, time_s,
    timestamp, ... in the same struct; and the same in the whole file.
    """
    struct, dot, field = array.rpartition(".")
    own = f"{struct}{dot}t_{field}"
    asked = [] if time is None else [time]
    shared = asked or [f"{struct}{dot}{name}" for name in _SHARED] + list(_SHARED)
    found = [name for name in (own, *shared) if name in signals.arrays or name == time]
    if not found:
        raise ReadError(
            f"no time base for {array!r}: none of {own}, {', '.join(_SHARED)} is among the arrays "
            f"{listed(signals.arrays)}. Name the array with the time stamps (time=, --time)."
        )
    matrix = signals.arrays.get(found[0])
    if matrix is not None and matrix.values.ndim != 1:
        raise ReadError(
            f"the time base {found[0]!r} has shape {matrix.values.shape}: it must be one column."
        )
    return found[0]


def _all_names(signals: Signals) -> dict[str, tuple[str, int | None]]:
    every = (_columns_of(name, signal) for name, signal in signals.arrays.items())
    return {name: place for names in every for name, place in names.items()}


def _is_time(arrays: Mapping[str, Signal], name: str, time: str | None) -> bool:
    struct, dot, field = name.rpartition(".")
    owner = f"{struct}{dot}{field.removeprefix('t_')}"
    own = field.startswith("t_") and owner in arrays
    return own or (time is None and field in _SHARED)


def _seconds(name: str, stamps: np.ndarray, unit: TimeUnit | None) -> Float[np.ndarray, " samples"]:
    seconds = stamps.astype(np.float64) / PER_SECOND[unit or "s"]
    doubt = doubt_of_seconds(seconds) if unit is None else ""
    if doubt:
        raise ReadError(f"the time base {name!r} {doubt}.")
    return seconds
