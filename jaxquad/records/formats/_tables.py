"""Tables of text (.csv), arrays that NumPy has saved (.npz, .npy), MATLAB 5 to 7 (.mat).

Source: MathWorks, "MAT-File Format"; files are read by their declared sizes. Version 7.3 is HDF5
and has its own reader; version 4 is recognised and refused.
"""

import csv
import dataclasses
import io
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from jaxtyping import Float

from .._log import add_columns, check_size, columns_of, FEWEST, Log, printable, ReadError, Table


_MAGIC = b"\x93NUMPY"


def sniff_numpy(head: bytes, path: Path) -> bool:
    return head.startswith((_MAGIC, b"PK\x03\x04"))


def load_numpy(path: Path) -> Log:
    """The arrays of a .npz archive, or the one of a .npy file, which is called `data`."""
    with path.open("rb") as stream:
        magic = stream.read(len(_MAGIC))
        stream.seek(0)
        size = path.stat().st_size
        if magic == _MAGIC:
            return Log({"": Table(_read_array("data", stream, size))})
        if not magic.startswith(b"PK"):
            raise ReadError("not a NumPy array, nor an archive of arrays", offset=0)
        try:
            archive = zipfile.ZipFile(stream)
        # On damaged archives zipfile raises almost anything, here and below.
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            raise ReadError(f"the archive is cut off or damaged ({reason})", offset=size) from error
        arrays: dict[str, np.ndarray] = {}
        remarks: list[str] = []
        with archive:
            members = [member for member in archive.infolist() if not member.filename.endswith("/")]
            check_size("the archive", sum(member.file_size for member in members), size)
            for member in members:
                name = member.filename.removesuffix(".npy")
                try:
                    with archive.open(member) as file:
                        if file.read(len(_MAGIC)) != _MAGIC:
                            continue
                        file.seek(0)
                        columns = _read_array(name, file, member.file_size)
                except ReadError:
                    raise
                except Exception as error:
                    reason = f"{type(error).__name__}: {printable(str(error))}"
                    raise ReadError(
                        f"the array {printable(name)!r} is cut off or damaged ({reason})",
                        offset=member.header_offset,
                    ) from error
                add_columns(arrays, columns, remarks)
    if not arrays and members:
        names = ", ".join(printable(member.filename) for member in members[:3])
        raise ReadError(f"an archive without arrays (it holds {names}): unpack it, and give a log")
    return Log({"": Table(arrays)}, tuple(remarks))


def _read_array(
    name: str, stream: io.BufferedIOBase | IO[bytes], size: int
) -> dict[str, np.ndarray]:
    """The array of a .npy stream of `size` bytes; the fields of a structured one are channels."""
    read = np.lib.format.read_array_header_1_0, np.lib.format.read_array_header_2_0
    try:
        version = np.lib.format.read_magic(stream)
        header = read[version[0] > 1](stream) if version in ((1, 0), (2, 0), (3, 0)) else None
    # The header is a piece of Python: what is wrong with it shows as almost anything.
    except Exception as error:
        raise ReadError(
            f"the header of the array {name!r} is cut off or damaged ({type(error).__name__})"
        ) from error
    if header is None:
        raise ReadError(f"the array {name!r} has npy version {version}: only 1 to 3 are read")
    shape, fortran, dtype = header
    if dtype.hasobject:
        raise ReadError(
            f"the array {name!r} is pickled, and reading it could run code: save it as numbers"
        )
    declared = dtype.itemsize * int(np.prod([int(n) for n in shape], dtype=object))
    if min(shape, default=0) < 0 or declared > size:
        raise ReadError(
            f"the array {name!r} declares the shape {shape} of {dtype} ({declared:.6g} bytes), but "
            f"has {size} bytes: it is cut off or damaged"
        )
    content = stream.read(declared)
    if len(content) < declared:
        raise ReadError(f"the array {name!r} has {len(content)} of {declared} bytes: it is cut off")
    stream.read(1)  # The end of an archive's member is where its checksum is looked at.
    array = np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C")
    return {field: array[field] for field in dtype.names} if dtype.names else {name: array}


_HEADER = 128
_TYPES = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
_MATRIX, _COMPRESSED = 14, 15
_STRUCT = 2
_CLASSES = {
    6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8",
}  # fmt: skip
_DEEPEST = 8  # structs within structs
_MOST_STRUCTS = 64  # of one array


def sniff_matlab(head: bytes, path: Path) -> bool:
    return head[126:128] in (b"IM", b"MI") and head[124:126] in (b"\0\1", b"\1\0")


def load_matlab(path: Path) -> Log:
    """The real numeric variables, and those in structs as `s.q` or `s[1].q`; no others."""
    content = path.read_bytes()
    if len(content) < _HEADER or content[126:128] not in (b"IM", b"MI"):
        raise ReadError(
            "not a MATLAB file of version 5 to 7.3, or cut off: save it with save(..., '-v7')",
            offset=0,
        )
    file = _MatFile("<" if content[126:128] == b"IM" else ">", len(content))
    arrays: dict[str, np.ndarray] = {}
    remarks: list[str] = []
    for element in file.elements(memoryview(content), _HEADER, 0):
        variable = file.inflated(element) if element.kind == _COMPRESSED else element
        if variable.kind == _MATRIX:
            add_columns(arrays, file.variable(variable, "", 0), remarks)
    return Log({"": Table(arrays)}, tuple(remarks))


class _Element(NamedTuple):
    """A typed piece of the file: its type, its bytes, and its place."""

    kind: int
    body: memoryview
    offset: int


@dataclasses.dataclass
class _MatFile:
    """Byte order and size of a file, and how many bytes its variables unfold to so far."""

    order: str
    stored: int
    taken: int = 0

    def take(self, size: int, offset: int) -> None:
        self.taken += size
        check_size("the file", self.taken, self.stored, offset=offset)

    def integers(self, content: memoryview | bytes, kind: str = "u4") -> list[int]:
        return np.frombuffer(content, self.order + kind).tolist()

    def elements(self, content: memoryview, place: int, base: int) -> Iterator[_Element]:
        """The elements from `place` on; `base` is added to the offsets in errors."""
        while place + 8 <= len(content):
            kind, size = self.integers(content[place : place + 8])
            if kind >> 16:  # A small element keeps up to four bytes in its own tag.
                kind, size, begin, after = kind & 0xFFFF, kind >> 16, place + 4, place + 8
            else:
                begin = place + 8
                after = begin + size + (-size % 8 if kind != _COMPRESSED else 0)
            if begin + size > len(content) or (after == place + 8 and size > 4):
                raise ReadError(
                    f"an element declares {size} bytes, but {len(content) - begin} are left: the "
                    f"file is cut off or damaged",
                    offset=base + place,
                )
            yield _Element(kind, content[begin : begin + size], base + place)
            place = after
        if place < len(content):
            raise ReadError(
                f"the last {len(content) - place} bytes are not an element: the file is cut off or "
                f"damaged",
                offset=base + place,
            )

    def inflated(self, element: _Element) -> _Element:
        inflater, place = zlib.decompressobj(), element.offset
        try:
            tag = inflater.decompress(element.body, 8)
            if len(tag) < 8:
                raise ReadError("a compressed variable is cut off", offset=place)
            kind, size = self.integers(tag)
            check_size("a compressed variable", size, len(element.body), offset=place)
            self.take(size, place)
            body = inflater.decompress(inflater.unconsumed_tail, size) if size else b""
            if inflater.decompress(inflater.unconsumed_tail, 1):
                raise ReadError("a compressed variable holds more than it declares", offset=place)
        except zlib.error as error:
            raise ReadError(f"a compressed variable is damaged ({error})", offset=place) from error
        if len(body) < size or not inflater.eof:
            raise ReadError("a compressed variable is cut off", offset=place)
        return _Element(kind, memoryview(body), place)

    def variable(self, matrix: _Element, prefix: str, depth: int) -> dict[str, np.ndarray]:
        """One variable as arrays by name: none if it holds no real numbers."""
        parts = list(self.elements(matrix.body, 0, matrix.offset))
        if len(parts) < 3 or len(parts[0].body) < 8:
            return {}
        flags = self.integers(parts[0].body[:4])[0]
        shape = self.integers(parts[1].body[: len(parts[1].body) // 4 * 4], "i4")
        name = prefix + bytes(parts[2].body).decode("latin-1")
        kind, is_complex = flags & 0xFF, flags & 0x0800
        count = int(np.prod(shape, dtype=object))
        if kind == _STRUCT and depth < _DEEPEST and len(parts) >= 5 and 1 <= count <= _MOST_STRUCTS:
            # The fields of a struct, or of an array of structs, one struct after the other.
            size = parts[3].body[:4]
            width = self.integers(size, "i4")[0] if len(size) == 4 else 0
            table = bytes(parts[4].body) if width > 0 else b""
            names = [
                table[i : i + width].split(b"\0")[0].decode("latin-1")
                for i in range(0, len(table), max(width, 1))
            ]
            owners = [f"{name}[{k}]" if count > 1 else name for k in range(count)]
            paths = [f"{owner}.{field}" for owner in owners for field in names]
            arrays: dict[str, np.ndarray] = {}
            for path, part in zip(paths, parts[5:], strict=False):
                if part.kind == _MATRIX:  # which has no name of its own
                    arrays |= self.variable(part, path, depth + 1)
            return arrays
        if kind not in _CLASSES or is_complex or len(parts) < 4:
            return {}
        content, offset = parts[3].body, parts[3].offset
        if parts[3].kind not in _TYPES:
            raise ReadError(
                f"the variable {name!r} has the unknown type {parts[3].kind}", offset=offset
            )
        # Numbers are stored in the smallest type that fits, regardless of their class.
        dtype = np.dtype(self.order + _TYPES[parts[3].kind])
        if len(content) % dtype.itemsize:
            raise ReadError(f"the variable {name!r} ends within a number", offset=offset)
        numbers = np.frombuffer(content, dtype)
        self.take(numbers.size * np.dtype(_CLASSES[kind]).itemsize, matrix.offset)
        values = numbers.astype(_CLASSES[kind])
        if (count if shape else 0) != values.size or min(shape, default=0) < 0 or len(shape) > 32:
            raise ReadError(
                f"the variable {name!r} declares the shape {shape[:32]}, but holds "
                f"{values.size} numbers",
                offset=matrix.offset,
            )
        return {name: values.reshape(shape, order="F").squeeze()}


_LONGEST_LINE = 1 << 20  # bytes
_BLOCK = 1 << 22  # bytes parsed at once
_BLANK = 0.1  # of a column: with more blank cells, the table holds several topics


def sniff_text(head: bytes, path: Path) -> bool:
    return False  # Any bytes could be text: the name decides.


def load_text(path: Path) -> Log:
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
