"""The outputs' noise along frequency, from the residuals of local fits."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float


_BANDWIDTH = 0.2  # of the smoothing, in ln(omega)
_UNLIKELY = 1e-4  # chance at which a residual counts as a misfit, or a line in the noise


class Noise(NamedTuple):
    """Noise covariance of the outputs at rising frequencies, power laws between them."""

    omega: Float[np.ndarray, " frequencies"]  # rad/s
    power: Float[np.ndarray, "frequencies outputs"]
    correlation: Complex[np.ndarray, "frequencies outputs outputs"]
    freedom: Float[np.ndarray, " frequencies"]  # complex degrees of freedom behind a power

    def power_at(self, omega: Float[np.ndarray, " bins"]) -> Float[np.ndarray, "bins outputs"]:
        """Powers at other frequencies; beyond the ends, those at the ends."""
        place, known = np.log(omega), np.log(self.omega)
        columns = [np.interp(place, known, column) for column in np.log(self.power).T]
        return np.exp(np.stack(columns, axis=1))

    def root(self) -> Complex[np.ndarray, "frequencies outputs outputs"]:
        """Roots of the covariances, which change along frequency as slowly as they do."""
        values, vectors = np.linalg.eigh(self.correlation)
        stretched = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        root = stretched @ np.conj(np.swapaxes(vectors, 1, 2))
        return np.sqrt(self.power)[:, :, None] * root


def smooth_noise(
    omega: Float[np.ndarray, " frequencies"],
    half_width: Float[np.ndarray, " frequencies"],
    scatter: Complex[np.ndarray, "frequencies outputs outputs"],
    freedom: Float[np.ndarray, " frequencies"],
) -> Noise:
    """Smooth residual covariances, each of `freedom` complex degrees of freedom, along frequency.

    Powers by local lines in log-log, less the bias of the logarithm of a chi-squared variable;
    correlations by positive weights, so that they stay positive semidefinite. Where a residual is
    larger than chance allows it takes no part.
    """
    from scipy.special import digamma, gammaincinv

    known = freedom > 0
    freedom = np.where(known, freedom, 1.0)
    raw = np.real(np.diagonal(scatter, axis1=1, axis2=2))
    raw = np.where(known[:, None], np.maximum(raw, 1e-300), 1.0)
    bias = (digamma(freedom) - np.log(freedom))[:, None]
    high = np.log(gammaincinv(freedom, 1 - _UNLIKELY) / freedom)[:, None]
    place, level = np.log(omega), np.log(raw) - bias
    weight = np.where(known, freedom, 0.0)[:, None] * np.ones_like(level)
    smooth = _local_lines(place, level, weight)
    for _ in range(3):
        outlier = known[:, None] & (np.log(raw) > smooth + high)
        smooth = _local_lines(place, level, np.where(outlier, 1e-9 * weight, weight))
    if np.any(known):  # Far from all that is known the kernel fades to nothing.
        lone = np.interp(place, place[known], np.arange(np.sum(known)))
        lone = np.abs(place - place[known][np.round(lone).astype(int)]) > 3 * _BANDWIDTH
        nearest = [np.interp(place, place[known], column[known]) for column in smooth.T]
        smooth = np.where(lone[:, None], np.stack(nearest, axis=1), smooth)
    freedom = np.where(known, freedom, 0.0)
    windows = 1 + np.sqrt(np.pi) * _BANDWIDTH * omega / half_width
    correlation = _correlation(place, scatter, raw, freedom)
    return Noise(omega, np.exp(smooth), correlation, freedom * windows)


def _local_lines(
    place: Float[np.ndarray, " frequencies"],
    level: Float[np.ndarray, "frequencies outputs"],
    weight: Float[np.ndarray, "frequencies outputs"],
) -> Float[np.ndarray, "frequencies outputs"]:
    offset = place[None, :] - place[:, None]
    kernel = np.exp(-0.5 * (offset / _BANDWIDTH) ** 2)
    m0, m1, m2 = ((kernel * offset**k) @ weight for k in (0, 1, 2))
    l0, l1 = ((kernel * offset**k) @ (weight * level) for k in (0, 1))
    # A lone frequency has no slope: a prior on it keeps the line flat there.
    spread = m2 + 1e-3 * _BANDWIDTH**2 * m0 + 1e-300
    return (spread * l0 - m1 * l1) / (spread * m0 - m1**2 + 1e-300)


def _correlation(
    place: Float[np.ndarray, " frequencies"],
    scatter: Complex[np.ndarray, "frequencies outputs outputs"],
    power: Float[np.ndarray, "frequencies outputs"],
    weight: Float[np.ndarray, " frequencies"],
) -> Complex[np.ndarray, "frequencies outputs outputs"]:
    offset = place[None, :] - place[:, None]
    kernel = weight[None, :] * np.exp(-0.5 * (offset / _BANDWIDTH) ** 2)
    size = np.sqrt(power)
    normal = np.where(weight[:, None, None] > 0, scatter, 0) / (size[:, :, None] * size[:, None, :])
    mixed = np.einsum("fg,gop->fop", kernel, normal) + 1e-12 * np.eye(power.shape[1])
    size = np.sqrt(np.real(np.diagonal(mixed, axis1=1, axis2=2)))
    return mixed / (size[:, :, None] * size[:, None, :])
