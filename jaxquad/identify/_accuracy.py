"""From the derivatives at the solution to covariances, bounds and conditioning (host side)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float


Matrix = Float[np.ndarray, "parameters parameters"]


class Block(NamedTuple):
    """One response pair: slopes of ln-magnitude and phase, their weights, and the noise."""

    misfit: Float[np.ndarray, "frequencies 2"]
    slopes: Float[np.ndarray, "frequencies 2 all"]
    weights: Float[np.ndarray, "frequencies 2"]
    error: Float[np.ndarray, " frequencies"]  # random error relative to the model
    covariance: Complex[np.ndarray, "frequencies frequencies"]  # of the relative error


class Known(NamedTuple):
    """Prior knowledge, in standard errors."""

    misfit: Float[np.ndarray, " priors"]
    slopes: Float[np.ndarray, "priors all"]


def gauss_newton(blocks: list[Block], known: Known, count: int) -> tuple[Matrix, np.ndarray]:
    """`J'J` and `J'r` of the weighted residuals over the free parameters."""
    jacobian = [known.slopes[:, :count]]
    residual = [known.misfit]
    for block in blocks:
        weighted = block.weights[..., None] * block.slopes[..., :count]
        jacobian.append(weighted.reshape(-1, count))
        residual.append((block.weights * block.misfit).reshape(-1))
    j, r = np.concatenate(jacobian), np.concatenate(residual)
    return j.T @ j, j.T @ r


def calibrated_covariance(
    blocks: list[Block], known: Known, count: int, inflation: float = 1.0
) -> Matrix:
    """Sandwich covariance: what the measured noise, with all its correlation, does to the fit.

    (J'WJ)^-1 J'W S W J (J'WJ)^-1 with S the covariance of the responses' errors. It holds for any
    weights, and counts neighbouring frequencies that share their noise once only. `inflation`
    multiplies S.
    """
    bread, _ = gauss_newton(blocks, known, count)
    meat = known.slopes[:, :count].T @ known.slopes[:, :count]
    for block in blocks:
        weighted = block.weights[..., None] ** 2 * block.slopes[..., :count]
        # Circular noise: real and imaginary parts share Im S with opposite signs.
        complex_slopes = weighted[:, 0] + 1j * weighted[:, 1]
        noise = np.real(complex_slopes.conj().T @ block.covariance @ complex_slopes)
        meat = meat + 0.5 * inflation * noise
    inverse = scaled_inverse(bread)
    return inverse @ meat @ inverse


def scaled_inverse(matrix: Matrix) -> Matrix:
    """Pseudo-inverse after unit scaling of the diagonal."""
    scale = np.sqrt(np.diagonal(matrix))
    scale = np.where(scale > 0, scale, 1.0)
    unit = matrix / np.outer(scale, scale)
    return np.linalg.pinv(unit, rcond=1e-13, hermitian=True) / np.outer(scale, scale)


def information_root(blocks: list[Block]) -> Float[np.ndarray, "rows all"]:
    """Slopes over the random error: its singular values say what the record determines."""
    rows = [
        (np.where(block.weights > 0, 1.0, 0.0) / block.error[:, None])[..., None] * block.slopes
        for block in blocks
    ]
    return np.concatenate([row.reshape(-1, row.shape[-1]) for row in rows])


def chi_squared(blocks: list[Block], known: Known, count: int) -> float:
    """Squared misfit over random error, per degree of freedom: 1 where the model is right."""
    used = [block.weights > 0 for block in blocks]
    total = float(np.sum(known.misfit**2))
    for block, mask in zip(blocks, used, strict=True):
        total += float(np.sum((block.misfit / block.error[:, None])[mask] ** 2))
    freedom = sum(int(mask.sum()) for mask in used) + len(known.misfit) - count
    return total / max(freedom, 1)


def cramer_rao(bread: Matrix) -> Float[np.ndarray, " parameters"]:
    """CIFER's Cramer-Rao bound 2 sqrt((H^-1)_ii) with H = d2J/dz2 = 2 J'J."""
    return 2 * np.sqrt(np.diagonal(scaled_inverse(2 * bread)))


def insensitivity(bread: Matrix) -> Float[np.ndarray, " parameters"]:
    """CIFER's insensitivity 1 / sqrt(H_ii) with H = d2J/dz2 = 2 J'J."""
    return 1 / np.sqrt(np.maximum(2 * np.diagonal(bread), 1e-300))


def condition_number(bread: Matrix) -> float:
    """Condition of the weighted Jacobian with columns of unit length."""
    scale = np.sqrt(np.maximum(np.diagonal(bread), 1e-300))
    values = np.linalg.eigvalsh(bread / np.outer(scale, scale))
    return float(np.sqrt(values[-1] / max(values[0], 1e-30 * values[-1])))
