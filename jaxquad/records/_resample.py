import dataclasses
import warnings
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ._clock import (
    check_increasing,
    clock_start,
    dates_in_seconds,
    FEWEST,
    in_file_time,
    longest_step,
    native_rate,
    nonuniformity,
    scatters,
    show_times,
)
from ._errors import choose_range, GapError, mend_holes, RecordError, RecordWarning
from ._repair import as_float64, longest_gap


Samples = Float[np.ndarray, " samples"]


@dataclasses.dataclass(frozen=True, eq=False)
class Channel:
    """One logged signal with its own time stamps, which may be jittered and have gaps.

    **Arguments:**

    - `name`: of the signal.
    - `time`: time stamps in s, strictly increasing; dates become s since 1970.
    - `values`: one for each time stamp, in `unit`; NaN where masked.
    - `unit`: such as `"rad/s"`; empty where unknown.

    **Raises:**

    - `RecordError`: for fewer than 16 samples, and for time stamps that repeat, go back or are not
        finite.
    """

    name: str
    time: Float[np.ndarray, " samples"]  # s
    values: Float[np.ndarray, " samples"]
    unit: str

    def __init__(self, name: str, time: ArrayLike, values: ArrayLike, unit: str = ""):
        stamps = _absolute(name, time)
        numbers = as_float64(f"channel {name!r}", values, copy=False)
        if stamps.ndim != 1 or stamps.shape != numbers.shape:
            raise RecordError(
                f"channel {name!r} has values of shape {numbers.shape} for time stamps of "
                f"shape {stamps.shape}: give one value for each time stamp."
            )
        if stamps.size < FEWEST:
            raise RecordError(
                f"channel {name!r} has {stamps.size} samples: at least {FEWEST} are needed."
            )
        check_increasing(f"channel {name!r}", stamps)
        vars(self).update(name=name, time=stamps, values=numbers, unit=unit)

    @property
    def rate(self) -> float:
        """Native sample rate in Hz, without the gaps."""
        return native_rate(self.time)


def _absolute(name: str, time: ArrayLike) -> Samples:
    """Time stamps in s, of dates since 1970."""
    stamps = np.asarray(time)
    dated = dates_in_seconds(stamps) if stamps.dtype.kind in "mM" else None
    label = f"the time of channel {name!r}"
    return as_float64(label, time, copy=False) if dated is None else dated


def contiguous_part(
    channel: Channel, begin: float, end: float, *, margin: float, max_gap: float | int | None
) -> Channel:
    """The samples from `begin` to `end` (s), and up to `margin` (s) beyond, without a break.

    A break is a gap longer than `max_gap` (s) or a value that is not finite. Outside of
    `begin` .. `end` it ends the part; inside it raises RecordError, a GapError where all are gaps.
    """
    time = channel.time
    bad = ~np.isfinite(channel.values)
    broken = (np.diff(time) > longest_gap(channel.time, max_gap)) | bad[:-1] | bad[1:]
    inside = (time[1:] > begin) & (time[:-1] < end)
    if (broken & inside).any():
        _raise_for_breaks(channel, np.flatnonzero(broken & inside), max_gap)
    before = np.flatnonzero(broken & (time[1:] <= begin))
    after = np.flatnonzero(broken & (time[:-1] >= end))
    reach = margin + longest_gap(channel.time, max_gap)
    first = max(np.searchsorted(time, begin - reach), *(before[-1:] + 1), 0)
    last = min(np.searchsorted(time, end + reach, "right"), *(after[:1] + 1), time.size)
    return Channel(channel.name, time[first:last], channel.values[first:last], channel.unit)


def gaps(channel: Channel, begin: float, end: float) -> np.ndarray:
    """Indices of the steps within `begin` .. `end` in which samples are missing."""
    step = np.diff(channel.time)
    inside = (channel.time[1:] > begin) & (channel.time[:-1] < end)
    return np.flatnonzero((step > longest_step(channel.time)) & inside)


def _raise_for_breaks(
    channel: Channel, breaks: np.ndarray, max_gap: float | int | None
) -> None:  # fmt: skip
    holes = ~np.isfinite(channel.values[breaks]) | ~np.isfinite(channel.values[breaks + 1])
    index = int(breaks[holes.argmax() if holes.any() else 0])
    left, right = channel.time[index : index + 2]
    origin = clock_start(channel.time)
    if holes.any():
        pair = channel.values[index : index + 2]
        i = index + int(np.isfinite(pair[0]))
        raise RecordError(
            f"channel {channel.name!r} is {channel.values[i]} at sample {i}, "
            f"t = {show_times(channel.time[i], start=origin)}. {mend_holes('it')}"
        )
    longest = longest_gap(channel.time, max_gap)
    raise GapError(
        f"channel {channel.name!r} has a gap of {1e3 * (right - left):.4g} ms from "
        f"t = {left - origin:.6g} s to {show_times(right, start=origin)} (limit "
        f"{1e3 * longest:.4g} ms). "
        f"{choose_range('it')}, or allow it, by its length in s («max_gap=»).",
        [(float(channel.time[i]), float(channel.time[i + 1])) for i in breaks],
    )


# Kaiser's formulas for 72 dB over a transition from 0.3 to 0.5 of the sample rate.
_BETA = 0.1102 * (72 - 8.7)
_HALF = 0.5 * (72 - 7.95) / (2.285 * 2 * np.pi * 0.2)  # samples of the target grid
_CUTOFF = 0.4  # of the target rate, where the filter is down by 6 dB


def half_width(sample_rate: float | int) -> float:
    """How far the filter for `sample_rate` (Hz) looks to either side, in s."""
    return (_HALF + 1) / sample_rate


def lowpass(
    curve: Callable[[Samples], Samples],
    span: tuple[float, float],
    time: Samples,
    sample_rate: float | int,
    fastest: float,
) -> Samples:
    """`curve` at the times `time` (s, at `sample_rate` in Hz), low-passed against aliasing.

    The curve is known over `span` (s) and is continued by reflection about its end points, which
    keeps a straight line straight. `fastest` (Hz) is the highest native rate: the filter runs on a
    grid twice as fine, the same for all channels.
    """
    fold = int(np.ceil(2 * fastest / sample_rate))
    taps = _taps(fold)
    half = taps.size // 2
    fine = fold * sample_rate
    lowest, highest = -half, (time.size - 1) * fold + half
    first = max(lowest, int(np.ceil((span[0] - time[0]) * fine - 1e-6)))
    last = min(highest, int(np.floor((span[1] - time[0]) * fine + 1e-6)))
    known = curve(np.clip(time[0] + np.arange(first, last + 1) / fine, *span))
    padding = (first - lowest, highest - last)
    padded = np.pad(known, padding, mode="reflect", reflect_type="odd")
    return np.lib.stride_tricks.sliding_window_view(padded, taps.size)[::fold] @ taps


def _taps(fold: int) -> Float[np.ndarray, " taps"]:
    half = int(np.ceil(_HALF * fold))
    position = np.arange(-half, half + 1) / fold
    taps = np.sinc(2 * _CUTOFF * position) * np.kaiser(2 * half + 1, _BETA)
    return taps / taps.sum()


Curve = Callable[[Float[np.ndarray, "..."]], Float[np.ndarray, "..."]]
_SAME = 1.05  # rates closer than this need neither a filter nor a warning
_MOST = 50_000_000  # samples


def resample(
    channels: Sequence[Channel],
    sample_rate: float | int,
    *,
    start: float | int | None = None,
    stop: float | int | None = None,
    max_gap: float | int | None = None,
) -> tuple[Samples, Float[np.ndarray, "samples channels"]]:
    """Resample channels with different time stamps to one uniform grid.

    Where a channel is faster than the grid, every channel passes the same linear-phase filter,
    whose delay is compensated: frequencies above half the `sample_rate` are attenuated by 70 dB,
    those below 0.3 of it are unchanged, and so is the phase between channels. It is designed with a
    Kaiser window (Oppenheim and Schafer, "Discrete-Time Signal Processing", 3rd ed., section 7.5).
    Between samples a spline of degree 7 interpolates: at a quarter of a channel's own rate a cubic
    would be off by 2 %.

    **Arguments:**

    - `channels`: the `Channel`s.
    - `sample_rate`: of the grid, in Hz.
    - `start`: where the grid begins, in s; by default where all channels overlap.
    - `stop`: in s; the grid ends at or before it. By default where the channels cease to overlap.
    - `max_gap`: the longest gap that is interpolated, in s; by default 10 nominal samples or
        0.05 s, whichever is longer.

    **Returns:** the time of the grid in s, and the values, shape `(samples, channels)`. Gaps that
    were interpolated, and channels slower than the grid, give a `RecordWarning`.

    **Raises:**

    - `RecordError`: for a longer gap or a value that is not finite within the range, and where the
        channels do not overlap.
    """
    begin, end = _extent(channels, start, stop)
    time = _grid(begin, end, sample_rate)
    margin = half_width(sample_rate) + 20 / min(channel.rate for channel in channels)
    pieces = [contiguous_part(c, begin, end, margin=margin, max_gap=max_gap) for c in channels]
    _warn_of_gaps(pieces, begin, end)
    _warn_of_scatter(pieces)
    _warn_of_slow(channels, sample_rate)
    fastest = max(channel.rate for channel in channels)
    curves = [_curve(piece) for piece in pieces]
    if fastest <= _SAME * sample_rate:
        return time, np.stack([curve(time) for curve in curves], axis=1)
    spans = [(piece.time[0], piece.time[-1]) for piece in pieces]
    columns = [
        lowpass(curve, span, time, sample_rate, fastest)
        for curve, span in zip(curves, spans, strict=True)
    ]
    return time, np.stack(columns, axis=1)


def _extent(
    channels: Sequence[Channel], start: float | int | None, stop: float | int | None
) -> tuple[float, float]:
    if not channels:
        raise RecordError("there are no channels to resample: give at least one.")
    latest = max(channels, key=lambda channel: channel.time[0])
    earliest = min(channels, key=lambda channel: channel.time[-1])
    first, last = float(latest.time[0]), float(earliest.time[-1])
    origin = min(clock_start(channel.time) for channel in channels)
    start, stop = in_file_time(start, origin), in_file_time(stop, origin)
    begin = first if start is None else float(start)
    end = last if stop is None else float(stop)
    shown = lambda *times: show_times(*times, start=origin)
    overlap = (
        f"the channels overlap from {first - origin:.6g} s ({latest.name!r} begins) "
        f"to {shown(last)} ({earliest.name!r} ends)"
    )
    if not first < last:
        raise RecordError(f"the channels have no common time: {overlap}.")
    if not begin < end:
        raise RecordError(f"start {shown(begin)} is not before stop {shown(end)}; {overlap}.")
    slack = 1e-9 * (1 + abs(last))
    if begin < first - slack or end > last + slack:
        raise RecordError(f"{shown(begin, end)} is out of range; {overlap}.")
    return max(begin, first), min(end, last)


def _grid(begin: float, end: float, sample_rate: float | int) -> Samples:
    if not (np.isfinite(sample_rate) and sample_rate > 0):
        raise RecordError(f"the sample rate is {sample_rate} Hz: it must be positive.")
    steps = (end - begin) * sample_rate
    if not FEWEST - 1 <= steps + 1e-6 < _MOST:
        raise RecordError(
            f"a sample rate of {sample_rate:.6g} Hz over {end - begin:.6g} s makes "
            f"{steps + 1:.6g} samples; {FEWEST} .. {_MOST} are allowed. Choose another rate or "
            f"range."
        )
    return begin + np.arange(int(steps + 1e-6) + 1) / sample_rate


def _curve(piece: Channel) -> Curve:
    from scipy.interpolate import make_interp_spline

    time, values = _bridged(piece)
    return make_interp_spline(time, values, k=7)


def _bridged(piece: Channel) -> tuple[Samples, Samples]:
    """Gaps filled by a cubic, because a spline of degree 7 oscillates where knots are far apart."""
    from scipy.interpolate import CubicSpline

    holes = gaps(piece, -np.inf, np.inf)
    if not holes.size:
        return piece.time, piece.values
    fill = []
    for left, right in zip(piece.time[holes], piece.time[holes + 1], strict=True):
        steps = round((right - left) * piece.rate)
        fill.append(np.linspace(left, right, steps + 1)[1:-1])
    time = np.sort(np.concatenate([piece.time, *fill]))
    return time, CubicSpline(piece.time, piece.values)(time)


def _warn_of_gaps(pieces: Sequence[Channel], begin: float, end: float) -> None:
    texts = []
    for piece in pieces:
        holes = gaps(piece, begin, end)
        if holes.size:
            step = np.diff(piece.time)[holes]
            where = piece.time[holes[step.argmax()]]
            place = show_times(float(where), start=clock_start(piece.time))
            longest = f"longest {1e3 * step.max():.4g} ms at t = {place}"
            texts.append(f"{piece.name!r} {holes.size}, {longest}")
    if texts:
        warnings.warn(
            f"gaps filled by interpolation: {'; '.join(texts)}.", RecordWarning, stacklevel=3
        )


def _warn_of_scatter(pieces: Sequence[Channel]) -> None:
    names = [repr(piece.name) for piece in pieces if scatters(piece.time)]
    if names:
        off = max(nonuniformity(piece.time) for piece in pieces if scatters(piece.time))
        rate = min(piece.rate for piece in pieces if scatters(piece.time))
        warnings.warn(
            f"the time stamps of {', '.join(names)} lie up to {off:.2g} samples off a clock of "
            f"{rate:.5g} Hz, and steps shorter than half a sample are as frequent as long ones: "
            f"values were interpolated at these times. If the samples were equally spaced, give "
            f"their interval instead: {1 / rate:.4g} s («dt=»).",
            RecordWarning,
            stacklevel=3,
        )


def _warn_of_slow(channels: Sequence[Channel], sample_rate: float | int) -> None:
    slow = [c for c in channels if sample_rate > _SAME * c.rate]
    if slow:
        listed = ", ".join(f"{c.name!r} {c.rate:.6g} Hz" for c in slow)
        warnings.warn(
            f"resampled to {sample_rate:.6g} Hz, faster than {listed}: such a channel holds no "
            f"information above half its own rate. Keep the frequency band below that.",
            RecordWarning,
            stacklevel=3,
        )
