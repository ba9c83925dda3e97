"""Logged channels: their time stamps and values, and the repair of both."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ._log import dates_in_seconds, FEWEST, RecordError, unknown_name


Times = Float[np.ndarray, " samples"]  # s
Values = Float[np.ndarray, " samples"]
JITTER = 0.02  # of a sample: largest departure from the uniform grid that still counts as uniform
GAP = 1.5  # nominal samples: a longer step is a gap
TimeUnit = Literal["s", "ms", "us", "ns"]
Number = float | int
Range = tuple[Number, Number]  # lowest and highest value that can be true
Valid = Mapping[str, Range]  # by channel
PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_SLOW = 0.25  # s: as large a step may be one of milliseconds
_DATES = 1e8  # s: stamps from here on are dates, in s since 1970


def clock_start(time: Times) -> float:
    """Where the time begins that is shown: 0, or for dates the first stamp (s)."""
    return float(time[0]) if time.size and time[0] >= _DATES else 0.0


def show_times(*times: float, start: float = 0.0) -> str:
    """Times in s as text: `3.2 .. 30 s`, counted from a `start` that `clock_start` gives."""
    text = " .. ".join(f"{time - start:.6g}" for time in times)
    return f"{text} s after {start:.3f} s" if start else f"{text} s"


def check_unit(unit: TimeUnit | None) -> None:
    if unit is not None and unit not in PER_SECOND:
        raise RecordError(f"time_unit is {unit!r}: use one of {', '.join(PER_SECOND)}.")


def require_seconds(
    label: str, stamps: Times, unit: TimeUnit | None, error: type[RecordError] = RecordError
) -> None:
    """Raise the error where nobody said the unit of `label`, and its steps may be in another."""
    step = float(np.median(np.abs(np.diff(stamps)))) if stamps.size > 1 else 0.0
    if unit is not None or not step >= _SLOW:
        return
    doubt = f"{1 / step:.3g} Hz if that is in s, {1e3 / step:.4g} Hz in ms"
    doubt = "which is probably not in seconds" if step >= 1 else doubt
    raise error(
        f"{label} steps by {step:.6g}, {doubt}. Give its unit («time_unit=»): ms, us or ns, or s "
        f"if the log really is that slow; for a count of rows give the sampling interval («dt=»)."
    )


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


def chosen_span(
    first: float, last: float, start: Number | None, stop: Number | None, origin: float,
    slack: float, extent: str,
) -> tuple[float, float]:  # fmt: skip
    """From `start` to `stop` within `first` .. `last` (s); both may count from `origin`."""
    start, stop = (
        origin + time if time is not None and origin and time < _DATES else time
        for time in (start, stop)
    )
    begin = first if start is None else float(start)
    end = last if stop is None else float(stop)
    shown = lambda *times: show_times(*times, start=origin)
    if not begin < end:
        raise RecordError(f"start {shown(begin)} is not before stop {shown(end)}; {extent}.")
    if begin < first - slack or end > last + slack:
        raise RecordError(f"{shown(begin, end)} is out of range; {extent}.")
    return begin, end


def window(time: Times, start: Number | None, stop: Number | None) -> slice:
    """The samples from `start` to `stop` (s, both included), which may count from a first date."""
    slack, origin = 1e-6 * (time[-1] - time[0]) / (time.size - 1), clock_start(time)
    extent = f"the record covers {show_times(time[0], time[-1], start=origin)}"
    begin, end = chosen_span(float(time[0]), float(time[-1]), start, stop, origin, slack, extent)
    first = int(np.searchsorted(time, begin - slack))
    last = int(np.searchsorted(time, end + slack, side="right"))
    if last - first < FEWEST:
        raise RecordError(
            f"{show_times(begin, end, start=origin)} holds {last - first} samples: at least "
            f"{FEWEST} are needed; {extent}."
        )
    return slice(first, last)


_MOST_DROPPED = 0.01  # of the time stamps; more is not a glitch, and the record is refused


def unwrap(counter: np.ndarray) -> tuple[np.ndarray, int]:
    """A counter with its overflows undone, and how many; seen by its dtype or a step of 32 bits."""
    if counter.dtype.kind in "iu" and counter.dtype.itemsize <= 4:
        span = float(2 ** (8 * counter.dtype.itemsize))
        wraps = np.diff(counter.astype(np.int64)) < -span / 2
    else:
        span = 2.0**32
        wraps = (counter[:-1] > 0.99 * span) & (counter[:-1] < span) & (counter[1:] < 0.01 * span)
        wraps &= counter[1:] >= 0
    if not wraps.any():
        return counter, 0
    turns = np.concatenate([[0], np.cumsum(wraps)])
    return counter.astype(np.float64) + span * turns, int(wraps.sum())


RepairedTime = tuple[np.ndarray, np.ndarray | None, str]  # stamps, which rows (None: all), a remark


def repair_time(time: Times) -> RepairedTime:
    """Drop stamps that repeat, go back, jump ahead or are not finite; none if over 1 % would."""
    good = np.isfinite(time)
    if time.size < FEWEST or (good.all() and (np.diff(time) > 0).all()):
        return time, None, ""
    kept = np.flatnonzero(good)
    if kept.size > 2:  # what jumps ahead although its neighbours are in order goes alone
        a, b, c = time[kept][:-2], time[kept][1:-1], time[kept][2:]
        kept = kept[~np.concatenate([[a[0] > b[0] and b[0] < c[0]], (b > c) & (a < c), [False]])]
    highest = np.maximum.accumulate(time[kept])
    kept = kept[np.concatenate([[True], time[kept][1:] > highest[:-1]])] if kept.size else kept
    dropped = time.size - kept.size
    if dropped > _MOST_DROPPED * time.size:
        return time, None, ""
    mask = np.zeros(time.size, dtype=bool)
    mask[kept] = True
    first = int(np.flatnonzero(~mask)[0])
    remark = (
        f"{dropped} of {time.size} time stamps repeat or go back; these rows were dropped, the "
        f"first of them row {first} ({time[first]:.9g} s)"
    )
    return time[mask], mask, remark


_GENERIC = 10  # nominal samples of a gap that is bridged where nobody says how long it may be
_SHORTEST = 0.05  # s


def longest_gap(time: Times, max_gap: Number | None) -> float:
    """The longest gap that is interpolated, in s: as told, else 10 nominal samples or 0.05 s."""
    if max_gap is not None:
        return float(max_gap)
    return max(_GENERIC * float(np.median(np.diff(time))), _SHORTEST)


def repair_values(
    name: str, time: Times, values: Values, valid: Range | None, max_gap: Number | None
) -> tuple[Values, Float[np.ndarray, " repaired"]]:
    """Values without what is missing or out of range, and the times (s) at which they are new.

    Monotone between neighbours at most `max_gap` (s) apart (Fritsch and Butland 1984), else NaN; as
    they are where neither `valid` nor `max_gap` asks for it.
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
        return values, np.empty(0)
    places, bad = np.flatnonzero(good), np.flatnonzero(~good)
    after = np.searchsorted(places, bad)
    between = (after > 0) & (after < places.size)
    bad, after = bad[between], after[between]
    gap = time[places[after]] - time[places[after - 1]]
    filled = bad[gap <= longest_gap(time, max_gap) * (1 + 1e-9)]
    repaired = np.where(good, values, np.nan)
    if filled.size:
        # Imported here: it takes a quarter of a second, and most records need no repair.
        from scipy.interpolate import PchipInterpolator

        repaired[filled] = PchipInterpolator(time[good], values[good])(time[filled])
    return repaired, time[filled]


def within(
    repaired: Mapping[str, Float[np.ndarray, " repaired"]], start: float, stop: float
) -> dict[str, Float[np.ndarray, " kept"]]:
    """Those times of repairs that lie between `start` and `stop` (s)."""
    kept = {name: times[(times >= start) & (times <= stop)] for name, times in repaired.items()}
    return {name: times for name, times in kept.items() if times.size}


def check_keys(what: str, keys: Iterable[str], channels: Iterable[str]) -> None:
    """Raise RecordError, which begins with `what`, for a key that is none of the `channels`."""
    names = list(channels)
    for name in keys:
        if name not in names:
            raise RecordError(f"{what} {name!r}: {unknown_name(name, names)}")


def as_float64(label: str, values: ArrayLike, *, copy: bool = True) -> np.ndarray:
    """In float64, NaN where masked; a `copy`, or a view. Raises RecordError for no numbers."""
    try:
        array = np.ma.asanyarray(values)
    except TypeError as error:
        if type(error).__name__ != "TracerArrayConversionError":
            raise
        raise RecordError(
            f"{label} is traced by JAX, but records and frequency responses are made by NumPy and "
            "have no derivatives: take them by the numbers of the response, which jq.fit has."
        ) from error
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


def uniform_stamps(time: ArrayLike, unit: TimeUnit | None) -> Times:
    """The time stamps of a record in s; raises RecordError where they are not uniform."""
    check_unit(unit)
    dates = np.asarray(time)
    if dates.dtype.kind in "mM":
        first = dates.flat[0] if dates.size and dates.dtype.kind == "M" else None
        # Before they become s, of which a float holds a day of ns but not 50 years of them.
        stamps = dates_in_seconds(dates if first is None else dates - first)
        if stamps is None or unit is not None:
            raise RecordError(
                f"time has the type {dates.dtype}: give «time_unit=» to plain numbers only, and "
                f"dates or durations in a unit between weeks and femtoseconds."
            )
    else:
        stamps = as_float64("time", time) / PER_SECOND[unit or "s"]
        if stamps.ndim == 1:
            require_seconds("time", stamps, unit)
    if stamps.ndim != 1:
        raise RecordError(f"time has shape {stamps.shape}: give one value for each sample.")
    if stamps.size < FEWEST:
        raise RecordError(f"{stamps.size} samples: a record needs at least {FEWEST}.")
    check_increasing("time", stamps)
    worst, step = nonuniformity(stamps), np.diff(stamps)
    if worst > JITTER:
        i = int(np.abs(step - np.median(step)).argmax())
        missing = step[i] > longest_step(stamps)
        gap = "; as rows are missing, state there how long a gap may be («max_gap=», in s)"
        raise RecordError(
            f"time is not uniformly sampled: the time stamps lie up to {worst:.3g} samples off a "
            f"uniform grid (limit {JITTER}); the most unusual step is {step[i]:.6g} s at "
            f"t = {show_times(stamps[i], start=clock_start(stamps))}, the median step "
            f"{np.median(step):.6g} s. "
            "Resample it with «sample_rate=|jq.read(..., sample_rate=), "
            "jq.Record.from_dataframe(..., sample_rate=) or "
            f"jq.records.resample»{gap if missing else ''}."
        )
    return stamps


_PERIODS = {"deg": (360.0,), "rad": (2 * np.pi,), "": (360.0, 2 * np.pi)}  # by unit
_TOLERANCE = 0.1  # of a turn, that an angle may move between two samples
_QUICK = 0.05  # of a turn: as much as the steps beside the jumps may be
_MOST_TURNS = 0.02  # of all steps; more are no turns of a vehicle


def without_turns(values: Values, unit: str) -> tuple[Values, int, float]:
    """An angle that goes on where it jumped by a turn, how often it jumped, and the turn.

    It jumps from end to end of a range of one turn, and else moves little from sample to sample,
    but moves: a square wave from -180 to 180 does not.
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
    time: Times
    values: Values
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
