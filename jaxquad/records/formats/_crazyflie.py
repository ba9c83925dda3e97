"""Crazyflie logs from the micro-SD deck: a table of events, then events with their values.

The file describes itself. The layout, which Bitcraze's documentation of the deck leaves open, was
found from logs: 0xBC, version (2 bytes), number of event types (2 bytes); for each an
identifier (2 bytes), a name, the number of its variables (2 bytes) and their names with a type
letter as `acc.x(f)`; then events of identifier, time stamp and values; CRC-32 of all that.
"""

import re
import struct
import zlib
from pathlib import Path

import numpy as np

from .._channel import unwrap
from .._log import Log, ReadError, Table


_WINDOW = 60  # s: the most between the two events with which reading goes on
_TRIES = 200_000  # places looked at after damage, in one file


MAGIC = 0xBC
_ID, _TIME = "event id", "time stamp"
_TYPES = set("bBhHiIqQefd")  # of Python's struct
_STAMP = {1: ("<u4", 1e3), 2: ("<u8", 1e6)}  # by version: counts of ms, of us
_VARIABLE = re.compile(r"([^()]+)\((.)\)")
_MOST_KINDS, _MOST_VARIABLES, _LONGEST_NAME = 256, 1000, 256
# The firmware logs these groups in these units; others differ from variable to variable.
_UNITS = {"acc": "g", "gyro": "deg/s"}


def sniff(head: bytes, path: Path) -> bool:
    return len(head) >= 9 and head[0] == MAGIC and head[1:3] in (b"\x01\0", b"\x02\0")


def load(path: Path) -> Log:
    """The events of a file, a table for each type; one type alone is the table `""`."""
    data = path.read_bytes()
    version, count = struct.unpack_from("<HH", data, 1) if len(data) >= 9 else (0, 0)
    if version not in _STAMP or data[0] != MAGIC:
        raise ReadError("not a Crazyflie log of version 1 or 2 (0xBC 01 00, 0xBC 02 00)", offset=0)
    if not 0 < count <= _MOST_KINDS:
        raise ReadError(
            f"{count} types of events: 1 .. {_MOST_KINDS} are possible, so the head of the file is "
            f"damaged",
            offset=3,
        )
    stamp, per_second = _STAMP[version]
    layouts: dict[int, np.dtype] = {}  # of the events by number: id, time stamp, then variables
    names: dict[str, int] = {}
    begin = 5
    for _ in range(count):
        first = begin
        number, at = _short(data, begin)
        name, at = _text(data, at)
        variables, at = _short(data, at)
        if variables > _MOST_VARIABLES:
            raise ReadError(
                f"the event {name!r} has {variables} variables: at most {_MOST_VARIABLES} are "
                f"possible",
                offset=at - 2,
            )
        layout = {_ID: "<u2", _TIME: stamp}
        for _ in range(variables):
            text, begin = _text(data, at)
            variable = _VARIABLE.fullmatch(text)
            if variable is None or variable[2] not in _TYPES or variable[1] in layout:
                raise ReadError(
                    f"variable {text[:60]!r} of the event {name!r} is not a new name with a type "
                    f"in brackets, as in 'gyro.x(f)'",
                    offset=at,
                )
            layout[variable[1]] = np.dtype(variable[2]).newbyteorder("<").str
            at = begin
        if number in layouts or name in names:
            raise ReadError(f"the event {name!r} is described twice", offset=first)
        layouts[number], names[name], begin = np.dtype(list(layout.items())), number, at
    end, remarks = len(data) - 4, []
    if zlib.crc32(memoryview(data)[:end]) != int.from_bytes(data[end:], "little"):
        remarks.append("the checksum is wrong: the log was cut off or damaged")
        end = len(data)
    offsets, skipped = _events(data, layouts, begin, end, int(_WINDOW * per_second))
    if skipped:
        size = sum(stretch for _, stretch in skipped)
        remarks.append(
            f"{size} bytes in {len(skipped)} places are not events of a known type and were "
            f"skipped, the first at byte {skipped[0][0]}"
        )
    tables = {}
    for event, number in names.items():
        places, layout = np.array(offsets[number], int), layouts[number]
        if places.size:
            if (np.diff(places) == layout.itemsize).all():  # a view where nothing is between them
                rows = np.frombuffer(data, layout, places.size, int(places[0]))
            else:
                raw = np.frombuffer(data, np.uint8)
                rows = raw[places[:, None] + np.arange(layout.itemsize)].view(layout)[:, 0]
            columns = {name: rows[name] for name in layout.names or () if name not in (_ID, _TIME)}
            units = {name: unit for name in columns if (unit := _UNITS.get(name.partition(".")[0]))}
            tables[event] = Table(columns, unwrap(rows[_TIME])[0] / per_second, units)
    if not tables:
        raise ReadError("the log holds no event of the types it describes", offset=begin)
    if len(names) == 1:
        tables = {"": next(iter(tables.values()))}
    return Log(tables, tuple(remarks), "crazyflie")


def _short(data: bytes, at: int) -> tuple[int, int]:
    if at + 2 > len(data):
        raise ReadError("the file ends within its description of events", offset=at)
    return data[at] | data[at + 1] << 8, at + 2


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.find(b"\0", at, at + _LONGEST_NAME)
    text = data[at : max(end, at)].decode("latin-1")
    if end < 0 or not text.isascii() or not text.isprintable() or not text:
        raise ReadError("a name in the description of events is damaged", offset=at)
    return text, end + 1


def _events(
    data: bytes, layouts: dict[int, np.dtype], begin: int, end: int, window: int
) -> tuple[dict[int, list[int]], list[tuple[int, int]]]:
    """Where the events of each type begin, and the stretches (offset, bytes) in between.

    After damage it goes on with the next two whose stamps fit; the event before it is left out.
    """
    sizes = {number: layout.itemsize for number, layout in layouts.items()}
    offsets: dict[int, list[int]] = {number: [] for number in layouts}
    skipped: list[tuple[int, int]] = []
    last: list[int] = []
    at, tries, smallest = begin, _TRIES, min(sizes.values())
    while at + smallest <= end:
        number = data[at] | data[at + 1] << 8
        size = sizes.get(number)
        if size is not None and at + size <= end:
            last = offsets[number]
            last.append(at)
            at += size
            continue
        bad = last.pop() if size is None and last else at
        at = end
        for place in range(bad + 1, min(end, bad + 1 + tries)):
            tries -= 1
            first = _stamp(data, layouts, place, end)
            if first is None:
                continue
            size = sizes[data[place] | data[place + 1] << 8]
            second = _stamp(data, layouts, place + size, end)
            if second is not None and first <= second <= first + window:
                at = place
                break
        skipped.append((bad, at - bad))
        last = []
    return offsets, skipped


def _stamp(data: bytes, layouts: dict[int, np.dtype], at: int, end: int) -> int | None:
    """The time stamp of the event at `at`, None where there is no whole event of a known type."""
    layout = layouts.get(data[at] | data[at + 1] << 8) if at + 1 < end else None
    if layout is None or at + layout.itemsize > end:
        return None
    return int.from_bytes(data[at + 2 : at + 2 + layout[_TIME].itemsize], "little")
