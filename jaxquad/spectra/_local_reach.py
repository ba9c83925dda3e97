"""How far a local window may reach before it hears another band than its own."""

import numpy as np
from jaxtyping import Float

from ._local_bins import Bins, window_slices


_DOMINATED = 30.0  # ratio of input powers from which a window's side outweighs its centre
_STEP = 1.3  # of the half-widths that are tried

Grid = Float[np.ndarray, " frequencies"]


def reach(omega: Grid, centre: Grid, widest: Grid, bins: Bins, columns: slice) -> Grid:
    """Half-widths in rad/s up to which what excites stands about `omega`, `widest` at most.

    Where a sweep has ended, a window that reaches back into its band takes the response from there:
    smooth, with a small error, and wrong. The mean power of each of the `columns` on either side of
    `centre` (half-width) must not outweigh that at the centre, unless both sides do: between the
    lines of a multisine a response is interpolated.
    """
    running = np.cumsum(np.abs(bins.values[:, columns]) ** 2, axis=0)
    running = np.concatenate([np.zeros((1, running.shape[1])), running])
    inner = window_slices(omega, centre, bins)
    middle = _mean(running, *inner)
    far, going = np.minimum(centre, widest), np.ones(omega.size, bool)
    while np.any(going):
        wider = np.minimum(_STEP * far, widest)
        first, last = window_slices(omega, wider, bins)
        low, high = _mean(running, first, inner[0]), _mean(running, inner[1], last)
        held = np.maximum(middle, np.minimum(low, high))
        going &= np.all(np.maximum(low, high) <= _DOMINATED * held, axis=1)
        far, going = np.where(going, wider, far), going & (wider < widest)
    return far


def _mean(
    running: Float[np.ndarray, "sums columns"], first: np.ndarray, last: np.ndarray
) -> Float[np.ndarray, "frequencies columns"]:
    """Power per bin from `first` to before `last`; 0 where there is none."""
    count = np.maximum(last - first, 1)[:, None]
    return (running[last] - running[first]) / count
