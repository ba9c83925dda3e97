"""Formats that other libraries decode: HDF5, Parquet and ROS 2 bags, in a process of their own.

The face of this folder runs it as a script, without the package: `_by_library.py FORMAT PATH
LIMIT`. It reads PATH and writes to stdout a line of JSON (names, dtypes, shapes, units, remarks; or
what was wrong), then the bytes of the arrays.
"""

import dataclasses
import importlib
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np


_SPARE = 512 * 2**20  # bytes of address space beside three times the numbers
Check = Callable[[str, int], None]  # of how many bytes something declares
Content = tuple[dict[str, dict[str, tuple[np.ndarray, str]]], list[str]]  # values, unit; remarks


class Oversize(Exception):
    """What declares how many bytes too many."""


_MAGIC = b"\x89HDF\r\n\x1a\n"
_MOST_OBJECTS = 100_000
_MATLAB_NUMBERS = ("double", "single", "logical")


def sniff_hdf5(head: bytes, path: Path) -> bool:
    return head.startswith((_MAGIC, b"MATLAB 7.3")) or head[512:520] == _MAGIC


def _hdf5_tables(path: str, check: Check) -> Content:
    """The numeric datasets as `group.name`; those of MATLAB v7.3 have its rows and columns.

    By the lower layer of h5py: its upper one takes five times as long for many small datasets.
    """
    import h5py
    from h5py import h5l, h5o  # pyright: ignore[reportAttributeAccessIssue]  # h5py has no stubs

    names: list[bytes] = []  # links by name are not followed
    columns: dict[str, tuple[np.ndarray, str]] = {}
    remarks: list[str] = []

    def visit(name: bytes) -> None:
        if len(names) >= _MOST_OBJECTS:
            raise ValueError(f"more than {_MOST_OBJECTS} objects")
        names.append(name)

    def visit_link(name: bytes, link: Any) -> None:
        if link.type == h5l.TYPE_EXTERNAL:
            remarks.append(_elsewhere(name.decode("utf-8", "replace").replace("/", ".")))

    size = 0
    with h5py.File(path, "r") as file:
        h5o.visit(file.id, visit)
        file.id.links.visit(visit_link, info=True)
        for raw in names:
            item = h5o.open(file.id, raw)
            if not isinstance(item, h5py.h5d.DatasetID) or raw.startswith(b"#"):
                continue
            shape, dtype = item.shape, item.dtype
            if shape is None or not 1 <= len(shape) <= 2 or 0 in shape:
                continue
            if not (dtype.kind in "fiub" or (dtype.names and len(shape) == 1)):
                continue
            attributes = h5py.Dataset(item).attrs if h5py.h5a.get_num_attrs(item) else {}
            kind = _text(attributes.get("MATLAB_class"))
            matlab = kind.startswith(("int", "uint")) or kind in _MATLAB_NUMBERS
            if (kind and not matlab) or "MATLAB_empty" in attributes:
                continue
            name = raw.decode("utf-8", "replace").replace("/", ".")
            layout = item.get_create_plist()
            stored = layout.get_layout()
            if layout.get_external_count() or stored == h5py.h5d.VIRTUAL:
                remarks.append(_elsewhere(name))
                continue
            size += math.prod(shape) * dtype.itemsize
            check("the file", size)
            if stored == h5py.h5d.CHUNKED:
                check(f"a chunk of {name!r}", math.prod(layout.get_chunk()) * dtype.itemsize)
            unit = _unit(attributes, "units", "unit")
            if dtype.names:
                records = np.asarray(h5py.Dataset(item)[()])
                arrays = {f"{name}.{field}": records[field] for field in dtype.names}
            else:
                values = np.empty(shape, dtype)
                item.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
                values = values.T if "MATLAB_class" in attributes else values
                arrays = {name: values.reshape(-1) if 1 in shape else values}
            for full, values in arrays.items():
                if full in columns:
                    remarks.append(f"two datasets are called {full!r}: the later one is used")
                columns[full] = values, unit
    return {"": columns}, remarks


def _elsewhere(name: str) -> str:
    return f"{name!r} lies in another file and was left out"


def _text(value: object) -> str:
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value if isinstance(value, str) else ""


def _unit(attributes: Mapping, *keys: str | bytes) -> str:
    logged = (attributes.get(key) for key in keys)
    return next((_text(text) for text in logged if text is not None), "")


_PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}


def sniff_parquet(head: bytes, path: Path) -> bool:
    return head.startswith(b"PAR1")


def _parquet_tables(path: str, check: Check) -> Content:
    """The numeric columns, with NaN where values are missing; time stamps and durations in s."""
    import pyarrow.parquet

    types = pyarrow.types
    is_time = lambda kind: types.is_timestamp(kind) or types.is_duration(kind)
    numeric = (types.is_integer, types.is_floating, types.is_boolean, is_time)
    with pyarrow.parquet.ParquetFile(path) as file:
        wanted = [f for f in file.schema_arrow if any(is_kind(f.type) for is_kind in numeric)]
        names = [field.name for field in wanted]
        if len(set(names)) < len(names):
            raise ValueError(f"two columns are called {max(names, key=names.count)!r}: rename one")
        check("the table", 8 * len(wanted) * file.metadata.num_rows)
        table = file.read(columns=names, use_threads=False)
    columns = {}
    for field in wanted:
        column = table.column(field.name)
        if is_time(field.type):
            seconds = column.cast(pyarrow.int64()).to_numpy() / _PER_SECOND[field.type.unit]
            columns[field.name] = seconds, "s"
        else:
            columns[field.name] = column.to_numpy(), _unit(field.metadata or {}, b"units", b"unit")
    return {"": columns}, []


_MCAP, _SQLITE = b"\x89MCAP0\r\n", b"SQLite format 3\0"
_LONGEST = 64  # elements of an array that is taken as channels
_DEEPEST = 6  # messages within messages
_UNITS = {"angular_velocity": "rad/s", "linear_acceleration": "m/s^2", "position": "m"}


def sniff_bag(head: bytes, path: Path) -> bool:
    """A folder with metadata.yaml, or a single .mcap or .db3 file."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return head.startswith((_MCAP, _SQLITE))


def _bag_tables(path: str, check: Check) -> Content:
    """The numbers of each topic, `/imu/data` with `angular_velocity.x`; its time begins at 0.

    It is that of the message's header, else that of recording. Covariances are left out.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import get_typestore, Stores

    topics: dict[str, _Topic] = {}
    size = 0
    # Some bags do not say how their messages are laid out.
    with AnyReader([Path(path)], default_typestore=get_typestore(Stores.LATEST)) as reader:
        defined = [x for x in reader.connections if x.msgtype in reader.typestore.types]
        unknown = {x.msgtype for x in reader.connections} - {x.msgtype for x in defined}
        for connection, recorded, raw in reader.messages(defined) if defined else ():
            message = reader.deserialize(raw, connection.msgtype)
            topic = topics.setdefault(connection.topic, _Topic(message, reader.start_time))
            size += topic.add(recorded, message)
            check("the bag", size)
    remarks = [f"messages of the unknown type {kind!r} were left out" for kind in sorted(unknown)]
    for name, topic in topics.items():
        if topic.odd:
            remarks.append(
                f"{topic.odd} messages of {name!r} whose arrays have another size were left out"
            )
        if topic.stamps and not topic.stamped:
            remarks.append(f"{name!r} has no header: the time of recording is used")
    return {name: topic.columns() for name, topic in topics.items() if topic.stamps}, remarks


class _Topic:
    """The numbers of one topic's messages, shaped like the first of them."""

    def __init__(self, first: Any, begin: int):
        self.begin = begin  # ns
        shapes = [(path, getattr(x, "shape", ())) for path, x in _leaves(first, "", 0)]
        self.shapes = dict(sorted(shapes, key=lambda item: len(item[1])))  # first the numbers
        self.stamped = {"header.stamp.sec", "header.stamp.nanosec"} <= self.shapes.keys()
        self.rows: list[tuple[Any, ...]] = []
        self.stamps: list[float] = []
        self.odd = 0
        self._get = attrgetter(*self.shapes) if self.shapes else None

    def add(self, recorded: int, message: Any) -> int:
        """Take one message; returns how many bytes its numbers are."""
        if self._get is None:
            return 0
        row: Any = self._get(message)
        row = row if len(self.shapes) > 1 else (row,)
        if [getattr(x, "shape", ()) for x in row] != list(self.shapes.values()):
            self.odd += 1
            return 0
        self.rows.append(row)
        stamp = message.header.stamp if self.stamped else None
        nanoseconds = stamp.sec * 10**9 + stamp.nanosec if stamp is not None else recorded
        self.stamps.append((nanoseconds - self.begin) * 1e-9)
        return sum(getattr(x, "nbytes", 8) for x in row)

    def columns(self) -> dict[str, tuple[np.ndarray, str]]:
        columns = {}
        for i, name in enumerate(self.shapes):
            if not name.startswith("header.stamp"):
                unit = _UNITS.get(name.split(".")[-2], "") if "." in name else ""
                columns[name] = np.array([row[i] for row in self.rows]), unit
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


LIBRARIES: Mapping[str, tuple[tuple[str, ...], Callable[[str, Check], Content]]] = {
    "hdf5": (("h5py",), _hdf5_tables),
    "parquet": (("pyarrow", "pyarrow.parquet"), _parquet_tables),
    "rosbag": (("rosbags.highlevel", "rosbags.typesys"), _bag_tables),
}  # the modules that a format needs, and the function that returns its tables and remarks


def main() -> None:
    kind, path, limit = sys.argv[1], sys.argv[2], int(sys.argv[3])
    stream = sys.stdout.buffer
    say = lambda what: stream.write(json.dumps(what).encode() + b"\n")
    try:
        # Before memory is limited: some libraries reserve gigabytes of addresses.
        for module in LIBRARIES[kind][0]:
            importlib.import_module(module)
    except ImportError as error:
        say({"missing": str(error)})
        return
    if sys.platform == "linux":
        import resource

        with open("/proc/self/statm") as file:
            used = int(file.read().split()[0]) * resource.getpagesize()
        most = used + 3 * limit + _SPARE
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    def check(what: str, declared: int) -> None:
        if declared > limit:
            raise Oversize(what, declared)

    try:
        tables, remarks = LIBRARIES[kind][1](path, check)
    except Oversize as error:
        say({"oversize": error.args})
        return
    # On damaged files the libraries raise almost anything.
    except Exception as error:
        say({"error": f"{type(error).__name__}: {error}"[:500]})
        return
    arrays = [
        (table, name, np.asarray(values), unit)
        for table, columns in tables.items()
        for name, (values, unit) in columns.items()
        if values.dtype.kind in "fiub" and values.ndim in (1, 2)
    ]
    listed = [(table, name, a.dtype.str, a.shape, unit) for table, name, a, unit in arrays]
    say({"arrays": listed, "remarks": remarks})
    for _, _, array, _ in arrays:
        stream.write(np.ascontiguousarray(array).data.cast("B") if array.size else b"")


if __name__ == "__main__":
    main()
