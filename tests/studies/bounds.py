"""The Cramer-Rao bound of a plant, and the estimate that attains it, from simulations alone.

Slopes of the noise-free outputs by each parameter (central differences of the exact simulation),
whitened by the noise's own covariance. A constant offset of each output counts as unknown, and so
do the plant's own nuisances, as a drift. In a closed loop the output is that caused by the
reference, and the noise is what the loop makes of gust and sensor noise: the information that the
reference brings. Its value is that of the joint estimate with a known or an unknown controller, as
the sensitivity cancels; what the loop's own noise tells beside it (which a prediction-error method
can use) is not counted.
"""

from typing import NamedTuple

import numpy as np
from plants import Flown, Plant
from scipy.interpolate import CubicSpline
from scipy.linalg import solve_toeplitz


class Efficient(NamedTuple):
    """The best unbiased estimate, linearised at the truth: its errors have the bound's covariance.

    It knows the noise's covariance and the truth's neighbourhood, so no user can have it. Its
    errors on the very records that an estimator had say how much of that estimator's own error is
    the records' noise, which no estimator escapes, and how much is lost on the way.
    """

    mean: np.ndarray  # (samples, outputs), noise-free at the truth
    gains: np.ndarray  # (parameters, samples, outputs), from noise to errors
    bound: np.ndarray  # (parameters,), standard deviations of the errors
    dt: float  # s

    def errors(self, flown: Flown) -> np.ndarray:
        """Of the parameters, by the noise of this record; units of the parameters."""
        clean = self.mean
        if flown.time is not None:  # samples at known stamps
            clean = CubicSpline(np.arange(len(clean)) * self.dt, clean)(flown.time)
        return np.einsum("pno,no->p", self.gains, flown.y - clean)


def efficient(plant: Plant) -> Efficient:
    """Weighted least squares of the outputs, offset and nuisances projected out."""
    given = plant.bound()
    slopes = _slopes(given.mean, plant.truth)  # (samples, outputs, parameters)
    samples, outputs, count = slopes.shape
    beside = np.ones((samples, 1))
    if given.nuisances is not None:
        beside = np.concatenate([beside, given.nuisances], axis=1)
    whitener = np.linalg.inv(np.linalg.cholesky(given.shared))
    turned = np.einsum("ij,njp->nip", whitener, slopes)
    information, pulls = np.zeros((count, count)), np.empty((count, samples, outputs))
    for output in range(outputs):
        columns = np.concatenate([turned[:, output], beside], axis=1)
        weighted = solve_toeplitz(given.covariances, columns)
        gram = columns.T @ weighted
        inner, cross, outer = gram[:count, :count], gram[:count, count:], gram[count:, count:]
        taken = np.linalg.solve(outer, cross.T)
        information += inner - cross @ taken
        pulls[:, :, output] = (weighted[:, :count] - weighted[:, count:] @ taken).T
    covariance = np.linalg.inv(information)
    gains = np.einsum("pq,qni,ij->pnj", covariance, pulls, whitener, optimize=True)
    return Efficient(given.mean(plant.truth), gains, np.sqrt(np.diag(covariance)), plant.dt)


def cramer_rao(plant: Plant) -> np.ndarray:
    """Least standard deviations of unbiased estimates, in the parameters' units."""
    return efficient(plant).bound


def _slopes(mean, truth: np.ndarray) -> np.ndarray:
    columns = []
    for k, value in enumerate(truth):
        step = np.zeros_like(truth)
        step[k] = 1e-4 * abs(value)
        columns.append((mean(truth + step) - mean(truth - step)) / (2 * step[k]))
    return np.stack(columns, axis=-1)
