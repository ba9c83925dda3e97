"""ArduPilot DataFlash logs as text (.log), as ground stations write them from the binary ones."""

import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from .._errors import ReadError
from .._log import changes_of, Log, Table
from ._dataflash import ABOUT, CLOCKS, find_rate_unit, Format, Scaling, tables_of
from ._dataflash_boots import choose_log, CUT_IT, firmware_of, MOST_PARTS, Part, span_of


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
    scaled = _text_scaling(lines, {each.kind: each.name for each in formats})
    tables: dict[str, Table] = {}
    for each in formats:
        if each.name in lines and each.name not in ABOUT:
            columns, odd = _text_columns(lines[each.name], each)
            skipped += odd
            tables |= tables_of(each, columns, scaled, applied=True)
    remarks += [f"{skipped} lines that match no format were left out"] if skipped else []
    remarks += find_rate_unit(tables, scaled)
    stamped = _text_parameters(lines, formats)
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
    parts = [Part(a, b, *_span_and_chirp(content[a:b])) for a, b in ends]
    numbers, remarks = choose_log(parts)
    return b"".join(content[slice(*ends[i])] for i in numbers), remarks


def _span_and_chirp(content: bytes) -> tuple[tuple[float, float] | None, bool]:
    """First and last time in s, by the most frequent messages, and whether there is a chirp."""
    lines, _ = _by_name(content)
    formats = [x for x in _text_formats(lines.get("FMT", [])) if x.name not in ABOUT]
    timed = [x for x in formats if x.columns[0] in CLOCKS and x.name in lines]
    if not timed:
        return None, False
    most = max(timed, key=lambda layout: len(lines[layout.name]))
    stamps = [_number(line.partition(b",")[0].decode("latin-1")) for line in lines[most.name]]
    return span_of(CLOCKS[most.columns[0]] * np.array(stamps)), "SIDD" in lines


def _text_parameters(
    lines: Mapping[str, list[bytes]], formats: Sequence[Format]
) -> list[tuple[float | None, str, str]]:
    """As `_parameters`. Later versions log a parameter's default behind its value."""
    columns = next((each.columns for each in formats if each.name == "PARM"), ())
    at = columns.index("Name") if {"Name", "Value"} <= set(columns) else -2
    beside = columns.index("Value") if at >= 0 else -1
    timed = columns[:1] == ("TimeUS",)
    least = max(2, at + 1, beside + 1)
    return [
        (1e-6 * _number(cells[0]) if timed else None, cells[at], cells[beside])
        for cells in _split(lines.get("PARM", []))
        if len(cells) >= least
    ]


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
            each = Format(int(kind[:9]), int(length[:9]), name, codes, tuple(columns))
            formats.setdefault(name, each)
    return list(formats.values())


def _text_scaling(lines: dict[str, list[bytes]], names: dict[int, str]) -> Scaling:
    units = {chr(int(c[-2])): c[-1] for c in _split(lines.get("UNIT", [])) if _is_pair(c)}
    mults = {chr(int(c[-2])): _number(c[-1]) for c in _split(lines.get("MULT", [])) if _is_pair(c)}
    letters = {
        names[int(kind)]: (unit_ids, mult_ids)
        for kind, unit_ids, mult_ids in (c[-3:] for c in _split(lines.get("FMTU", [])) if c[2:])
        if kind.isdecimal() and len(kind) < 9 and int(kind) in names
    }
    return Scaling(units, {k: mult for k, mult in mults.items() if 0 < mult < np.inf}, letters)


def _is_pair(cells: list[str]) -> bool:
    return len(cells) >= 2 and cells[-2].isdecimal() and len(cells[-2]) <= 3


def _text_columns(lines: list[bytes], layout: Format) -> tuple[dict[str, np.ndarray], int]:
    """The columns that hold numbers throughout, and how many lines had too many or few cells."""
    width = len(layout.columns)
    fitting = [line for line in lines if line.count(b",") == width - 1]
    odd = len(lines) - len(fitting)
    table = _plain(fitting, width)
    if table is not None:
        return dict(zip(layout.columns, table.T, strict=True)), odd
    columns = {}
    for name, cells in zip(layout.columns, zip(*_split(fitting), strict=True), strict=True):
        values = np.array([_number(cell) for cell in cells])
        if np.isfinite(values).any():
            columns[name] = values
    return columns, odd


def _plain(lines: Sequence[bytes], width: int) -> np.ndarray | None:
    """All numbers at once, where there is nothing else."""
    try:
        numbers = np.fromstring(b",".join(lines).decode("latin-1"), sep=",")
    except ValueError:
        return None
    return numbers.reshape(-1, width) if numbers.size == width * len(lines) else None


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")
