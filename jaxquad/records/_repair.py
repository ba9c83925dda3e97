"""Values that are missing, or that a sensor cannot show, and their repair by interpolation."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ._errors import RecordError, unknown_name


Samples = Float[np.ndarray, " samples"]
Range = tuple[float | int, float | int]  # lowest and highest value that can be true
Valid = Mapping[str, Range]  # by channel
_GENERIC = 10  # nominal samples of a gap that is bridged where nobody says how long it may be
_SHORTEST = 0.05  # s


class RepairedValues(NamedTuple):
    """Values of a channel, NaN where they are still missing, and when others were filled in."""

    values: Samples
    times: Float[np.ndarray, " repaired"]  # s


def longest_gap(time: Samples, max_gap: float | int | None) -> float:
    """The longest gap that is interpolated, in s: as told, else 10 nominal samples or 0.05 s."""
    if max_gap is not None:
        return float(max_gap)
    return max(_GENERIC * float(np.median(np.diff(time))), _SHORTEST)


def repair_values(
    name: str, time: Samples, values: Samples, valid: Range | None, max_gap: float | int | None
) -> RepairedValues:
    """Interpolate what is missing or out of range, between neighbours at most `max_gap` (s) apart.

    Nothing is repaired unless `valid` or `max_gap` asks for it. The interpolation is monotone
    between neighbours (Fritsch and Butland 1984). What lies at an end, or in a longer gap, is NaN.
    """
    none = np.empty(0)
    if valid is None and max_gap is None:
        return RepairedValues(values, none)
    low, high = _range(name, valid)
    good = np.isfinite(values) & (values >= low) & (values <= high)
    if good.all():
        return RepairedValues(values, none)
    places, bad = np.flatnonzero(good), np.flatnonzero(~good)
    after = np.searchsorted(places, bad)
    between = (after > 0) & (after < places.size)
    bad, after = bad[between], after[between]
    apart = time[places[after]] - time[places[after - 1]]
    filled = bad[apart <= longest_gap(time, max_gap) * (1 + 1e-9)]
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
    kept = {name: each[(each >= start) & (each <= stop)] for name, each in repaired.items()}
    return {name: each for name, each in kept.items() if each.size}


def check_ranges(valid: Valid, known: Iterable[str]) -> None:
    """Raise RecordError for a range of a channel that is not among the `known` ones."""
    known = list(known)
    for name in valid:
        if name not in known:
            raise RecordError(f"«valid=» names {name!r}: {unknown_name(name, known)}")


def _range(name: str, valid: Range | None) -> Range:
    if valid is None:
        return -np.inf, np.inf
    if len(valid) != 2 or not valid[0] < valid[1]:
        raise RecordError(
            f"the valid range of {name!r} is {valid}: give its lowest and highest value, as "
            f"«valid=NAME=-20:20|valid={{{name!r}: (-20, 20)}}»."
        )
    return valid


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
