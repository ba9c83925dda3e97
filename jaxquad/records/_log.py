"""What every reader returns: tables of signals, each on one clock, units, remarks on damage."""

import dataclasses
import difflib
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float

from jaxquad._core import marked_text, Message


FEWEST = 16  # samples in a record


def dates_in_seconds(stamps: np.ndarray) -> np.ndarray | None:
    """Dates (s since 1970) or durations (s) of NumPy; None where they have no fixed unit."""
    unit, _ = np.datetime_data(stamps.dtype)
    if unit in ("generic", "as") or (unit in "YM" and stamps.dtype.kind == "m"):
        return None
    since = stamps - np.datetime64(0, "s") if stamps.dtype.kind == "M" else stamps
    return since / np.timedelta64(1, "s")


@dataclasses.dataclass(frozen=True)
class Table:
    """Signals that were logged together, a row per time stamp.

    A column has one or two dimensions and any real dtype, and may be a strided view. Its values
    times its `scale` (1 by default) are in its `unit`. Without a `time` the time stamps are found
    by their name, as `read` describes. A column with blank cells holds its values alone.
    """

    columns: Mapping[str, np.ndarray]
    time: Float[np.ndarray, " samples"] | None = None  # s
    units: Mapping[str, str] = dataclasses.field(default_factory=dict)
    scales: Mapping[str, float] = dataclasses.field(default_factory=dict)
    # Of columns with blank cells: in which rows of the table the values stand.
    rows: Mapping[str, Bool[np.ndarray, " rows"]] = dataclasses.field(default_factory=dict)
    # Of columns whose header has a unit: the whole title -> column.
    titles: Mapping[str, str] = dataclasses.field(default_factory=dict)


class SettingChange(NamedTuple):
    """A parameter that got another value while the log was written."""

    time: float  # s, on the clock of the log
    name: str
    before: str
    after: str

    def __str__(self) -> str:
        return f"{self.name} {self.before} -> {self.after} at t = {self.time:.6g} s"


@dataclasses.dataclass(frozen=True)
class Log:
    """The tables of a file by name; the channels of the table `""` have no prefix."""

    tables: Mapping[str, Table]
    remarks: tuple[str, ...] = ()
    vehicle: str = ""  # ardupilot, px4, betaflight, crazyflie, or unknown
    settings: Mapping[str, str] = dataclasses.field(default_factory=dict)  # header, parameters
    changes: tuple[SettingChange, ...] = ()  # of settings in flight, in the order of time
    firmware: str = ""  # as the log names it with its version: "ArduCopter V4.5.7 (2a3dc4b7)"


@dataclasses.dataclass(frozen=True)
class Signal:
    """One array of a log under its full name, `table.column`."""

    values: np.ndarray
    clock: str  # the name of its time base, empty if the log does not say
    unit: str
    scale: float
    rows: Bool[np.ndarray, " rows"] | None = None  # of the table that hold a value; None: all


@dataclasses.dataclass(frozen=True)
class Signals:
    """All numeric arrays of a log, and the time bases (s) that its format defines."""

    arrays: Mapping[str, Signal]
    clocks: Mapping[str, Float[np.ndarray, " samples"]]
    titles: Mapping[str, str] = dataclasses.field(default_factory=dict)  # of headers -> array


_MOST_CHANGES = 1000
Stamp = TypeVar("Stamp")


def changes_of(
    logged: Iterable[tuple[Stamp, str, str]], time_of: Callable[[Stamp], float | None]
) -> tuple[SettingChange, ...]:
    """The changes among settings as they were logged, with stamps of which `time_of` gives s."""
    values: dict[str, str] = {}
    changes: list[SettingChange] = []
    for stamp, name, value in logged:
        before = values.get(name, value)
        values[name] = value
        if before != value and len(changes) < _MOST_CHANGES:
            time = time_of(stamp)
            if time is not None and np.isfinite(time):
                changes.append(SettingChange(time, name, before, value))
    return tuple(sorted(changes, key=lambda change: change.time))


def flattened(log: Log) -> Signals:
    """The numeric columns of a log by their full names, without those longer than their clock.

    Without a clock, a matrix whose rows are the channels is turned: it has too few rows for a
    record, or as many columns as other arrays of the file have samples.
    """
    arrays, clocks, titles = {}, {}, {}
    for table_name, table in log.tables.items():
        lengths = {len(values) for values in table.columns.values() if values.ndim == 1}
        clock = "" if table.time is None else f"clock of {table_name}".removesuffix(" of ")
        if table.time is not None:
            clocks[clock] = table.time
        titles |= {printable(title): printable(name) for title, name in table.titles.items()}
        for name, values in table.columns.items():
            full = printable(f"{table_name}.{name}" if table_name else name)
            unit, scale = printable(table.units.get(name, "")), table.scales.get(name, 1.0)
            if values.dtype.kind in "mM":
                seconds = dates_in_seconds(values)
                values, unit = (values, unit) if seconds is None else (seconds, "s")
            if values.dtype.kind not in "fiub" or values.ndim not in (1, 2):
                continue
            if max(values.shape) > MOST_SAMPLES:
                raise ReadError(
                    f"{full!r} has {max(values.shape)} samples, which is more than a record can "
                    f"use ({MOST_SAMPLES}): cut the file into parts"
                )
            if table.time is None and values.ndim == 2:
                rows, columns = values.shape
                alike = columns in lengths and rows not in lengths
                values = values.T if alike or rows < FEWEST <= columns else values
            if table.time is None or len(values) == table.time.size:
                arrays[full] = Signal(values, clock, unit, scale, table.rows.get(name))
    return Signals(arrays, clocks, titles)


def add_columns(
    columns: dict[str, np.ndarray], more: Mapping[str, np.ndarray], remarks: list[str]
) -> None:
    """Put arrays to those of a file; of two with the same name the later stays, with a remark."""
    for name, values in more.items():
        if name in columns:
            remarks.append(f"two arrays are called {printable(name)!r}: the later one is used")
        columns[name] = values


def number_in(cell: str) -> float:
    """The number that a cell of a table holds, else NaN."""
    try:
        return float(cell)
    except ValueError:
        return float("nan")


_HARMLESS = 64 * 2**20  # bytes of decoded arrays that any file may hold
_DENSEST, _LARGEST = 250, 3 * 2**28  # decoded bytes per byte of the file, and in all ...
_LOOSEST, _MOST = 3, 4 * 2**30  # ... which a file that is hardly compressed may go beyond
MOST_SAMPLES = 20_000_000  # of a channel: more than five hours at 1 kHz


def allowance(stored: int) -> int:
    """How many bytes `stored` ones may decode to: lists and records of them stay near 2 GB."""
    dense = max(_HARMLESS, min(_LARGEST, _DENSEST * stored))
    return max(dense, min(_MOST, _LOOSEST * stored))


def check_size(what: str, declared: int, stored: int, *, offset: int | None = None) -> None:
    """Raise ReadError where `stored` bytes declare that they unfold to too many."""
    limit = allowance(stored)
    if declared > limit:
        raise ReadError(
            f"{what} declares {declared:.4g} bytes of numbers in {stored:.4g} bytes of file (limit "
            f"{limit:.4g}): it is probably damaged; if it is not, cut it into parts",
            offset=offset,
        )


def describe_skips(skipped: list[tuple[int, int]], place: int, end: int) -> list[str]:
    """Remarks on damaged blocks (first byte, byte after the last) and on a file that is cut off."""
    remarks = []
    if skipped:
        lost = sum(after - before for before, after in skipped)
        first = ", ".join(f"{before} .. {after - 1}" for before, after in skipped[:4])
        more = ", ..." if len(skipped) > 4 else ""
        blocks = "damaged block" if len(skipped) == 1 else "damaged blocks"
        remarks.append(f"{len(skipped)} {blocks} ({lost} bytes) skipped: bytes {first}{more}")
    if place < end:
        remarks.append(
            f"the file is cut off: the last {end - place} bytes, from byte {place} on, were ignored"
        )
    return remarks


_UNITS = (
    "s", "ms", "us", "ns", "Hz", "rad", "deg", "rad/s", "deg/s", "rad/s^2", "deg/s^2",
    "m", "m/s", "m/s^2", "N", "N m", "V", "rpm",
)  # fmt: skip
_SAME = {
    "sec": "s", "seconds": "s", "msec": "ms", "usec": "us", "\u00b5s": "us", "\u03bcs": "us",
    "radians": "rad", "degrees": "deg", "\u00b0": "deg",
    "rad/sec": "rad/s", "deg/sec": "deg/s", "\u00b0/s": "deg/s", "dps": "deg/s",
    "rad/s2": "rad/s^2", "rad/s\u00b2": "rad/s^2", "rad/s/s": "rad/s^2",
    "deg/s2": "deg/s^2", "deg/s\u00b2": "deg/s^2", "deg/s/s": "deg/s^2",
    "m/s2": "m/s^2", "m/s\u00b2": "m/s^2", "m/s/s": "m/s^2",
    "Nm": "N m", "N*m": "N m", "N.m": "N m", "N\u00b7m": "N m", "RPM": "rpm",
}  # fmt: skip
_TITLE = re.compile(r"(.*\S)\s*(?:\[([^\[\]()]+)\]|\(([^\[\]()]+)\))")


def known_unit(text: str) -> str:
    """A unit as this library writes it; empty for one that is not known to be one."""
    plain = text.strip()
    return plain if plain in _UNITS else _SAME.get(plain, "")


def columns_of(titles: Sequence[str]) -> dict[str, tuple[str, str]]:
    """The cells of a header, such as `q [deg/s]`, as names and units.

    A cell keeps its whole text where the name alone would be that of another cell.
    """
    parts = {}
    for title in titles:
        match = _TITLE.fullmatch(title)
        unit = known_unit(match[2] or match[3]) if match else ""
        parts[title] = (match[1], unit) if match and unit else (title, "")
    names = [name for name, _ in parts.values()]
    return {t: (n if names.count(n) == 1 else t, unit) for t, (n, unit) in parts.items()}


class RecordError(ValueError):
    """A record that cannot be used: the message says what is wrong, the value and what to do."""

    def __init__(self, reason: str):
        super().__init__(Message(reason))


class ReadError(RecordError):
    """A file that cannot be read, and the byte `offset` where the fault shows, if known."""

    def __init__(self, reason: str, *, offset: int | None = None):
        self.reason, self.offset = marked_text(reason), offset
        where = "" if offset is None else f" (at byte {offset})"
        super().__init__(f"{self.reason.rstrip('.')}{where}.")


class GapError(RecordError):
    """Samples are missing for too long; `gaps` are first and last time in s of each, in order."""

    def __init__(self, reason: str, gaps: Sequence[tuple[float, float]] = ()):
        super().__init__(reason)
        self.gaps = tuple(gaps)


class RecordWarning(UserWarning):
    """A record can be used, but something in it was repaired, left out or looks wrong."""

    def __init__(self, reason: str):
        super().__init__(Message(reason))


def warn(reason: str) -> None:
    """Warn whoever called the function that says this."""
    warnings.warn(reason, RecordWarning, stacklevel=3)


def located(error: ReadError, path: Path | str) -> ReadError:
    """The same error, with the file named."""
    return ReadError(f"{path}: {error.reason}", offset=error.offset)


def unknown_name(name: str, channels: Iterable[str]) -> str:
    """What an error says of a `name` that is not among the `channels`, with the nearest."""
    channels = list(channels)
    names = {channel.lower(): channel for channel in channels}
    near = difflib.get_close_matches(name.lower(), names, n=1)
    guess = f" Did you mean {names[near[0]]!r}?" if near else ""
    return f"there is no channel {name!r}.{guess} The channels are: {listed(channels)}."


def choose_range(it: str) -> str:
    """Advice to leave a part of the data out."""
    return f"Choose a range without {it} («start=», «stop=»)« in jq.read, or cut the arrays»"


def mend_holes(it: str) -> str:
    """Advice where values are missing."""
    return f"{choose_range(it)}, or let gaps up to some length in s be interpolated («max_gap=»)."


def listed(names: Iterable[str]) -> str:
    """The names, separated by commas; of many, the first 40."""
    names = list(names)
    more = f", and {len(names) - 40} more" if len(names) > 40 else ""
    return f"{', '.join(names[:40]) or 'none'}{more}"


def printable(text: str) -> str:
    """Text from a file without terminal control characters, cut to 500 characters."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text[:500])
