"""Formats that another library decodes, read in a process of its own.

Compiled libraries can loop for ever or crash on a damaged file, and a compressed file can unfold to
fill the memory before anyone has seen its size. The other process has limits of time, memory and
file size. It runs `_by_library.py` by its path, without the package, so that file imports nothing
of the package, and its libraries within its functions only.
"""

import functools as ft
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from .._errors import printable, ReadError
from .._log import allowance, Log, oversize, Table


_CHILD = Path(__file__).with_name("_by_library.py")
PATIENCE = 20.0  # s, beside what the size of the file allows
_Listed = tuple[str, str, str, Sequence[int], str]  # table, column, dtype, shape, unit


def in_child(name: str, kind: str, *, per_megabyte: float = 0.1) -> Callable[[Path], Log]:
    """A `load` function that reads the format `name` of `_by_library` in a child process.

    A column `time` of a table with a name is its clock, in s. The process may take `per_megabyte`
    s for each megabyte of the file beside `PATIENCE`.
    """
    return ft.partial(_load, name, kind, per_megabyte)


def _load(name: str, kind: str, per_megabyte: float, path: Path) -> Log:
    stored = sum(each.stat().st_size for each in _files(path))
    header, _, content = _answer(name, path, kind, stored, per_megabyte).partition(b"\n")
    found = json.loads(header)
    if "missing" in found:
        raise ReadError(
            f"reading {kind} needs a further library ({found['missing']}): "
            f'pip install "jaxquad[logs]"'
        )
    if "oversize" in found:
        what, declared = found["oversize"]
        raise ReadError(oversize(what, declared, stored))
    if "error" in found:
        raise ReadError(
            f"cannot be read as {kind}: the file is cut off or damaged "
            f"({printable(found['error'])})"
        )
    arrays = [tuple(each) for each in found["arrays"]]
    return Log(_tables(arrays, content), tuple(found["remarks"]))


def _files(path: Path) -> list[Path]:
    return [each for each in path.iterdir() if each.is_file()] if path.is_dir() else [path]


def _answer(name: str, path: Path, kind: str, stored: int, per_megabyte: float) -> bytes:
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
    return child.stdout


def _tables(arrays: Sequence[_Listed], content: bytes) -> dict[str, Table]:
    columns: dict[str, dict[str, np.ndarray]] = {}
    units: dict[str, dict[str, str]] = {}
    place = 0
    for table, name, dtype, shape, unit in arrays:
        count = int(np.prod(shape, dtype=object))
        values = np.frombuffer(content, dtype, count, place).reshape(shape)
        columns.setdefault(table, {})[name] = values
        units.setdefault(table, {})[name] = unit
        place += values.nbytes
    return {
        table: Table(named, named.pop("time") if table else None, units[table])
        for table, named in columns.items()
    }
