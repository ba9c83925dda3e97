"""Betaflight, Cleanflight and INAV blackbox logs (.bbl, .bfl), and the tables made of them.

Source: "Blackbox logging internals" of the Betaflight documentation.
"""

import dataclasses
import re
from itertools import islice
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np
from jaxtyping import Bool, Float, Int

from .._clock import unwrap
from .._errors import ReadError
from .._log import Log, Table
from ._betaflight_flags import FlagTexts
from ._betaflight_frames import ADJUSTMENT, Frames, Payload, payload
from ._betaflight_header import Frame, Header, headers, MARKER, scaled, with_derived
from ._betaflight_mixer import with_mixed_axes
from ._betaflight_predict import add_constants, believed, constants, elapsed, predicted, segments


def slow_tables(
    slow: dict[str, Frames], main: Frames, time: Float[np.ndarray, " samples"], header: Header
) -> dict[str, Table]:
    """The tables `slow` (flight modes) and `gps`, stamped with the last main frame before.

    GPS frames that no home position precedes are left out, as they are relative to it.
    """
    tables = {}
    for letter, name in (("S", "slow"), ("G", "gps")):
        found = slow.get(letter)
        if found is None or not found.offsets.size:
            continue
        frame = header.frames[letter]
        before = np.searchsorted(main.offsets, found.offsets) - 1
        if 10 not in frame.predictors:  # What was noted before the first frame held then, too.
            before = np.maximum(before, 0)
        rows = np.flatnonzero(before >= 0)
        home, rows = _home(slow.get("H"), frame, found.offsets, rows)
        values = found.coded[rows]
        add_constants(values, frame, constants(frame, header))
        values[:, frame.predictors == 7] += home
        values[:, frame.predictors == 10] += main.coded[before[rows], 1][:, None]
        stamps = time[before[rows]]
        tables[name] = table(values, frame, stamps, header)
    return tables


def table(
    values: Int[np.ndarray, "samples fields"],
    frame: Frame,
    time: Float[np.ndarray, " samples"],
    header: Header,
) -> Table:
    """Views of the decoded columns with the units that the header gives them."""
    columns = {
        name: values[:, i] if frame.signed[i] else values[:, i].view(np.uint32)
        for i, name in enumerate(frame.names)
        if name != "time"
    }
    known = scaled(frame.names, header.settings)
    units = {name: unit for name, (_, unit) in known.items()}
    return Table(columns, time, units, {name: factor for name, (factor, _) in known.items()})


def _home(
    homes: Frames | None, frame: Frame, offsets: np.ndarray, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The home coordinates for the fields that refer to them, and the rows that have one."""
    fields = int((frame.predictors == 7).sum())
    if not fields:
        return np.zeros((rows.size, 0), np.int32), rows
    if homes is None or not homes.offsets.size or homes.coded.shape[1] < fields:
        return np.zeros((0, fields), np.int32), rows[:0]
    last = np.searchsorted(homes.offsets, offsets) - 1
    rows = rows[last[rows] >= 0]
    return homes.coded[last[rows], :fields], rows


def sniff(head: bytes, path: Path) -> bool:
    return MARKER[:40] in head


def load(path: Path) -> Log:
    """All logs of a file that have frames."""
    return decode(path.read_bytes())


def decode(data: bytes) -> Log:
    """The logs in the bytes of a blackbox file.

    A single log has the tables `""`, `slow` and `gps`; of several, the second is `log2`,
    `log2.slow`, `log2.gps`. Raises ReadError where no log has frames.
    """
    tables, remarks, settings, failures = {}, [], {}, []
    found = headers(data)
    for number, header in enumerate(found, start=1):
        label = f"log{number}" if len(found) > 1 else ""
        try:
            if isinstance(header, ReadError):
                raise header
            mine, said = _log(data, header)
        except ReadError as error:
            failures.append(error)
            remarks.append(f"{label or 'log'}: {error}".rstrip("."))
            continue
        tables |= {".".join(filter(None, (label, name))): each for name, each in mine.items()}
        remarks += [f"{label or 'log'}: {each}" for each in said]
        settings |= {f"{label} {k}".lstrip(): v for k, v in header.settings.items()}
    if not tables:
        raise failures[0] if failures else ReadError("the file holds no blackbox log", offset=0)
    return Log(tables, tuple(remarks), "betaflight", settings)


def _log(data: bytes, header: Header) -> tuple[dict[str, Table], list[str]]:
    held = payload(data, header)
    parts = segments(held.main, header, held.damage)
    predicted(held.main, header, parts)
    rows, as_scheduled = believed(held.main, header, parts, held.events)
    if not rows.size:
        raise ReadError("the log holds no readable frame", offset=header.payload)
    left_out = held.main.offsets.size - rows.size
    main = Frames(*(part[rows] for part in held.main)) if left_out else held.main
    time = _seconds(main.coded[:, 1])
    tables = {"": _main_table(main, time, header)} | slow_tables(held.slow, main, time, header)
    remarks = _remarks(held, rows)
    if not as_scheduled:
        remarks.append(
            "the frames between key frames differ from the I and P intervals of the header: "
            "loopIteration is not reliable, and lost frames cannot be detected"
        )
    return tables, remarks


def _seconds(counter: np.ndarray) -> np.ndarray:
    counter = np.ascontiguousarray(counter)
    start = int(counter[:1].view(np.uint32)[0])
    passed = np.cumsum(elapsed(counter), dtype=np.int64)
    return np.concatenate([[start], start + passed]) / 1e6


def _main_table(main: Frames, time: np.ndarray, header: Header) -> Table:
    fields = table(main.coded, header.frames["I"], time, header)
    columns = with_mixed_axes(with_derived(fields.columns), header.settings, time)
    return dataclasses.replace(fields, columns=columns)


def _remarks(held: Payload, rows: np.ndarray) -> list[str]:
    remarks = []
    if held.damage:
        size = sum(each.size for each in held.damage)
        remarks.append(
            f"{_count(len(held.damage), 'damaged block')} ({size} bytes) without frames skipped, "
            f"the first at byte {held.damage[0].offset}"
        )
    left_out = held.main.offsets.size - rows.size
    if left_out:
        mask = np.ones(held.main.offsets.size, bool)
        mask[rows] = False
        remarks.append(
            f"{left_out} of {mask.size} frames were left out, because they refer to lost or "
            f"damaged ones or are out of order, the first at byte "
            f"{held.main.offsets[mask.argmax()]}"
        )
    changed = [each for each in held.events if each.name == ADJUSTMENT]
    if changed:
        remarks.append(
            f"{_count(len(changed), 'setting')} changed in flight, first at byte "
            f"{changed[0].offset}: the gains in the header do not hold for the whole log"
        )
    return remarks


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' if number > 1 else ''}"


Values = Float[np.ndarray, "rows columns"]
_MOST_COLUMNS = 2000
_LONGEST_LINE = 1 << 16  # characters
_HEADED = re.compile(r"([^()]*?)\s*\(([^()]*)\)")
_PER_SECOND = {"": 1e6, "us": 1e6, "ms": 1e3, "s": 1.0}
_CHUNK = 20_000  # lines
_MODES = "flightModeFlags"
_MOST_SETTINGS = 2000


class _TableHeader(NamedTuple):
    names: list[str]
    units: list[str]
    settings: dict[str, str]
    lines: int


def sniff_table(head: bytes, path: Path) -> bool:
    first = head.removeprefix(b"\xef\xbb\xbf").lstrip(b'"')
    explorer = first.startswith(b"Product") and b"Blackbox flight data" in first[:80]
    return first.startswith(b"loopIteration") or explorer


def load_table(path: Path) -> Log:
    """The columns with numbers under their names, the units taken off.

    Cells that are missing or hold text are NaN; rows without a time are left out. Flight modes,
    which are text, become the table `slow`, as a native log has it.
    """
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        header = _table_header(file)
        wanted = [i for i, unit in enumerate(header.units) if unit != "flags"]
        clock = wanted.index(header.names.index("time"))
        flags = header.names.index(_MODES) if _MODES in header.names else None
        values, kept, modes, remarks = _rows(file, wanted, clock, header.lines, flags)
    unit = header.units[wanted[clock]]
    if unit not in _PER_SECOND:
        raise ReadError(f"the unit of time is {unit[:20]!r}: us, ms and s are known")
    numeric = [k for k in range(len(wanted)) if not np.isnan(values[:, k]).all() and k != clock]
    columns = {header.names[wanted[k]]: values[:, k] for k in numeric}
    units = {name: unit for name, unit in zip(header.names, header.units, strict=True) if unit}
    counter, _ = unwrap(values[:, clock])
    time = counter / _PER_SECOND[unit]
    columns = with_mixed_axes(with_derived(columns), header.settings, time)
    tables = {"": Table(columns, time, units)}
    slow = modes.table(kept, time) if flags is not None else None
    tables |= {} if slow is None else {"slow": slow}
    return Log(tables, tuple(remarks), "betaflight", header.settings)


def _table_header(file: TextIO) -> _TableHeader:
    settings, lines = {}, 0
    while (cells := _cells(file))[:1] != ["loopIteration"]:
        if not cells or (lines := lines + 1) > _MOST_SETTINGS:
            raise ReadError("no line begins with loopIteration: the header of the table is missing")
        settings[cells[0]] = ",".join(cells[1:])
    parts = [match.groups() if (match := _HEADED.fullmatch(c)) else (c, "") for c in cells]
    names = [name for name, _ in parts]
    if len(names) > _MOST_COLUMNS or len(set(names)) < len(names) or "time" not in names:
        raise ReadError(
            f"the header has {len(names)} names: at most {_MOST_COLUMNS} are allowed, none "
            f"twice, and one must be 'time'"
        )
    if not all(name.isprintable() for name in names):
        raise ReadError("a name in the header has characters that cannot be printed")
    return _TableHeader(names, [unit.strip() for _, unit in parts], settings, lines + 1)


def _cells(file: TextIO) -> list[str]:
    line = file.readline(_LONGEST_LINE)
    return [cell.strip().strip('"') for cell in line.rstrip("\r\n").split(",")] if line else []


class _Rows(NamedTuple):
    values: Values
    kept: Bool[np.ndarray, " lines"]  # the lines that have a time
    modes: FlagTexts
    remarks: list[str]


def _rows(file: TextIO, wanted: list[int], clock: int, above: int, flags: int | None) -> _Rows:
    """The wanted columns of the lines that have a time, and the texts of the column `flags`.

    `above` lines stand over them.
    """
    parts, modes = [], FlagTexts()
    while chunk := list(islice(file, _CHUNK)):
        commas = np.array([line.count(",") for line in chunk])
        parts.append(np.full((len(chunk), len(wanted)), np.nan))
        if flags is not None:
            modes.add(chunk, flags)
        for count in np.unique(commas[commas > 0]):
            rows = np.flatnonzero(commas == count)
            parts[-1][rows] = _parse_equal([chunk[i] for i in rows], wanted, int(count) + 1)
    values = np.concatenate(parts) if parts else np.empty((0, len(wanted)))
    timed = np.isfinite(values[:, clock])
    remarks = []
    if not timed.all():
        first = above + 1 + int((~timed).argmax())
        remarks.append(f"{(~timed).sum()} lines without a time were left out, first line {first}")
        values = values[timed]
    if not values.size:
        raise ReadError(f"no line after line {above} has an iteration and a time")
    return _Rows(values, timed, modes, remarks)


def _parse_equal(lines: list[str], wanted: list[int], cells: int) -> Values:
    """The wanted columns of lines with equally many cells."""
    there = [k for k, i in enumerate(wanted) if i < cells]
    values = np.full((len(lines), len(wanted)), np.nan)
    columns = [wanted[k] for k in there]
    try:
        found = np.loadtxt(lines, delimiter=",", comments=None, usecols=columns, ndmin=2)
    except ValueError:
        found = np.array([[_number(line.split(",")[i]) for i in columns] for line in lines])
    values[:, there] = found
    return values


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return np.nan
