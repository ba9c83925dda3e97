"""HDF5 and MATLAB v7.3 files, which are HDF5 with the axes reversed; read in a child process."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np


if TYPE_CHECKING:
    import h5py

LIBRARIES = ("h5py",)
_MAGIC = b"\x89HDF\r\n\x1a\n"
_MOST_OBJECTS = 20_000
_MATLAB_NUMBERS = ("double", "single", "logical")


def sniff(head: bytes, path: Path) -> bool:
    return head.startswith((_MAGIC, b"MATLAB 7.3")) or head[512:520] == _MAGIC


def tables(
    path: str, check: Callable[[str, int], None]
) -> tuple[dict[str, dict[str, tuple[np.ndarray, str]]], list[str]]:
    """The numeric datasets as `group.name` with their units, and what was left out.

    MATLAB v7.3 files keep the rows and columns that they have in MATLAB. Datasets whose values
    lie in other files are left out.
    """
    import h5py

    columns: dict[str, tuple[np.ndarray, str]] = {}
    remarks = []
    with h5py.File(path, "r") as file:
        datasets = _datasets(file)
        check("the file", sum(int(dataset.nbytes) for dataset in datasets.values()))
        for name, dataset in datasets.items():
            if dataset.external or dataset.is_virtual:
                remarks.append(f"{name!r} lies in another file and was left out")
                continue
            chunk = np.prod(dataset.chunks or (0,), dtype=object) * dataset.dtype.itemsize
            check(f"a chunk of {name!r}", int(chunk))
            unit = _unit(dataset)
            columns |= {full: (values, unit) for full, values in _columns(name, dataset).items()}
    return {"": columns}, remarks


def _datasets(file: "h5py.File") -> dict[str, "h5py.Dataset"]:
    """Those of numbers or records; soft and external links are not followed."""
    import h5py

    found: dict[str, h5py.Dataset] = {}
    visited = 0

    def visit(name: str, item: object) -> None:
        nonlocal visited
        visited += 1
        if visited > _MOST_OBJECTS:
            raise ValueError(f"more than {_MOST_OBJECTS} objects")
        if isinstance(item, h5py.Dataset) and not name.startswith("#") and _is_wanted(item):
            found[name.replace("/", ".")] = item

    file.visititems(visit)
    return found


def _is_wanted(dataset: "h5py.Dataset") -> bool:
    if dataset.shape is None or not 1 <= len(dataset.shape) <= 2 or not dataset.size:
        return False
    kind = _text(dataset.attrs.get("MATLAB_class", b""))
    numeric = dataset.dtype.kind in "fiub" or (dataset.dtype.names and len(dataset.shape) == 1)
    matlab = kind.startswith(("int", "uint")) or kind in _MATLAB_NUMBERS
    return bool(numeric) and (matlab or not kind) and "MATLAB_empty" not in dataset.attrs


def _columns(name: str, dataset: "h5py.Dataset") -> dict[str, np.ndarray]:
    values = np.asarray(dataset[()])
    if values.dtype.names:
        return {f"{name}.{field}": values[field] for field in values.dtype.names}
    if "MATLAB_class" in dataset.attrs:
        values = values.T
    return {name: values.reshape(-1) if 1 in values.shape else values}


def _unit(dataset: "h5py.Dataset") -> str:
    named = (dataset.attrs.get(key) for key in ("units", "unit"))
    return next((_text(each) for each in named if each is not None), "")


def _text(value: object) -> str:
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value if isinstance(value, str) else ""
