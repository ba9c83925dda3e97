"""What a vector of time stamps says: its order, its rate, how uniform it is."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ._errors import RecordError


Times = Float[np.ndarray, " samples"]  # s
FEWEST = 16  # samples in a record
JITTER = 0.02  # of a sample: largest departure from the uniform grid that still counts as uniform
GAP = 1.5  # nominal samples: a longer step is a gap


def check_increasing(label: str, time: Times) -> None:
    """Raise RecordError where the stamps of `label` are not finite, repeat or go back."""
    stuck = np.flatnonzero(~np.isfinite(time))
    if stuck.size:
        raise RecordError(
            f"{label}: time stamp {stuck[0]} is {time[stuck[0]]}: drop such rows before reading."
        )
    back = np.flatnonzero(np.diff(time) <= 0)
    if back.size:
        i = back[0] + 1
        verb = "repeats" if time[i] == time[i - 1] else "goes back"
        raise RecordError(
            f"{label}: time {verb} at sample {i}, from {time[i - 1]:.9g} s to {time[i]:.9g} s "
            f"({back.size} such places): time has to increase strictly; drop or sort these rows."
        )


def native_rate(time: Times) -> float:
    """Samples per second of jittered stamps, gaps not counted."""
    step = np.diff(time)
    whole = step[step <= GAP * np.median(step)]
    return float(whole.size / whole.sum())


def departure(time: Times) -> float:
    """Largest distance of the stamps from the uniform grid between their ends, in samples."""
    grid = np.linspace(time[0], time[-1], time.size)
    return float(np.abs(time - grid).max() * (time.size - 1) / (time[-1] - time[0]))


def check_uniform(time: Times) -> None:
    """Raise RecordError for stamps that are not on a uniform grid within 2 % of a sample."""
    worst = departure(time)
    if worst > JITTER:
        step = np.diff(time)
        i = int(np.abs(step - np.median(step)).argmax())
        raise RecordError(
            f"time is not uniformly sampled: stamps lie up to {worst:.3g} samples off the uniform "
            f"grid (limit {JITTER}); the oddest step is {step[i]:.6g} s at t = {time[i]:.6g} s, "
            f"the median {np.median(step):.6g} s. Use jq.read(..., sample_rate=) or jq.records.resample."
        )


def window(time: Times, start: float | int | None, stop: float | int | None) -> slice:
    """The samples from `start` to `stop` (s, both included; None is the end of the record)."""
    slack = 1e-6 * (time[-1] - time[0]) / (time.size - 1)
    begin = time[0] if start is None else start
    end = time[-1] if stop is None else stop
    extent = f"the record covers {time[0]:.6g} .. {time[-1]:.6g} s"
    if not begin < end:
        raise RecordError(f"start {begin:.6g} s is not before stop {end:.6g} s: {extent}.")
    if begin < time[0] - slack or end > time[-1] + slack:
        raise RecordError(f"{begin:.6g} .. {end:.6g} s is out of range: {extent}.")
    first = int(np.searchsorted(time, begin - slack))
    last = int(np.searchsorted(time, end + slack, side="right"))
    if last - first < FEWEST:
        raise RecordError(
            f"{begin:.6g} .. {end:.6g} s holds {last - first} samples, at least {FEWEST} are "
            f"needed: {extent}."
        )
    return slice(first, last)


MOST_DROPPED = 0.01  # of the stamps; more is no glitch, and the record is refused
_WRAP = 2.0**32


class Mended(NamedTuple):
    """Stamps that increase, which of the rows they are, and what was done."""

    time: np.ndarray
    kept: Bool[np.ndarray, " samples"] | None  # None: all
    remark: str


def unwrapped(counter: np.ndarray) -> tuple[np.ndarray, int]:
    """A counter with its overflows taken out, and how many there were.

    A 32-bit counter shows by its dtype, or by stepping from the last hundredth of its range to
    the first; an int16 or uint16 by its dtype alone.
    """
    if counter.dtype.kind in "iu" and counter.dtype.itemsize <= 4:
        span = float(2 ** (8 * counter.dtype.itemsize))
        steps = np.diff(counter.astype(np.int64))
        wraps = steps < -span / 2
    else:
        span = _WRAP
        wraps = (counter[:-1] > 0.99 * span) & (counter[:-1] < span) & (counter[1:] < 0.01 * span)
        wraps &= counter[1:] >= 0
    if not wraps.any():
        return counter, 0
    turns = np.concatenate([[0], np.cumsum(wraps)])
    return counter.astype(np.float64) + span * turns, int(wraps.sum())


def mended(time: Float[np.ndarray, " samples"]) -> Mended:
    """Drops stamps that repeat, go back, stand out or are not finite, if they are few.

    Where more than 1 % would go, nothing is dropped: `Channel` then refuses the record.
    """
    good = np.isfinite(time)
    if time.size < FEWEST or (good.all() and (np.diff(time) > 0).all()):
        return Mended(time, None, "")
    kept = np.flatnonzero(good)
    kept = kept[~_spikes(time[kept])]
    highest = np.maximum.accumulate(time[kept])
    kept = kept[np.concatenate([[True], time[kept][1:] > highest[:-1]])] if kept.size else kept
    dropped = time.size - kept.size
    if dropped > MOST_DROPPED * time.size:
        return Mended(time, None, "")
    mask = np.zeros(time.size, dtype=bool)
    mask[kept] = True
    first = int(np.flatnonzero(~mask)[0])
    remark = (
        f"{dropped} of {time.size} time stamps repeat or go back and were dropped with their "
        f"rows, the first at row {first} (stamp {time[first]:.9g} s)"
    )
    return Mended(time[mask], mask, remark)


def _spikes(time: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " samples"]:
    """Stamps ahead of what follows although their neighbours are in order."""
    spike = np.zeros(time.size, dtype=bool)
    if time.size > 2:
        spike[1:-1] = (time[1:-1] > time[2:]) & (time[:-2] < time[2:])
        spike[0] = time[0] > time[1] and time[1] < time[2]
    return spike
