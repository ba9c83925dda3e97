"""Files that other libraries decode, read in a process of its own.

Compiled libraries can loop for ever or crash on a damaged file, and a bomb within it unfolds before
anyone has seen its size. The other process has limits of time, memory and file size.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from .._errors import ReadError
from .._log import Log, Table
from .._names import printable
from ._limits import allowance, oversize


_CHILD = Path(__file__).with_name("_child.py")
PATIENCE = 20.0  # s, beside what the size of the file allows


def read_isolated(path: Path, *, module: str, kind: str, per_megabyte: float = 0.1) -> Log:
    """The tables that `tables` of the file `module`, beside this one, finds in `path`.

    A column `time` of a table with a name is its clock, in s. It has `per_megabyte` s for each
    megabyte. Raises ReadError.
    """
    stored = sum(each.stat().st_size for each in _files(path))
    header, _, content = _answer(module, path, kind, stored, per_megabyte).partition(b"\n")
    found = json.loads(header)
    if "missing" in found:
        raise ReadError(f'{kind} needs more: pip install "jaxquad[logs]" ({found["missing"]})')
    if "oversize" in found:
        what, declared = found["oversize"]
        raise ReadError(oversize(what, declared, stored))
    if "error" in found:
        raise ReadError(f"{kind} that is cut off or damaged ({printable(found['error'])})")
    return Log(_tables(found["arrays"], content), tuple(found["remarks"]))


def _files(path: Path) -> list[Path]:
    return [each for each in path.iterdir() if each.is_file()] if path.is_dir() else [path]


def _answer(module: str, path: Path, kind: str, stored: int, per_megabyte: float) -> bytes:
    script = Path(__file__).with_name(f"{module}.py")
    words = [str(_CHILD), str(script), str(path.absolute()), str(allowance(stored))]
    patience = PATIENCE + per_megabyte * stored / 1e6
    try:
        child = subprocess.run(
            [sys.executable, "-P", *words], capture_output=True, timeout=patience, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise ReadError(f"{kind} does not come to an end within {patience:.0f} s") from error
    if child.returncode:
        last = child.stderr.decode("utf-8", "replace").strip().rpartition("\n")[2]
        said = f", {printable(last)}" if last else ""
        raise ReadError(f"{kind} broke its reader down (exit {child.returncode}{said})")
    return child.stdout


def _tables(arrays: list[list[Any]], content: bytes) -> dict[str, Table]:
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
