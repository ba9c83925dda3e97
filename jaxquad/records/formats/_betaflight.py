"""Betaflight, Cleanflight and INAV blackbox logs (.bbl, .bfl), and the tables made of them.

Source: "Blackbox logging internals" of the Betaflight documentation.
"""

import dataclasses
import re
from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np
from jaxtyping import Float, Int, UInt

from .._clock import unwrap
from .._errors import ReadError
from .._log import Log, number_in, Table
from ._betaflight_frames import ADJUSTMENT, Frames, payload
from ._betaflight_header import Header, headers, MARKER, scaled, with_derived
from ._betaflight_mixer import with_mixed_axes
from ._betaflight_predict import (
    add_constants,
    add_predictions,
    constants,
    elapsed,
    segments,
    trusted_rows,
)


def sniff(head: bytes, path: Path) -> bool:
    return MARKER[:40] in head


def load(path: Path) -> Log:
    """All logs of a file that have frames.

    A single log has the tables `""`, `slow` and `gps`; of several, the second is `log2`,
    `log2.slow`, `log2.gps`. Raises ReadError where no log has frames.
    """
    data = path.read_bytes()
    tables, remarks, settings, failures = {}, [], {}, []
    logs = headers(data)
    for number, header in enumerate(logs, start=1):
        label = f"log{number}" if len(logs) > 1 else ""
        try:
            if isinstance(header, ReadError):
                raise header
            log, said = _log(data, header)
        except ReadError as error:
            failures.append(error)
            remarks.append(f"{label or 'log'}: {error}".rstrip("."))
            continue
        tables |= {".".join(filter(None, (label, name))): table for name, table in log.items()}
        remarks += [f"{label or 'log'}: {remark}" for remark in said]
        settings |= {f"{label} {k}".lstrip(): v for k, v in header.settings.items()}
    if not tables:
        raise failures[0] if failures else ReadError("the file holds no blackbox log", offset=0)
    return Log(tables, tuple(remarks), "betaflight", settings)


def _log(data: bytes, header: Header) -> tuple[dict[str, Table], list[str]]:
    content = payload(data, header)
    main = content.main
    parts = segments(main, header, content.damage)
    add_predictions(main, header, parts)
    rows, as_scheduled = trusted_rows(main, header, parts, content.events)
    if not rows.size:
        raise ReadError("the log holds no readable frame", offset=header.payload)
    count = lambda number, noun: f"{number} {noun}{'s' if number > 1 else ''}"
    remarks = []
    if content.damage:
        size = sum(damage.size for damage in content.damage)
        remarks.append(
            f"{count(len(content.damage), 'damaged block')} ({size} bytes) without frames skipped, "
            f"the first at byte {content.damage[0].offset}"
        )
    frames = main.offsets.size
    if frames > rows.size:
        mask = np.ones(frames, bool)
        mask[rows] = False
        remarks.append(
            f"{frames - rows.size} of {frames} frames were left out, because they refer "
            f"to lost or damaged ones or are out of order, the first at byte "
            f"{main.offsets[mask.argmax()]}"
        )
        main = Frames(*(part[rows] for part in main))
    changed = [event for event in content.events if event.name == ADJUSTMENT]
    if changed:
        remarks.append(
            f"{count(len(changed), 'setting')} changed in flight, first at byte "
            f"{changed[0].offset}: the gains in the header do not hold for the whole log"
        )
    if not as_scheduled:
        remarks.append(
            "the frames between key frames differ from the I and P intervals of the header: "
            "loopIteration is not reliable, and lost frames cannot be detected"
        )
    counter = np.ascontiguousarray(main.coded[:, 1])
    start = int(counter[:1].view(np.uint32)[0])
    passed = np.cumsum(elapsed(counter), dtype=np.int64)
    time = np.concatenate([[start], start + passed]) / 1e6
    table = _table(main.coded, "I", time, header)
    columns = with_mixed_axes(with_derived(table.columns), header.settings, time)
    slow = _slow_tables(content.slow, main, time, header)
    return {"": dataclasses.replace(table, columns=columns), **slow}, remarks


def _table(
    values: Int[np.ndarray, "samples fields"],
    letter: str,
    time: Float[np.ndarray, " samples"],
    header: Header,
) -> Table:
    """Views of the decoded columns with the units that the header gives them."""
    frame = header.frames[letter]
    columns = {
        name: values[:, i] if frame.signed[i] else values[:, i].view(np.uint32)
        for i, name in enumerate(frame.names)
        if name != "time"
    }
    factors = scaled(frame.names, header.settings)
    units = {name: unit for name, (_, unit) in factors.items()}
    return Table(columns, time, units, {name: factor for name, (factor, _) in factors.items()})


def _slow_tables(
    slow: dict[str, Frames], main: Frames, time: Float[np.ndarray, " samples"], header: Header
) -> dict[str, Table]:
    """The tables `slow` (flight modes) and `gps`, stamped with the last main frame before.

    GPS frames that no home position precedes are left out, as they are relative to it.
    """
    tables = {}
    for letter, name in (("S", "slow"), ("G", "gps")):
        frames = slow.get(letter)
        if frames is None or not frames.offsets.size:
            continue
        frame = header.frames[letter]
        before = np.searchsorted(main.offsets, frames.offsets) - 1
        if 10 not in frame.predictors:  # What was noted before the first frame held then, too.
            before = np.maximum(before, 0)
        rows = np.flatnonzero(before >= 0)
        from_home = frame.predictors == 7
        home = np.zeros((0, int(from_home.sum())), np.int32)
        if from_home.any():
            homes = slow.get("H")
            if homes is None or not homes.offsets.size or homes.coded.shape[1] < home.shape[1]:
                rows = rows[:0]
            else:
                last = np.searchsorted(homes.offsets, frames.offsets) - 1
                rows = rows[last[rows] >= 0]
                home = homes.coded[last[rows], : home.shape[1]]
        values = frames.coded[rows]
        add_constants(values, frame, constants(frame, header))
        if from_home.any():
            values[:, from_home] += home
        values[:, frame.predictors == 10] += main.coded[before[rows], 1][:, None]
        tables[name] = _table(values, letter, time[before[rows]], header)
    return tables


Values = Float[np.ndarray, "rows columns"]
_MOST_COLUMNS = 2000
_LONGEST_LINE = 1 << 16  # characters
_HEADED = re.compile(r"([^()]*?)\s*\(([^()]*)\)")
_PER_SECOND = {"": 1e6, "us": 1e6, "ms": 1e3, "s": 1.0}
_CHUNK = 20_000  # lines
_MODES = "flightModeFlags"
_MOST_SETTINGS = 2000
# In the order of the bits. An older blackbox_decode gives the bits of Betaflight, which begin with
# ARM, the names of Cleanflight's: armed reads ANGLE_MODE, and ANGLE reads HORIZON_MODE.
_OLD = "ANGLE_MODE HORIZON_MODE MAG BARO GPS_HOME GPS_HOLD HEADFREE AUTOTUNE PASSTHRU SONAR".split()
_NEW = (
    "ARM ANGLE HORIZON MAG HEADFREE PASSTHRU FAILSAFE GPSRESCUE - ANTIGRAVITY HEADADJ CAMSTAB "
    "BEEPERON LEDLOW CALIB OSD TELEMETRY SERVO1 SERVO2 SERVO3 BLACKBOX AIRMODE 3D FPVANGLEMIX "
    "BLACKBOXERASE CAMERA1 CAMERA2 CAMERA3 FLIPOVERAFTERCRASH PREARM BEEPGPSCOUNT VTXPITMODE"
).split()


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
        columns = [i for i, unit in enumerate(header.units) if unit != "flags"]
        clock = columns.index(header.names.index("time"))
        flags = header.names.index(_MODES) if _MODES in header.names else None
        values, texts, cells = _rows(file, columns, flags)
    timed = np.isfinite(values[:, clock])
    remarks = ()
    if not timed.all():
        first = header.lines + 1 + int((~timed).argmax())
        remarks = (f"{(~timed).sum()} lines without a time were left out, first line {first}",)
        values = values[timed]
    if not values.size:
        raise ReadError(f"no line after line {header.lines} has an iteration and a time")
    unit = header.units[columns[clock]]
    if unit not in _PER_SECOND:
        raise ReadError(f"the unit of time is {unit[:20]!r}: us, ms and s are known")
    named = {
        header.names[i]: values[:, k]
        for k, i in enumerate(columns)
        if not np.isnan(values[:, k]).all() and k != clock
    }
    units = {name: unit for name, unit in zip(header.names, header.units, strict=True) if unit}
    time = unwrap(values[:, clock])[0] / _PER_SECOND[unit]
    named = with_mixed_axes(with_derived(named), header.settings, time)
    tables = {"": Table(named, time, units)}
    modes = _flight_modes(texts)
    if modes is not None:
        bits = modes[cells[timed]]
        changes = np.flatnonzero(np.diff(bits, prepend=~bits[:1]))
        tables["slow"] = Table({_MODES: bits[changes]}, time[changes])
    return Log(tables, remarks, "betaflight", header.settings)


class _TableHeader(NamedTuple):
    names: list[str]
    units: list[str]
    settings: dict[str, str]
    lines: int


def _table_header(file: TextIO) -> _TableHeader:
    settings, lines = {}, 0
    while True:
        line = file.readline(_LONGEST_LINE)
        cells = [cell.strip().strip('"') for cell in line.rstrip("\r\n").split(",")]
        if cells[0] == "loopIteration":
            break
        if not line or (lines := lines + 1) > _MOST_SETTINGS:
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


def _rows(
    file: TextIO, columns: list[int], flags: int | None
) -> tuple[Values, dict[str, int], Int[np.ndarray, " lines"]]:
    """The numbers in the columns, the texts in the column `flags`, and which of them a line has.

    A line that ends before the column `flags` has the text "".
    """
    parts, texts, numbers = [], {}, []
    while chunk := list(islice(file, _CHUNK)):
        commas = np.array([line.count(",") for line in chunk])
        parts.append(np.full((len(chunk), len(columns)), np.nan))
        if flags is not None:
            cells = (line.split(",", flags + 1)[flags : flags + 1] for line in chunk)
            for cell in cells:
                text = cell[0].strip().strip('"') if cell else ""
                numbers.append(texts.setdefault(text, len(texts)))
        for count in np.unique(commas[commas > 0]):  # of lines with equally many cells
            rows = np.flatnonzero(commas == count)
            lines = [chunk[i] for i in rows]
            there = [k for k, column in enumerate(columns) if column <= count]
            wanted = [columns[k] for k in there]
            try:
                values = np.loadtxt(lines, delimiter=",", comments=None, usecols=wanted, ndmin=2)
            except ValueError:
                values = [[number_in(line.split(",")[i]) for i in wanted] for line in lines]
            parts[-1][rows[:, None], there] = values
    table = np.concatenate(parts) if parts else np.empty((0, len(columns)))
    return table, texts, np.array(numbers, int)


def _flight_modes(texts: Iterable[str]) -> UInt[np.ndarray, " texts"] | None:
    """The bits of each text; None where all are empty, or one is no name of a mode."""
    texts = list(texts)
    old = any(name.endswith("_MODE") for text in texts for name in text.split("|"))
    bits = {name: 1 << i for i, name in enumerate(_OLD if old else _NEW)}
    masks = []
    for text in texts:
        if text.isascii() and text.isdecimal() and len(text) < 10:
            masks.append(int(text))
        elif text in ("", "NONE"):
            masks.append(0)
        elif all(name in bits for name in text.split("|")):
            masks.append(sum(bits[name] for name in set(text.split("|"))))
        else:
            return None
    return np.array(masks, np.uint32) if any(texts) else None
