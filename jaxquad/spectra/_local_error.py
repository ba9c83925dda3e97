"""The random errors of local fits, and the coherence that they see."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int

from ._errors import ErrorCovariance
from ._local_bins import Bins
from ._local_fit import LocalFit
from ._local_noise import Noise


_CHANCE = 1e-5  # of taking a residual for a misfit
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
    """What each input explains of each output beyond the other inputs, from 0 to 1."""
    known = np.isfinite(fit.response[:, 0, 0])[:, None, None]
    power = np.where(known, fit.power, np.eye(fit.power.shape[1]))
    alone = 1 / np.real(np.diagonal(np.linalg.inv(power), axis1=1, axis2=2))
    explained = np.abs(np.where(known, fit.response, 0)) ** 2 * alone[:, None, :]
    return explained / (explained + noise[:, :, None])


def multiple_coherence(
    fit: LocalFit, noise: Float[np.ndarray, "frequencies outputs"]
) -> Float[np.ndarray, "frequencies outputs"]:
    """What all inputs together explain of each output, from 0 to 1."""
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
    """Ratio of residuals to the noise, where it is beyond chance; else 1."""
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
