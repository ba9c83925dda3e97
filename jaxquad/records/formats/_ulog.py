"""PX4 ULog (.ulg), after the description at docs.px4.io, "ULog File Format"."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .._errors import ReadError
from .._log import Log, Table
from ._skips import describe_skips
from ._ulog_messages import interpret, Messages, Topic


MAGIC = b"ULog\x01\x12\x35"
_BEGIN = 16  # bytes of file header
_KINDS = frozenset(b"BFIMPQARDLCSO")
_DATA = ord("D")
_SPARE = 64  # bytes that a message may be longer than its fields


def sniff(head: bytes, path: Path) -> bool:
    return head.startswith(MAGIC)


def load(path: Path) -> Log:
    """The topics of a ULog file as tables: `sensor_gyro`, of further sensors `sensor_gyro[1]`."""
    data = path.read_bytes()
    if len(data) < _BEGIN:
        raise ReadError("cut off within the file header", offset=len(data))
    messages, skipped, place = _scan(data)
    if not messages.topics:
        raise ReadError("it logs no topic: it is cut off or damaged", offset=place)
    remarks = describe_skips(skipped, place, len(data)) + _remarks(messages)
    tables = {name: _table(data, each) for name, each in messages.topics.items() if each.offsets}
    return Log(tables, tuple(remarks), "px4", messages.settings)


def _scan(data: bytes) -> tuple[Messages, list[tuple[int, int]], int]:
    """What the messages say, the damaged blocks that were skipped, and where they end."""
    messages, skipped = Messages(), []
    current = messages.current
    place, limit = _BEGIN, len(data)
    while place + 3 <= len(data):
        size, kind = data[place] | data[place + 1] << 8, data[place + 2]
        after = place + 3 + size
        if kind == _DATA and size >= 2 and after <= limit:
            topic = current.get(data[place + 3] | data[place + 4] << 8)
            if topic is not None and topic.length <= size - 2 <= topic.length + _SPARE:
                topic.offsets.append(place + 5)
                place = after
                continue
        if after > limit < len(data):
            place, limit = limit, messages.limit(limit, len(data))
        elif after <= limit and _follows(data, after, kind):
            interpret(kind, data[place + 3 : after], place, messages)
            limit = messages.limit(after, len(data))
            place = after
        else:
            resumed = _resumed(data, place + 1, messages)
            if resumed == len(data) and after > limit and kind in _KINDS:
                break
            skipped.append((place, resumed))
            place = resumed
    return messages, skipped, place


def _follows(data: bytes, after: int, kind: int) -> bool:
    """Whether a message of this kind is followed by another one or by the end."""
    return kind in _KINDS and (after + 3 > len(data) or data[after + 2] in _KINDS)


def _resumed(data: bytes, place: int, messages: Messages) -> int:
    """Where a data message begins whose length fits its topic and that another one follows."""
    while (kind := data.find(b"D", place + 2)) >= 0 and kind + 3 <= len(data):
        place = kind - 2
        size, number = (data[at] | data[at + 1] << 8 for at in (place, kind + 1))
        topic, after = messages.current.get(number), place + 3 + size
        fits = topic is not None and topic.length <= size - 2 <= topic.length + _SPARE
        if fits and after <= len(data) and _follows(data, after, _DATA):
            return place
        place += 1
    return len(data)


def _table(data: bytes, topic: Topic) -> Table:
    windows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(data, np.uint8), topic.length)
    rows = windows[np.array(topic.offsets)].view(topic.dtype)[:, 0]
    shown = [name for name in topic.dtype.names or () if "_padding" not in name]
    columns = {name: rows[name] for name in shown if name != "timestamp"}
    return Table(columns, rows["timestamp"] * 1e-6, topic.units)


def _remarks(messages: Messages) -> list[str]:
    remarks = list(messages.notes)
    if messages.stray:
        remarks.append(f"{messages.stray} messages belong to no topic that could be read")
    lost: Sequence[int] = messages.dropouts
    if lost:
        remarks.append(
            f"{len(lost)} dropouts of the logger, {sum(lost)} ms together, the longest "
            f"{max(lost)} ms: samples are missing there"
        )
    return remarks
