"""How well an estimated noise power is known: on how many independent values it rests."""

import functools as ft
import inspect
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int

from ._window import leaked_power


Grid = Float[np.ndarray, " frequencies"]
Square = Float[np.ndarray, "frequencies frequencies"]
Function = TypeVar("Function", bound=Callable)
_FEW = 256  # frequencies, of which a square takes half a megabyte


def kept_if_few(function: Function, frequencies: int) -> Function:
    """The function with its `ft.lru_cache` for few frequencies, else without: squares are large."""
    return function if frequencies <= _FEW else inspect.unwrap(function)


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


def covariance_of_windows(
    angle: Grid,
    levels: Float[np.ndarray, "frequencies groups"],
    shape: str,
    lengths: tuple[int, ...],
) -> Square:
    """Of the logarithm of mean residual powers over windows of several lengths.

    All lengths see the same noise, each with its own resolution; `levels` are the standard errors
    that they contribute. `angle` is in rad per sample.
    """
    total, angles = np.zeros((angle.size, angle.size)), tuple(angle.tolist())
    shared = kept_if_few(_shared_power, angle.size)
    for level, length in zip(levels.T, lengths, strict=True):
        total += np.outer(level, level) * shared(shape, length, angles)
    return total


@ft.lru_cache(maxsize=12)
def _shared_power(shape: str, length: int, angle: tuple[float, ...]) -> Square:
    """What windows of this length have in common at two frequencies, in rad per sample."""
    places = np.array(angle)
    return leaked_power(shape, length, places[:, None] - places)
