"""PX4 ULog (.ulg), after the description at docs.px4.io, "ULog File Format"."""

import bisect
import dataclasses
import re
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from .._log import changes_of, describe_skips, Log, ReadError, Table


_LARGEST = 65_535  # bytes of a message: its length is a 16-bit number
_DEEPEST = 16  # formats within formats
_MOST_COLUMNS = 50_000  # of all topics together; a large log has some 8000
_WIDEST = 5000  # columns of one topic; the widest of PX4 has some 400
_MOST_NOTES = 100


# The fields of a format: a basic type or another format, alone (None) or so many times, a name.
Formats = dict[str, tuple[tuple[str, int | None, str], ...]]


@dataclasses.dataclass
class _Topic:
    """One subscription: how its messages are laid out, and where their bytes begin."""

    name: str
    dtype: np.dtype
    offsets: list[int] = dataclasses.field(default_factory=list)

    def __post_init__(self):
        self.length = self.dtype.itemsize


@dataclasses.dataclass
class _Messages:
    """What the messages of a log have said so far."""

    formats: Formats = dataclasses.field(default_factory=dict)
    current: dict[int, _Topic] = dataclasses.field(default_factory=dict)  # by message number
    topics: dict[str, _Topic] = dataclasses.field(default_factory=dict)  # by label
    layouts: dict[str, np.dtype] = dataclasses.field(default_factory=dict)  # by format
    appended: list[int] = dataclasses.field(default_factory=list)  # offsets of further parts
    dropouts: list[int] = dataclasses.field(default_factory=list)  # ms
    settings: dict[str, str] = dataclasses.field(default_factory=dict)
    stamped: list[tuple[int, str, str]] = dataclasses.field(default_factory=list)  # by place
    notes: list[str] = dataclasses.field(default_factory=list)
    stray: int = 0  # messages without a subscription
    columns_left: int = _MOST_COLUMNS

    def limit(self, place: int, end: int) -> int:
        """Where the part of the file that holds `place` ends."""
        return min((begin for begin in self.appended if place < begin < end), default=end)


_MAGIC = b"ULog\x01\x12\x35"
_BEGIN = 16  # bytes of file header
_KINDS = frozenset(b"BFIMPQARDLCSO")
_DATA = ord("D")
_MOST_PARAMETERS = 100_000
_SPARE = 64  # bytes that a message may be longer than its fields


def sniff(head: bytes, path: Path) -> bool:
    return head.startswith(_MAGIC)


def load(path: Path) -> Log:
    """The topics of a ULog file as tables: `sensor_gyro`, of further sensors `sensor_gyro[1]`."""
    data = path.read_bytes()
    if len(data) < _BEGIN:
        raise ReadError("the file is cut off within its header", offset=len(data))
    messages, skipped, place = _scan(data)
    if not messages.topics:
        raise ReadError("the file logs no topic: it is cut off or damaged", offset=place)
    tables = {}
    for label, topic in messages.topics.items():
        if topic.offsets:
            buffer = np.frombuffer(data, np.uint8)
            windows = np.lib.stride_tricks.sliding_window_view(buffer, topic.length)
            rows = windows[np.array(topic.offsets)].view(topic.dtype)[:, 0]
            shown = [name for name in topic.dtype.names or () if "_padding" not in name]
            columns = {name: rows[name] for name in shown if name != "timestamp"}
            units = dict(_UNITS.get(topic.name, {}))  # by topic, else by a name's ending
            for column in columns:
                for ending, unit in _ENDINGS.items():
                    if column.endswith(ending):
                        units.setdefault(column, unit)
            tables[label] = Table(columns, rows["timestamp"] * 1e-6, units)
    remarks = [*describe_skips(skipped, place, len(data)), *messages.notes]
    if messages.stray:
        remarks.append(f"{messages.stray} messages of unknown topics were left out")
    if lost := messages.dropouts:
        remarks.append(
            f"the logger lost data {len(lost)} times, {sum(lost)} ms in all, the longest dropout "
            f"{max(lost)} ms: samples are missing there"
        )

    def time_before(place: int) -> float | None:
        """Of the last data message before a byte of the file; None before the first."""
        latest, last = None, -1
        for topic in messages.topics.values():
            k = bisect.bisect_left(topic.offsets, place)
            if k and topic.offsets[k - 1] > last:
                latest, last = topic, topic.offsets[k - 1]
        if latest is None:
            return None
        stamp = last + (latest.dtype.fields or {})["timestamp"][1]
        return 1e-6 * int.from_bytes(data[stamp : stamp + 8], "little")

    changes = changes_of(messages.stamped, time_before)
    return Log(tables, tuple(remarks), "px4", messages.settings, changes)


def _scan(data: bytes) -> tuple[_Messages, list[tuple[int, int]], int]:
    """What the messages say, the damaged blocks that were skipped, and where they end."""
    messages, skipped = _Messages(), []
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
            _interpret(kind, data[place + 3 : after], place, messages)
            limit = messages.limit(after, len(data))
            place = after
        else:
            resumed = place + 1  # where a data message begins that fits, and another one follows
            while (at := data.find(b"D", resumed + 2)) >= 0 and at + 3 <= len(data):
                resumed = at - 2
                size, number = (data[i] | data[i + 1] << 8 for i in (resumed, at + 1))
                topic, behind = current.get(number), resumed + 3 + size
                fits = topic is not None and topic.length <= size - 2 <= topic.length + _SPARE
                if fits and behind <= len(data) and _follows(data, behind, _DATA):
                    break
                resumed += 1
            else:
                resumed = len(data)
            if resumed == len(data) and after > limit and kind in _KINDS:
                break
            skipped.append((place, resumed))
            place = resumed
    return messages, skipped, place


def _follows(data: bytes, after: int, kind: int) -> bool:
    """Whether a message of this kind is followed by another one or by the end."""
    return kind in _KINDS and (after + 3 > len(data) or data[after + 2] in _KINDS)


_BASIC = {
    "int8_t": "i1", "uint8_t": "u1", "int16_t": "<i2", "uint16_t": "<u2", "int32_t": "<i4",
    "uint32_t": "<u4", "int64_t": "<i8", "uint64_t": "<u8", "float": "<f4", "double": "<f8",
    "bool": "u1", "char": "S1",
}  # fmt: skip
_FIELD = re.compile(r"(\w+)(?:\[(\d{1,9})\])? (\w+)", re.ASCII)


def _columns(
    name: str, prefix: str, formats: Formats, offset: int, depth: int
) -> Iterator[tuple[str, str]]:
    if name not in formats or depth > _DEEPEST:
        why = "contains itself" if name in formats else "is not defined"
        raise ReadError(f"the format {name!r} {why}", offset=offset)
    for kind, count, field in formats[name]:
        if (count or 0) > _LARGEST:
            raise ReadError(f"{name}.{field} has {count} elements", offset=offset)
        column = prefix + field
        if kind in _BASIC:
            yield column, ("" if count is None else f"({count},)") + _BASIC[kind]
        else:
            for i in [""] if count is None else (f"[{k}]" for k in range(count)):
                yield from _columns(kind, f"{column}{i}.", formats, offset, depth + 1)


_UNITS = {
    "vehicle_angular_velocity": {"xyz": "rad/s", "xyz_derivative": "rad/s^2"},
    "vehicle_angular_acceleration": {"xyz": "rad/s^2"},
    "vehicle_rates_setpoint": dict.fromkeys(("roll", "pitch", "yaw"), "rad/s"),
    "vehicle_attitude": {"rollspeed": "rad/s", "pitchspeed": "rad/s", "yawspeed": "rad/s"},
    "vehicle_attitude_setpoint": {"roll_body": "rad", "pitch_body": "rad", "yaw_body": "rad"},
    "vehicle_acceleration": {"xyz": "m/s^2"},
    "sensor_combined": {"gyro_rad": "rad/s", "accelerometer_m_s2": "m/s^2"},
    "sensor_gyro": {"x": "rad/s", "y": "rad/s", "z": "rad/s"},
    "sensor_accel": {"x": "m/s^2", "y": "m/s^2", "z": "m/s^2"},
    "autotune_attitude_control_status": {"rate_sp": "rad/s"},
    "vehicle_local_position": dict.fromkeys("xyz", "m") | dict.fromkeys(("vx", "vy", "vz"), "m/s"),
    "vehicle_local_position_setpoint": dict.fromkeys("xyz", "m"),
}
_ENDINGS = {"_m_s2": "m/s^2", "_m_s": "m/s", "_rad": "rad", "_rad_s": "rad/s", "_v": "V", "_a": "A"}


_APPENDED = 1  # the one incompatible flag that is understood
_NUMBERS = {"float": "<f", "int32_t": "<i", "uint32_t": "<I", "uint64_t": "<Q", "double": "<d"}


def _interpret(kind: int, body: bytes, place: int, messages: _Messages) -> None:
    """Interpret one message that is not data; a damaged one is left out with a remark."""
    letter = chr(kind)
    if letter == "B":
        if len(body) < 40:
            raise ReadError("the flags of the file are cut off", offset=place)
        incompatible = int.from_bytes(body[8:16], "little")
        if incompatible & ~_APPENDED:
            raise ReadError(
                f"the file needs a newer reader: its incompatible flags are {incompatible:#x}",
                offset=place,
            )
        if incompatible & _APPENDED:
            messages.appended += sorted(filter(None, struct.unpack_from("<3Q", body, 16)))
        return
    try:
        if letter == "F":
            text = body.decode()  # `name:type field;type[4] field;`
            name, colon, rest = text.partition(":")
            parts = [part.strip() for part in rest.split(";") if part.strip()]
            matches = [_FIELD.fullmatch(part) for part in parts]
            if not name or not colon or not parts or not all(matches):
                raise ReadError(f"{text[:60]!r} is not a definition of a format", offset=place)
            defined = tuple((m[1], int(m[2]) if m[2] else None, m[3]) for m in matches if m)
            if messages.formats.setdefault(name, defined) != defined:
                raise ReadError(f"the format {name!r} is defined twice, differently", offset=place)
        elif letter == "A":
            instance, number = struct.unpack_from("<BH", body)
            messages.current.pop(number, None)
            name = body[3:].decode()
            if name in messages.formats and name not in messages.layouts:
                most = min(_WIDEST, messages.columns_left)
                messages.columns_left -= most  # What fails has cost as much time as a wide one.
                fields: list[tuple[str, str]] = []
                size = 0
                for column, code in _columns(name, "", messages.formats, place, 0):
                    fields.append((column, code))
                    size += np.dtype(code).itemsize
                    if size > _LARGEST or len(fields) > most:
                        raise ReadError(f"the format {name!r} is implausibly long", offset=place)
                while fields and fields[-1][0].rpartition(".")[2].startswith("_padding"):
                    fields.pop()  # as the logger leaves it out
                if len({column for column, _ in fields}) < max(1, len(fields)):
                    raise ReadError(
                        f"the format {name!r} has no field, or two with the same name", offset=place
                    )
                messages.layouts[name] = np.dtype(fields)
                messages.columns_left += most - len(fields)
            if name not in messages.layouts:
                raise ReadError(f"the format {name!r} is not defined", offset=place)
            dtype = messages.layouts[name]
            columns = dtype.names or ()
            if "timestamp" not in columns or dtype["timestamp"] != np.dtype("<u8"):
                raise ReadError(f"the format {name!r} has no timestamp", offset=place)
            label = f"{name}[{instance}]" if instance else name
            messages.current[number] = messages.topics.setdefault(label, _Topic(name, dtype))
        elif letter == "R":
            messages.current.pop(*struct.unpack_from("<H", body), None)
        elif letter in "IP":
            kind_of_value, _, name = body[1 : 1 + body[0]].decode().partition(" ")
            value = body[1 + body[0] :]
            if kind_of_value.startswith("char["):
                messages.settings[name] = value.decode("utf-8", "replace")
            elif kind_of_value in _NUMBERS:
                number = struct.unpack_from(_NUMBERS[kind_of_value], value)[0]
                messages.settings[name] = f"{number:.9g}"
                if letter == "P" and len(messages.stamped) < _MOST_PARAMETERS:
                    messages.stamped.append((place, name, messages.settings[name]))
        elif letter == "O":
            messages.dropouts += struct.unpack_from("<H", body)
        elif letter == "D":
            messages.stray += 1
    except (ReadError, UnicodeDecodeError, struct.error) as error:
        if len(messages.notes) < _MOST_NOTES:
            reason = str(error).rstrip(".")
            messages.notes.append(f"message {letter} at byte {place} was left out: {reason}")
