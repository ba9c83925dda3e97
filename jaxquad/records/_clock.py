"""Time stamps: their order, rate and uniformity, and the repair of glitches and overflows."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ._errors import RecordError


Times = Float[np.ndarray, " samples"]  # s
FEWEST = 16  # samples in a record
JITTER = 0.02  # of a sample: largest departure from the uniform grid that still counts as uniform
GAP = 1.5  # nominal samples: a longer step is a gap
TimeUnit = Literal["s", "ms", "us", "ns"]
Number = float | int
PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_SLOW = 0.25  # s: as large a step may be one of milliseconds
_DATES = 1e8  # s: stamps from here on are dates, in s since 1970
_DATE_UNITS = {
    "W": 604800.0, "D": 86400.0, "h": 3600.0, "m": 60.0, "s": 1.0,
    "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "ps": 1e-12, "fs": 1e-15, "as": 1e-18,
}  # fmt: skip


def clock_start(time: Times) -> float:
    """Where the time begins that is shown: 0, or for dates the first stamp (s)."""
    return float(time[0]) if time.size and time[0] >= _DATES else 0.0


def show_times(*times: float, start: float = 0.0) -> str:
    """Times in s as text: `3.2 .. 30 s`, counted from a `start` that `clock_start` gives."""
    text = " .. ".join(f"{time - start:.6g}" for time in times)
    return f"{text} s after {start:.3f} s" if start else f"{text} s"


def in_file_time(time: Number | None, start: float) -> Number | None:
    """A time that a user named, which may count from the `start` that is shown (s)."""
    return start + time if time is not None and start and time < _DATES else time


def check_unit(unit: TimeUnit | None) -> None:
    """Raise RecordError for another unit of time."""
    if unit is not None and unit not in PER_SECOND:
        raise RecordError(f"time_unit is {unit!r}: use one of {', '.join(PER_SECOND)}.")


def doubt_of_seconds(stamps: Times) -> str:
    """What speaks against steps in s of which nobody said the unit; empty if nothing does."""
    step = float(np.median(np.abs(np.diff(stamps)))) if stamps.size > 1 else 0.0
    if not step >= _SLOW:
        return ""
    doubt = f"{1 / step:.3g} Hz if that is in s, {1e3 / step:.4g} Hz in ms"
    doubt = "which is probably not in seconds" if step >= 1 else doubt
    return (
        f"steps by {step:.6g}, {doubt}. Give its unit («time_unit=»): ms, us or ns, or s if the "
        f"log really is that slow; for a count of rows give the sampling interval («dt=»)"
    )


def steady(stamps: np.ndarray) -> bool:
    """Whether numbers rise as a clock does: always, and mostly by steps of nearly one size."""
    if stamps.size < FEWEST or not np.isfinite(stamps).all():
        return False
    steps = np.diff(stamps.astype(np.float64))
    usual = np.abs(steps / np.median(steps) - 1) < 0.5 if (steps > 0).all() else np.zeros(1)
    return bool(np.mean(usual) > 0.9)


def dates_in_seconds(stamps: np.ndarray) -> np.ndarray | None:
    """Dates (s since 1970) or durations (s) of NumPy; None where they have no fixed unit."""
    if stamps.dtype.kind == "M" and np.datetime_data(stamps.dtype)[0] in ("Y", "M"):
        stamps = stamps.astype("M8[D]")
    unit, count = np.datetime_data(stamps.dtype)
    if unit not in _DATE_UNITS:
        return None
    seconds = stamps.astype(np.int64) * (count * _DATE_UNITS[unit])
    return np.where(np.isnat(stamps), np.nan, seconds)


def check_increasing(label: str, time: Times) -> None:
    """Raise RecordError where the stamps of `label` are not finite, repeat or go back."""
    bad = np.flatnonzero(~np.isfinite(time))
    if bad.size:
        raise RecordError(
            f"{label}: time stamp {bad[0]} is {time[bad[0]]}: delete such rows from the file."
        )
    back = np.flatnonzero(np.diff(time) <= 0)
    if back.size:
        i = back[0] + 1
        verb = "repeats" if time[i] == time[i - 1] else "goes back"
        raise RecordError(
            f"{label}: time {verb} at sample {i}, from {time[i - 1]:.9g} s to {time[i]:.9g} s "
            f"(in {back.size} places). Time must increase strictly: delete or sort these rows."
        )


_SCATTERED = 0.01  # of the steps; fewer are those of single late stamps
_SPAN = 16  # samples, over which scattered stamps are counted: their ends hardly matter


def scatters(time: Times) -> bool:
    """Whether time stamps scatter about a clock: steps are too short as often as too long."""
    step = np.diff(time)
    usual = np.median(step)
    too_long, too_short = np.sum(step > GAP * usual), np.sum(step < (2 - GAP) * usual)
    return bool(too_short > max(0.5 * too_long, _SCATTERED * step.size))


def longest_step(time: Times) -> float:
    """The step in s beyond which samples are missing: between scattered stamps up to 2 samples."""
    return (2.0 if scatters(time) else GAP) * float(np.median(np.diff(time)))


def native_rate(time: Times) -> float:
    """Samples per second of jittered time stamps, without the gaps."""
    count = min(_SPAN, time.size // 2) if scatters(time) else 1
    span = time[count:] - time[:-count]
    usual = float(np.median(np.diff(time)))
    unbroken = span[span <= np.median(span) + (longest_step(time) - usual)]
    return float(count * unbroken.size / unbroken.sum())


def nonuniformity(time: Times) -> float:
    """Largest distance of the time stamps from a uniform grid between their ends, in samples."""
    grid = np.linspace(time[0], time[-1], time.size)
    return float(np.abs(time - grid).max() * (time.size - 1) / (time[-1] - time[0]))


def check_uniform(time: Times) -> None:
    """Raise RecordError for time stamps more than 2 % of a sample off a uniform grid."""
    worst = nonuniformity(time)
    if worst > JITTER:
        step = np.diff(time)
        i = int(np.abs(step - np.median(step)).argmax())
        missing = step[i] > longest_step(time)
        gap = "; as rows are missing, state there how long a gap may be («max_gap=», in s)"
        raise RecordError(
            f"time is not uniformly sampled: the time stamps lie up to {worst:.3g} samples off a "
            f"uniform grid (limit {JITTER}); the most unusual step is {step[i]:.6g} s at "
            f"t = {show_times(time[i], start=clock_start(time))}, the median step "
            f"{np.median(step):.6g} s. "
            "Resample it with «sample_rate=|jq.read(..., sample_rate=), "
            "jq.Record.from_dataframe(..., sample_rate=) or "
            f"jq.records.resample»{gap if missing else ''}."
        )


def window(time: Times, start: Number | None, stop: Number | None) -> slice:
    """The samples from `start` to `stop` (s, both included; None is the end of the record).

    Where the time stamps are dates, both may count from the first of them.
    """
    slack = 1e-6 * (time[-1] - time[0]) / (time.size - 1)
    origin = clock_start(time)
    start, stop = in_file_time(start, origin), in_file_time(stop, origin)
    begin = time[0] if start is None else start
    end = time[-1] if stop is None else stop
    shown = lambda *times: show_times(*times, start=origin)
    extent = f"the record covers {shown(time[0], time[-1])}"
    if not begin < end:
        raise RecordError(f"start {shown(begin)} is not before stop {shown(end)}; {extent}.")
    if begin < time[0] - slack or end > time[-1] + slack:
        raise RecordError(f"{shown(begin, end)} is out of range; {extent}.")
    first = int(np.searchsorted(time, begin - slack))
    last = int(np.searchsorted(time, end + slack, side="right"))
    if last - first < FEWEST:
        raise RecordError(
            f"{shown(begin, end)} holds {last - first} samples: at least {FEWEST} are "
            f"needed; {extent}."
        )
    return slice(first, last)


_MOST_DROPPED = 0.01  # of the time stamps; more is not a glitch, and the record is refused


class RepairedTime(NamedTuple):
    """Increasing time stamps, the rows that they belong to, and what was repaired."""

    time: np.ndarray
    kept: Bool[np.ndarray, " samples"] | None  # None: all
    remark: str


def unwrap(counter: np.ndarray) -> tuple[np.ndarray, int]:
    """A counter with its overflows undone, and how many there were.

    A 32-bit counter is recognised by its dtype, or by a step from the last hundredth of its range
    to the first; an int16 or uint16 by its dtype alone.
    """
    if counter.dtype.kind in "iu" and counter.dtype.itemsize <= 4:
        span = float(2 ** (8 * counter.dtype.itemsize))
        steps = np.diff(counter.astype(np.int64))
        wraps = steps < -span / 2
    else:
        span = 2.0**32
        wraps = (counter[:-1] > 0.99 * span) & (counter[:-1] < span) & (counter[1:] < 0.01 * span)
        wraps &= counter[1:] >= 0
    if not wraps.any():
        return counter, 0
    turns = np.concatenate([[0], np.cumsum(wraps)])
    return counter.astype(np.float64) + span * turns, int(wraps.sum())


def repair(time: Times) -> RepairedTime:
    """Drop time stamps that repeat, go back, jump ahead or are not finite, if they are few.

    Where more than 1 % would have to go, nothing is dropped: `Channel` then refuses the record.
    """
    good = np.isfinite(time)
    if time.size < FEWEST or (good.all() and (np.diff(time) > 0).all()):
        return RepairedTime(time, None, "")
    kept = np.flatnonzero(good)
    if kept.size > 2:  # what jumps ahead although its neighbours are in order goes alone
        a, b, c = time[kept][:-2], time[kept][1:-1], time[kept][2:]
        kept = kept[~np.concatenate([[a[0] > b[0] and b[0] < c[0]], (b > c) & (a < c), [False]])]
    highest = np.maximum.accumulate(time[kept])
    kept = kept[np.concatenate([[True], time[kept][1:] > highest[:-1]])] if kept.size else kept
    dropped = time.size - kept.size
    if dropped > _MOST_DROPPED * time.size:
        return RepairedTime(time, None, "")
    mask = np.zeros(time.size, dtype=bool)
    mask[kept] = True
    first = int(np.flatnonzero(~mask)[0])
    remark = (
        f"{dropped} of {time.size} time stamps repeat or go back; these rows were dropped, the "
        f"first of them row {first} ({time[first]:.9g} s)"
    )
    return RepairedTime(time[mask], mask, remark)
