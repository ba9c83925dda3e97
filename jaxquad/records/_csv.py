import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ._csv_arrow import parsed_fast
from ._csv_block import parsed
from ._errors import ReadError
from ._log import Log, Table


Line = tuple[int, str]  # number in the file from 1, text
_LONGEST_LINE = 1 << 20  # bytes
_BLOCK = 1 << 22  # bytes parsed at once
_UTF16 = (b"\xff\xfe", b"\xfe\xff")


def sniff(head: bytes, path: Path) -> bool:
    return False  # Anything could be text: the name decides.


def load(path: Path) -> Log:
    """The columns of a text table by the names in its header row.

    Cells are separated by commas, semicolons, tabs or blanks; lines with # are comments, the
    last of which may be the header. Raises ReadError with the line and the column.
    """
    content = _as_utf8(path.read_bytes())
    names, separator, place, number = _header(content)
    values, rows = np.empty((len(names), _most_rows(content, place, len(names)))), 0
    for begin, end in _blocks(content, place):
        block = content[begin:end]
        rows += _fill(values[:, rows:], block, number, names, separator)
        number += block.count(b"\n")
    if not rows:
        raise ReadError(f"only a header ({', '.join(names)}), no row of numbers.")
    return Log({"": Table(dict(zip(names, values[:, :rows], strict=True)))})


def _most_rows(content: bytes, place: int, columns: int) -> int:
    """A row takes two bytes for each cell at least, however many line ends there are."""
    return min(content.count(b"\n", place) + 1, (len(content) - place + 1) // (2 * columns))


def _fill(
    values: Float[np.ndarray, "columns rows"],
    block: bytes,
    first: int,
    names: list[str],
    separator: str | None,
) -> int:
    """Write a block's rows by the fastest way that can be; returns their number."""
    if rows := parsed_fast(block, separator, values):
        return rows
    table = parsed(block, separator, len(names))
    table = _slowly(block, first, names, separator) if table is None else table
    values[:, : len(table)] = table.T
    return len(table)


def _as_utf8(content: bytes) -> bytes:
    """Text in UTF-8 with the line ends of Unix; other 8-bit text is taken as Latin-1."""
    if content.startswith(_UTF16):
        content = content.decode("utf-16", "replace").encode()
    zero = content.find(b"\0")
    if zero >= 0:
        raise ReadError("it is no text: it holds a zero", offset=zero)
    try:
        if not content.isascii():
            content.decode()
    except UnicodeDecodeError:
        content = content.decode("latin-1").encode()
    content = content.removeprefix(b"\xef\xbb\xbf")
    if b"\r" in content:
        content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return content


def _header(content: bytes) -> tuple[list[str], str | None, int, int]:
    """Names, separator, and the byte and line number where the numbers begin."""
    comment = ""
    for number, begin, end in _line_places(content):
        text = content[begin:end].decode().strip(" ")
        if not text.strip():
            continue
        if text.lstrip().startswith("#"):
            comment = text.lstrip("# \t")
            continue
        separator = next((mark for mark in ";\t," if mark in text), None)
        cells = split(text, separator)
        if not all(map(_is_number, cells)):
            return _distinct(cells), separator, end + 1, number + 1
        names = split(comment, separator) if comment else []
        if len(names) != len(cells):
            raise ReadError(
                f"line {number}: numbers where the header should be: "
                f"put a row with the {len(cells)} channel names above them."
            )
        return _distinct(names), separator, begin, number
    raise ReadError("the file holds no table: it needs a header row and numbers.")


def _distinct(names: list[str]) -> list[str]:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise ReadError(f"the header names {name!r} twice: rename one of them.")
        seen.add(name)
    return names


def _line_places(content: bytes) -> Iterator[tuple[int, int, int]]:
    number, begin = 0, 0
    while begin < len(content):
        end = content.find(b"\n", begin)
        end = len(content) if end < 0 else end
        number += 1
        if end - begin > _LONGEST_LINE:
            raise ReadError(f"line {number} has {end - begin} bytes: it is no table", offset=begin)
        yield number, begin, end
        begin = end + 1


def _blocks(content: bytes, place: int) -> Iterator[tuple[int, int]]:
    while place < len(content):
        end = content.find(b"\n", min(place + _BLOCK, len(content)))
        end = len(content) if end < 0 else end + 1
        yield place, end
        place = end


def split(text: str, separator: str | None) -> list[str]:
    """The cells of one line, free of blanks and quotes."""
    if separator is None:
        return text.split()
    if '"' in text:
        cells = next(csv.reader([text], delimiter=separator, skipinitialspace=True))
    else:
        cells = text.split(separator)
    return [cell.strip() for cell in cells]


def _slowly(
    block: bytes, first: int, names: list[str], separator: str | None
) -> Float[np.ndarray, "rows columns"]:
    """Row by row, which finds what is wrong, and takes comments and quotes."""
    rows = []
    for number, text in enumerate(block.decode().split("\n"), start=first):
        if text.strip() and not text.lstrip().startswith("#"):
            rows.append(_numbers((number, text), names, separator))
    return np.array(rows).reshape(-1, len(names))


def _numbers(row: Line, header: list[str], separator: str | None) -> list[float]:
    number, text = row
    cells = split(text, separator)
    if len(cells) != len(header):
        raise ReadError(
            f"line {number}: {len(cells)} cells for {len(header)} columns: "
            f"is the file cut off, or does its separator change?"
        )
    try:
        return [float(cell) for cell in cells]
    except ValueError as error:
        i = next(i for i, cell in enumerate(cells) if not _is_number(cell))
        what = f"{cells[i][:40]!r} is no number" if cells[i] else "the cell is blank"
        raise ReadError(
            f"line {number}, column {i + 1} ({header[i]!r}): {what}: fill or drop the row, "
            f"and write decimals with a point."
        ) from error


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
