import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ._clock import check_increasing, FEWEST, GAP, native_rate
from ._errors import RecordError


class Channel(eqx.Module):
    """One logged signal with its own time stamps, which may be jittered and have gaps.

    **Arguments:**

    - `name`: of the signal.
    - `time`: time stamps in s, strictly increasing.
    - `values`: one for each time stamp, in `unit`.
    - `unit`: such as `"rad/s"`; empty where unknown.

    **Raises:**

    - `RecordError`: for fewer than 16 samples, and for time stamps that repeat, go back or are not
        finite.
    """

    name: str = eqx.field(static=True)
    time: Float[np.ndarray, " samples"]  # s
    values: Float[np.ndarray, " samples"]
    unit: str = eqx.field(static=True)

    def __init__(self, name: str, time: ArrayLike, values: ArrayLike, unit: str = ""):
        self.name = name
        self.time = np.asarray(time, dtype=np.float64)
        self.values = np.asarray(values, dtype=np.float64)
        self.unit = unit
        if self.time.ndim != 1 or self.time.shape != self.values.shape:
            raise RecordError(
                f"channel {name!r} has values of shape {self.values.shape} for time stamps of "
                f"shape {self.time.shape}: give one value for each time stamp."
            )
        if self.time.size < FEWEST:
            raise RecordError(
                f"channel {name!r} has {self.time.size} samples: at least {FEWEST} are needed."
            )
        check_increasing(f"channel {name!r}", self.time)

    @property
    def rate(self) -> float:
        """Native sample rate in Hz, without the gaps."""
        return native_rate(self.time)


def contiguous_part(
    channel: Channel, begin: float, end: float, *, margin: float, max_gap: float | int | None
) -> Channel:
    """The samples from `begin` to `end` (s), and up to `margin` (s) beyond, without a break.

    A break is a gap longer than `max_gap` (s) or a value that is not finite. Outside of
    `begin` .. `end` it ends the part; inside it raises RecordError.
    """
    time = channel.time
    bad = ~np.isfinite(channel.values)
    broken = (np.diff(time) > _longest_gap(channel, max_gap)) | bad[:-1] | bad[1:]
    inside = (time[1:] > begin) & (time[:-1] < end)
    if (broken & inside).any():
        _raise_for_break(channel, int(np.flatnonzero(broken & inside)[0]), max_gap)
    before = np.flatnonzero(broken & (time[1:] <= begin))
    after = np.flatnonzero(broken & (time[:-1] >= end))
    reach = margin + _longest_gap(channel, max_gap)
    first = max(np.searchsorted(time, begin - reach), *(before[-1:] + 1), 0)
    last = min(np.searchsorted(time, end + reach, "right"), *(after[:1] + 1), time.size)
    return Channel(channel.name, time[first:last], channel.values[first:last], channel.unit)


def gaps(channel: Channel, begin: float, end: float) -> np.ndarray:
    """Indices of the steps within `begin` .. `end` longer than 1.5 nominal samples."""
    step = np.diff(channel.time)
    inside = (channel.time[1:] > begin) & (channel.time[:-1] < end)
    return np.flatnonzero((step > GAP * np.median(step)) & inside)


def _longest_gap(channel: Channel, max_gap: float | int | None) -> float:
    nominal = float(np.median(np.diff(channel.time)))
    return max(10 * nominal, 0.05) if max_gap is None else float(max_gap)


def _raise_for_break(channel: Channel, index: int, max_gap: float | int | None) -> None:
    left, right = channel.time[index : index + 2]
    pair = channel.values[index : index + 2]
    if not np.isfinite(pair).all():
        i = index + int(np.isfinite(pair[0]))
        raise RecordError(
            f"channel {channel.name!r} is {channel.values[i]} at sample {i}, "
            f"t = {channel.time[i]:.6g} s. Choose a range without it (start=, stop=; --start, "
            f"--stop), or repair the value in the file."
        )
    raise RecordError(
        f"channel {channel.name!r} has a gap of {1e3 * (right - left):.4g} ms from "
        f"t = {left:.6g} s to {right:.6g} s (limit {1e3 * _longest_gap(channel, max_gap):.4g} ms). "
        f"Choose a range without it (start=, stop=; --start, --stop), or in Python allow it with "
        f"max_gap= (s)."
    )
