"""The outputs' noise along frequency, from the residuals of local fits."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int

from ._error_covariance import ErrorCovariance
from ._local_fit import Bins, LocalFit


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

    Powers are smoothed by local lines in log-log, corrected for the bias of the logarithm of a
    chi-squared variable; correlations by positive weights, so that they stay positive semidefinite.
    Residuals larger than chance allows are left out.
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
    if np.any(known):  # Far from all known frequencies the kernel vanishes.
        isolated = np.interp(place, place[known], np.arange(np.sum(known)))
        isolated = np.abs(place - place[known][np.round(isolated).astype(int)]) > 3 * _BANDWIDTH
        nearest = [np.interp(place, place[known], column[known]) for column in smooth.T]
        smooth = np.where(isolated[:, None], np.stack(nearest, axis=1), smooth)
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
    # A single frequency has no slope: a prior on the slope keeps the line flat there.
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


_CHANCE = 1e-5  # of calling a residual a misfit
_UNKNOWN = 1e60  # error of what is not determined: infinity, but products with zero are zero


def error_covariance(
    omega: Float[np.ndarray, " frequencies"],
    fit: LocalFit,
    noise: Noise,
    at: Int[np.ndarray, " frequencies"],
    bins: Bins,
    back: Complex[np.ndarray, "frequencies 1 1"],
) -> ErrorCovariance:
    """Errors of `fit`, recoloured by `back`; `at` is the place of each frequency in `noise`.

    The atoms are the bins, each with the noise of its own frequency. Where the residual is larger
    than chance allows, the error is as much larger: it must not shrink below a local misfit.
    """
    places = np.minimum(fit.first[:, None] + np.arange(fit.effect.shape[2]), bins.omega.size - 1)
    power, each = noise.power[at], noise.power_at(bins.omega)
    colour = each[places] / power[:, None, :]
    inside = np.any(fit.effect != 0, axis=1)
    effect = fit.effect * np.exp(0.5 * np.mean(np.log(colour), axis=2))[:, None, :]
    scale = fit.boost * np.sqrt(_misfit(fit, noise, at, colour, inside))
    root = noise.root()[at] * scale[:, :, None]
    known = np.isfinite(fit.response[:, 0, 0])
    shared = _on_common_bins(np.where(known[:, None, None], effect * back, 0.0), places)
    shared[~known, :, 0] = _UNKNOWN
    kind = np.where(known[:, None, None], root, np.eye(root.shape[1]))
    return ErrorCovariance(jnp.asarray(omega), jnp.asarray(shared), jnp.asarray(kind))


def partial_coherence(
    fit: LocalFit, noise: Float[np.ndarray, "frequencies outputs"]
) -> Float[np.ndarray, "frequencies outputs inputs"]:
    """Share of each output's power that an input explains beyond the other inputs, 0 to 1."""
    known = np.isfinite(fit.response[:, 0, 0])[:, None, None]
    response = np.where(known, fit.response, 0)
    explained = np.abs(response) ** 2 * power_alone(fit)[:, None, :]
    return explained / (explained + noise[:, :, None])


def power_alone(fit: LocalFit) -> Float[np.ndarray, "frequencies inputs"]:
    """Power of each input that no other input explains; 1 where nothing is determined."""
    known = np.isfinite(fit.response[:, 0, 0])[:, None, None]
    power = np.where(known, fit.power, np.eye(fit.power.shape[1]))
    return 1 / np.real(np.diagonal(np.linalg.inv(power), axis1=1, axis2=2))


def multiple_coherence(
    fit: LocalFit, noise: Float[np.ndarray, "frequencies outputs"]
) -> Float[np.ndarray, "frequencies outputs"]:
    """Share of each output's power that all inputs together explain, 0 to 1."""
    known = np.isfinite(fit.response[:, 0, 0])[:, None, None]
    response, power = np.where(known, fit.response, 0), np.where(known, fit.power, 0)
    explained = np.real(np.einsum("foi,fij,foj->fo", response, power, np.conj(response)))
    return explained / (explained + noise)


def _misfit(
    fit: LocalFit,
    noise: Noise,
    at: Int[np.ndarray, " frequencies"],
    colour: Float[np.ndarray, "frequencies window outputs"],
    inside: np.ndarray,
) -> Float[np.ndarray, "frequencies outputs"]:
    """Ratio of residuals to the noise where it is larger than chance allows, else 1."""
    from scipy.special import fdtri

    count = np.maximum(np.sum(inside, axis=1), 1)[:, None]
    expected = noise.power[at] * np.sum(colour * inside[:, :, None], axis=1) / count
    left = np.real(np.diagonal(fit.scatter, axis1=1, axis2=2)) / expected
    freedom = 2 * np.maximum(fit.freedom, 1.0), 2 * np.maximum(noise.freedom[at], 1.0)
    return np.where(left > fdtri(*freedom, 1 - _CHANCE)[:, None], left, 1.0)


def _on_common_bins(
    effect: Complex[np.ndarray, "frequencies inputs window"],
    places: Int[np.ndarray, "frequencies window"],
) -> Complex[np.ndarray, "frequencies inputs atoms"]:
    used = np.any(effect != 0, axis=1)
    atoms, column = np.unique(places[used], return_inverse=True)
    row, step = np.nonzero(used)
    shared = np.zeros((*effect.shape[:2], max(atoms.size, 1)), complex)
    shared[row, :, column] = effect[row, :, step]
    return shared
