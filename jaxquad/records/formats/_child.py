"""Run as a script by `_isolated`, without the package: `_child.py MODULE PATH LIMIT`.

Loads the file MODULE, lets its `tables` read PATH, and writes what that returns to stdout: a line
of JSON (names, dtypes, shapes, units, remarks; or what was wrong), then the bytes of the arrays.
"""

import importlib
import importlib.util
import json
import sys
from types import ModuleType
from typing import BinaryIO

import numpy as np


_SPARE = 512 * 2**20  # bytes of address space beside three times the numbers


class Oversize(Exception):
    """What declares how many bytes too many."""


def answer(module: ModuleType, path: str, limit: int, stream: BinaryIO) -> None:
    """Write the tables of a file, which may declare up to `limit` bytes."""

    def check(what: str, declared: int) -> None:
        if declared > limit:
            raise Oversize(what, declared)

    try:
        tables, remarks = module.tables(path, check)
    except Oversize as error:
        stream.write(json.dumps({"oversize": error.args}).encode() + b"\n")
        return
    # On damaged files the libraries raise almost anything.
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        stream.write(json.dumps({"error": reason[:500]}).encode() + b"\n")
        return
    arrays = [
        (table, name, np.asarray(values), unit)
        for table, columns in tables.items()
        for name, (values, unit) in columns.items()
        if values.dtype.kind in "fiub" and values.ndim in (1, 2)
    ]
    listed = [(table, name, a.dtype.str, a.shape, unit) for table, name, a, unit in arrays]
    stream.write(json.dumps({"arrays": listed, "remarks": remarks}).encode() + b"\n")
    for _, _, array, _ in arrays:
        stream.write(np.ascontiguousarray(array).data.cast("B") if array.size else b"")


def load_module(path: str) -> ModuleType:
    """The module in a file, which need not be in a package, with the libraries that it needs.

    The libraries are imported here, before memory is limited: some reserve gigabytes of
    addresses when they are loaded.
    """
    spec = importlib.util.spec_from_file_location("reader", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for library in module.LIBRARIES:
        importlib.import_module(library)
    return module


def _limit_memory(limit: int) -> None:
    try:
        import resource
    except ImportError:  # There is no such thing on Windows.
        return
    with open("/proc/self/statm") as file:
        held = int(file.read().split()[0]) * resource.getpagesize()
    most = held + 3 * limit + _SPARE
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))


def main() -> None:
    script, path, limit = sys.argv[1], sys.argv[2], int(sys.argv[3])
    try:
        module = load_module(script)
    except ImportError as error:
        sys.stdout.buffer.write(json.dumps({"missing": str(error)}).encode() + b"\n")
        return
    if sys.platform == "linux":
        _limit_memory(limit)
    answer(module, path, limit, sys.stdout.buffer)


if __name__ == "__main__":
    main()
