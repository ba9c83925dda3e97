import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ._errors import ReadError


Line = tuple[int, str]  # number in the file from 1, text


def read_csv(path: Path) -> dict[str, np.ndarray]:
    """The columns of a text table by the names in its header row.

    Cells are separated by commas, semicolons, tabs or blanks; lines with # are comments, the
    last of which may be the header. Raises ReadError with the line and the column.
    """
    lines = [line for line in _lines(path) if line[1].strip()]
    comments = [line for line in lines if line[1].lstrip().startswith("#")]
    rows = [line for line in lines if not line[1].lstrip().startswith("#")]
    if not rows:
        raise ReadError(f"{path}: the file holds no table: it needs a header row and numbers.")
    header, rows, separator = _header(path, comments, rows)
    if not rows:
        raise ReadError(f"{path}: only a header ({', '.join(header)}), no row of numbers.")
    table = np.array([_numbers(path, row, header, separator) for row in rows])
    return dict(zip(header, table.T, strict=True))


def _lines(path: Path) -> Iterator[Line]:
    with path.open(encoding="utf-8-sig", newline=None) as file:
        for number, text in enumerate(file, start=1):
            yield number, text.rstrip("\n")


def _header(
    path: Path, comments: list[Line], rows: list[Line]
) -> tuple[list[str], list[Line], str | None]:
    separator = _separator(rows[0][1])
    cells = _split(rows[0][1], separator)
    if not all(map(_is_number, cells)):
        names, rows = cells, rows[1:]
    else:
        above = [text for number, text in comments if number < rows[0][0]]
        names = _split(above[-1].lstrip("# "), separator) if above else []
        if len(names) != len(cells):
            raise ReadError(
                f"{path} line {rows[0][0]}: numbers where the header should be: "
                f"put a row with the {len(cells)} channel names above them."
            )
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ReadError(f"{path}: the header names {twice[0]!r} twice: rename one of them.")
    return names, rows, separator


def _separator(text: str) -> str | None:
    return next((mark for mark in ";\t," if mark in text), None)


def _split(text: str, separator: str | None) -> list[str]:
    if separator is None:
        return text.split()
    cells = next(csv.reader([text], delimiter=separator, skipinitialspace=True))
    return [cell.strip() for cell in cells]


def _numbers(path: Path, row: Line, header: list[str], separator: str | None) -> list[float]:
    number, text = row
    cells = _split(text, separator)
    if len(cells) != len(header):
        raise ReadError(
            f"{path} line {number}: {len(cells)} cells for {len(header)} columns: "
            f"is the file cut off, or does its separator change?"
        )
    try:
        return [float(cell) for cell in cells]
    except ValueError as error:
        i = next(i for i, cell in enumerate(cells) if not _is_number(cell))
        what = f"{cells[i]!r} is no number" if cells[i] else "the cell is blank"
        raise ReadError(
            f"{path} line {number}, column {i + 1} ({header[i]!r}): {what}: fill or drop the row, "
            f"and write decimals with a point."
        ) from error


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
