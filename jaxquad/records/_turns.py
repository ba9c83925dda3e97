"""Angles that jump by a whole turn where they leave their range."""

import numpy as np
from jaxtyping import Float


_PERIODS = {"deg": (360.0,), "rad": (2 * np.pi,), "": (360.0, 2 * np.pi)}  # by unit
_TOLERANCE = 0.1  # of a turn, that an angle may move between two samples
_QUICK = 0.05  # of a turn: as much as the steps beside the jumps may be
_MOST = 0.02  # of all steps; more are no turns of a vehicle

Values = Float[np.ndarray, " samples"]


def without_turns(values: Values, unit: str) -> tuple[Values, int, float]:
    """An angle that goes on where it jumped by a turn, how often it jumped, and the turn.

    A turn is 360 where the `unit` is deg, 2 pi where it is rad, either where it is unknown; other
    units are no angles. Jumps are turns where they go from one end of a range of one turn to the
    other, and the angle moves little from sample to sample elsewhere, but moves. A square wave from
    -180 to 180 does not.
    """
    for period in _PERIODS.get(unit, ()):
        turns = _turns(values, period)
        if turns is not None:
            passed = np.concatenate([[0.0], np.cumsum(turns)])
            return values - period * passed, int(np.count_nonzero(turns)), period
    return values, 0, 0.0


def _turns(values: Values, period: float) -> Float[np.ndarray, " steps"] | None:
    """The turn of each step, 1, -1 or 0; None where the values are no such angle."""
    if values.size < 2 or not np.isfinite(values).all():
        return None
    low, high = float(values.min()), float(values.max())
    in_range = low >= -period / 2 * 1.001 and high <= period / 2 * 1.001
    from_zero = low >= -1e-3 * period and high <= period * 1.001
    if not (in_range or from_zero):
        return None
    steps = np.diff(values)
    turns = np.where(np.abs(steps) > (1 - _TOLERANCE) * period, np.sign(steps), 0.0)
    jumps = np.count_nonzero(turns)
    if not 0 < jumps <= _MOST * steps.size:
        return None
    calm = np.abs(steps[turns == 0])
    moving = np.abs(steps - period * turns)[turns != 0]
    goes_on = float(np.median(moving)) > 0 and calm.max() < _QUICK * period
    return turns if goes_on else None
