"""The covariance of the outputs' noise, from what is left of their windows."""

import numpy as np
from jaxtyping import Complex, Float

from ._leakage import Rest
from ._noise_freedom import kernels


_FLOOR = 1e-26  # of the output's power: below it lies rounding

Levels = Float[np.ndarray, "frequencies outputs groups"]


def noise_root(
    omega: Float[np.ndarray, " frequencies"], rest: Rest, outputs: Levels, weights: Levels
) -> Complex[np.ndarray, "frequencies outputs outputs"]:
    """Hermitian root of the covariance of the noise, from the residuals, smooth along frequency.

    `outputs` are the outputs' own energies, and `weights` says how much a length counts.
    """
    freedom = rest.freedom
    near = kernels(omega)
    energy = np.real(np.einsum("foog->fog", rest.products))
    # The logarithm of a chi-squared variable is biased by digamma(f) - ln(f).
    low = -1 / (2 * freedom) - 1 / (12 * freedom**2)
    levels = np.log(np.maximum(energy, _FLOOR * outputs + 1e-280) / rest.trace) - low
    level, weight = np.sum(weights * levels, axis=2), np.sum(weights * freedom, axis=2)
    root = np.exp(_local_lines(near, level, weight) / 2)
    if root.shape[1] == 1:
        return root[:, :, None].astype(complex)
    scale = np.sqrt(np.mean(weights, axis=1, keepdims=True) / (energy + 1e-280))
    unit = np.sum(np.conj(rest.products) * (scale[:, :, None] * scale[:, None]), axis=3)
    return _hermitian_root(_coherency(near[0], unit), root)


def _local_lines(
    near: Float[np.ndarray, "3 frequencies frequencies"],
    level: Float[np.ndarray, "frequencies outputs"],
    weight: Float[np.ndarray, "frequencies outputs"],
) -> Float[np.ndarray, "frequencies outputs"]:
    """Weighted local straight lines: a power law passes unchanged."""
    outputs = weight.shape[1]
    moments = near @ np.concatenate([weight, weight * level], axis=1)
    (m0, m1, m2), (l0, l1, _) = moments[:, :, :outputs], moments[:, :, outputs:]
    # A single frequency has no slope: the small term keeps the line flat there.
    spread = m2 + 1e-9 * m0
    return (spread * l0 - m1 * l1) / (spread * m0 - m1**2)


def _coherency(
    kernel: Float[np.ndarray, "frequencies frequencies"],
    total: Complex[np.ndarray, "frequencies outputs outputs"],
) -> Complex[np.ndarray, "frequencies outputs outputs"]:
    """Correlation between the outputs' noise, of unit diagonal and positive semidefinite."""
    flat = total.reshape(len(total), -1).view(float)
    smooth = (kernel @ flat).view(complex).reshape(total.shape)
    deviation = np.sqrt(np.maximum(np.real(np.diagonal(smooth, axis1=1, axis2=2)), 1e-300))
    found = smooth / (deviation[:, :, None] * deviation[:, None, :])
    outputs = np.arange(total.shape[2])
    found[:, outputs, outputs] = 1.0  # also of an output that the inputs explain to the last digit
    return found


def _hermitian_root(
    coherency: Complex[np.ndarray, "frequencies outputs outputs"],
    root: Float[np.ndarray, "frequencies outputs"],
) -> Complex[np.ndarray, "frequencies outputs outputs"]:
    # Not Cholesky's: along frequency the root must change as slowly as the matrix does.
    values, vectors = np.linalg.eigh(coherency * (root[:, :, None] * root[:, None, :]))
    stretched = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return stretched @ np.conj(np.swapaxes(vectors, 1, 2))
