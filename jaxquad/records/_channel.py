"""Logged channels: their repair, and their resampling to one grid."""

import dataclasses
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

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
    Number,
    scatters,
    show_times,
    Times,
)
from ._errors import (
    choose_range,
    GapError,
    mend_holes,
    RecordError,
    RecordWarning,
    unknown_name,
)


Values = Float[np.ndarray, " samples"]
Range = tuple[Number, Number]  # lowest and highest value that can be true
Valid = Mapping[str, Range]  # by channel
_GENERIC = 10  # nominal samples of a gap that is bridged where nobody says how long it may be
_SHORTEST = 0.05  # s


class RepairedValues(NamedTuple):
    """Values of a channel, NaN where they are still missing, and when others were filled in."""

    values: Values
    times: Float[np.ndarray, " repaired"]  # s


def _longest_gap(time: Times, max_gap: Number | None) -> float:
    """The longest gap that is interpolated, in s: as told, else 10 nominal samples or 0.05 s."""
    if max_gap is not None:
        return float(max_gap)
    return max(_GENERIC * float(np.median(np.diff(time))), _SHORTEST)


def repair_values(
    name: str, time: Times, values: Values, valid: Range | None, max_gap: Number | None
) -> RepairedValues:
    """Interpolate what is missing or out of range, between neighbours at most `max_gap` (s) apart.

    Nothing is repaired unless `valid` or `max_gap` asks for it. The interpolation is monotone
    between neighbours (Fritsch and Butland 1984). What lies at an end, or in a longer gap, is NaN.
    """
    good = np.isfinite(values)
    if valid is not None:
        if len(valid) != 2 or not valid[0] < valid[1]:
            raise RecordError(
                f"the valid range of {name!r} is {valid}: give its lowest and highest value, as "
                f"«valid=NAME=-20:20|valid={{{name!r}: (-20, 20)}}»."
            )
        good &= (values >= valid[0]) & (values <= valid[1])
    if good.all() or (valid is None and max_gap is None):
        return RepairedValues(values, np.empty(0))
    places, bad = np.flatnonzero(good), np.flatnonzero(~good)
    after = np.searchsorted(places, bad)
    between = (after > 0) & (after < places.size)
    bad, after = bad[between], after[between]
    gap = time[places[after]] - time[places[after - 1]]
    filled = bad[gap <= _longest_gap(time, max_gap) * (1 + 1e-9)]
    repaired = np.where(good, values, np.nan)
    if filled.size:
        # Imported here: it takes a quarter of a second, and most records need no repair.
        from scipy.interpolate import PchipInterpolator

        repaired[filled] = PchipInterpolator(time[good], values[good])(time[filled])
    return RepairedValues(repaired, time[filled])


def within(
    repaired: Mapping[str, Float[np.ndarray, " repaired"]], start: float, stop: float
) -> dict[str, Float[np.ndarray, " kept"]]:
    """Those times of repairs that lie between `start` and `stop` (s)."""
    kept = {name: times[(times >= start) & (times <= stop)] for name, times in repaired.items()}
    return {name: times for name, times in kept.items() if times.size}


def check_ranges(valid: Valid, channels: Iterable[str]) -> None:
    """Raise RecordError for a range of a channel that is not among the `channels`."""
    names = list(channels)
    for name in valid:
        if name not in names:
            raise RecordError(f"«valid=» names {name!r}: {unknown_name(name, names)}")


def as_float64(label: str, values: ArrayLike, *, copy: bool = True) -> np.ndarray:
    """In float64, NaN where masked; a `copy`, or a view. Raises RecordError for no numbers."""
    array = np.ma.asanyarray(values)
    if array.dtype.names:
        raise RecordError(
            f"{label} is a structured array with the fields {', '.join(array.dtype.names)}: stack "
            f"those that are channels, as np.stack([x[{array.dtype.names[-1]!r}], ...], axis=1)."
        )
    if array.dtype.kind in "mM":
        raise RecordError(f"{label} holds dates or durations ({array.dtype}), not numbers.")
    if array.dtype.kind == "c":
        raise RecordError(f"{label} is complex: a record holds real numbers.")
    try:
        return np.asarray(np.ma.filled(array.astype(np.float64, copy=copy), np.nan))
    except (TypeError, ValueError) as error:
        raise RecordError(f"{label} is not an array of numbers: {error}.") from error


_PERIODS = {"deg": (360.0,), "rad": (2 * np.pi,), "": (360.0, 2 * np.pi)}  # by unit
_TOLERANCE = 0.1  # of a turn, that an angle may move between two samples
_QUICK = 0.05  # of a turn: as much as the steps beside the jumps may be
_MOST_TURNS = 0.02  # of all steps; more are no turns of a vehicle


def without_turns(values: Values, unit: str) -> tuple[Values, int, float]:
    """An angle that goes on where it jumped by a turn, how often it jumped, and the turn.

    A turn is 360 where the `unit` is deg, 2 pi where it is rad, either where it is unknown; other
    units are no angles. Jumps are turns where they go from one end of a range of one turn to the
    other, and the angle moves little from sample to sample elsewhere, but moves. A square wave from
    -180 to 180 does not.
    """
    periods = _PERIODS.get(unit, ())
    if not periods or values.size < 2 or not np.isfinite(values).all():
        return values, 0, 0.0
    low, high, steps = float(values.min()), float(values.max()), np.diff(values)
    for period in periods:
        in_range = low >= -period / 2 * 1.001 and high <= period / 2 * 1.001
        from_zero = low >= -1e-3 * period and high <= period * 1.001
        if not (in_range or from_zero):
            continue
        turns = np.where(np.abs(steps) > (1 - _TOLERANCE) * period, np.sign(steps), 0.0)
        jumps = int(np.count_nonzero(turns))
        if not 0 < jumps <= _MOST_TURNS * steps.size:
            continue
        moving = np.abs(steps - period * turns)[turns != 0]
        if np.median(moving) > 0 and np.abs(steps[turns == 0]).max() < _QUICK * period:
            passed = np.concatenate([[0.0], np.cumsum(turns)])
            return values - period * passed, jumps, period
    return values, 0, 0.0


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
        stamps = np.asarray(time)
        dates = dates_in_seconds(stamps) if stamps.dtype.kind in "mM" else None  # s since 1970
        label = f"the time of channel {name!r}"
        stamps = as_float64(label, time, copy=False) if dates is None else dates
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


def _contiguous_part(
    channel: Channel, begin: float, end: float, *, margin: float, max_gap: Number | None
) -> Channel:
    """The samples from `begin` to `end` (s), and up to `margin` (s) beyond, without a break.

    A break is a gap longer than `max_gap` (s) or a value that is not finite. Outside of
    `begin` .. `end` it ends the part; inside it raises RecordError, a GapError where all are gaps.
    """
    time, longest = channel.time, _longest_gap(channel.time, max_gap)
    bad = ~np.isfinite(channel.values)
    broken = (np.diff(time) > longest) | bad[:-1] | bad[1:]
    inside = broken & (time[1:] > begin) & (time[:-1] < end)
    if inside.any():
        breaks = np.flatnonzero(inside)
        holes = bad[breaks] | bad[breaks + 1]
        index = int(breaks[holes.argmax() if holes.any() else 0])
        left, right = time[index : index + 2]
        origin = clock_start(time)
        if holes.any():
            i = index if bad[index] else index + 1
            raise RecordError(
                f"channel {channel.name!r} is {channel.values[i]} at sample {i}, "
                f"t = {show_times(time[i], start=origin)}. {mend_holes('it')}"
            )
        raise GapError(
            f"channel {channel.name!r} has a gap of {1e3 * (right - left):.4g} ms from "
            f"t = {left - origin:.6g} s to {show_times(right, start=origin)} (limit "
            f"{1e3 * longest:.4g} ms). "
            f"{choose_range('it')}, or allow it, by its length in s («max_gap=»).",
            [(float(time[i]), float(time[i + 1])) for i in breaks],
        )
    before = np.flatnonzero(broken & (time[1:] <= begin))
    after = np.flatnonzero(broken & (time[:-1] >= end))
    reach = margin + longest
    first = max(np.searchsorted(time, begin - reach), *(before[-1:] + 1), 0)
    last = min(np.searchsorted(time, end + reach, "right"), *(after[:1] + 1), time.size)
    return Channel(channel.name, time[first:last], channel.values[first:last], channel.unit)


def _gaps(channel: Channel, begin: float, end: float) -> np.ndarray:
    """Indices of the steps within `begin` .. `end` in which samples are missing."""
    step = np.diff(channel.time)
    inside = (channel.time[1:] > begin) & (channel.time[:-1] < end)
    return np.flatnonzero((step > longest_step(channel.time)) & inside)


# Kaiser's formulas for 72 dB over a transition from 0.3 to 0.5 of the sample rate.
_BETA = 0.1102 * (72 - 8.7)
_HALF = 0.5 * (72 - 7.95) / (2.285 * 2 * np.pi * 0.2)  # samples of the target grid
_CUTOFF = 0.4  # of the target rate, where the filter is down by 6 dB


def _lowpass(
    curve: Callable[[Times], Times],
    span: tuple[float, float],
    time: Times,
    sample_rate: Number,
    fastest: float,
) -> Times:
    """`curve` at the times `time` (s, at `sample_rate` in Hz), low-passed against aliasing.

    The curve is known over `span` (s) and is continued by reflection about its end points, which
    keeps a straight line straight. `fastest` (Hz) is the highest native rate: the filter runs on a
    grid twice as fine, the same for all channels.
    """
    fold = int(np.ceil(2 * fastest / sample_rate))
    half = int(np.ceil(_HALF * fold))
    taps = np.sinc(2 * _CUTOFF * (np.arange(-half, half + 1) / fold))
    taps *= np.kaiser(2 * half + 1, _BETA)
    taps /= taps.sum()
    fine = fold * sample_rate
    lowest, highest = -half, (time.size - 1) * fold + half
    first = max(lowest, int(np.ceil((span[0] - time[0]) * fine - 1e-6)))
    last = min(highest, int(np.floor((span[1] - time[0]) * fine + 1e-6)))
    inside = curve(np.clip(time[0] + np.arange(first, last + 1) / fine, *span))
    padding = (first - lowest, highest - last)
    padded = np.pad(inside, padding, mode="reflect", reflect_type="odd")
    return np.lib.stride_tricks.sliding_window_view(padded, taps.size)[::fold] @ taps


_SAME = 1.05  # rates closer than this need neither a filter nor a warning
_MOST = 50_000_000  # samples


def resample(
    channels: Sequence[Channel],
    sample_rate: Number,
    *,
    start: Number | None = None,
    stop: Number | None = None,
    max_gap: Number | None = None,
) -> tuple[Times, Float[np.ndarray, "samples channels"]]:
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
    from scipy.interpolate import CubicSpline, make_interp_spline

    begin, end = _common_extent(channels, start, stop)
    if not (np.isfinite(sample_rate) and sample_rate > 0):
        raise RecordError(f"the sample rate is {sample_rate} Hz: it must be positive.")
    steps = (end - begin) * sample_rate
    if not FEWEST - 1 <= steps + 1e-6 < _MOST:
        raise RecordError(
            f"a sample rate of {sample_rate:.6g} Hz over {end - begin:.6g} s makes "
            f"{steps + 1:.6g} samples; {FEWEST} .. {_MOST} are allowed. Choose another rate or "
            f"range."
        )
    time = begin + np.arange(int(steps + 1e-6) + 1) / sample_rate
    # The filter looks as far to either side, and a spline at its end needs some samples more.
    margin = (_HALF + 1) / sample_rate + 20 / min(channel.rate for channel in channels)
    pieces = [_contiguous_part(c, begin, end, margin=margin, max_gap=max_gap) for c in channels]
    for remark in _remarks(pieces, channels, begin, end, sample_rate):
        warnings.warn(remark, RecordWarning, stacklevel=2)
    fastest = max(channel.rate for channel in channels)
    columns = []
    for piece in pieces:
        holes, knots, values = _gaps(piece, -np.inf, np.inf), piece.time, piece.values
        if holes.size:  # filled by a cubic: far apart knots make a spline of degree 7 oscillate
            fill = []
            for left, right in zip(piece.time[holes], piece.time[holes + 1], strict=True):
                steps = round((right - left) * piece.rate)
                fill.append(np.linspace(left, right, steps + 1)[1:-1])
            knots = np.sort(np.concatenate([piece.time, *fill]))
            values = CubicSpline(piece.time, piece.values)(knots)
        curve = make_interp_spline(knots, values, k=7)
        if fastest <= _SAME * sample_rate:
            columns.append(curve(time))
        else:
            span = piece.time[0], piece.time[-1]
            columns.append(_lowpass(curve, span, time, sample_rate, fastest))
    return time, np.stack(columns, axis=1)


def _common_extent(
    channels: Sequence[Channel], start: Number | None, stop: Number | None
) -> tuple[float, float]:
    """First and last time (s) of the grid, within the time that all channels share."""
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


def _remarks(
    pieces: Sequence[Channel],
    channels: Sequence[Channel],
    begin: float,
    end: float,
    sample_rate: Number,
) -> Iterator[str]:
    """What is to be said of gaps, of time stamps that scatter, and of channels that are slow."""
    gaps = []
    for piece in pieces:
        holes = _gaps(piece, begin, end)
        if holes.size:
            step = np.diff(piece.time)[holes]
            where = piece.time[holes[step.argmax()]]
            place = show_times(float(where), start=clock_start(piece.time))
            longest = f"longest {1e3 * step.max():.4g} ms at t = {place}"
            gaps.append(f"{piece.name!r} {holes.size}, {longest}")
    if gaps:
        yield f"gaps filled by interpolation: {'; '.join(gaps)}."
    scattered = [piece for piece in pieces if scatters(piece.time)]
    if scattered:
        off = max(nonuniformity(piece.time) for piece in scattered)
        rate = min(piece.rate for piece in scattered)
        yield (
            f"the time stamps of {', '.join(repr(piece.name) for piece in scattered)} lie up to "
            f"{off:.2g} samples off a clock of "
            f"{rate:.5g} Hz, and steps shorter than half a sample are as frequent as long ones: "
            f"values were interpolated at these times. If the samples were equally spaced, give "
            f"their interval instead: {1 / rate:.4g} s («dt=»)."
        )
    slow = [f"{c.name!r} {c.rate:.6g} Hz" for c in channels if sample_rate > _SAME * c.rate]
    if slow:
        yield (
            f"resampled to {sample_rate:.6g} Hz, faster than {', '.join(slow)}: such a channel "
            f"holds no information above half its own rate. Keep the frequency band below that."
        )
