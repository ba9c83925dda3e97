"""ArduPilot DataFlash logs as text (.log), as ground stations write them from the binary ones."""

import itertools
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .._errors import ReadError
from .._log import changes_of, Log, number_in, Table
from ._dataflash import (
    ABOUT,
    choose_log,
    CLOCKS,
    CUT_IT,
    find_rate_unit,
    firmware_of,
    Format,
    LogPart,
    MOST_PARTS,
    Scaling,
    span_of,
    tables_of,
)


_MOST_TYPES = 1000
_MOST_COLUMNS = 64


def sniff_text(head: bytes, path: Path) -> bool:
    return head.lstrip().startswith(b"FMT,")


def load_text(path: Path) -> Log:
    """The same of a text log, as ground stations write them from the binary ones.

    Numbers stand in the units of their format letters; those of FMTU remain to be multiplied.
    """
    content, remarks = _one_log(path.read_bytes())
    lines, skipped = _by_name(content)
    formats = _text_formats(lines.get("FMT", []))
    if not formats:
        raise ReadError(
            "there is no valid FMT line: the file is not a DataFlash log, or its beginning is "
            "missing",
            offset=0,
        )
    names = {layout.kind: layout.name for layout in formats}
    units, mults = (
        {
            chr(int(cells[-2])): cells[-1]
            for cells in _split(lines.get(name, []))
            if len(cells) >= 2 and cells[-2].isdecimal() and len(cells[-2]) <= 3
        }
        for name in ("UNIT", "MULT")
    )
    letters = {
        names[int(kind)]: (unit_ids, mult_ids)
        for kind, unit_ids, mult_ids in (c[-3:] for c in _split(lines.get("FMTU", [])) if c[2:])
        if kind.isdecimal() and len(kind) < 9 and int(kind) in names
    }
    factors = {letter: number_in(text) for letter, text in mults.items()}
    factors = {letter: factor for letter, factor in factors.items() if 0 < factor < np.inf}
    scaled = Scaling(units, factors, letters)
    tables: dict[str, Table] = {}
    for layout in formats:
        if layout.name in lines and layout.name not in ABOUT:
            columns, odd = _text_columns(lines[layout.name], layout)
            skipped += odd
            tables |= tables_of(layout, columns, scaled, applied=True)
    remarks += [f"{skipped} lines that match no format were left out"] if skipped else []
    remarks += find_rate_unit(tables, scaled)
    columns = next((layout.columns for layout in formats if layout.name == "PARM"), ())
    name, value = -2, -1  # Later versions log a parameter's default behind its value.
    if {"Name", "Value"} <= set(columns):
        name, value = columns.index("Name"), columns.index("Value")
    cells = [c for c in _split(lines.get("PARM", [])) if len(c) >= max(2, name + 1, value + 1)]
    timed = columns[:1] == ("TimeUS",)
    stamped = [(1e-6 * number_in(c[0]) if timed else None, c[name], c[value]) for c in cells]
    settings = {name: value for _, name, value in stamped}
    changes = changes_of(stamped, lambda time: time)
    texts = (line.decode("latin-1") for name in ("VER", "MSG") for line in lines.get(name, []))
    return Log(tables, tuple(remarks), "ardupilot", settings, changes, firmware_of(texts))


_BEGIN = re.compile(rb"^[ \t]*FMT, *128,", re.MULTILINE)


def _one_log(content: bytes) -> tuple[bytes, list[str]]:
    """The lines of one of the logs that a file holds, and a remark on the others."""
    begins = [hit.start() for hit in _BEGIN.finditer(content)][1:]
    if not begins:
        return content, []
    if len(begins) >= MOST_PARTS:
        raise ReadError(
            f"the file defines its messages {len(begins) + 1} times: {CUT_IT}", offset=0
        )
    ends = list(itertools.pairwise([0, *begins, len(content)]))
    parts = []
    for begin, end in ends:
        lines, _ = _by_name(content[begin:end])
        formats = [x for x in _text_formats(lines.get("FMT", [])) if x.name not in ABOUT]
        timed = [x for x in formats if x.columns[0] in CLOCKS and x.name in lines]
        span = None
        if timed:
            most = max(timed, key=lambda layout: len(lines[layout.name]))
            cells = (line.partition(b",")[0] for line in lines[most.name])
            stamps = np.array([number_in(cell.decode("latin-1")) for cell in cells])
            span = span_of(CLOCKS[most.columns[0]] * stamps)
        parts.append(LogPart(begin, end, span, bool(timed) and "SIDD" in lines))
    numbers, remarks = choose_log(parts)
    return b"".join(content[slice(*ends[i])] for i in numbers), remarks


def _by_name(content: bytes) -> tuple[dict[str, list[bytes]], int]:
    """What follows the name on each line, by name; and how many lines have none."""
    lines: dict[bytes, list[bytes]] = {}
    skipped = 0
    for line in content.split(b"\n"):
        name, comma, rest = line.partition(b",")
        if comma and (name in lines or len(lines) < _MOST_TYPES):
            lines.setdefault(name, []).append(rest)
        else:
            skipped += bool(line.strip())
    return {name.decode("latin-1").strip(): rests for name, rests in lines.items()}, skipped


def _split(lines: Sequence[bytes]) -> list[list[str]]:
    return [[cell.strip() for cell in line.decode("latin-1").split(",")] for line in lines]


def _text_formats(lines: Sequence[bytes]) -> list[Format]:
    """From `140, 27, RATE, Qfff, TimeUS,RDes,R,ROut`; the first of a name counts."""
    formats: dict[str, Format] = {}
    for kind, length, name, codes, *columns in (c for c in _split(lines) if len(c) >= 5):
        plausible = kind.isdecimal() and length.isdecimal() and name
        if plausible and len(codes) == len(columns) == len(set(columns)) <= _MOST_COLUMNS:
            layout = Format(int(kind[:9]), int(length[:9]), name, codes, tuple(columns))
            formats.setdefault(name, layout)
    return list(formats.values())


def _text_columns(lines: list[bytes], layout: Format) -> tuple[dict[str, np.ndarray], int]:
    """The columns that hold numbers throughout, and how many lines had too many or few cells."""
    width = len(layout.columns)
    fitting = [line for line in lines if line.count(b",") == width - 1]
    odd = len(lines) - len(fitting)
    try:  # all numbers at once, where there is nothing else
        numbers = np.fromstring(b",".join(fitting).decode("latin-1"), sep=",")
    except ValueError:
        numbers = None
    if numbers is not None and numbers.size == width * len(fitting):
        return dict(zip(layout.columns, numbers.reshape(-1, width).T, strict=True)), odd
    columns = {}
    for name, cells in zip(layout.columns, zip(*_split(fitting), strict=True), strict=True):
        values = np.array([number_in(cell) for cell in cells])
        if np.isfinite(values).any():
            columns[name] = values
    return columns, odd
