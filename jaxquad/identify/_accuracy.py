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


class Noise(NamedTuple):
    """What the noise does: J'W S W J of data and of priors, and its share of the cost."""

    data: Matrix
    priors: Matrix
    cost: float  # expected cost of the noise before any parameter is fitted to it


def noise_effect(blocks: list[Block], known: Known, count: int) -> Noise:
    """The responses' errors, with all their correlation, seen through weights and slopes."""
    data, cost = np.zeros((count, count)), 0.0
    for block in blocks:
        weighted = block.weights[..., None] ** 2 * block.slopes[..., :count]
        # Circular noise: real and imaginary parts share Im S with opposite signs.
        complex_slopes = weighted[:, 0] + 1j * weighted[:, 1]
        data += 0.5 * np.real(complex_slopes.conj().T @ block.covariance @ complex_slopes)
        cost += float(np.sum(block.weights**2 * block.error[:, None] ** 2))
    return Noise(data, known.slopes[:, :count].T @ known.slopes[:, :count], cost)


def calibrated_covariance(bread: Matrix, noise: Noise, inflation: float = 1.0) -> Matrix:
    """Sandwich covariance: (J'WJ)^-1 J'W S W J (J'WJ)^-1, S the covariance of the errors.

    It holds for any weights, and counts neighbouring frequencies that share their noise once only.
    `inflation` multiplies S.
    """
    inverse = scaled_inverse(bread)
    return inverse @ (inflation * noise.data + noise.priors) @ inverse


def misfit_ratio(cost: float, bread: Matrix, noise: Noise) -> float:
    """The data's cost over what noise alone would leave of it: about 1 for the right model."""
    fitted = float(np.trace(scaled_inverse(bread) @ noise.data))
    return cost / max(noise.cost - fitted, 1e-300)


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
