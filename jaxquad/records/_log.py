"""What every reader hands over: tables of signals, each table on one clock."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from ._names import printable


@dataclasses.dataclass(frozen=True)
class Table:
    """Signals that were logged together, a row per time stamp.

    A column has one or two dimensions and any real dtype; a strided view is welcome. Its values
    times its `scale` (1 by default) are in its `unit`. Without a `time` the table's clock is
    found by its name, as `read` describes.
    """

    columns: Mapping[str, np.ndarray]
    time: Float[np.ndarray, " samples"] | None = None  # s
    units: Mapping[str, str] = dataclasses.field(default_factory=dict)
    scales: Mapping[str, float] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Log:
    """The tables of a file by name; the channels of the table `""` have no prefix.

    Each of the `remarks` says what was skipped or mended, and becomes a RecordWarning.
    """

    tables: Mapping[str, Table]
    remarks: tuple[str, ...] = ()
    vehicle: str = ""  # ardupilot, px4, betaflight, crazyflie, or unknown
    settings: Mapping[str, str] = dataclasses.field(default_factory=dict)  # header, parameters


@dataclasses.dataclass(frozen=True)
class Signal:
    """One array of a log under its full name, `table.column`."""

    values: np.ndarray
    clock: str  # the name of its time base, empty if the log does not say
    unit: str
    scale: float


@dataclasses.dataclass(frozen=True)
class Signals:
    """All numeric arrays of a log, and the clocks (s) that it is sure of."""

    arrays: Mapping[str, Signal]
    clocks: Mapping[str, Float[np.ndarray, " samples"]]


def flattened(log: Log) -> Signals:
    """The log's numeric columns of one or two dimensions, as long as their clock if they have one.

    A lone number, such as a parameter, is no channel of a table that has a clock.
    """
    arrays, clocks = {}, {}
    for table_name, table in log.tables.items():
        clock = "" if table.time is None else f"clock of {table_name}".removesuffix(" of ")
        if table.time is not None:
            clocks[clock] = table.time
        for name, values in table.columns.items():
            full = printable(f"{table_name}.{name}" if table_name else name)
            unit, scale = printable(table.units.get(name, "")), table.scales.get(name, 1.0)
            if is_data(values) and (table.time is None or len(values) == table.time.size):
                arrays[full] = Signal(values, clock, unit, scale)
    return Signals(arrays, clocks)


def is_data(array: np.ndarray) -> bool:
    """Real numbers in one or two dimensions."""
    return array.dtype.kind in "fiub" and array.ndim in (1, 2)
