"""Period averages of several realisations: their response, and what scatters around it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from ._local_noise import smooth_noise
from ._periodic import Periods, pooled


_DEPENDENT = 1e-8  # smallest singular value of the inputs' cross powers, to the largest
_ROUNDING = 1e-24  # power of rounding errors, to that of the output
_CHANCE = 1e-4  # of finding distortion in mere noise, or a line in smooth noise

Lines = Int[np.ndarray, " frequencies"]
Averaged = Complex[np.ndarray, "frequencies channels realisations"]
Levels = Float[np.ndarray, "frequencies outputs"]
Covariances = Complex[np.ndarray, "frequencies outputs outputs"]


class Averages(NamedTuple):
    """The error of `response` is `sum_r v[f, o, r] effect[f, i, r]`, v the averages' noise."""

    u: Complex[np.ndarray, "frequencies inputs realisations"]
    y: Complex[np.ndarray, "frequencies outputs realisations"]
    response: Complex[np.ndarray, "frequencies outputs inputs"]
    effect: Complex[np.ndarray, "frequencies inputs realisations"]
    known: Bool[np.ndarray, " frequencies"]


class Scatter(NamedTuple):
    """Powers per line of the averages over a record's periods, smooth along frequency."""

    noise: Levels
    total: Levels | None  # of one realisation more than inputs, or more
    significant: Bool[np.ndarray, " outputs"]
    root: Covariances  # of the larger of the two that counts
    periods: float  # to an average

    def nonlinear(self) -> Levels:
        """Power that the noise does not explain."""
        total = self.noise if self.total is None else self.total
        return np.maximum(total - self.noise, 0.0)


def instrumental(u: Averaged, y: Averaged, z: Averaged) -> Averages:
    """G = Y Z^H (U Z^H)^-1 at each line."""
    adjoint = np.conj(np.swapaxes(z, 1, 2))
    cross = u @ adjoint
    size = np.linalg.norm(u, axis=2)[:, :, None] * np.linalg.norm(z, axis=2)[:, None, :]
    strength = np.linalg.svd(cross / np.maximum(size, 1e-300), compute_uv=False)
    known = strength[:, -1] > _DEPENDENT * np.maximum(strength[:, 0], 1e-300)
    inverse = np.linalg.inv(np.where(known[:, None, None], cross, np.eye(u.shape[1])))
    effect = np.swapaxes(adjoint @ inverse, 1, 2)
    response = np.swapaxes(effect @ np.swapaxes(y, 1, 2), 1, 2)
    return Averages(u, y, response, effect, known)


def judge_scatter(
    omega: Float[np.ndarray, " frequencies"],
    fit: Averages,
    periods: Sequence[Periods],
    lines: Lines,
) -> Scatter:
    """Noise from period to period, seen through v = y - G u, and scatter between realisations.

    With input noise and feedback, v is what perturbs G: its variance is that of Pintelon and
    Schoukens, eq. 2-25, with the covariance of input and output.
    """
    from scipy.special import fdtri

    inputs, outputs = fit.u.shape[1], fit.y.shape[1]
    count = 1 / float(np.mean([1 / each.count for each in periods]))
    freedom = float(sum(each.count - 1 for each in periods))
    left = np.concatenate(
        [-fit.response, np.broadcast_to(np.eye(outputs), (len(lines), outputs, outputs))], axis=2
    )
    channels = slice(0, inputs + outputs)
    covariance = pooled(periods)[lines][:, channels, channels] / count
    noise = left @ covariance @ np.conj(np.swapaxes(left, 1, 2))
    power, root = _smooth(omega, noise, freedom, fit.known)
    spare = float(fit.u.shape[2] - inputs)
    if spare <= 0:
        return Scatter(power, None, np.zeros(outputs, bool), root, count)
    residual = fit.y - fit.response @ fit.u
    between = residual @ np.conj(np.swapaxes(residual, 1, 2)) / spare
    total, total_root = _smooth(omega, between, spare, fit.known)
    ratio = np.sum(_diagonal(between) / power * fit.known[:, None], axis=0)
    size = 2.0 * max(np.sum(fit.known), 1)
    ratio = 2 * ratio / size
    significant = ratio > fdtri(size * spare, size * freedom, 1 - _CHANCE)
    # Rounding errors repeat from period to period, and not from one realisation to the next.
    output = np.mean(np.abs(fit.y) ** 2, axis=(0, 2))
    significant &= np.mean(_diagonal(between), axis=0) > _ROUNDING * output
    if np.any(significant):
        larger = np.sqrt(np.maximum(power, total) / total)
        return Scatter(power, total, significant, total_root * larger[:, :, None], count)
    return Scatter(power, total, significant, root, count)


def _smooth(
    omega: Float[np.ndarray, " frequencies"],
    covariance: Covariances,
    freedom: float,
    known: Bool[np.ndarray, " frequencies"],
) -> tuple[Levels, Covariances]:
    """Powers and roots, smooth along frequency but for lines that stand out."""
    from scipy.special import gammaincinv

    spacing = np.gradient(omega) if omega.size > 1 else omega
    smooth = smooth_noise(omega, spacing, covariance, np.where(known, freedom, 0.0))
    raw = _diagonal(covariance)
    high = gammaincinv(freedom, 1 - _CHANCE) / freedom
    power = np.where(raw > high * smooth.power, raw, smooth.power)
    return power, smooth._replace(power=power).root()


def _diagonal(x: Covariances) -> Levels:
    return np.real(np.diagonal(x, axis1=1, axis2=2))
