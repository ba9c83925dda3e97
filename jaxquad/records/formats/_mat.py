"""MATLAB files of versions 5 to 7 (MathWorks, "MAT-File Format"), read by their declared sizes.

Version 7.3 is HDF5 and has its own reader; version 4 is recognised and refused.
"""

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .._errors import ReadError
from .._log import add_columns, check_size, Log, Table


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


class _Element(NamedTuple):
    """A typed piece of the file: its type, its bytes, and its place."""

    kind: int
    body: memoryview
    offset: int


class _Budget:
    """How many bytes the variables of a file unfold to, in the type that they are stored in or in
    the wider one of their class; raises ReadError where they are too many."""

    def __init__(self, stored: int):
        self.stored, self.taken = stored, 0

    def take(self, size: int, offset: int) -> None:
        self.taken += size
        check_size("the file", self.taken, self.stored, offset=offset)


def sniff(head: bytes, path: Path) -> bool:
    return head[126:128] in (b"IM", b"MI") and head[124:126] in (b"\0\1", b"\1\0")


def load(path: Path) -> Log:
    """The real numeric variables, and those in structs as `s.q` or `s[1].q`; no others."""
    content = path.read_bytes()
    if len(content) < _HEADER or content[126:128] not in (b"IM", b"MI"):
        raise ReadError(
            "not a MATLAB file of version 5 to 7.3, or cut off: save it with save(..., '-v7')",
            offset=0,
        )
    order = "<" if content[126:128] == b"IM" else ">"
    arrays: dict[str, np.ndarray] = {}
    remarks: list[str] = []
    budget = _Budget(len(content))
    for element in _elements(memoryview(content), order, _HEADER, 0):
        variable = _inflate(element, order, budget) if element.kind == _COMPRESSED else element
        if variable.kind == _MATRIX:
            add_columns(arrays, _variable(variable, order, "", 0, budget), remarks)
    return Log({"": Table(arrays)}, tuple(remarks))


def _elements(content: memoryview, order: str, place: int, base: int) -> Iterator[_Element]:
    """The elements from `place` on; `base` is added to the offsets in errors."""
    while place + 8 <= len(content):
        kind, size = (int(n) for n in np.frombuffer(content[place : place + 8], f"{order}u4"))
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


def _inflate(element: _Element, order: str, budget: _Budget) -> _Element:
    inflater = zlib.decompressobj()
    try:
        tag = inflater.decompress(element.body, 8)
        if len(tag) < 8:
            raise ReadError("a compressed variable is cut off", offset=element.offset)
        kind, size = (int(n) for n in np.frombuffer(tag, f"{order}u4"))
        check_size("a compressed variable", size, len(element.body), offset=element.offset)
        budget.take(size, element.offset)
        body = inflater.decompress(inflater.unconsumed_tail, size) if size else b""
        if inflater.decompress(inflater.unconsumed_tail, 1):
            raise ReadError(
                "a compressed variable holds more than it declares", offset=element.offset
            )
    except zlib.error as error:
        raise ReadError(
            f"a compressed variable is damaged ({error})", offset=element.offset
        ) from error
    if len(body) < size or not inflater.eof:
        raise ReadError("a compressed variable is cut off", offset=element.offset)
    return _Element(kind, memoryview(body), element.offset)


def _variable(
    matrix: _Element, order: str, prefix: str, depth: int, budget: _Budget
) -> dict[str, np.ndarray]:
    """One variable as arrays by name: none if it holds no real numbers."""
    parts = list(_elements(matrix.body, order, 0, matrix.offset))
    if len(parts) < 3 or len(parts[0].body) < 8:
        return {}
    flags = int(np.frombuffer(parts[0].body[:4], f"{order}u4")[0])
    shape = np.frombuffer(parts[1].body[: len(parts[1].body) // 4 * 4], f"{order}i4")
    name = prefix + bytes(parts[2].body).decode("latin-1")
    kind, is_complex = flags & 0xFF, flags & 0x0800
    count = int(np.prod(shape.astype(object)))
    if kind == _STRUCT and depth < _DEEPEST and len(parts) >= 5 and 1 <= count <= _MOST_STRUCTS:
        # The fields of a struct, or of an array of structs, one struct after the other.
        size = parts[3].body[:4]
        width = int(np.frombuffer(size, f"{order}i4")[0]) if len(size) == 4 else 0
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
                arrays |= _variable(part, order, path, depth + 1, budget)
        return arrays
    if kind not in _CLASSES or is_complex or len(parts) < 4:
        return {}
    content, offset = parts[3].body, parts[3].offset
    if parts[3].kind not in _TYPES:
        raise ReadError(
            f"the variable {name!r} has the unknown type {parts[3].kind}", offset=offset
        )
    # Numbers are stored in the smallest type that fits, regardless of their class.
    dtype = np.dtype(order + _TYPES[parts[3].kind])
    if len(content) % dtype.itemsize:
        raise ReadError(f"the variable {name!r} ends within a number", offset=offset)
    numbers = np.frombuffer(content, dtype)
    budget.take(numbers.size * np.dtype(_CLASSES[kind]).itemsize, matrix.offset)
    values = numbers.astype(_CLASSES[kind])
    if (count if shape.size else 0) != values.size or (shape < 0).any() or shape.size > 32:
        raise ReadError(
            f"the variable {name!r} declares the shape {shape[:32].tolist()}, but holds "
            f"{values.size} numbers",
            offset=matrix.offset,
        )
    return {name: values.reshape(shape, order="F").squeeze()}
