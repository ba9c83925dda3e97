"""The Cramer-Rao bound of a plant, from simulations alone.

Slopes of the noise-free outputs by each parameter (central differences of the exact simulation),
whitened by the noise's own covariance. A constant offset of each output counts as unknown. In a
closed loop the output is that caused by the reference, and the noise is what the loop makes of
gust and sensor noise: the information that the reference brings. Its value is that of the joint
estimate with a known or an unknown controller, as the sensitivity cancels; what the loop's own
noise tells beside it (which a prediction-error method can use) is not counted.
"""

import numpy as np
from plants import Plant
from scipy.linalg import solve_toeplitz


def cramer_rao(plant: Plant) -> np.ndarray:
    """Least standard deviations of unbiased estimates, in the parameters' units."""
    given = plant.bound()
    slopes = _slopes(given.mean, plant.truth)  # (samples, outputs, parameters)
    samples, outputs, count = slopes.shape
    beside = np.ones((samples, 1))
    if given.nuisances is not None:
        beside = np.concatenate([beside, given.nuisances], axis=1)
    whitener = np.linalg.inv(np.linalg.cholesky(given.shared))
    turned = np.einsum("ij,njp->nip", whitener, slopes)
    information = np.zeros((count, count))
    for output in range(outputs):
        columns = np.concatenate([turned[:, output], beside], axis=1)
        gram = columns.T @ solve_toeplitz(given.covariances, columns)
        inner, cross, outer = gram[:count, :count], gram[:count, count:], gram[count:, count:]
        information += inner - cross @ np.linalg.solve(outer, cross.T)
    return np.sqrt(np.diag(np.linalg.inv(information)))


def _slopes(mean, truth: np.ndarray) -> np.ndarray:
    columns = []
    for k, value in enumerate(truth):
        step = np.zeros_like(truth)
        step[k] = 1e-4 * abs(value)
        columns.append((mean(truth + step) - mean(truth - step)) / (2 * step[k]))
    return np.stack(columns, axis=-1)
