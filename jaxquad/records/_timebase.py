from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from ._channel import Channel
from ._errors import ReadError
from ._names import unknown_name


Arrays = Mapping[str, np.ndarray]
TimeUnit = Literal["s", "ms", "us", "ns"]
_PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_SHARED = ("t", "time", "time_s", "timestamp", "Time", "Timestamp", "TIME")


def signal_names(arrays: Arrays, time: str | None) -> dict[str, tuple[str, int | None]]:
    """Channel name -> array and column; the columns of `x` are `x[0]`, `x[1]`, ..."""
    names = {}
    for name, array in arrays.items():
        if _is_time(arrays, name, time):
            continue
        if array.ndim == 1:
            names[name] = (name, None)
        else:
            names |= {f"{name}[{i}]": (name, i) for i in range(array.shape[1])}
    return names


def timed_channels(
    arrays: Arrays, names: Sequence[str], *, time: str | None, time_unit: TimeUnit | None
) -> list[Channel]:
    """The named channels with their time bases, in s.

    Raises ReadError for an unknown channel and for one without a time base of its length.
    """
    known = signal_names(arrays, time)
    channels = []
    for name in names:
        if name not in known:
            raise ReadError(unknown_name(name, known))
        array, column = known[name]
        base = time_array(arrays, array, time)
        stamps = _seconds(base, arrays[base], time_unit)
        values = arrays[array] if column is None else arrays[array][:, column]
        if stamps.size != len(values):
            raise ReadError(
                f"channel {name!r} has {len(values)} samples, its time base {base!r} "
                f"{stamps.size}: name another with time=, or save its own as {'t_' + array!r}."
            )
        channels.append(Channel(name, stamps, values))
    return channels


def time_array(arrays: Arrays, array: str, time: str | None) -> str:
    """The name of the time stamps that belong to `array`.

    Its own, `t_<array>`, comes first; then the one asked for; then the first of t, time,
    time_s, timestamp, ... beside it (in the same struct) or in the file.
    """
    struct, dot, field = array.rpartition(".")
    if time is not None and time not in arrays:
        raise ReadError(f"time={time!r}: {unknown_name(time, arrays)}")
    own = f"{struct}{dot}t_{field}"
    asked = [] if time is None else [time]
    shared = asked or [f"{struct}{dot}{name}" for name in _SHARED] + list(_SHARED)
    found = [name for name in (own, *shared) if name in arrays]
    if not found:
        raise ReadError(
            f"no time base for {array!r}: none of {own}, {', '.join(_SHARED)} is among "
            f"{', '.join(arrays)}: say which it is with time=."
        )
    if arrays[found[0]].ndim != 1:
        raise ReadError(f"the time base {found[0]!r} has shape {arrays[found[0]].shape}, not 1-D.")
    return found[0]


def _is_time(arrays: Arrays, name: str, time: str | None) -> bool:
    struct, dot, field = name.rpartition(".")
    owner = f"{struct}{dot}{field.removeprefix('t_')}"
    own = field.startswith("t_") and owner in arrays
    return own or name == time or (time is None and field in _SHARED)


def _seconds(name: str, stamps: np.ndarray, unit: TimeUnit | None) -> Float[np.ndarray, " samples"]:
    if unit is not None and unit not in _PER_SECOND:
        raise ReadError(f"time_unit {unit!r}: it is one of {', '.join(_PER_SECOND)}.")
    seconds = stamps.astype(np.float64) / _PER_SECOND[unit or "s"]
    if unit is None and stamps.size > 1 and np.median(np.abs(np.diff(seconds))) >= 1:
        raise ReadError(
            f"the time base {name!r} steps by {np.median(np.diff(seconds)):.6g}, too much for "
            f"seconds: say time_unit='ms', 'us' or 'ns', or 's' if it is really that slow."
        )
    return seconds
