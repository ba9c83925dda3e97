import csv
import io
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .._channel import FEWEST
from .._errors import ReadError
from .._log import columns_of, Log, Table


_LONGEST_LINE = 1 << 20  # bytes
_BLOCK = 1 << 22  # bytes parsed at once
_BLANK = 0.1  # of a column: with more blank cells, the table holds several topics


def sniff(head: bytes, path: Path) -> bool:
    return False  # Any bytes could be text: the name decides.


def load(path: Path) -> Log:
    """The columns of a text table by the names in its header row, with the units in these.

    The last comment, with #, may be the header; without one the columns are a matrix `data`. In a
    table of several topics the cells of a column are blank where its topic has no message.
    """
    content = path.read_bytes()
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        content = content.decode("utf-16", "replace").encode()
    zero = content.find(b"\0")
    if zero >= 0:
        raise ReadError("the file is not text: it holds a zero byte", offset=zero)
    try:
        if not content.isascii():
            content.decode()
    except UnicodeDecodeError:  # other 8-bit text is taken as Latin-1
        content = content.decode("latin-1").encode()
    content = content.removeprefix(b"\xef\xbb\xbf")
    if b"\r" in content:
        content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    header = _header(content)
    place, number, names = header.place, header.number, header.names
    # A row takes two bytes for each cell at least, however many line ends there are.
    most = min(content.count(b"\n", place) + 1, (len(content) - place + 1) // (2 * len(names)))
    values, count = np.empty((len(names), most)), 0
    try:
        while place < len(content):
            end = content.find(b"\n", min(place + _BLOCK, len(content)))
            end = len(content) if end < 0 else end + 1
            if end - place > _BLOCK + _LONGEST_LINE:
                begin = content.rfind(b"\n", place, place + _BLOCK) + 1 or place
                raise _too_long(number + content.count(b"\n", place, begin), begin, end)
            block = content[place:end]
            table = _parse(block, header)
            table = _parse_rows(block, number, header) if table is None else table
            values[:, count : count + len(table)] = table.T
            count, number, place = count + len(table), number + block.count(b"\n"), end
    except _BlankCell as error:
        columns, rows, remarks = _topics(content, header, error)
    else:
        values = values[:, :count]
        if not count:
            raise ReadError(
                f"the file has only a header ({', '.join(names)}) and no row of numbers"
            )
        columns, rows, remarks = dict(zip(names, values, strict=True)), {}, ()
        if not header.named:
            remark = (
                "the file has no line of channel names: its columns are called data[0] .. "
                f"data[{len(values) - 1}]"
            )
            return Log({"": Table({"data": values.T})}, (remark,))
    # The columns by the names in their titles, with the units that stand behind these.
    parts = columns_of(list(columns))
    table = Table(
        columns={parts[title][0]: values for title, values in columns.items()},
        units={name: unit for name, unit in parts.values() if unit},
        rows={parts[title][0]: there for title, there in rows.items()},
        titles={title: name for title, (name, _) in parts.items() if title != name},
    )
    return Log({"": table}, remarks)


class _Header(NamedTuple):
    """What the lines above the numbers say, and where those begin."""

    names: list[str]
    named: bool
    separator: str | None
    place: int  # byte
    number: int  # of the line


class _BlankCell(ReadError):
    """A cell without a number, in a table that has one elsewhere in its column."""


def _topics(
    content: bytes, header: _Header, error: _BlankCell
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], tuple[str, ...]]:
    """Of a table of several topics the columns, the rows that they have a value in, and remarks."""
    table = _parse_rows(content[header.place :], header.number, header, blank=np.nan).T
    rows = table.shape[1]
    filled = dict(zip(header.names, ~np.isnan(table), strict=True))
    counts = {name: int(there.sum()) for name, there in filled.items()}
    partly = {name for name, count in counts.items() if 0 < count < rows}
    rarest = min(partly or counts, key=lambda name: counts[name] or rows)
    if counts[rarest] < FEWEST or (partly and 1 - counts[rarest] / rows < _BLANK):
        raise error
    named = dict(zip(header.names, table, strict=True))
    columns = {name: values[filled[name]] for name, values in named.items() if counts[name]}
    remarks = []
    if partly:
        remarks += [
            f"cells are blank where a topic has no message: {rarest!r}, for instance, has "
            f"{counts[rarest]} values in {rows} rows"
        ]
    if empty := [name for name in header.names if not counts[name]]:
        remarks.append(f"columns without any value were left out: {', '.join(empty)}")
    return columns, {name: filled[name] for name in columns if name in partly}, tuple(remarks)


def _too_long(number: int, begin: int, end: int) -> ReadError:
    return ReadError(
        f"line {number} has {end - begin} bytes: the file is not a table", offset=begin
    )


def _header(content: bytes) -> _Header:
    comment, number, end = "", 0, -1
    while (begin := end + 1) < len(content):
        end = content.find(b"\n", begin)
        end = len(content) if end < 0 else end
        number += 1
        if end - begin > _LONGEST_LINE:
            raise _too_long(number, begin, end)
        text = content[begin:end].decode().strip(" ")
        if not text.strip():
            continue
        if text.lstrip().startswith("#"):
            comment = text.lstrip("# \t")
            continue
        separator = next((mark for mark in ";\t," if mark in text), None)
        cells = _split(text, separator)
        above = not all(map(_is_number, cells))
        names = cells if above else _split(comment, separator) if comment else []
        named = len(names) == len(cells)
        names = names if named else [f"data[{k}]" for k in range(len(cells))]
        earlier: set[str] = set()
        for name in names:
            if name in earlier:
                raise ReadError(f"the header names {name!r} twice: rename one of them")
            earlier.add(name)
        if above:
            return _Header(names, True, separator, end + 1, number + 1)
        return _Header(names, named, separator, begin, number)
    raise ReadError("the file holds no table: it needs lines of numbers, below a line of names")


def _split(text: str, separator: str | None) -> list[str]:
    """The cells of one line, free of blanks and quotes."""
    if separator is None:
        return text.split()
    if '"' in text:
        cells = next(csv.reader([text], delimiter=separator, skipinitialspace=True))
    else:
        cells = text.split(separator)
    return [cell.strip() for cell in cells]


def _parse(block: bytes, header: _Header) -> Float[np.ndarray, "rows columns"] | None:
    """The numbers of whole lines; None where they are not one plain number per cell."""
    if not block.strip():
        return np.empty((0, len(header.names)))
    try:
        text = io.StringIO(block.decode())
        table = np.loadtxt(text, delimiter=header.separator, comments=None, ndmin=2)
    except ValueError:  # says less of what is wrong than reading row by row does
        return None
    return table if table.shape[1] == len(header.names) else None


def _parse_rows(
    block: bytes, first: int, header: _Header, *, blank: float | None = None
) -> Float[np.ndarray, "rows columns"]:
    """Row by row, with comments and quotes; lines count from `first`, blank cells are `blank`."""
    rows = []
    for number, text in enumerate(block.decode().split("\n"), start=first):
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        cells = _split(text, header.separator)
        if len(cells) != len(header.names):
            raise ReadError(
                f"line {number} has {len(cells)} cells for {len(header.names)} columns: the file "
                f"is cut off, or its separator changes"
            )
        try:
            rows.append(
                [blank if blank is not None and not cell else float(cell) for cell in cells]
            )
        except ValueError as error:
            wrong = (i for i, cell in enumerate(cells) if not _is_number(cell))
            i = next(i for i in wrong if cells[i] or blank is None)
            place = f"line {number}, column {i + 1} ({header.names[i]!r})"
            if cells[i]:
                what = f"{cells[i][:40]!r} is not a number"
                raise ReadError(
                    f"{place}: {what}. Correct or delete the row; write decimals with a point"
                ) from error
            raise _BlankCell(
                f"{place}: the cell is blank. Fill it in, delete the row, or write nan and let "
                "gaps be interpolated («max_gap=»)"
            ) from error
    return np.array(rows).reshape(-1, len(header.names))


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
