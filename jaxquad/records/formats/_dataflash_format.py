"""What DataFlash messages say about each other: layout, units, multipliers, instances."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from .._log import Table


FORMAT_TYPE = 128
HEAD_SIZE = 3  # bytes of a message before its columns
_CODES = {
    "a": "(32,)<i2", "b": "i1", "B": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4",
    "f": "<f4", "d": "<f8", "g": "<f2", "n": "S4", "N": "S16", "Z": "S64", "c": "<i2", "C": "<u2",
    "e": "<i4", "E": "<u4", "L": "<i4", "M": "u1", "q": "<i8", "Q": "<u8",
}  # fmt: skip
_BUILT_IN = {"c": 0.01, "C": 0.01, "e": 0.01, "E": 0.01, "L": 1e-7}
_CLOCKS = {"TimeUS": 1e-6, "TimeMS": 1e-3}  # s
_MOST_INSTANCES = 64
_INSTANCE = "#"  # the unit letter of the column that numbers the sensors of one kind


class Format(NamedTuple):
    """The layout of one message type."""

    kind: int
    length: int  # bytes, with the head of three
    name: str
    codes: str
    columns: tuple[str, ...]

    def dtype(self) -> np.dtype | None:
        """Of a whole message; None where the layout contradicts itself."""
        columns = self.columns
        if not set(self.codes) <= set(_CODES) or len(self.codes) != len(columns):
            return None
        if len(set(columns)) < len(columns) or "" in columns or not self.name:
            return None
        formats = [np.dtype(_CODES[code]) for code in self.codes]
        ends = np.cumsum([HEAD_SIZE, *(each.itemsize for each in formats)]).tolist()
        if ends[-1] != self.length:
            return None
        return np.dtype(
            {
                "names": list(columns),
                "formats": formats,
                "offsets": ends[:-1],
                "itemsize": self.length,
            }
        )


def parse_format(body: bytes) -> Format:
    """From the 86 bytes of a FMT message."""
    name, codes, columns = (text(body[a:b]) for a, b in ((2, 6), (6, 22), (22, 86)))
    return Format(body[0], body[1], name, codes, tuple(columns.split(",")))


def text(field: bytes) -> str:
    """A padded field; not UTF-8 is possible where a log is damaged."""
    return field.split(b"\0")[0].decode("latin-1").strip()


class Scaling(NamedTuple):
    """What FMTU, UNIT and MULT say about the columns of the other messages."""

    units: Mapping[str, str]  # by letter
    multipliers: Mapping[str, float]  # by letter
    letters: Mapping[str, tuple[str, str]]  # by message: one letter per column, of either kind


def scaling(rows: Mapping[str, np.ndarray], names: Mapping[int, str]) -> Scaling:
    """From the rows of those three messages, where the log has them."""
    units = dict(_cells(rows.get("UNIT"), "Id", "Label"))
    multipliers = dict(_cells(rows.get("MULT"), "Id", "Mult"))
    letters = {
        names[kind]: (text(unit_ids), text(mult_ids))
        for kind, unit_ids, mult_ids in _cells(rows.get("FMTU"), "FmtType", "UnitIds", "MultIds")
        if kind in names
    }
    return Scaling(
        {chr(letter & 0xFF): text(label) for letter, label in units.items()},
        {chr(letter & 0xFF): mult for letter, mult in multipliers.items() if 0 < mult < np.inf},
        letters,
    )


def _cells(rows: np.ndarray | None, *columns: str) -> Iterator[tuple[Any, ...]]:
    kinds = {"Label": "S", "UnitIds": "S", "MultIds": "S", "Mult": "f", "Id": "iu", "FmtType": "iu"}
    if rows is None or not set(columns) <= set(rows.dtype.names or ()):
        return iter(())
    if not all(rows.dtype[column].kind in kinds[column] for column in columns):
        return iter(())
    return zip(*(rows[column].tolist() for column in columns), strict=True)


def tables_of(
    layout: Format, rows: Mapping[str, np.ndarray], scaled: Scaling, *, applied: bool = False
) -> dict[str, Table]:
    """The messages of one type as a table, or one table per instance: `IMU[0]`, `IMU[1]`, ...

    `rows` are columns by name, with their own scale `applied` or not. Messages without a time
    stamp (formats, parameters) make no table.
    """
    clock = next((name for name in layout.columns if name in _CLOCKS), None)
    if clock is None or clock not in rows:
        return {}
    if rows[clock].ndim != 1 or rows[clock].dtype.kind not in "iuf":
        return {}
    time = rows[clock] * _CLOCKS[clock]
    units, scales, instance = _labels(layout, scaled, applied)
    columns = {name: rows[name] for name in layout.columns if name in rows and name != clock}
    numbers = np.unique(columns[instance]) if instance in columns else np.empty(0)
    if not 0 < numbers.size <= _MOST_INSTANCES:
        return {layout.name: Table(columns, time, units, scales)}
    tables = {}
    for number in numbers.tolist():
        kept = columns[instance] == number
        own = {name: values[kept] for name, values in columns.items() if name != instance}
        tables[f"{layout.name}[{number:.0f}]"] = Table(own, time[kept], units, scales)
    return tables


def _labels(
    layout: Format, scaled: Scaling, applied: bool
) -> tuple[dict[str, str], dict[str, float], str]:
    """Units and scales by column, and the column that numbers the instances."""
    unit_ids, mult_ids = scaled.letters.get(layout.name, ("", ""))
    units, scales, instance = {}, {}, ""
    for i, (name, code) in enumerate(zip(layout.columns, layout.codes, strict=True)):
        letter = unit_ids[i : i + 1]
        units[name] = scaled.units.get(letter, "")
        own = 1.0 if applied else _BUILT_IN.get(code, 1.0)
        multiplier = scaled.multipliers.get(mult_ids[i : i + 1], 1.0)
        scales[name] = own if code in _BUILT_IN else multiplier
        instance = name if letter == _INSTANCE else instance
    return units, scales, instance
