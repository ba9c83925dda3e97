"""Tables that blackbox_decode and Blackbox Explorer make of a blackbox log."""

import re
from itertools import islice
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np
from jaxtyping import Float

from .._clock import unwrap
from .._errors import ReadError
from .._log import Log, Table
from ._betaflight_header import with_axis_sums


Values = Float[np.ndarray, "rows columns"]
_MOST_COLUMNS = 2000
_LONGEST_LINE = 1 << 16  # characters
_HEADED = re.compile(r"([^()]*?)\s*\(([^()]*)\)")
_PER_SECOND = {"": 1e6, "us": 1e6, "ms": 1e3, "s": 1.0}
_CHUNK = 20_000  # lines
_MOST_SETTINGS = 2000


class _Header(NamedTuple):
    names: list[str]
    units: list[str]
    settings: dict[str, str]
    lines: int


def sniff(head: bytes, path: Path) -> bool:
    first = head.removeprefix(b"\xef\xbb\xbf").lstrip(b'"')
    explorer = first.startswith(b"Product") and b"Blackbox flight data" in first[:80]
    return first.startswith(b"loopIteration") or explorer


def load(path: Path) -> Log:
    """The columns with numbers under their names, the units taken off.

    Cells that are missing or hold text are NaN; rows without a time are left out.
    """
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        header = _header(file)
        wanted = [i for i, unit in enumerate(header.units) if unit != "flags"]
        clock = wanted.index(header.names.index("time"))
        values, remarks = _rows(file, wanted, clock, header.lines)
    unit = header.units[wanted[clock]]
    if unit not in _PER_SECOND:
        raise ReadError(f"the unit of time is {unit[:20]!r}: us, ms and s are known")
    numeric = [k for k in range(len(wanted)) if not np.isnan(values[:, k]).all() and k != clock]
    columns = {header.names[wanted[k]]: values[:, k] for k in numeric}
    units = {name: unit for name, unit in zip(header.names, header.units, strict=True) if unit}
    counter, _ = unwrap(values[:, clock])
    table = Table(with_axis_sums(columns), counter / _PER_SECOND[unit], units)
    return Log({"": table}, tuple(remarks), "betaflight", header.settings)


def _header(file: TextIO) -> _Header:
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
    return _Header(names, [unit.strip() for _, unit in parts], settings, lines + 1)


def _cells(file: TextIO) -> list[str]:
    line = file.readline(_LONGEST_LINE)
    return [cell.strip().strip('"') for cell in line.rstrip("\r\n").split(",")] if line else []


def _rows(file: TextIO, wanted: list[int], clock: int, above: int) -> tuple[Values, list[str]]:
    """The wanted columns of the lines that have a time; `above` lines stand over them."""
    parts = []
    while chunk := list(islice(file, _CHUNK)):
        commas = np.array([line.count(",") for line in chunk])
        parts.append(np.full((len(chunk), len(wanted)), np.nan))
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
    return values, remarks


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
