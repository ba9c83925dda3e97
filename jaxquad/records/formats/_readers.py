"""Which reader takes a file: by what its first bytes say, else by its name."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from .._errors import located, ReadError, RecordWarning
from .._log import flattened, Log, Signals
from .._names import printable
from . import (
    _betaflight,
    _betaflight_csv,
    _crazyflie,
    _csv,
    _dataflash,
    _dataflash_text,
    _hdf5,
    _mat,
    _npz,
    _parquet,
    _rosbag,
    _ulog,
)


HEAD = 4096  # bytes that `sniff` gets
_LISTED = 8  # remarks shown one by one


class Reader(NamedTuple):
    """A file format.

    `sniff` says from the first 4096 bytes and the path whether a file is of this format, and
    never raises. `load` raises ReadError, with the offset where it knows one.
    """

    kind: str
    sniff: Callable[[bytes, Path], bool]
    load: Callable[[Path], Log]
    suffixes: tuple[str, ...] = ()


READERS = (
    Reader("a NumPy archive", _npz.sniff, _npz.load, (".npz", ".npy")),
    Reader("a MATLAB file", _mat.sniff, _mat.load, (".mat",)),
    Reader("an ArduPilot DataFlash log", _dataflash.sniff, _dataflash.load, (".bin",)),
    Reader("an ArduPilot text log", _dataflash_text.sniff, _dataflash_text.load, (".log",)),
    Reader("a PX4 ULog", _ulog.sniff, _ulog.load, (".ulg", ".ulog")),
    Reader("a Betaflight blackbox log", _betaflight.sniff, _betaflight.load, (".bbl", ".bfl")),
    Reader("a table of blackbox_decode", _betaflight_csv.sniff, _betaflight_csv.load),
    Reader("a Crazyflie log", _crazyflie.sniff, _crazyflie.load),
    Reader("HDF5 or MATLAB v7.3", _hdf5.sniff, _hdf5.load, (".h5", ".hdf5", ".hdf")),
    Reader("a Parquet table", _parquet.sniff, _parquet.load, (".parquet", ".pq")),
    Reader("a ROS 2 bag", _rosbag.sniff, _rosbag.load, (".mcap", ".db3")),
    Reader("a text table", _csv.sniff, _csv.load, (".csv", ".tsv", ".txt")),
)


def load_signals(path: str | Path) -> Signals:
    """The numeric arrays of a file and what is known of their clocks and units.

    Raises ReadError, and nothing else, where the file is missing, damaged or of another kind.
    Warns with RecordWarning of what was skipped.
    """
    signals = flattened(load_log(path))
    if not signals.arrays:
        raise ReadError(f"{path}: the file holds no numeric array of one or two dimensions.")
    return signals


def load_log(path: str | Path) -> Log:
    """The tables of a file, as its reader finds them. Raises ReadError, warns RecordWarning."""
    path = Path(path)
    log = _guarded(_chosen(path), path)
    remarks = list(log.remarks[:_LISTED])
    if len(log.remarks) > _LISTED:
        remarks.append(f"{len(log.remarks) - _LISTED} more remarks like these")
    for remark in remarks:
        warnings.warn(f"{path}: {remark}.", RecordWarning, stacklevel=3)
    return log


def _chosen(path: Path) -> Reader:
    head = _head(path)
    suffix = path.suffix.lower()
    by_content = (reader for reader in READERS if reader.sniff(head, path))
    by_name = (reader for reader in READERS if suffix in reader.suffixes)
    reader = next(by_content, None) or next(by_name, None)
    if reader is None:
        known = ", ".join(each for reader in READERS for each in reader.suffixes)
        raise ReadError(
            f"{path}: neither its first bytes nor its ending {suffix or 'nothing'!r} are of a "
            f"kind that is read ({known}): convert it, or give its arrays to jq.Record."
        )
    return reader


def _head(path: Path) -> bytes:
    if path.is_dir():
        return b""
    if not path.is_file():
        missing = f"there is no such file in {path.resolve().parent}"
        raise ReadError(f"{path}: {'it is no regular file' if path.exists() else missing}.")
    try:
        with path.open("rb") as file:
            head = file.read(HEAD)
    except OSError as error:
        raise ReadError(f"{path}: cannot be opened ({error}).") from error
    if not head:
        raise ReadError(f"{path}: the file is empty.", offset=0)
    return head


def _guarded(reader: Reader, path: Path) -> Log:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return reader.load(path)
    except ReadError as error:
        raise located(error, path) from error.__cause__
    # A damaged file makes zipfile, zlib, numpy, HDF5 and their like raise almost anything.
    except Exception as error:
        raise ReadError(
            f"{path}: {reader.kind} that is cut off or damaged, not as it should be "
            f"({type(error).__name__}: {printable(str(error))})."
        ) from error
