"""Arrays that NumPy has saved (.npz, .npy), and MATLAB in versions 5 to 7 (.mat).

Source: MathWorks, "MAT-File Format"; files are read by their declared sizes. Version 7.3 is HDF5
and has its own reader; version 4 is recognised and refused.
"""

import dataclasses
import io
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from .._errors import printable, ReadError
from .._log import add_columns, check_size, Log, Table


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
