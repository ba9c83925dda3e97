"""The file formats that can be read, and which of them a file is.

A format is one file of this folder with two functions: `sniff(head, path) -> bool` and
`load(path) -> Log`. To add one, write that file and enter it in `READERS`. A format that another
library decodes is a function `tables(path, check)` of `_by_library.py`, which a child process runs.

Compiled libraries can loop for ever or crash on a damaged file, and a compressed file can unfold to
fill the memory before anyone has seen its size. So that process has limits of time, memory and file
size. It runs `_by_library.py` by its path, without the package.
"""

import contextlib
import functools as ft
import json
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .._firmwares import registered_logs
from .._log import (
    allowance,
    check_size,
    flattened,
    located,
    Log as Log,
    printable,
    ReadError,
    Signals,
    Table as Table,
    warn,
)
from . import (
    _betaflight,
    _betaflight_columns,
    _by_library,
    _crazyflie,
    _dataflash,
    _tables,
    _ulog,
)


_HEAD = 4096  # bytes that `sniff` gets
_LISTED = 8  # remarks shown one by one
_CHILD = Path(__file__).with_name("_by_library.py")
PATIENCE = 20.0  # s, beside what the size of the file allows


def _in_child(name: str, per_megabyte: float, path: Path) -> Log:
    """A file of a format of `_by_library`, in a process that may take so many s per megabyte."""
    kind = READERS[name].kind
    files = [file for file in path.iterdir() if file.is_file()] if path.is_dir() else [path]
    stored = sum(file.stat().st_size for file in files)
    words = [str(_CHILD), name, str(path.absolute()), str(allowance(stored))]
    patience = PATIENCE + per_megabyte * stored / 1e6
    try:
        child = subprocess.run(
            [sys.executable, "-P", *words], capture_output=True, timeout=patience, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise ReadError(
            f"cannot be read as {kind}: reading did not end within {patience:.0f} s. The file is "
            f"probably damaged"
        ) from error
    if child.returncode:
        last = child.stderr.decode("utf-8", "replace").strip().rpartition("\n")[2]
        said = f", {printable(last)}" if last else ""
        raise ReadError(
            f"cannot be read as {kind}: the library that decodes it crashed (exit status "
            f"{child.returncode}{said}). The file is probably damaged"
        )
    header, _, content = child.stdout.partition(b"\n")
    answer = json.loads(header)
    if "missing" in answer:
        raise ReadError(
            f"reading {kind} needs a further library ({answer['missing']}): "
            f'pip install "jaxquad[logs]"'
        )
    if "oversize" in answer:
        what, declared = answer["oversize"]
        check_size(what, declared, stored)
    if "error" in answer:
        raise ReadError(
            f"cannot be read as {kind}: the file is cut off or damaged "
            f"({printable(answer['error'])})"
        )
    columns: dict[str, dict[str, np.ndarray]] = {}
    units: dict[str, dict[str, str]] = {}
    place = 0
    for table, column, dtype, shape, unit in answer["arrays"]:
        count = int(np.prod(shape, dtype=object))
        values = np.frombuffer(content, dtype, count, place).reshape(shape)
        columns.setdefault(table, {})[column] = values
        units.setdefault(table, {})[column] = unit
        place += values.nbytes
    tables = {
        table: Table(named, named.pop("time") if table else None, units[table])
        for table, named in columns.items()
    }
    return Log(tables, tuple(answer["remarks"]))


class Reader(NamedTuple):
    """A file format.

    `sniff` says from the first 4096 bytes and the path whether a file is of this format, and
    never raises. `load` raises ReadError, with the offset where it knows one. `suffixes` decide
    where no format recognises the first bytes.
    """

    kind: str
    sniff: Callable[[bytes, Path], bool]
    load: Callable[[Path], Log]
    suffixes: tuple[str, ...] = ()


READERS: Mapping[str, Reader] = {
    "npz": Reader(
        "a NumPy archive", _tables.sniff_numpy, _tables.load_numpy, (".npz", ".npy")
    ),
    "mat": Reader("a MATLAB file", _tables.sniff_matlab, _tables.load_matlab, (".mat",)),
    "dataflash": Reader(
        "an ArduPilot DataFlash log", _dataflash.sniff, _dataflash.load, (".bin",)
    ),
    "dataflash_text": Reader(
        "an ArduPilot text log", _dataflash.sniff_text, _dataflash.load_text, (".log",)
    ),
    "ulog": Reader("a PX4 ULog", _ulog.sniff, _ulog.load, (".ulg", ".ulog")),
    "betaflight": Reader(
        "a Betaflight blackbox log", _betaflight.sniff, _betaflight.load, (".bbl", ".bfl")
    ),
    "betaflight_csv": Reader(
        "a table of blackbox_decode", _betaflight_columns.sniff, _betaflight_columns.load
    ),
    "crazyflie": Reader("a Crazyflie log", _crazyflie.sniff, _crazyflie.load),
    "hdf5": Reader(
        "an HDF5 or MATLAB v7.3 file", _by_library.sniff_hdf5, ft.partial(_in_child, "hdf5", 0.1),
        (".h5", ".hdf5", ".hdf"),
    ),
    "parquet": Reader(
        "a Parquet table", _by_library.sniff_parquet, ft.partial(_in_child, "parquet", 0.1),
        (".parquet", ".pq"),
    ),
    "rosbag": Reader(
        "a ROS 2 bag", _by_library.sniff_bag, ft.partial(_in_child, "rosbag", 2.0),
        (".mcap", ".db3"),
    ),
    "csv": Reader("a text table", _tables.sniff_text, _tables.load_text, (".csv", ".tsv", ".txt")),
}  # fmt: skip


def load_signals(path: str | Path) -> Signals:
    """The numeric arrays of a file and what is known of their clocks and units."""
    if not isinstance(path, str | Path):
        raise ReadError(
            f"{type(path).__name__} is no path of a file: a table in memory is read by "
            "jq.records.from_dataframe, arrays by jq.Record(time, inputs, outputs)"
        )
    log = load_log(path)
    try:
        signals = flattened(log)
    except ReadError as error:
        raise located(error, path) from error
    if not signals.arrays:
        raise ReadError(
            f"{path}: the file holds no numeric array of one or two dimensions. Objects of MATLAB "
            f"(timeseries, timetable) are not read: save an array, or a structure with time."
        )
    return signals


def channel_names(path: str | Path) -> set[str]:
    """Those of all arrays of a file, and of their columns. Raises ReadError."""
    arrays = {name: signal.values for name, signal in load_signals(path).arrays.items()}
    columns = ((name, x.shape[1]) for name, x in arrays.items() if x.ndim == 2)
    return {*arrays, *(f"{name}[{k}]" for name, count in columns for k in range(count))}


_kept: ContextVar[dict[Path, Log] | None] = ContextVar("kept logs", default=None)


@contextlib.contextmanager
def keep_logs() -> Iterator[None]:
    """Within it, a file that is read again is not decoded again."""
    token = _kept.set({})
    try:
        yield
    finally:
        _kept.reset(token)


def load_log(path: str | Path) -> Log:
    """The tables of a file, as its reader finds them. Raises ReadError, warns RecordWarning."""
    path, kept = Path(path), _kept.get()
    log = None if kept is None else kept.get(path)
    if log is None:
        log = _decode(path)
    if kept is not None:
        kept.clear()
        kept[path] = log
    remarks = list(log.remarks[:_LISTED])
    if len(log.remarks) > _LISTED:
        remarks.append(f"{len(log.remarks) - _LISTED} more remarks of this kind")
    for remark in remarks:
        warn(f"{path}: {remark}.")
    return log


def _decode(path: Path) -> Log:
    try:
        require_file(path)
        head = b""
        if not path.is_dir():
            with path.open("rb") as file:
                head = file.read(_HEAD)
            if not head:
                raise ReadError(f"{path}: the file is empty.", offset=0)
        suffix = path.suffix.lower()
        readers = [*(log.reader for log in registered_logs() if log.reader), *READERS.values()]
        by_content = (reader for reader in readers if reader.sniff(head, path))
        by_name = (reader for reader in readers if suffix in reader.suffixes)
        reader = next(by_content, None)
        if reader is None and path.is_dir():
            raise ReadError(f"{path} is a folder, and no bag of ROS 2: name the file in it.")
        reader = reader or next(by_name, None)
        if reader is None:
            suffixes = ", ".join(ending for x in READERS.values() for ending in x.suffixes)
            ending = f"ending {suffix!r}" if suffix else "name, which has no ending,"
            raise ReadError(
                f"{path}: unknown file format: neither the first bytes nor the {ending} are those "
                f"of a known one ({suffixes}). Convert the file«, or build a jq.Record from its "
                "arrays»."
            )
    # A name with a zero byte, one too long, a link to itself, a folder that may not be read.
    except (OSError, RuntimeError, ValueError) as error:
        if isinstance(error, ReadError):
            raise
        raise ReadError(
            f"{printable(str(path))}: the file cannot be opened "
            f"({type(error).__name__}: {printable(str(error))})."
        ) from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return reader.load(path)
    except ReadError as error:
        raise located(error, path) from error.__cause__
    # A damaged file makes zipfile, zlib, numpy, HDF5 and their like raise almost anything.
    except Exception as error:
        raise ReadError(
            f"{path}: cannot be read as {reader.kind}: the file is cut off or damaged "
            f"({type(error).__name__}: {printable(str(error))})."
        ) from error


def require_file(path: str | Path) -> None:
    """Raise ReadError where there is neither a file nor a folder. Nothing is read."""
    path = Path(path)
    if not (path.is_dir() or path.is_file()):
        missing = f"there is no such file in {path.resolve().parent}"
        raise ReadError(f"{path}: {'it is not a regular file' if path.exists() else missing}.")
