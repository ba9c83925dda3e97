"""Records from and to tables of pandas."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ._clock import dates_in_seconds, doubt_of_seconds, PER_SECOND, TimeUnit
from ._errors import ReadError, RecordError, unknown_name
from ._record import as_tuple, check_distinct, Hold, Names, Record
from ._repair import repair_values
from ._resample import Channel, resample


if TYPE_CHECKING:
    import pandas


_KEPT = "jaxquad"  # entry of `DataFrame.attrs` with what columns cannot say
_TIMES = ("t", "time", "time_s", "timestamp")
_ROLES = ("inputs", "outputs", "references")


def from_dataframe(
    frame: "pandas.DataFrame",
    roles: tuple[Names, Names, Names],
    *,
    time: str | None,
    time_unit: TimeUnit | None,
    sample_rate: float | int | None,
    max_gap: float | int | None,
    units: Mapping[str, str] | None,
    hold: Hold,
    source: str,
) -> Record:
    """`Record.from_dataframe`, where the arguments are described."""
    kept = frame.attrs.get(_KEPT, {})
    names = _names_of_roles(frame, roles, kept)
    flat = [name for role in names for name in role]
    values = {name: _values(frame, name) for name in flat}
    stamps = _stamps(frame, time, time_unit)
    if sample_rate is not None:
        stamps, values = _resampled(stamps, values, sample_rate, max_gap)
    blocks = [np.stack([values[name] for name in role], axis=1) if role else None for role in names]
    inputs, outputs, references = blocks
    if inputs is None or outputs is None:
        raise RecordError(
            "a record needs at least one input and one output («inputs=», «outputs=»)."
        )
    known = _all_units(kept.get("units", {}), units or {}, flat)
    each = [[known[name] for name in role] for role in names]
    return Record(
        stamps, inputs, outputs, references,
        input_names=names[0], output_names=names[1], reference_names=names[2],
        input_units=each[0], output_units=each[1], reference_units=each[2],
        hold=kept.get("hold") if hold is None else hold,
        source=source or kept.get("source", ""), max_gap=max_gap, time_unit="s",
    )  # fmt: skip


def _names_of_roles(
    frame: "pandas.DataFrame", roles: tuple[Names, Names, Names], kept: Mapping
) -> list[tuple[str, ...]]:
    if all(role is None for role in roles):
        if not all(role in kept for role in _ROLES):
            raise RecordError(
                "the table does not say which columns are inputs and outputs: name them "
                f"(«inputs=», «outputs=»). Its columns are {', '.join(map(str, frame.columns))}."
            )
        roles = tuple(kept[role] for role in _ROLES)
    names = [as_tuple(role or ()) for role in roles]
    check_distinct([name for role in names for name in role])
    return names


def _all_units(
    kept: Mapping[str, str], given: Mapping[str, str], names: list[str]
) -> dict[str, str]:
    for name in given:
        if name not in names:
            raise RecordError(f"a unit is given for {name!r}: {unknown_name(name, names)}")
    return dict.fromkeys(names, "") | {k: v for k, v in kept.items() if k in names} | dict(given)


def _stamps(
    frame: "pandas.DataFrame", time: str | None, unit: TimeUnit | None
) -> Float[np.ndarray, " samples"]:
    """Time stamps (s): of the column `time`, of one that is called like that, or of the index."""
    from pandas import RangeIndex

    found = [name for name in _TIMES if name in frame.columns] if time is None else [time]
    if not found and isinstance(frame.index, RangeIndex):
        raise RecordError(
            f"the table has no time stamps: no column {', '.join(_TIMES)}, and an index that "
            "counts rows. Name the column («time=»), or set the index: frame.set_index(...)."
        )
    if found and found[0] not in frame.columns:
        raise RecordError(f"time: {unknown_name(found[0], map(str, frame.columns))}")
    label = found[0] if found else "the index"
    series = _column(frame, label) if found else frame.index.to_series()
    seconds = _dates(series, unit)
    if seconds is not None:
        return seconds
    seconds = _numbers(label, series) / PER_SECOND[unit or "s"]
    doubt = doubt_of_seconds(seconds) if unit is None else ""
    if doubt:
        raise RecordError(f"the time base {label!r} {doubt}.")
    return seconds


def _dates(series: "pandas.Series", unit: TimeUnit | None) -> np.ndarray | None:
    """Seconds since the first date, or of durations; None where the series holds neither."""
    from pandas.api.types import is_datetime64_any_dtype, is_timedelta64_dtype

    if not (is_datetime64_any_dtype(series) or is_timedelta64_dtype(series)):
        return None
    if unit is not None:
        raise RecordError("the time stamps are dates or durations: leave «time_unit=» out.")
    if is_datetime64_any_dtype(series):
        dates = series.to_numpy("datetime64[ns]")  # of any time zone, in UTC
        return dates_in_seconds(dates - dates[:1])
    return dates_in_seconds(series.to_numpy("timedelta64[ns]"))


def _values(frame: "pandas.DataFrame", name: str) -> Float[np.ndarray, " samples"]:
    if name not in frame.columns:
        raise ReadError(unknown_name(name, map(str, frame.columns)))
    return _numbers(name, _column(frame, name))


def _column(frame: "pandas.DataFrame", name: str) -> "pandas.Series":
    from pandas import Series

    column = frame[name]
    if not isinstance(column, Series):
        raise RecordError(f"the table has several columns {name!r}: give each its own name.")
    return column


def _numbers(label: str, series: "pandas.Series") -> Float[np.ndarray, " samples"]:
    """What is missing becomes NaN."""
    try:
        return series.to_numpy(np.float64, na_value=np.nan)
    except (TypeError, ValueError) as error:
        raise RecordError(
            f"column {label!r} holds {series.dtype}, not numbers: convert it (pandas.to_numeric)."
        ) from error


def _resampled(
    stamps: Float[np.ndarray, " samples"],
    values: Mapping[str, np.ndarray],
    rate: float | int,
    max_gap: float | int | None,
) -> tuple[Float[np.ndarray, " resampled"], dict[str, np.ndarray]]:
    channels = []
    for name, column in values.items():
        whole = repair_values(name, stamps, column, None, max_gap).values
        channels.append(Channel(name, stamps, whole, ""))
    grid, table = resample(channels, rate, max_gap=max_gap)
    return grid, dict(zip(values, table.T, strict=True))


def to_dataframe(record: Record) -> "pandas.DataFrame":
    """`Record.to_dataframe`."""
    import pandas

    table = np.concatenate([record.inputs, record.outputs, record.references], axis=1)
    index = pandas.Index(record.time, name="time")
    frame = pandas.DataFrame(table, index=index, columns=pandas.Index(record.names))
    frame.attrs[_KEPT] = {
        "inputs": record.input_names,
        "outputs": record.output_names,
        "references": record.reference_names,
        "units": {name: record.unit(name) for name in record.names},
        "hold": record.hold,
        "source": record.source,
    }
    return frame
