"""How well an estimated noise power is known: on how many independent values it rests."""

import functools as ft
import inspect
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int

from ._windows import leaked_power


Grid = Float[np.ndarray, " frequencies"]
Square = Float[np.ndarray, "frequencies frequencies"]
Function = TypeVar("Function", bound=Callable)
BANDWIDTH = 0.2  # of the smoothing, in ln(omega)
_FEW = 256  # frequencies, of which a square takes half a megabyte


def kept_if_few(function: Function, frequencies: int) -> Function:
    """The function with its `ft.lru_cache` for few frequencies, else without: squares are large."""
    return function if frequencies <= _FEW else inspect.unwrap(function)


def kernels(omega: Grid) -> Float[np.ndarray, "3 frequencies frequencies"]:
    """Weights of neighbours, times 1, the distance in ln(omega) and its square."""
    return kept_if_few(_kernels, omega.size)(tuple(omega.tolist()))


@ft.lru_cache(maxsize=4)
def _kernels(omega: tuple[float, ...]) -> Float[np.ndarray, "3 frequencies frequencies"]:
    place = np.log(omega)
    offset = place[None, :] - place[:, None]
    kernel = np.exp(-0.5 * (offset / BANDWIDTH) ** 2)
    return np.stack([kernel, kernel * offset, kernel * offset**2])


def _line_weights(omega: Grid, weight: Grid) -> Square:
    """Weights of the values in local straight lines along ln(omega); each row sums to one."""
    near = kernels(omega)
    m0, m1, m2 = (near @ weight)[:, :, None]
    # A single frequency has no slope: the small term keeps the line flat there.
    spread = m2 + 1e-3 * BANDWIDTH**2 * m0 + 1e-300
    size = spread * m0 - m1**2 + 1e-300
    return (near[0] * (spread / size) - near[1] * (m1 / size)) * weight


def smoothed(omega: Grid, covariance: Square, weight: Grid) -> Square:
    """Covariance of the logarithm of noise powers after smoothing along frequency.

    `covariance` is that of the single ones, each of `weight` complex degrees of freedom.
    """
    lines = _line_weights(omega, weight)
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
    angles, shared = tuple(angle.tolist()), kept_if_few(_shared_power, angle.size)
    parts = (
        shared(shape, length, angles) * level * level[:, None]
        for level, length in zip(levels.T, lengths, strict=True)
    )
    return ft.reduce(np.add, parts)


@ft.lru_cache(maxsize=12)
def _shared_power(shape: str, length: int, angle: tuple[float, ...]) -> Square:
    """What windows of this length have in common at two frequencies, in rad per sample."""
    places = np.array(angle)
    return leaked_power(shape, length, places[:, None] - places)
