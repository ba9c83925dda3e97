"""What a person would write with scipy: spectra by Welch's method, least squares on logarithms.

The response is S_yx S_ux^-1, with x the references where there are any, else the inputs: unbiased
in a closed loop, too. Hann windows of a fifth of the record, 80 % overlapping; frequencies of
the excitation, for single inputs where the coherence exceeds .6. Half a hold is known to be a
delay. Standard errors are those of `scipy.optimize.curve_fit`: residual variance times the inverse
normal matrix.
"""

import numpy as np
from plants import Flown, Plant
from scipy import optimize, signal


def fit(plant: Plant, flown: Flown) -> tuple[np.ndarray, np.ndarray]:
    """Values and standard errors."""
    omega, measured, used = _response(plant, flown)
    used = used & (np.abs(plant.kind.matrices(plant.truth).response(omega)) > 0)
    signs = np.sign(plant.truth)

    def residuals(logs):
        model = plant.kind.matrices(signs * np.exp(logs)).response(omega)
        model = model * np.exp(-0.5j * omega * (plant.held or 0.0))[:, None, None]
        ratio = np.log(measured[used] / model[used])
        return np.concatenate([np.real(ratio), np.imag(ratio)])

    start = np.log(np.abs(plant.truth))  # the truth: no local minimum spoils the comparison
    found = optimize.least_squares(residuals, start, x_scale=0.1)
    values = signs * np.exp(found.x)
    variance = 2 * found.cost / (len(found.fun) - len(values))
    covariance = variance * np.linalg.pinv(found.jac.T @ found.jac)
    return values, np.abs(values) * np.sqrt(np.diag(covariance))


def _response(plant: Plant, flown: Flown):
    window, rate = len(flown.u) // 5, 1 / plant.dt
    overlap = window * 4 // 5
    x = flown.u if flown.r is None else flown.r
    csd = lambda c, d: signal.csd(c, d, fs=rate, nperseg=window, noverlap=overlap)[1]
    cross = lambda a: np.stack([[csd(c, d) for c in x.T] for d in a.T]).transpose(2, 0, 1)
    omega = 2 * np.pi * signal.welch(x[:, 0], fs=rate, nperseg=window, noverlap=overlap)[0]
    inside = (omega >= plant.band[0]) & (omega <= plant.band[1])
    to_y, to_u = cross(flown.y)[inside], cross(flown.u)[inside]
    measured = to_y @ np.linalg.inv(to_u)
    if x.shape[1] > 1:
        return omega[inside], measured, np.ones(measured.shape, bool)
    first = x[:, 0], flown.y[:, 0]
    coherence = signal.coherence(*first, fs=rate, nperseg=window, noverlap=overlap)[1]
    used = (coherence[inside] > 0.6)[:, None, None]
    return omega[inside], measured, used if used.sum() > 4 else np.ones_like(used)
