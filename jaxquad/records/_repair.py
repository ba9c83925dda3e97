"""Repair of values: missing ones, those that a sensor cannot show, angles that jump by a turn."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ._clock import Number, Times
from ._errors import RecordError, unknown_name


Values = Float[np.ndarray, " samples"]
Range = tuple[Number, Number]  # lowest and highest value that can be true
Valid = Mapping[str, Range]  # by channel
_GENERIC = 10  # nominal samples of a gap that is bridged where nobody says how long it may be
_SHORTEST = 0.05  # s


class RepairedValues(NamedTuple):
    """Values of a channel, NaN where they are still missing, and when others were filled in."""

    values: Values
    times: Float[np.ndarray, " repaired"]  # s


def longest_gap(time: Times, max_gap: Number | None) -> float:
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
    filled = bad[gap <= longest_gap(time, max_gap) * (1 + 1e-9)]
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
_MOST = 0.02  # of all steps; more are no turns of a vehicle


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
        if not 0 < jumps <= _MOST * steps.size:
            continue
        moving = np.abs(steps - period * turns)[turns != 0]
        if np.median(moving) > 0 and np.abs(steps[turns == 0]).max() < _QUICK * period:
            passed = np.concatenate([[0.0], np.cumsum(turns)])
            return values - period * passed, jumps, period
    return values, 0, 0.0
