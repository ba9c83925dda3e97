"""Records from and to MAT files with the fields of an `iddata` of MATLAB."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ._errors import ReadError, RecordError
from ._record import as_tuple, Hold, Names, Record
from .formats import load_log


_HOLDS: Mapping[str, Hold] = {"zoh": "dt", "bl": 0.0}  # held, or measured within the band
_UNITS = {
    "seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9,
    "minutes": 60.0, "hours": 3600.0,
}  # fmt: skip
_SAVE = "s = get(z); save('z.mat', 's', '-v7')"


def from_iddata(path: str | Path, variable: str | None, references: Names) -> Record:
    """`Record.from_iddata`, where the arguments are described."""
    fields = _fields(path, variable)
    y, u = (_columns(path, fields, *names) for names in (("y", "OutputData"), ("u", "InputData")))
    time, dt = _time(path, fields, len(y))
    names = [_texts(fields, "InputName", u, "u"), _texts(fields, "OutputName", y, "y")]
    units = [_texts(fields, "InputUnit", u, ""), _texts(fields, "OutputUnit", y, "")]
    outer = as_tuple(references or ())
    for name in outer:
        if name not in names[0]:
            raise RecordError(f"{path}: there is no input {name!r}; it has {', '.join(names[0])}.")
    is_outer = np.array([name in outer for name in names[0]], bool)
    pick = lambda texts, chosen: [t for t, c in zip(texts, chosen, strict=True) if c]
    return Record(
        time, u[:, ~is_outer], y, u[:, is_outer] if outer else None,
        input_names=pick(names[0], ~is_outer), output_names=names[1],
        reference_names=pick(names[0], is_outer),
        input_units=pick(units[0], ~is_outer), output_units=units[1],
        reference_units=pick(units[0], is_outer),
        source=str(path), hold=_hold(fields, dt), time_unit="s",
    )  # fmt: skip


def _fields(path: str | Path, variable: str | None) -> Mapping:
    """The struct with y and u: the variable of that name, the only one, or the file itself."""
    load_log(path)  # which refuses what is damaged, before scipy reads it
    from scipy.io import loadmat

    try:
        content = loadmat(path, simplify_cells=True)
    except Exception as error:  # of damaged and of HDF5 files scipy raises almost anything
        raise ReadError(
            f"{path}: cannot be read as a MAT file of version 5 to 7 ({type(error).__name__}): "
            f"save it in MATLAB with {_SAVE}"
        ) from error
    structs = {name: value for name, value in content.items() if _is_iddata(value)}
    if variable is None and _is_iddata(content):
        return content
    if variable is None and len(structs) == 1:
        return next(iter(structs.values()))
    if variable in structs:
        return structs[variable]
    found = ", ".join(structs) or "none"
    asked = "which of them (variable=) is not said" if variable is None else f"not {variable!r}"
    raise ReadError(
        f"{path}: structs with y and u: {found}; {asked}. An iddata object cannot be read "
        f"outside of MATLAB: make a struct of it, {_SAVE}"
    )


def _is_iddata(value: object) -> bool:
    return isinstance(value, Mapping) and any(
        names <= set(value) for names in ({"y", "u"}, {"OutputData", "InputData"})
    )


def _columns(path: str | Path, fields: Mapping, *names: str) -> np.ndarray:
    name = next(name for name in names if name in fields)
    array = fields[name]
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiub":
        raise ReadError(
            f"{path}: {name} is no matrix of numbers: of several experiments, take one with "
            "getexp(z, 1)"
        )
    return array.reshape(len(array), -1).astype(np.float64)


def _time(path: str | Path, fields: Mapping, samples: int) -> tuple[np.ndarray, float]:
    """Time stamps and the sample interval, both in s."""
    unit = str(fields.get("TimeUnit", "seconds"))
    if unit not in _UNITS:
        raise ReadError(f"{path}: TimeUnit is {unit!r}: use one of {', '.join(_UNITS)}")
    stamps = np.atleast_1d(np.asarray(fields.get("SamplingInstants", []), np.float64))
    dt = np.atleast_1d(np.asarray(fields.get("Ts", []), np.float64))
    start = np.atleast_1d(np.asarray(fields.get("Tstart", []), np.float64))
    if stamps.size == samples:
        return _UNITS[unit] * stamps, float(np.mean(np.diff(stamps))) * _UNITS[unit]
    if dt.size != 1 or not dt[0] > 0:
        raise ReadError(f"{path}: Ts is {dt.tolist()}: give the sample interval, in {unit}")
    first = float(start[0]) if start.size else 0.0
    return _UNITS[unit] * (first + dt[0] * np.arange(samples)), float(_UNITS[unit] * dt[0])


def _texts(fields: Mapping, name: str, columns: np.ndarray, letter: str) -> list[str]:
    """Names or units, one for each column; numbered letters or nothing where there are none."""
    found = [str(each) for each in np.atleast_1d(np.asarray(fields.get(name, []), object))]
    count = columns.shape[1]
    if len(found) == count:
        return found
    return [f"{letter}{k + 1}" if letter and count > 1 else letter for k in range(count)]


def _hold(fields: Mapping, dt: float) -> float | None:
    kinds = {str(each) for each in np.atleast_1d(np.asarray(fields.get("InterSample", []), object))}
    hold = _HOLDS.get(kinds.pop()) if len(kinds) == 1 else None
    return dt if hold == "dt" else hold


def to_iddata(record: Record, path: str | Path, variable: str) -> Path:
    """`Record.to_iddata`."""
    from scipy.io import savemat

    cell = lambda texts: np.array(texts, dtype=object).reshape(-1, 1)
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
        "InterSample": _inter_sample(record),
    }
    savemat(path, {variable: fields}, do_compression=True)
    return Path(path)


def _inter_sample(record: Record) -> str:
    """How the inputs run between samples, in the words of iddata."""
    if record.hold is None:
        return "foh"
    return "bl" if record.hold == 0 else "zoh"
