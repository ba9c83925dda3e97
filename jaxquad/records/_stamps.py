"""Time stamps as loggers write them: counters that wrap, stamps out of order."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ._clock import FEWEST


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
