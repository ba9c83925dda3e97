"""The frequencies at which local fits are made, and how wide their windows may be."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ._estimators import LocalPolynomial
from ._local_fit import Bins, check_bins, smallest_widths


_FREEDOM = 10  # complex degrees of freedom left over by the least window
_NARROW = 0.15  # half-width, relative to the frequency, at which noise and powers are estimated
WIDENED, WIDENINGS = 1.5, 6  # ratio and number of the steps from a window that is undetermined
_WIDEST, _LEAST_SPAN = 1.2, 3.0  # widest: relative to the frequency, or to the least window
_MOST = 4096  # Fourier bins of a window, unless more lie around a frequency of the grid
_PER_OCTAVE = 4  # further frequencies, which help to choose the widths

Grid = Float[np.ndarray, " frequencies"]


class Windows(NamedTuple):
    """Frequencies and half-widths in rad/s; those beyond the band help to choose the widths."""

    grid: Grid  # frequencies asked for, and others to an octave beyond them
    at: Int[np.ndarray, " asked"]  # places in the grid of those asked for
    least: Grid  # half-widths that hold enough bins
    narrow: Grid  # at which noise and powers are estimated
    most: Grid  # beyond which a window only costs memory and time

    @property
    def asked(self) -> Float[np.ndarray, " asked"]:
        """The frequencies asked for."""
        return self.grid[self.at]

    @property
    def widest(self) -> Grid:
        """Half-widths that are tried at the most."""
        return np.minimum(np.maximum(_WIDEST * self.grid, _LEAST_SPAN * self.least), self.most)

    def furthest(self, width: float | None) -> float:
        """The end in rad/s of the windows that reach furthest: no bin beyond it matters."""
        widest = np.maximum(self.narrow * WIDENED**WIDENINGS, self.most)
        return float(np.max(self.grid + np.maximum(widest, width or 0.0)))


def make_windows(omega: Grid, bins: Bins, options: LocalPolynomial, inputs: int) -> Windows:
    """Around increasing `omega`. Raises `ValueError` where the bins are too few."""
    coefficients, transients = inputs * (options.order + 1), options.order + 1
    check_bins(omega, bins, coefficients, transients, _FREEDOM)
    grid, at = _with_neighbours(omega, bins)
    least = smallest_widths(grid, bins, coefficients, transients, _FREEDOM)
    most = np.maximum(least, _most(grid, bins))
    return Windows(grid, at, least, np.clip(_NARROW * grid, least, most), most)


def _with_neighbours(
    omega: Grid, bins: Bins
) -> tuple[Float[np.ndarray, " grid"], Int[np.ndarray, " frequencies"]]:
    """A grid of `omega` and others to an octave beyond, and the places of `omega` in it."""
    first, last = max(omega[0] / 2, bins.omega[0]), min(omega[-1] * 2, bins.omega[-1])
    steps = _PER_OCTAVE * np.log2([first, last])
    lattice = 2 ** (np.arange(np.ceil(steps[0]), np.floor(steps[1]) + 1) / _PER_OCTAVE)
    grid = np.union1d(omega, lattice)
    return grid, np.searchsorted(grid, omega)


def _most(grid: Grid, bins: Bins) -> Grid:
    """Half-widths beyond which a window of a long record only costs memory and time.

    Windows that reach half of the way to the next frequency leave nothing of the record out.
    """
    density = bins.omega.size / (bins.omega[-1] - bins.omega[0])
    steps = np.diff(grid)
    spacing = np.maximum(np.append(steps, steps[-1:]), np.insert(steps, 0, steps[:1]))
    return np.maximum(spacing, _MOST / density) / 2
