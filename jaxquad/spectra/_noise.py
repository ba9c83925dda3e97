"""The outputs' noise, smooth along frequency, and how well its power is known."""

import functools as ft
import inspect
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Complex, Float, Int

from ._fourier_sums import coefficients
from ._leakage import Rest


Grid = Float[np.ndarray, " frequencies"]
Square = Float[np.ndarray, "frequencies frequencies"]
Levels = Float[np.ndarray, "frequencies outputs"]
Groups = Float[np.ndarray, "frequencies outputs groups"]
Covariances = Complex[np.ndarray, "frequencies outputs outputs"]
Function = TypeVar("Function", bound=Callable)

_BANDWIDTH = 0.2  # of the smoothing, in ln(omega)
_WIDE = 2.0  # that of the correlations between outputs in open loop
_UNLIKELY = 1e-4  # chance at which a residual counts as a misfit, or a line in the noise
_FLOOR = 1e-26  # of the output's power: below it lies rounding
_NEAR = 1e-2  # of a pole: its neighbourhood's rounding is below 1e-13
_FEW = 256  # frequencies, of which a square takes half a megabyte


class Noise(NamedTuple):
    """Noise covariance of the outputs at rising frequencies, power laws between them."""

    omega: Grid  # rad/s
    power: Levels
    correlation: Covariances
    freedom: Grid  # complex degrees of freedom behind a power

    def power_at(self, omega: Float[np.ndarray, " bins"]) -> Float[np.ndarray, "bins outputs"]:
        """Powers at other frequencies; beyond the ends, those at the ends."""
        place, grid = np.log(omega), np.log(self.omega)
        columns = [np.interp(place, grid, column) for column in np.log(self.power).T]
        return np.exp(np.stack(columns, axis=1))

    def root_at(
        self, omega: Float[np.ndarray, " bins"]
    ) -> Complex[np.ndarray, "bins outputs outputs"]:
        """Roots of the covariances at other frequencies, correlated as at the nearest one."""
        near = np.searchsorted(np.sqrt(self.omega[1:] * self.omega[:-1]), omega)
        scale = np.sqrt(self.power_at(omega) / self.power[near])
        return self.root()[near] * scale[:, :, None]

    def root(self) -> Covariances:
        """Roots of the covariances, which change along frequency as slowly as they do."""
        return np.sqrt(self.power)[:, :, None] * _hermitian_root(self.correlation)


def _hermitian_root(covariance: Covariances) -> Covariances:
    # Not Cholesky's: along frequency the root must change as slowly as the matrix does.
    values, vectors = np.linalg.eigh(covariance)
    stretched = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return stretched @ np.conj(np.swapaxes(vectors, 1, 2))


def smooth_noise(
    omega: Grid, half_width: Grid, scatter: Covariances, freedom: Grid, *, open_loop: bool = False
) -> Noise:
    """Smooth residual covariances, each of `freedom` complex degrees of freedom, along frequency.

    Powers are smoothed by local lines in log-log, corrected for the bias of the logarithm of a
    chi-squared variable; correlations by positive weights, so that they stay positive semidefinite.
    Residuals larger than chance allows are left out. Outputs in `open_loop` are correlated as in a
    wide band, as far as the narrow ones agree with it.
    """
    from scipy.special import digamma, gammaincinv

    finite = freedom > 0
    freedom = np.where(finite, freedom, 1.0)
    raw = np.real(np.diagonal(scatter, axis1=1, axis2=2))
    raw = np.where(finite[:, None], np.maximum(raw, 1e-300), 1.0)
    bias = (digamma(freedom) - np.log(freedom))[:, None]
    high = np.log(gammaincinv(freedom, 1 - _UNLIKELY) / freedom)[:, None]
    place, level = np.log(omega), np.log(raw) - bias
    weight = np.where(finite, freedom, 0.0)[:, None] * np.ones_like(level)
    smooth = _local_lines(place, level, weight)
    for _ in range(3):
        outlier = finite[:, None] & (np.log(raw) > smooth + high)
        smooth = _local_lines(place, level, np.where(outlier, 1e-9 * weight, weight))
    if np.any(finite):  # Far from all determined frequencies the kernel vanishes.
        isolated = np.interp(place, place[finite], np.arange(np.sum(finite)))
        isolated = np.abs(place - place[finite][np.round(isolated).astype(int)]) > 3 * _BANDWIDTH
        nearest = [np.interp(place, place[finite], column[finite]) for column in smooth.T]
        smooth = np.where(isolated[:, None], np.stack(nearest, axis=1), smooth)
    freedom = np.where(finite, freedom, 0.0)
    counts = freedom * (1 + np.sqrt(np.pi) * _BANDWIDTH * omega / half_width)
    correlation = _correlation(place, scatter, raw, freedom, _BANDWIDTH)
    if open_loop and raw.shape[1] > 1:
        # Wide ones where the narrow ones differ from them by chance, towards the narrow ones as the
        # squared differences grow to twice that: a complex correlation r of n complex degrees of
        # freedom has the variance (1 - |r|^2) / n.
        wide = _correlation(place, scatter, raw, counts, _WIDE)
        distance = np.sum(counts[:, None, None] * np.abs(correlation - wide) ** 2)
        chance = np.sum((1 - np.abs(wide) ** 2)[counts > 0])
        share = np.clip(distance / max(float(chance), 1e-300) - 1, 0.0, 1.0)
        correlation = wide + share * (correlation - wide)
    return Noise(omega, np.exp(smooth), correlation, counts)


def _local_lines(place: Grid, level: Levels, weight: Levels) -> Levels:
    """Weighted local straight lines along ln(omega)."""
    offset = place[None, :] - place[:, None]
    kernel = np.exp(-0.5 * (offset / _BANDWIDTH) ** 2)
    m0, m1, m2 = ((kernel * offset**k) @ weight for k in (0, 1, 2))
    l0, l1 = ((kernel * offset**k) @ (weight * level) for k in (0, 1))
    # A single frequency has no slope: a prior on the slope keeps the line flat there.
    spread = m2 + 1e-3 * _BANDWIDTH**2 * m0 + 1e-300
    return (spread * l0 - m1 * l1) / (spread * m0 - m1**2 + 1e-300)


def _correlation(
    place: Grid, scatter: Covariances, power: Levels, weight: Grid, bandwidth: float
) -> Covariances:
    offset = place[None, :] - place[:, None]
    kernel = weight[None, :] * np.exp(-0.5 * (offset / bandwidth) ** 2)
    size = np.sqrt(power)
    normal = np.where(weight[:, None, None] > 0, scatter, 0) / (size[:, :, None] * size[:, None, :])
    mixed = np.einsum("fg,gop->fop", kernel, normal) + 1e-12 * np.eye(power.shape[1])
    size = np.sqrt(np.real(np.diagonal(mixed, axis1=1, axis2=2)))
    return mixed / (size[:, :, None] * size[:, None, :])


def noise_root(omega: Grid, rest: Rest, outputs: Groups, weights: Groups) -> Covariances:
    """Hermitian root of the noise's covariance, from what is left of the outputs' windows.

    It is smooth along frequency: local straight lines, which leave a power law unchanged.
    `outputs` are the outputs' own energies, and `weights` says how much a length counts.
    """
    freedom = rest.freedom
    near = _kernels(omega)
    energy = np.real(np.einsum("foog->fog", rest.products))
    # The logarithm of a chi-squared variable is biased by digamma(f) - ln(f).
    low = -1 / (2 * freedom) - 1 / (12 * freedom**2)
    levels = np.log(np.maximum(energy, _FLOOR * outputs + 1e-280) / rest.trace) - low
    level, weight = np.sum(weights * levels, axis=2), np.sum(weights * freedom, axis=2)
    count = weight.shape[1]
    moments = near @ np.concatenate([weight, weight * level], axis=1)
    (m0, m1, m2), (l0, l1, _) = moments[:, :, :count], moments[:, :, count:]
    # A single frequency has no slope: the small term keeps the line flat there.
    spread = m2 + 1e-9 * m0
    root = np.exp((spread * l0 - m1 * l1) / (spread * m0 - m1**2) / 2)
    if count == 1:
        return root[:, :, None].astype(complex)
    scale = np.sqrt(np.mean(weights, axis=1, keepdims=True) / (energy + 1e-280))
    unit = np.sum(np.conj(rest.products) * (scale[:, :, None] * scale[:, None]), axis=3)
    smooth = (near[0] @ unit.reshape(len(unit), -1).view(float)).view(complex).reshape(unit.shape)
    deviation = np.sqrt(np.maximum(np.real(np.diagonal(smooth, axis1=1, axis2=2)), 1e-300))
    coherency = smooth / (deviation[:, :, None] * deviation[:, None, :])
    diagonal = np.arange(count)
    coherency[:, diagonal, diagonal] = 1.0  # also of an output that the inputs explain exactly
    return _hermitian_root(coherency * (root[:, :, None] * root[:, None, :]))


def kept_if_few(function: Function, frequencies: int) -> Function:
    """The function with its `ft.lru_cache` for few frequencies, else without: squares are large."""
    return function if frequencies <= _FEW else inspect.unwrap(function)


def _kernels(omega: Grid) -> Float[np.ndarray, "3 frequencies frequencies"]:
    """Weights of neighbours, times 1, the distance in ln(omega) and its square."""
    return kept_if_few(_kernels_of, omega.size)(tuple(omega.tolist()))


@ft.lru_cache(maxsize=4)
def _kernels_of(omega: tuple[float, ...]) -> Float[np.ndarray, "3 frequencies frequencies"]:
    place = np.log(omega)
    offset = place[None, :] - place[:, None]
    kernel = np.exp(-0.5 * (offset / _BANDWIDTH) ** 2)
    return np.stack([kernel, kernel * offset, kernel * offset**2])


def smoothed(omega: Grid, covariance: Square, weight: Grid) -> Square:
    """Covariance of the logarithm of noise powers after smoothing along frequency.

    `covariance` is that of the single ones, each of `weight` complex degrees of freedom.
    """
    near = _kernels(omega)
    m0, m1, m2 = (near @ weight)[:, :, None]
    # A single frequency has no slope: the small term keeps the line flat there.
    spread = m2 + 1e-3 * _BANDWIDTH**2 * m0 + 1e-300
    size = spread * m0 - m1**2 + 1e-300
    lines = (near[0] * (spread / size) - near[1] * (m1 / size)) * weight  # rows sum to one
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
    """Squared correlation of white noise behind windows of this length at two frequencies (rad)."""
    places = np.array(angle)
    level, cosine = coefficients(shape)
    cycles = (places[:, None] - places) * length / (2 * np.pi)
    terms = level**2 + cosine**2 / 2, level * cosine, cosine**2 / 4  # of the squared window
    # sinc(c - k) + sinc(c + k) for k = 0, 1, 2 have one sine in common, but poles at whole cycles.
    square = cycles**2
    poles = square * (square - 1) * (square - 4)
    near = np.abs(poles) < _NEAR
    poles = np.where(near, 1.0, poles)
    ratio = terms[0] * (square - 1) * (square - 4)
    ratio += 2 * square * (terms[2] * (square - 1) - terms[1] * (square - 4))
    correlation = np.sin(np.pi * cycles) * cycles * ratio / (np.pi * poles)
    close = cycles[near]
    correlation[near] = terms[0] * np.sinc(close)
    for k in (1, 2):
        correlation[near] += terms[k] * (np.sinc(close - k) + np.sinc(close + k))
    return (correlation / terms[0]) ** 2
