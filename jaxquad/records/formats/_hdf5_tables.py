"""HDF5 and MATLAB v7.3 files, which are HDF5 with the axes reversed; `_child` runs this."""

from collections.abc import Callable
from typing import Any

import h5py
import numpy as np


_MOST_OBJECTS = 20_000
_MATLAB_NUMBERS = ("double", "single", "logical")


def tables(
    path: str, check: Callable[[str, int], None]
) -> tuple[dict[str, dict[str, tuple[np.ndarray, str]]], list[str]]:
    """The numeric datasets with their units, and what was left out."""
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


def _datasets(file: Any) -> dict[str, Any]:
    """Those of numbers or records; soft and external links are not followed."""
    found: dict[str, Any] = {}
    visited = 0

    def visit(name: str, item: Any) -> None:
        nonlocal visited
        visited += 1
        if visited > _MOST_OBJECTS:
            raise ValueError(f"more than {_MOST_OBJECTS} objects")
        if isinstance(item, h5py.Dataset) and not name.startswith("#") and _is_wanted(item):
            found[name.replace("/", ".")] = item

    file.visititems(visit)
    return found


def _is_wanted(dataset: Any) -> bool:
    if dataset.shape is None or not 1 <= len(dataset.shape) <= 2 or not dataset.size:
        return False
    kind = _text(dataset.attrs.get("MATLAB_class", b""))
    numeric = dataset.dtype.kind in "fiub" or (dataset.dtype.names and len(dataset.shape) == 1)
    matlab = kind.startswith(("int", "uint")) or kind in _MATLAB_NUMBERS
    return bool(numeric) and (matlab or not kind) and "MATLAB_empty" not in dataset.attrs


def _columns(name: str, dataset: Any) -> dict[str, np.ndarray]:
    values = np.asarray(dataset[()])
    if values.dtype.names:
        return {f"{name}.{field}": values[field] for field in values.dtype.names}
    if "MATLAB_class" in dataset.attrs:
        values = values.T
    return {name: values.reshape(-1) if 1 in values.shape else values}


def _unit(dataset: Any) -> str:
    named = (dataset.attrs.get(key) for key in ("units", "unit"))
    return next((_text(each) for each in named if each is not None), "")


def _text(value: object) -> str:
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value if isinstance(value, str) else ""
