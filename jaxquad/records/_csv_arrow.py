"""Rows of numbers parsed by pyarrow, four times as fast as by NumPy."""

import functools as ft
from typing import Any

import numpy as np
from jaxtyping import Float


_WORTHWHILE = 1 << 20  # bytes: below, the import takes longer than the parsing
_PART = 1 << 20  # bytes, of a thread; larger ones leave the cache
_NUMBERS = b"0123456789+-.eEnNaAiIfF \t\n"  # with nan and inf


def parsed_fast(
    block: bytes, separator: str | None, into: Float[np.ndarray, "columns rows"]
) -> int:
    """Write the numbers of whole lines into the first rows; returns how many rows they were.

    0 where they may be anything else, or without pyarrow. It gets no text but digits, signs and
    separators, so it runs in this process.
    """
    if separator is None or len(block) < _WORTHWHILE:
        return 0
    if block.translate(None, _NUMBERS + separator.encode()):
        return 0
    csv = _csv()
    if csv is None:
        return 0
    arrow, options = csv
    names = [str(i) for i in range(len(into))]
    try:
        table = arrow.csv.read_csv(arrow.BufferReader(block), **options(separator, names))
    except arrow.ArrowException:  # Says less of what is wrong than reading row by row does.
        return 0
    for row, column in zip(into, table.columns, strict=True):
        place = 0
        for chunk in column.chunks:
            row[place : place + len(chunk)] = chunk.to_numpy()
            place += len(chunk)
    return table.num_rows


@ft.cache
def _csv() -> Any:
    try:
        import pyarrow
        import pyarrow.csv
    except ImportError:
        return None

    def options(separator: str, names: list[str]) -> dict[str, Any]:
        types = dict.fromkeys(names, pyarrow.float64())
        return {
            "read_options": pyarrow.csv.ReadOptions(column_names=names, block_size=_PART),
            "parse_options": pyarrow.csv.ParseOptions(
                delimiter=separator, quote_char=False, double_quote=False
            ),
            "convert_options": pyarrow.csv.ConvertOptions(
                column_types=types, null_values=[], check_utf8=False
            ),
        }

    return pyarrow, options
