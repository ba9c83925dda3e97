"""Parquet tables; read in a child process."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np


if TYPE_CHECKING:
    import pyarrow

LIBRARIES = ("pyarrow", "pyarrow.parquet")
_PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}


def sniff(head: bytes, path: Path) -> bool:
    return head.startswith(b"PAR1")


def tables(
    path: str, check: Callable[[str, int], None]
) -> tuple[dict[str, dict[str, tuple[np.ndarray, str]]], list[str]]:
    """The numeric columns with their units; time stamps and durations in s."""
    import pyarrow.parquet

    with pyarrow.parquet.ParquetFile(path) as file:
        wanted = [field for field in file.schema_arrow if _is_wanted(field.type)]
        check("the table", 8 * len(wanted) * file.metadata.num_rows)
        table = file.read(columns=[field.name for field in wanted], use_threads=False)
    columns = {field.name: (_values(table, field), _unit(field)) for field in wanted}
    return {"": columns}, []


def _is_wanted(kind: "pyarrow.DataType") -> bool:
    import pyarrow

    types = pyarrow.types
    number = types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind)
    return number or types.is_timestamp(kind) or types.is_duration(kind)


def _values(table: "pyarrow.Table", field: "pyarrow.Field") -> np.ndarray:
    """Where values are missing, integers become floats with NaN."""
    import pyarrow

    column = table.column(field.name)
    if pyarrow.types.is_timestamp(field.type) or pyarrow.types.is_duration(field.type):
        return column.cast(pyarrow.int64()).to_numpy() / _PER_SECOND[field.type.unit]
    return column.to_numpy()


def _unit(field: "pyarrow.Field") -> str:
    metadata = field.metadata or {}
    named = (metadata.get(key) for key in (b"units", b"unit"))
    return next((each.decode("utf-8", "replace") for each in named if each is not None), "")
