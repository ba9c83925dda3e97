from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ._channel import Channel
from ._clock import departure, JITTER, window
from ._edit import combine
from ._errors import ReadError, RecordError
from ._formats import load_arrays
from ._names import as_tuple, check_distinct, unknown_name
from ._record import Record
from ._resample import resample
from ._timebase import timed_channels, TimeUnit


Mixes = Mapping[str, Mapping[str, float | int]]
Selection = str | Sequence[str] | Mixes


def read(
    path: str | Path,
    *,
    inputs: Selection,
    outputs: Selection,
    references: Selection | None = None,
    sample_rate: float | int | None = None,
    start: float | int | None = None,
    stop: float | int | None = None,
    time: str | None = None,
    time_unit: TimeUnit | None = None,
    max_gap: float | int | None = None,
    units: Mapping[str, str] | None = None,
) -> Record:
    """Read a record from a .csv, .npz or .mat file.

    `inputs`, `outputs` and `references` are channel names, or new names with the weighted sums
    that make them: `{"roll": {"motor[0]": -1, "motor[1]": 1}}`. The columns of a 2-D array `x`
    are `x[0]`, `x[1]`, ... The time base of `x` is `t_x`, else the array that `time` names, else
    t, time, time_s or timestamp; `time_unit` None means s and refuses steps of 1 s and more.

    `start` and `stop` are in s of the file's own time, which the record keeps. Without a
    `sample_rate` (Hz), channels that share one uniform time base are passed on bit by bit;
    others come to the lowest of their own rates, rounded to three digits. See `resample` for how,
    and for `max_gap` (s). `units` by the record's own channel names go onto figures and tables.

    Raises ReadError for what is wrong with the file, RecordError for what is wrong with the data.
    """
    roles = [_mixes(inputs), _mixes(outputs), _mixes(references or ())]
    names = list(dict.fromkeys(name for role in roles for mix in role.values() for name in mix))
    channels = _channels(path, names, time, time_unit)
    kept = _shared_grid(channels, start, stop) if sample_rate is None else None
    if kept is not None:
        stamps = channels[0].time[kept]
        values = np.stack([channel.values[kept] for channel in channels], axis=1)
    else:
        rate = _slowest(channels) if sample_rate is None else sample_rate
        stamps, values = resample(channels, rate, start=start, stop=stop, max_gap=max_gap)
    columns = dict(zip(names, values.T, strict=True))
    units = _known_units(units or {}, [name for role in roles for name in role])
    return Record(
        stamps,
        *(_blend(role, columns, stamps.size) for role in roles),
        input_names=tuple(roles[0]),
        output_names=tuple(roles[1]),
        reference_names=tuple(roles[2]),
        input_units=[units[name] for name in roles[0]],
        output_units=[units[name] for name in roles[1]],
        reference_units=[units[name] for name in roles[2]],
        source=str(path),
    )


def _known_units(units: Mapping[str, str], names: Sequence[str]) -> dict[str, str]:
    for name in units:
        if name not in names:
            raise RecordError(f"a unit for {name!r}: {unknown_name(name, names)}")
    return {name: units.get(name, "") for name in names}


def _mixes(selection: Selection) -> Mixes:
    if isinstance(selection, Mapping):
        return selection
    names = as_tuple(selection)
    check_distinct(names)
    return {name: {name: 1.0} for name in names}


def _channels(
    path: str | Path, names: Sequence[str], time: str | None, time_unit: TimeUnit | None
) -> list[Channel]:
    arrays = load_arrays(path)
    if not names:
        raise ReadError(f"{path}: no channels were asked for: name inputs and outputs.")
    try:
        return timed_channels(arrays, names, time=time, time_unit=time_unit)
    except ReadError as error:
        raise ReadError(f"{path}: {error}") from error


def _slowest(channels: Sequence[Channel]) -> float:
    return float(f"{min(channel.rate for channel in channels):.3g}")


def _shared_grid(
    channels: Sequence[Channel], start: float | int | None, stop: float | int | None
) -> slice | None:
    time = channels[0].time
    if not all(np.array_equal(time, channel.time) for channel in channels):
        return None
    kept = window(time, start, stop)
    return kept if departure(time[kept]) <= JITTER else None


def _blend(
    role: Mixes, columns: Mapping[str, np.ndarray], samples: int
) -> Float[np.ndarray, "samples channels"]:
    mixed = [combine(name, mix, columns.__getitem__) for name, mix in role.items()]
    return np.stack(mixed, axis=1) if mixed else np.empty((samples, 0))
