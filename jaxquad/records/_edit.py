"""Other records from what there is: channels on one grid, parts, sums and other roles."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ._channel import (
    Channel,
    chosen_span,
    clock_start,
    longest_gap,
    longest_step,
    nonuniformity,
    Number,
    scatters,
    show_times,
    Times,
    window,
    within,
)
from ._log import choose_range, FEWEST, GapError, mend_holes, MOST_SAMPLES, RecordError, warn
from ._record import as_tuple, assemble, Record


Channels = Float[np.ndarray, "samples channels"]


# Kaiser's formulas for 72 dB over a transition from 0.3 to 0.5 of the sample rate.
_BETA = 0.1102 * (72 - 8.7)
_HALF = 0.5 * (72 - 7.95) / (2.285 * 2 * np.pi * 0.2)  # samples of the target grid
_CUTOFF = 0.4  # of the target rate, where the filter is down by 6 dB
_SAME = 1.05  # rates closer than this need neither a filter nor a warning


def resample(
    channels: Sequence[Channel], sample_rate: Number, *, start: Number | None = None,
    stop: Number | None = None, max_gap: Number | None = None,
) -> tuple[Times, Channels]:  # fmt: skip
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

    if not channels:
        raise RecordError("there are no channels to resample: give at least one.")
    latest = max(channels, key=lambda channel: channel.time[0])
    earliest = min(channels, key=lambda channel: channel.time[-1])
    first, last = float(latest.time[0]), float(earliest.time[-1])
    origin = min(clock_start(channel.time) for channel in channels)
    overlap = (
        f"the channels overlap from {first - origin:.6g} s ({latest.name!r} begins) "
        f"to {show_times(last, start=origin)} ({earliest.name!r} ends)"
    )
    if not first < last:
        raise RecordError(f"the channels have no common time: {overlap}.")
    slack = 1e-9 * (1 + abs(last))
    begin, end = chosen_span(first, last, start, stop, origin, slack, overlap)
    begin, end = max(begin, first), min(end, last)
    if not (np.isfinite(sample_rate) and sample_rate > 0):
        raise RecordError(f"the sample rate is {sample_rate} Hz: it must be positive.")
    steps = (end - begin) * sample_rate
    if not FEWEST - 1 <= steps + 1e-6 < MOST_SAMPLES:
        raise RecordError(
            f"a sample rate of {sample_rate:.6g} Hz over {end - begin:.6g} s makes "
            f"{steps + 1:.6g} samples; {FEWEST} .. {MOST_SAMPLES} are allowed. Choose another "
            f"rate or range."
        )
    time = begin + np.arange(int(steps + 1e-6) + 1) / sample_rate
    # The filter looks as far to either side, and a spline at its end needs some samples more.
    margin = (_HALF + 1) / sample_rate + 20 / min(channel.rate for channel in channels)
    pieces = [_contiguous_part(c, begin, end, margin=margin, max_gap=max_gap) for c in channels]
    _warn_of_clocks(pieces, begin, end)
    if slow := [f"{c.name!r} {c.rate:.6g} Hz" for c in channels if sample_rate > _SAME * c.rate]:
        warn(
            f"resampled to {sample_rate:.6g} Hz, faster than {', '.join(slow)}: such a channel "
            f"holds no information above half its own rate. Keep the frequency band below that."
        )
    # The low-pass against aliasing runs on a grid twice as fine as the fastest channel's.
    fastest = max(channel.rate for channel in channels)
    fold = int(np.ceil(2 * fastest / sample_rate))
    half, fine = int(np.ceil(_HALF * fold)), fold * sample_rate
    taps = np.sinc(2 * _CUTOFF * (np.arange(-half, half + 1) / fold))
    taps *= np.kaiser(2 * half + 1, _BETA)
    taps /= taps.sum()
    lowest, highest = -half, (time.size - 1) * fold + half
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
            continue
        # Beyond its ends it goes on by reflection, which keeps a straight line straight.
        first = max(lowest, int(np.ceil((piece.time[0] - time[0]) * fine - 1e-6)))
        last = min(highest, int(np.floor((piece.time[-1] - time[0]) * fine + 1e-6)))
        grid = time[0] + np.arange(first, last + 1) / fine
        inside = curve(np.clip(grid, piece.time[0], piece.time[-1]))
        padding = (first - lowest, highest - last)
        padded = np.pad(inside, padding, mode="reflect", reflect_type="odd")
        columns.append(np.lib.stride_tricks.sliding_window_view(padded, taps.size)[::fold] @ taps)
    return time, np.stack(columns, axis=1)


def _contiguous_part(
    channel: Channel, begin: float, end: float, *, margin: float, max_gap: Number | None
) -> Channel:
    """The samples from `begin` to `end` (s), and up to `margin` (s) beyond, without a break.

    A break is a gap longer than `max_gap` (s) or a value that is not finite: inside it raises.
    """
    time, longest = channel.time, longest_gap(channel.time, max_gap)
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


def _warn_of_clocks(pieces: Sequence[Channel], begin: float, end: float) -> None:
    """Warn of gaps that are filled, and of time stamps that scatter."""
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
        warn(f"gaps filled by interpolation: {'; '.join(gaps)}.")
    scattered = [piece for piece in pieces if scatters(piece.time)]
    if scattered:
        off = max(nonuniformity(piece.time) for piece in scattered)
        rate = min(piece.rate for piece in scattered)
        warn(
            f"the time stamps of {', '.join(repr(piece.name) for piece in scattered)} lie up to "
            f"{off:.2g} samples off a clock of "
            f"{rate:.5g} Hz, and steps shorter than half a sample are as frequent as long ones: "
            f"values were interpolated at these times. If the samples were equally spaced, give "
            f"their interval instead: {1 / rate:.4g} s («dt=»)."
        )


def trim(record: Record, start: Number | None = None, stop: Number | None = None) -> Record:
    """The part of a record from `start` to `stop`.

    **Arguments:**

    - `record`: a `Record`.
    - `start`, `stop`: first and last time in s of the record's own time, both included; `None` is
        the end of the record.

    **Returns:** a `Record` with the same channels.

    **Raises:**

    - `RecordError`: where the range leaves the record or holds fewer than 16 samples.
    """
    span = window(record.time, start, stop)
    time = record.time[span]
    return dataclasses.replace(
        record, time=time, inputs=record.inputs[span], outputs=record.outputs[span],
        references=record.references[span], time_unit="s",
        repaired=within(record.repaired, time[0], time[-1]),
    )  # fmt: skip


def select(
    record: Record, *, inputs: str | Sequence[str], outputs: str | Sequence[str],
    references: str | Sequence[str] = (),
) -> Record:  # fmt: skip
    """Assign new roles to channels, and drop the others.

    **Arguments:**

    - `record`: a `Record`.
    - `inputs`, `outputs`, `references`: names of channels of the record, whatever their role was.

    **Returns:** a `Record` of the named channels, with their units. Its `hold` is known where every
    input was one before.

    **Raises:**

    - `RecordError`: for a name that the record lacks or that is given twice.
    """
    roles = [as_tuple(names) for names in (inputs, outputs, references)]
    hold = record.hold if set(roles[0]) <= set(record.input_names) else None
    return assemble(
        record.time, roles, record.channel, record.unit, source=record.source, hold=hold,
        repaired=record.repaired,
    )  # fmt: skip
