"""Parquet tables; `_child` runs this."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow
import pyarrow.parquet


_PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}


def tables(
    path: str, check: Callable[[str, int], None]
) -> tuple[dict[str, dict[str, tuple[np.ndarray, str]]], list[str]]:
    """The numeric columns with their units."""
    with pyarrow.parquet.ParquetFile(path) as file:
        wanted = [field for field in file.schema_arrow if _is_wanted(field.type)]
        check("the table", 8 * len(wanted) * file.metadata.num_rows)
        table = file.read(columns=[field.name for field in wanted], use_threads=False)
    columns = {field.name: (_values(table, field), _unit(field)) for field in wanted}
    return {"": columns}, []


def _is_wanted(kind: Any) -> bool:
    types = pyarrow.types
    number = types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind)
    return number or types.is_timestamp(kind) or types.is_duration(kind)


def _values(table: Any, field: Any) -> np.ndarray:
    """Where values are missing, integers become floats with NaN."""
    column = table.column(field.name)
    if pyarrow.types.is_timestamp(field.type) or pyarrow.types.is_duration(field.type):
        return column.cast(pyarrow.int64()).to_numpy() / _PER_SECOND[field.type.unit]
    return column.to_numpy()


def _unit(field: Any) -> str:
    metadata = field.metadata or {}
    named = (metadata.get(key) for key in (b"units", b"unit"))
    return next((each.decode("utf-8", "replace") for each in named if each is not None), "")
