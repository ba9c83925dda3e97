"""The types of a ULog file: what a format definition makes of a message's bytes."""

import re
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from ._errors import ReadError


LARGEST = 65_535  # bytes of a message: its length is a 16-bit number
_DEEPEST = 16  # formats within formats
_BASIC = {
    "int8_t": "i1", "uint8_t": "u1", "int16_t": "<i2", "uint16_t": "<u2", "int32_t": "<i4",
    "uint32_t": "<u4", "int64_t": "<i8", "uint64_t": "<u8", "float": "<f4", "double": "<f8",
    "bool": "u1", "char": "S1",
}  # fmt: skip
_FIELD = re.compile(r"(\w+)(?:\[(\d{1,9})\])? (\w+)", re.ASCII)


class Field(NamedTuple):
    """One field of a format: a basic type or another format, alone or `count` times."""

    kind: str
    count: int | None
    name: str


Formats = Mapping[str, tuple[Field, ...]]


def parse_format(text: str, offset: int) -> tuple[str, tuple[Field, ...]]:
    """`name:type field;type[4] field;` as the name and the fields. Raises ReadError."""
    name, colon, body = text.partition(":")
    parts = [part.strip() for part in body.split(";") if part.strip()]
    matches = [_FIELD.fullmatch(part) for part in parts]
    if not name or not colon or not parts or not all(matches):
        raise ReadError(f"{text[:60]!r} is no definition of a format", offset=offset)
    fields = [Field(m[1], None if m[2] is None else int(m[2]), m[3]) for m in matches if m]
    return name, tuple(fields)


def layout(name: str, formats: Formats, offset: int, *, most: int = LARGEST) -> np.dtype:
    """The bytes of one message as columns; those of a nested format are `field.column`.

    Padding at the end is left out, as the logger leaves it out. Raises ReadError, also for
    more than `most` columns.
    """
    fields: list[tuple[str, str]] = []
    size = 0
    for column, kind in _columns(name, "", formats, offset, 0):
        fields.append((column, kind))
        size += np.dtype(kind).itemsize
        if size > LARGEST or len(fields) > most:
            raise ReadError(f"the format {name!r} is longer than makes sense", offset=offset)
    while fields and fields[-1][0].rpartition(".")[2].startswith("_padding"):
        fields.pop()
    if len({column for column, _ in fields}) < max(1, len(fields)):
        raise ReadError(f"the format {name!r} has no field, or two of one name", offset=offset)
    return np.dtype(fields)


def _columns(
    name: str, prefix: str, formats: Formats, offset: int, depth: int
) -> Iterator[tuple[str, str]]:
    if name not in formats or depth > _DEEPEST:
        why = "holds itself" if name in formats else "is not defined"
        raise ReadError(f"the format {name!r} {why}", offset=offset)
    for field in formats[name]:
        if (field.count or 0) > LARGEST:
            raise ReadError(f"{name}.{field.name} has {field.count} elements", offset=offset)
        column = prefix + field.name
        if field.kind in _BASIC:
            shape = "" if field.count is None else f"({field.count},)"
            yield column, shape + _BASIC[field.kind]
        elif field.count is None:
            yield from _columns(field.kind, f"{column}.", formats, offset, depth + 1)
        else:
            for i in range(field.count):
                yield from _columns(field.kind, f"{column}[{i}].", formats, offset, depth + 1)
