"""ROS 2 bags: a folder with metadata.yaml, or a single .mcap or .db3 file.

Read in a child process.
"""

import dataclasses
from collections.abc import Callable, Iterator
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np


LIBRARIES = ("rosbags.highlevel", "rosbags.typesys")
_MCAP, _SQLITE = b"\x89MCAP0\r\n", b"SQLite format 3\0"
_LONGEST = 64  # elements of an array that is taken as channels
_DEEPEST = 6  # messages within messages
_UNITS = {"angular_velocity": "rad/s", "linear_acceleration": "m/s^2", "position": "m"}


def sniff(head: bytes, path: Path) -> bool:
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return head.startswith((_MCAP, _SQLITE))


def tables(
    path: str, check: Callable[[str, int], None]
) -> tuple[dict[str, dict[str, tuple[np.ndarray, str]]], list[str]]:
    """The numbers of each topic with their units and a column `time` (s), and what was left out.

    The table `/imu/data` has the columns `angular_velocity.x`, ... Its time is that of the
    message's header, else that of recording, in s from the beginning of the bag. Covariances are
    left out.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import get_typestore, Stores

    topics: dict[str, _Topic] = {}
    size = 0
    # Some bags do not say how their messages are laid out.
    with AnyReader([Path(path)], default_typestore=get_typestore(Stores.LATEST)) as reader:
        known = [each for each in reader.connections if each.msgtype in reader.typestore.types]
        unknown = {each.msgtype for each in reader.connections} - {each.msgtype for each in known}
        for connection, recorded, raw in reader.messages(known) if known else ():
            message = reader.deserialize(raw, connection.msgtype)
            topic = topics.setdefault(connection.topic, _Topic(message, reader.start_time))
            size += topic.add(recorded, message)
            check("the bag", size)
    found = {name: topic.columns() for name, topic in topics.items() if topic.stamps}
    return found, [*_remarks(unknown, topics)]


def _remarks(unknown: set[str], topics: dict[str, "_Topic"]) -> Iterator[str]:
    for kind in sorted(unknown):
        yield f"messages of the unknown type {kind!r} were left out"
    for name, topic in topics.items():
        if topic.odd:
            yield f"{topic.odd} messages of {name!r} whose arrays have another size were left out"
        if topic.stamps and not topic.stamped:
            yield f"{name!r} has no header: the time of recording is used"


class _Topic:
    """The numbers of one topic's messages, shaped like the first of them."""

    def __init__(self, first: Any, begin: int):
        self.begin = begin  # ns
        paths = list(_leaves(first, "", 0))
        self.numbers = [path for path, value in paths if not isinstance(value, np.ndarray)]
        self.arrays = {path: value.shape for path, value in paths if isinstance(value, np.ndarray)}
        self.stamped = {"header.stamp.sec", "header.stamp.nanosec"} <= set(self.numbers)
        self.rows: list[tuple[Any, ...]] = []
        self.stamps: list[float] = []
        self.odd = 0
        self._get = attrgetter(*self.numbers, *self.arrays) if paths else None

    def add(self, recorded: int, message: Any) -> int:
        """Take one message; returns how many bytes its numbers are."""
        if self._get is None:
            return 0
        row: Any = self._get(message)
        row = row if len(self.numbers) + len(self.arrays) > 1 else (row,)
        ours = row[len(self.numbers) :]
        if any(a.shape != shape for a, shape in zip(ours, self.arrays.values(), strict=True)):
            self.odd += 1
            return 0
        self.rows.append(row)
        stamp = message.header.stamp if self.stamped else None
        nanoseconds = stamp.sec * 10**9 + stamp.nanosec if stamp is not None else recorded
        self.stamps.append((nanoseconds - self.begin) * 1e-9)
        return 8 * len(self.numbers) + sum(array.nbytes for array in ours)

    def columns(self) -> dict[str, tuple[np.ndarray, str]]:
        named = {}
        for i, name in enumerate(self.numbers):
            if not name.startswith("header.stamp"):
                named[name] = np.array([row[i] for row in self.rows])
        for i, name in enumerate(self.arrays, start=len(self.numbers)):
            named[name] = np.stack([row[i] for row in self.rows])
        units = {name: _UNITS.get(name.split(".")[-2], "") for name in named if "." in name}
        columns = {name: (values, units.get(name, "")) for name, values in named.items()}
        # Last, for a field of the message may be called time as well.
        return columns | {"time": (np.array(self.stamps), "s")}


def _leaves(message: Any, prefix: str, depth: int) -> Iterator[tuple[str, Any]]:
    """The numbers of a message, and its short vectors, by the way to them."""
    for field in dataclasses.fields(message):
        value, path = getattr(message, field.name), prefix + field.name
        if field.name.endswith("covariance"):
            continue
        if dataclasses.is_dataclass(value) and depth < _DEEPEST:
            yield from _leaves(value, f"{path}.", depth + 1)
        elif isinstance(value, bool | int | float):
            if not field.name.isupper():  # Constants of the message type.
                yield path, value
        elif isinstance(value, np.ndarray) and value.ndim == 1 and 0 < value.size <= _LONGEST:
            yield path, value
