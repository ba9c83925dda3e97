"""The parts of a flight between events."""

from collections.abc import Sequence

import numpy as np


def parts_of(
    events: Sequence[float], start: float, stop: float | None
) -> list[tuple[float, float | None]]:
    """From event to event, in s: each counts ITAE's time and overshoot anew."""
    ends = np.inf if stop is None else stop
    inside = sorted({float(t) for t in events if start < t < ends})
    return list(zip([start, *inside], [*inside, stop], strict=True))
