import dataclasses
import struct

import numpy as np

from ._errors import ReadError
from ._ulog_format import Field, layout, parse_format
from ._ulog_units import units_of


_APPENDED = 1  # the one incompatible flag that is understood
_NUMBERS = {"float": "<f", "int32_t": "<i", "uint32_t": "<I", "uint64_t": "<Q", "double": "<d"}
_MOST_NOTES = 100
_MOST_COLUMNS = 50_000  # of all topics together; a large log has some 8000
_WIDEST = 5000  # columns of one topic; the widest of PX4 has some 400


@dataclasses.dataclass
class Topic:
    """One subscription: how its messages are laid out, and where their bytes begin."""

    label: str
    dtype: np.dtype
    units: dict[str, str]
    offsets: list[int] = dataclasses.field(default_factory=list)

    def __post_init__(self):
        self.length = self.dtype.itemsize


@dataclasses.dataclass
class Messages:
    """What the messages of a log have said so far."""

    formats: dict[str, tuple[Field, ...]] = dataclasses.field(default_factory=dict)
    current: dict[int, Topic] = dataclasses.field(default_factory=dict)  # by message number
    topics: dict[str, Topic] = dataclasses.field(default_factory=dict)  # by label
    layouts: dict[str, np.dtype] = dataclasses.field(default_factory=dict)  # by format
    appended: list[int] = dataclasses.field(default_factory=list)  # offsets of further parts
    dropouts: list[int] = dataclasses.field(default_factory=list)  # ms
    settings: dict[str, str] = dataclasses.field(default_factory=dict)
    notes: list[str] = dataclasses.field(default_factory=list)
    stray: int = 0  # messages without a subscription
    columns_left: int = _MOST_COLUMNS

    def limit(self, place: int, end: int) -> int:
        """Where the part of the file that holds `place` ends."""
        return min((each for each in self.appended if place < each < end), default=end)


def interpret(kind: int, body: bytes, place: int, messages: Messages) -> None:
    """Take note of one message; one that makes no sense is noted as such.

    Raises ReadError for a file of a kind that cannot be read at all.
    """
    letter = chr(kind)
    if letter == "B":
        _flags(body, place, messages)
        return
    try:
        if letter == "F":
            _define(body, place, messages)
        elif letter == "A":
            _subscribe(body, place, messages)
        elif letter == "R":
            messages.current.pop(*struct.unpack_from("<H", body), None)
        elif letter in "IP":
            _setting(body, messages)
        elif letter == "O":
            messages.dropouts += struct.unpack_from("<H", body)
        elif letter == "D":
            messages.stray += 1
    except (ReadError, UnicodeDecodeError, struct.error) as error:
        if len(messages.notes) < _MOST_NOTES:
            messages.notes.append(f"message {letter} at byte {place} left out: {error}")


def _flags(body: bytes, place: int, messages: Messages) -> None:
    if len(body) < 40:
        raise ReadError("the flags of the file are cut off", offset=place)
    incompatible = int.from_bytes(body[8:16], "little")
    if incompatible & ~_APPENDED:
        raise ReadError(
            f"it needs a newer reader: its incompatible flags are {incompatible:#x}", offset=place
        )
    if incompatible & _APPENDED:
        messages.appended += sorted(filter(None, struct.unpack_from("<3Q", body, 16)))


def _define(body: bytes, place: int, messages: Messages) -> None:
    name, fields = parse_format(body.decode(), place)
    if messages.formats.setdefault(name, fields) != fields:
        raise ReadError(f"the format {name!r} is defined twice, differently", offset=place)


def _subscribe(body: bytes, place: int, messages: Messages) -> None:
    instance, number = struct.unpack_from("<BH", body)
    messages.current.pop(number, None)
    name = body[3:].decode()
    if name in messages.formats and name not in messages.layouts:
        most = min(_WIDEST, messages.columns_left)
        messages.columns_left -= most  # What fails has cost as much time as what is too wide.
        dtype = layout(name, messages.formats, place, most=most)
        messages.columns_left += most - len(dtype.names or ())
        messages.layouts[name] = dtype
    if name not in messages.layouts:
        raise ReadError(f"the format {name!r} is not defined", offset=place)
    dtype = messages.layouts[name]
    if "timestamp" not in (dtype.names or ()) or dtype["timestamp"] != np.dtype("<u8"):
        raise ReadError(f"the format {name!r} has no timestamp", offset=place)
    label = f"{name}[{instance}]" if instance else name
    topic = messages.topics.setdefault(
        label, Topic(label, dtype, units_of(name, dtype.names or ()))
    )
    messages.current[number] = topic


def _setting(body: bytes, messages: Messages) -> None:
    kind, _, name = body[1 : 1 + body[0]].decode().partition(" ")
    value = body[1 + body[0] :]
    if kind.startswith("char["):
        messages.settings[name] = value.decode("utf-8", "replace")
    elif kind in _NUMBERS:
        messages.settings[name] = f"{struct.unpack_from(_NUMBERS[kind], value)[0]:.9g}"
