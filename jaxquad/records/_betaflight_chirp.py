from typing import NamedTuple

import numpy as np

from ._log import Table


_AXES = (0, 1, 2)
_SHORTEST = 1.0  # s
_MOST_EDGES = 10_000


class Chirp(NamedTuple):
    """A sweep that Betaflight's chirp mode injected: roll 0, pitch 1, yaw 2."""

    axis: int
    start: float  # s
    stop: float
    low: float  # Hz
    high: float


def chirps(table: Table) -> list[Chirp]:
    """The sweeps in a log whose debug channels are those of debug mode CHIRP.

    There, debug[1] is the axis (-1 when idle), debug[2] the frequency in 0.1 Hz and debug[3] the
    excitation (betaflight pull request 15113). The number of that mode depends on the version, so
    the data have to speak: a frequency that only rises while the axis stays the same.
    """
    debug = [table.columns.get(f"debug[{i}]") for i in range(4)]
    if table.time is None or any(each is None for each in debug):
        return []
    _, axis, tenths, excitation = (np.asarray(each, np.float64) for each in debug)
    active = np.where(tenths > 0, axis, -1)
    edges = np.flatnonzero(np.diff(active)) + 1
    if not np.isin(axis, (-1, *_AXES)).all() or edges.size > _MOST_EDGES:
        return []
    found = []
    for first, end in zip([0, *edges], [*edges, axis.size], strict=True):
        frequency, time = tenths[first:end] / 10, table.time[first:end]
        sweeps = (np.diff(frequency) >= 0).all() and frequency[-1] > frequency[0]
        moves = sweeps and np.ptp(excitation[first:end]) > 0
        if active[first] in _AXES and moves and time[-1] - time[0] >= _SHORTEST:
            ends = (float(time[0]), float(time[-1]), float(frequency[0]), float(frequency[-1]))
            found.append(Chirp(int(active[first]), *ends))
    return found
