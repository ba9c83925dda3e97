"""What a vector of time stamps says: its order, its rate, how uniform it is."""

import numpy as np
from jaxtyping import Float

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
            f"the median {np.median(step):.6g} s. Use jq.read(..., sample_rate=) or jq.resample."
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
