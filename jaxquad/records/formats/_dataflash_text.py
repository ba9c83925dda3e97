"""ArduPilot logs as text (.log), as ground stations write them from the binary ones.

Numbers stand in the units of their format letters; the multipliers of FMTU remain to be applied.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .._errors import ReadError
from .._log import Log, Table
from ._dataflash import Format, Scaling, tables_of


_ABOUT = ("FMT", "FMTU", "UNIT", "MULT", "PARM")
_MOST_TYPES = 1000
_MOST_COLUMNS = 64


def sniff(head: bytes, path: Path) -> bool:
    return head.lstrip().startswith(b"FMT,")


def load(path: Path) -> Log:
    """The message types of a text log as tables, those with instances as `IMU[0]`, ..."""
    lines, skipped = _by_name(path.read_bytes())
    formats = _formats(lines.get("FMT", []))
    if not formats:
        raise ReadError(
            "there is no valid FMT line: the file is not a DataFlash log, or its beginning is "
            "missing",
            offset=0,
        )
    scaled = _scaling(lines, {each.kind: each.name for each in formats})
    tables: dict[str, Table] = {}
    for each in formats:
        if each.name in lines and each.name not in _ABOUT:
            columns, odd = _columns(lines[each.name], each)
            skipped += odd
            tables |= tables_of(each, columns, scaled, applied=True)
    remarks = [f"{skipped} lines that match no format were left out"] if skipped else []
    settings = {cells[-2]: cells[-1] for cells in _split(lines.get("PARM", [])) if len(cells) >= 2}
    return Log(tables, tuple(remarks), "ardupilot", settings)


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


def _formats(lines: Sequence[bytes]) -> list[Format]:
    """From `140, 27, RATE, Qfff, TimeUS,RDes,R,ROut`; the first of a name counts."""
    formats: dict[str, Format] = {}
    for kind, length, name, codes, *columns in (c for c in _split(lines) if len(c) >= 5):
        plausible = kind.isdecimal() and length.isdecimal() and name
        if plausible and len(codes) == len(columns) == len(set(columns)) <= _MOST_COLUMNS:
            each = Format(int(kind[:9]), int(length[:9]), name, codes, tuple(columns))
            formats.setdefault(name, each)
    return list(formats.values())


def _scaling(lines: dict[str, list[bytes]], names: dict[int, str]) -> Scaling:
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


def _columns(lines: list[bytes], layout: Format) -> tuple[dict[str, np.ndarray], int]:
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
