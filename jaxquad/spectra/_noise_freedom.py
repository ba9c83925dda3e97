"""How well an estimated noise power is known: on how many independent values it rests."""

import numpy as np
from jaxtyping import Float, Int


Grid = Float[np.ndarray, " frequencies"]
Square = Float[np.ndarray, "frequencies frequencies"]


def line_weights(place: Grid, weight: Grid, bandwidth: float) -> Square:
    """Weights of the values in local straight lines along `place`; each row sums to one."""
    offset = place[None, :] - place[:, None]
    kernel = weight[None, :] * np.exp(-0.5 * (offset / bandwidth) ** 2)
    m0, m1, m2 = (np.sum(kernel * offset**k, axis=1)[:, None] for k in (0, 1, 2))
    # A single frequency has no slope: the small term keeps the line flat there.
    spread = m2 + 1e-3 * bandwidth**2 * m0 + 1e-300
    return kernel * (spread - m1 * offset) / (spread * m0 - m1**2 + 1e-300)


def smoothed(omega: Grid, covariance: Square, weight: Grid, bandwidth: float) -> Square:
    """Covariance of the logarithm of noise powers after smoothing along frequency.

    `covariance` is that of the single ones, each of `weight` complex degrees of freedom.
    """
    lines = line_weights(np.log(omega), weight, bandwidth)
    return lines @ covariance @ lines.T


def covariance_of_bands(
    first: Int[np.ndarray, " frequencies"], last: Int[np.ndarray, " frequencies"], freedom: Grid
) -> Square:
    """Of the logarithm of mean residual powers over the bins `first` to before `last`.

    Residuals of `n` bins have `freedom` complex degrees of freedom: their mean has a relative
    variance of 1 / freedom. Two bands share as much of it as they share of their bins.
    """
    count = np.maximum(last - first, 1)
    shared = np.minimum(last[:, None], last) - np.maximum(first[:, None], first)
    overlap = np.maximum(shared, 0) / np.sqrt(np.outer(count, count))
    return overlap / np.sqrt(np.outer(np.maximum(freedom, 1.0), np.maximum(freedom, 1.0)))
