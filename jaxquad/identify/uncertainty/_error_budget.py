"""The error budget of a fit: noise, and what the model leaves unexplained of a response.

The logarithm of measurement over model is noise plus a discrepancy: a Gaussian process over the
logarithm of frequency, with one amplitude for all response pairs: in rad of phase, and half of it
in neper of magnitude. It walks at random and is drawn back to zero (Ornstein & Uhlenbeck), as lags,
zeros and modes make it that are missing here and there, each near its own frequency. Smoother ones
take what a band shows for a piece of a wider swing, most of which would be an error of the gain.
Amplitude and length follow from the restricted likelihood, which leaves out what the parameters can
take up themselves.
Source: Kennedy & O'Hagan (2001), Bayesian calibration of computer models; Rasmussen & Williams
(2006), Gaussian Processes for Machine Learning, sec. 4.2.1.
"""

import functools as ft
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxquad._core import pytree_node
from jaxquad.spectra import FrequencyResponse

from ..frequency_domain._cost import Mixing, Points, Weights
from ..frequency_domain._problem import Problem
from ..frequency_domain._solve import Solution
from ._accuracy import (
    Block,
    blocks_of,
    calibrated_covariance,
    gauss_newton,
    Matrix,
    Noise,
    noise_effect,
    PriorRows,
    ResponseTerm,
    scaled_inverse,
)


LENGTHS = (1.0, 3.0, 9.0)  # in ln(omega); 2.3 is a decade
MEAN = 0.05  # of the prior of the amplitude, neper
_SHAPE = 1.5  # of that prior, a gamma distribution: errors far below its mean are few
SHARES = np.array([0.5, 1.0])  # of the amplitude, in magnitude and in phase
_NONE = 0.85  # the prior's mass at a discrepancy of zero
_AMPLITUDES = 16
_RANK = 16  # of a kernel over a band of two decades: 1 to 6 % of its variance is left, the fastest
_OTHER = 3.0  # times the prior's mean: a width that follows it is the prior's
FOLLOWS = 1.25  # factor by which such a width grows
_DENSE = 256  # frequencies, up to which whole kernels are made


@pytree_node
class Discrepancy:
    """How far a model is off beyond the noise, in rad of phase; half of it in neper of magnitude.

    **Attributes:**

    - `amplitude`: root mean square of the posterior; 0.1 is 6 deg, and 5 % of magnitude.
    - `length`: over which it changes, in ln(omega).
    - `none`: the probability that the model is right.
    - `widths`: for each parameter what makes its interval as wide as it is: "noise", "data" (the
      response itself shows a discrepancy of this size), or "prior" (it shows none that the
      parameter would not take up: the width follows what models usually leave unexplained).
    """

    amplitude: float
    length: float
    none: float
    widths: tuple[str, ...] = eqx.field(static=True)


class Mixture(NamedTuple):
    """A posterior mean of squared amplitudes by length, and the probability of none."""

    powers: Float[np.ndarray, " lengths"]
    none: float

    @property
    def amplitude(self) -> float:
        return float(np.sqrt(np.sum(self.powers)))


def find_discrepancy(
    records: Sequence[ResponseTerm],
    points: Sequence[Points],
    prior: PriorRows,
    moving: Sequence[int],
) -> tuple[Mixture, Mixture]:
    """The discrepancy of a fit, under the prior and under one of a larger mean.

    `moving` are the parameters that can take up a misfit: not those that a bound holds against it.
    """
    columns = np.asarray(moving, int)
    rows = np.concatenate([prior.slopes[:, columns], prior.misfit[:, None]], axis=1)
    # Products of slopes and misfit under noise alone; along the components of the kernels, gains of
    # unit amplitude over the noise, and these products.
    products, gains, along, errors = rows.T @ rows, [], [], []
    for record, counted in zip(records, points, strict=True):
        used = record.weights[..., 0] > 0
        error = np.maximum(record.error, 1e-7)
        inverse = np.where(used, error**-2 / counted.shared, 0.0)
        rows = np.concatenate([record.slopes[..., columns], record.misfit[..., None]], axis=-1)
        rows = np.where(used[..., None, None], rows, 0.0)
        weighted = (inverse[..., None, None] * rows).reshape(-1, len(products))
        products += weighted.T @ rows.reshape(-1, len(products))
        parts = _components(np.asarray(record.frf.omega), used, inverse, rows)
        gains.append(parts[0])
        along.append(parts[1])
        errors.append(error[used])
    gains, along = np.concatenate(gains, axis=1), np.concatenate(along, axis=1)
    error = np.sort(np.concatenate(errors))  # `np.median` takes ten times as long for few values
    typical = float(0.5 * (error[error.size // 2] + error[-(error.size // 2) - 1]))
    lowest = np.log(0.1 * typical)
    amplitudes = np.exp(np.linspace(lowest, max(0.0, lowest + 1.4), _AMPLITUDES))
    power = np.concatenate([[0.0], amplitudes]) ** 2
    likelihoods = _restricted_likelihoods(products, gains, along, power[None, :, None])
    relative = np.exp(likelihoods - np.max(likelihoods))

    def mix(mean: float) -> Mixture:
        """The posterior under a mass at zero, and a gamma distribution above it."""
        cell = amplitudes * np.log(amplitudes[1] / amplitudes[0])
        density = cell * amplitudes ** (_SHAPE - 1) * np.exp(-_SHAPE * amplitudes / mean)
        density *= (1 - _NONE) / max(float(np.sum(density)), 1e-300) / len(relative)
        none, some = _NONE * relative[0, 0], relative[:, 1:] * density
        total = none + np.sum(some)
        return Mixture(np.sum(some * amplitudes**2, axis=1) / total, float(none / total))

    return mix(MEAN), mix(_OTHER * MEAN)


def _components(
    omega: np.ndarray, used: np.ndarray, inverse: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Components of the kernels in which noise and discrepancy are both diagonal."""
    pairs = np.any(used, axis=0)
    inverse, columns = inverse[:, pairs].T, np.moveaxis(columns[:, pairs], 0, 1)
    basis = kernel_basis(omega.tobytes())[:, None]  # length pair frequency rank
    weighted = np.swapaxes(basis * inverse[:, :, None], 2, 3)
    gains, turned = np.linalg.eigh(weighted @ basis)
    along = weighted @ columns.reshape(*columns.shape[:2], -1)
    along = (np.swapaxes(turned, 2, 3) @ along).reshape(*gains.shape, *columns.shape[2:])
    along = along * SHARES[:, None]
    products = along[..., :, None] * along[..., None, :]
    gains = np.maximum(gains, 0.0)[..., None] * SHARES**2
    return gains.reshape(len(basis), -1), products.reshape(len(basis), -1, columns.shape[-1] ** 2)


def _restricted_likelihoods(
    products: Float[np.ndarray, "columns columns"],
    gains: Float[np.ndarray, "lengths components"],
    along: Float[np.ndarray, "lengths components squares"],
    power: Float[np.ndarray, "1 amplitudes 1"],
) -> Float[np.ndarray, "lengths amplitudes"]:
    """Logarithms, up to a constant; the parameters' own changes are projected out."""
    damped, width = power / (1 + power * gains[:, None, :]), len(products)
    left = products - np.reshape(damped @ along, (*damped.shape[:2], width, width))
    scale = np.sqrt(np.maximum(np.diagonal(products), 1e-300))
    left = left / np.outer(scale, scale) + 1e-11 * np.eye(width)
    slopes, misfit = left[..., :-1, :-1], left[..., :-1, -1]
    step = np.linalg.solve(slopes, misfit[..., None])[..., 0]
    rest = (left[..., -1, -1] - np.sum(misfit * step, axis=-1)) * scale[-1] ** 2
    volume = np.linalg.slogdet(slopes)[1]
    grown = np.sum(np.log1p(power * gains[:, None, :]), axis=-1)
    return -0.5 * (grown + volume + rest)


@ft.lru_cache(maxsize=16)
def kernel_basis(omega: bytes) -> Float[np.ndarray, "lengths frequencies rank"]:
    """Roots of the kernels of all lengths at frequencies (the bytes of their array, rad/s).

    Where an Ornstein-Uhlenbeck process is depends on its two neighbours alone, so the inverse of
    its kernel has three diagonals, which serve for many frequencies.
    """
    place = np.log(np.frombuffer(omega))
    order = np.argsort(place)
    if place.size <= _DENSE or not np.min(np.diff(place[order])) > 1e-9:
        distance, roots = np.abs(place[:, None] - place[None, :]), []
        for length in LENGTHS:
            values, vectors = np.linalg.eigh(np.exp(-distance / length))
            root = vectors * np.sqrt(np.maximum(values, 0.0))
            roots.append(root[:, ::-1][:, :_RANK])
        return np.stack(roots)
    from scipy.linalg import eigh_tridiagonal

    roots, last = np.empty((len(LENGTHS), place.size, _RANK)), min(_RANK, place.size) - 1
    for root, length in zip(roots, LENGTHS, strict=True):
        gaps = np.diff(place[order]) / length
        passed = -np.exp(-2 * gaps) / np.expm1(-2 * gaps)  # rho^2 / (1 - rho^2) of neighbours
        diagonal = 1 + np.concatenate([passed, [0.0]]) + np.concatenate([[0.0], passed])
        neighbours = np.exp(-gaps) / np.expm1(-2 * gaps)
        values, vectors = eigh_tridiagonal(diagonal, neighbours, select="i", select_range=(0, last))
        root[order] = vectors / np.sqrt(values)
    return roots


def discrepancy_effect(
    records: Sequence[ResponseTerm], count: int
) -> Float[np.ndarray, "lengths parameters parameters"]:
    """J'W D W J of a discrepancy D of unit amplitude, for each length."""
    total = np.zeros((len(LENGTHS), count, count))
    for record in records:
        pulls = np.where(record.weights[..., None] > 0, record.pulls, 0.0)
        basis = kernel_basis(np.asarray(record.frf.omega).tobytes())
        pulls = np.reshape(pulls * SHARES[:, None], (len(pulls), -1))
        along = (np.swapaxes(basis, 1, 2) @ pulls).reshape(len(LENGTHS), -1, count)
        total += np.swapaxes(along, 1, 2) @ along
    return total


def describe_discrepancy(
    mixtures: tuple[Mixture, Mixture], bread: Matrix, noise: Matrix, effect: np.ndarray
) -> tuple[Discrepancy, Matrix]:
    """The discrepancy in words and numbers, and the covariance that it adds to the parameters."""
    inverse = scaled_inverse(bread)
    one, other = (
        inverse @ np.tensordot(mixture.powers, effect, axes=1) @ inverse for mixture in mixtures
    )
    by_noise, with_one, with_other = (
        np.sqrt(np.maximum(np.diagonal(part), 0.0)) for part in (noise, noise + one, noise + other)
    )
    widths = np.where(with_other > FOLLOWS * with_one, "prior", "data")
    widths = np.where(with_one < FOLLOWS * by_noise, "noise", widths)
    mixture = mixtures[0]
    weight = mixture.powers / max(float(np.sum(mixture.powers)), 1e-300)
    length = float(np.exp(weight @ np.log(LENGTHS)))
    return Discrepancy(mixture.amplitude, length, mixture.none, tuple(widths.tolist())), one


Units = Float[np.ndarray, " all"]


class Weighting(NamedTuple):
    """How the points of a fit count: as the noise says, and with what the model does not explain.

    `records` are at the solution, by changes relative to its own units. `weights` are those by the
    noise alone, where those of the problem have a floor on the error.
    """

    points: Sequence[Points]
    records: list[ResponseTerm]
    mixtures: tuple[Mixture, Mixture]  # what the model leaves unexplained
    weights: Sequence[Weights] | None = None
    mixings: Sequence[Mixing | None] | None = None


def weighting_at(problem: Problem, points: Sequence[Points], solution: Solution) -> Weighting:
    """The responses at a solution, and what the model leaves unexplained of them."""
    units, count = units_of(solution), solution.z.size
    records = records_of(problem, [one.frf for one in points], solution, units)
    prior, fixed = prior_rows(solution, units), set()
    if solution.at_zero:
        gradient = gauss_newton(blocks_of(records), prior, count)[1]
        fixed = {k for k in solution.at_zero if gradient[k] > 0}
    moving = [k for k in range(count) if k not in fixed]
    return Weighting(points, records, find_discrepancy(records, points, prior, moving))


class ErrorBudget(NamedTuple):
    """Derivatives and errors at a solution, by changes relative to some units."""

    records: list[ResponseTerm]
    blocks: list[Block]
    prior: PriorRows
    bread: Matrix  # J'J
    gradient: Float[np.ndarray, " parameters"]
    noise: Noise
    by_noise: Matrix  # covariance
    covariance: Matrix  # with what the model leaves unexplained
    discrepancy: Discrepancy


def error_budget(
    records: list[ResponseTerm],
    mixtures: tuple[Mixture, Mixture],
    solution: Solution,
    units: Units,
) -> ErrorBudget:
    """All of it, with these mixtures of a discrepancy; changes are relative to `units`."""
    count = solution.z.size
    blocks, prior = blocks_of(records), prior_rows(solution, units)
    bread, gradient = gauss_newton(blocks, prior, count)
    noise = noise_effect(records, blocks, prior, count)
    by_noise = calibrated_covariance(bread, noise)
    effect = discrepancy_effect(records, count)
    discrepancy, added = describe_discrepancy(mixtures, bread, by_noise, effect)
    parts = (bread, gradient, noise, by_noise, by_noise + added, discrepancy)
    return ErrorBudget(records, blocks, prior, *parts)


def units_of(solution: Solution) -> Units:
    """What relative changes are relative to: the value, or the change that shows of one at zero.

    Relative to itself, a lag at zero would look as if it had no effect, while in truth it trades
    off with the delay.
    """
    units = np.asarray(solution.slopes).copy()
    units[list(solution.at_zero)] = solution.units_at_zero
    return units


def rescale(solution: Solution, units: Units) -> Units:
    """From derivatives by z to derivatives by changes relative to `units`."""
    slopes = np.asarray(solution.slopes)
    return np.where(slopes == 0, 1.0, units / np.where(slopes == 0, 1.0, slopes))


def records_of(
    problem: Problem, frfs: Sequence[FrequencyResponse], solution: Solution, units: Units
) -> list[ResponseTerm]:
    """Misfits and slopes of each response, by changes relative to `units`."""
    scale, parts = rescale(solution, units), solution.sensitivity
    weights = [np.asarray(one) for one in problem.weights]
    misfits = [np.asarray(one) for one in parts.misfits]
    slopes = [np.asarray(one) * scale for one in parts.slopes]
    terms = zip(frfs, misfits, slopes, weights, problem.mixings, strict=True)
    return [ResponseTerm(*term, problem.parameters.count) for term in terms]


def prior_rows(solution: Solution, units: Units) -> PriorRows:
    """Those of the priors, likewise."""
    parts = solution.sensitivity
    slopes = np.asarray(parts.prior_slopes) * rescale(solution, units)
    return PriorRows(np.asarray(parts.prior_misfits), slopes)
