"""Records from and to tables of pandas, and MAT files with the fields of an `iddata` of MATLAB."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np

from ._channel import dates_in_seconds, PER_SECOND, require_seconds, Times, TimeUnit
from ._log import ReadError, RecordError, unknown_name
from ._record import as_tuple, assemble, Names, Record
from .formats import load_log


if TYPE_CHECKING:
    import pandas


_TIMES = ("t", "time", "time_s", "timestamp")


def frame_stamps(frame: "pandas.DataFrame", time: str | None, unit: TimeUnit | None) -> Times:
    """Time stamps (s): of the column `time`, of one that is called like that, or of the index."""
    from pandas import RangeIndex

    clocks = [name for name in _TIMES if name in frame.columns] if time is None else [time]
    if not clocks and isinstance(frame.index, RangeIndex):
        raise RecordError(
            f"the table has no time stamps: no column {', '.join(_TIMES)}, and an index that "
            "counts rows. Name the column («time=»), or set the index: frame.set_index(...)."
        )
    if clocks and clocks[0] not in frame.columns:
        raise RecordError(f"time: {unknown_name(clocks[0], map(str, frame.columns))}")
    label = clocks[0] if clocks else "the index"
    series = _column(frame, label) if clocks else frame.index.to_series()
    dated = series.dtype.kind == "M"
    if dated or series.dtype.kind == "m":
        if unit is not None:
            raise RecordError("the time stamps are dates or durations: leave «time_unit=» out.")
        # Dates of any time zone, in UTC.
        stamps = series.to_numpy("datetime64[ns]" if dated else "timedelta64[ns]")
        seconds = dates_in_seconds(stamps - stamps[:1] if dated else stamps)
        assert seconds is not None  # as nanoseconds have a fixed length
        return seconds
    seconds = _numbers(label, series) / PER_SECOND[unit or "s"]
    require_seconds(f"the time base {label!r}", seconds, unit)
    return seconds


def frame_values(frame: "pandas.DataFrame", name: str) -> Times:
    """A column; what is missing becomes NaN."""
    if name not in frame.columns:
        raise ReadError(unknown_name(name, map(str, frame.columns)))
    return _numbers(name, _column(frame, name))


def _column(frame: "pandas.DataFrame", name: str) -> "pandas.Series":
    from pandas import Series

    column = frame[name]
    if not isinstance(column, Series):
        raise RecordError(f"the table has several columns {name!r}: give each its own name.")
    return column


def _numbers(label: str, series: "pandas.Series") -> Times:
    try:
        return series.to_numpy(np.float64, na_value=np.nan)
    except (TypeError, ValueError) as error:
        raise RecordError(
            f"column {label!r} holds {series.dtype}, not numbers: convert it (pandas.to_numeric)."
        ) from error


_UNITS = {
    "seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9,
    "minutes": 60.0, "hours": 3600.0,
}  # fmt: skip
_SAVE = "s = get(z); save('z.mat', 's', '-v7')"


def read_struct(
    path: str | Path, *keys: frozenset[str], variable: str | None = None, save: str
) -> Mapping[str, Any]:
    """The fields of a struct in a MAT file, or the file's variables themselves.

    **Arguments:**

    - `path`: a MAT file of version 5 to 7.
    - `keys`: sets of names; the struct has all of at least one of them.
    - `variable`: the name of the struct, where several have them.
    - `save`: the command in MATLAB that writes such a file, for messages.

    **Raises:** ReadError for a damaged file, and for none or several such structs.
    """
    load_log(path)  # which refuses what is damaged, before scipy reads it
    from scipy.io import loadmat

    try:
        content = loadmat(path, simplify_cells=True)
    except Exception as error:  # of damaged and of HDF5 files scipy raises almost anything
        raise ReadError(
            f"{path}: cannot be read as a MAT file of version 5 to 7 ({type(error).__name__}): "
            f"save it in MATLAB with {save}"
        ) from error
    fits = lambda value: isinstance(value, Mapping) and any(names <= set(value) for names in keys)
    structs = {name: value for name, value in content.items() if fits(value)}
    if variable is None and fits(content):
        return content
    if variable is None and len(structs) == 1:
        return next(iter(structs.values()))
    if variable in structs:
        return structs[variable]
    which = "which of them (variable=) is not said" if variable is None else f"not {variable!r}"
    raise ReadError(
        f"{path}: structs with {' and '.join(sorted(keys[0], reverse=True))}: "
        f"{', '.join(structs) or 'none'}; {which}. An object of MATLAB's toolbox cannot be read "
        f"outside of it: make a struct of it, {save}"
    )


def from_iddata(path: str | Path, variable: str | None, references: Names) -> Record:
    """`Record.from_iddata`, from the variable of that name, the only struct, or the file itself."""
    names = frozenset(("y", "u")), frozenset(("OutputData", "InputData"))
    fields = read_struct(path, *names, variable=variable, save=_SAVE)
    y = _matrix(path, fields, "y", "OutputData")
    u = _matrix(path, fields, "u", "InputData")
    unit = str(fields.get("TimeUnit", "seconds"))
    if unit not in _UNITS:
        raise ReadError(f"{path}: TimeUnit is {unit!r}: use one of {', '.join(_UNITS)}")
    stamps, interval, start = (
        np.atleast_1d(np.asarray(fields.get(name, []), np.float64))
        for name in ("SamplingInstants", "Ts", "Tstart")
    )
    if stamps.size == len(y):
        time, dt = _UNITS[unit] * stamps, float(np.mean(np.diff(stamps))) * _UNITS[unit]
    elif interval.size == 1 and interval[0] > 0:
        first = float(start[0]) if start.size else 0.0
        time = _UNITS[unit] * (first + interval[0] * np.arange(len(y)))
        dt = float(_UNITS[unit] * interval[0])
    else:
        raise ReadError(f"{path}: Ts is {interval.tolist()}: give the sample interval, in {unit}")
    inputs, outputs = _labels(fields, "InputName", u, "u"), _labels(fields, "OutputName", y, "y")
    names, columns = [*inputs, *outputs], [*u.T, *y.T]
    labels = [*_labels(fields, "InputUnit", u, ""), *_labels(fields, "OutputUnit", y, "")]
    outer = as_tuple(references or ())
    for name in outer:
        if name not in inputs:
            raise RecordError(f"{path}: there is no input {name!r}; it has {', '.join(inputs)}.")
    kinds = set(_texts(fields, "InterSample"))
    return assemble(
        time,
        ([x for x in inputs if x not in outer], outputs, [x for x in inputs if x in outer]),
        dict(zip(names, columns, strict=True)).__getitem__,
        dict(zip(names, labels, strict=True)).__getitem__,
        source=str(path),
        # Held, or measured within the band.
        hold={"zoh": dt, "bl": 0.0}.get(kinds.pop()) if len(kinds) == 1 else None,
    )


def _matrix(path: str | Path, fields: Mapping, *names: str) -> np.ndarray:
    name = next(name for name in names if name in fields)
    array = fields[name]
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiub":
        raise ReadError(
            f"{path}: {name} is no matrix of numbers: of several experiments, take one with "
            "getexp(z, 1)"
        )
    return array.reshape(len(array), -1).astype(np.float64)


def _texts(fields: Mapping, name: str) -> list[str]:
    return [str(text) for text in np.atleast_1d(np.asarray(fields.get(name, []), object))]


def _labels(fields: Mapping, name: str, columns: np.ndarray, letter: str) -> list[str]:
    """Names or units, one for each column; numbered letters or nothing where there are none."""
    texts, count = _texts(fields, name), columns.shape[1]
    if len(texts) == count:
        return texts
    return [f"{letter}{k + 1}" if letter and count > 1 else letter for k in range(count)]


def to_iddata(record: Record, path: str | Path) -> Path:
    from scipy.io import savemat

    cell = lambda texts: np.array(texts, dtype=object).reshape(-1, 1)
    inter_sample = "bl" if record.hold == 0 else "zoh"
    fields = {
        "y": record.outputs,
        "u": np.concatenate([record.inputs, record.references], axis=1),
        "Ts": record.dt,
        "Tstart": record.time[0],
        "TimeUnit": "seconds",
        "InputName": cell(record.input_names + record.reference_names),
        "OutputName": cell(record.output_names),
        "InputUnit": cell(record.input_units + record.reference_units),
        "OutputUnit": cell(record.output_units),
        "InterSample": "foh" if record.hold is None else inter_sample,
    }
    savemat(path, {"z": fields}, do_compression=True)
    return Path(path)
