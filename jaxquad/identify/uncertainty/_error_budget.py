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

import dataclasses
import functools as ft
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from jaxquad._core import pytree_node
from jaxquad.spectra import FrequencyResponse

from ..frequency_domain._cost import expected_cost, mix, Mixing, Points
from ..frequency_domain._parameters import namespace_of, Numbers
from ..frequency_domain._problem import Problem
from ..frequency_domain._solve import Solution


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

Matrix = Float[np.ndarray, "parameters parameters"]
Units = Float[np.ndarray, " all"]


def units_of(solution: Solution) -> Units:
    """What relative changes are relative to: the value, or the change that shows of one at zero. A
    lag at zero would look without effect, while it trades off with the delay."""
    units = np.asarray(solution.slopes).copy()
    units[list(solution.at_zero)] = solution.units_at_zero
    return units


def rescale(solution: Solution, units: Units) -> Units:
    """From derivatives by z to derivatives by changes relative to `units`."""
    slopes = np.asarray(solution.slopes)
    return np.where(slopes == 0, 1.0, units / np.where(slopes == 0, 1.0, slopes))


class PriorRows(NamedTuple):
    """Prior knowledge, in standard errors, by relative changes."""

    misfit: Float[np.ndarray, " priors"]
    slopes: Float[np.ndarray, "priors all"]


def prior_rows(solution: Solution, units: Units) -> PriorRows:
    """Those of the solution, relative to `units`."""
    parts = solution.sensitivity
    slopes = np.asarray(parts.prior_slopes) * rescale(solution, units)
    return PriorRows(np.asarray(parts.prior_misfits), slopes)


class Noise(NamedTuple):
    """What the noise does: J'W S W J of data and of priors, and its share of the cost."""

    data: Matrix
    priors: Matrix
    cost: float  # expected cost of the noise before any parameter is fitted to it


def scaled_inverse(matrix: Matrix) -> Matrix:
    """Pseudo-inverse after unit scaling of the diagonal."""
    return _scaled_inverse(matrix.tobytes(), len(matrix))


@ft.lru_cache(maxsize=64)
def _scaled_inverse(elements: bytes, count: int) -> Matrix:
    # Ten parts of an assessment ask for the inverse of the same matrix.
    matrix = np.frombuffer(elements).reshape(count, count)
    scale = np.sqrt(np.diagonal(matrix))
    scale = np.where(scale > 0, scale, 1.0)
    unit = matrix / np.outer(scale, scale)
    return np.linalg.pinv(unit, rcond=1e-13, hermitian=True) / np.outer(scale, scale)


def calibrated_covariance(bread: Matrix, noise: Noise) -> Matrix:
    """Sandwich covariance: (J'WJ)^-1 J'W S W J (J'WJ)^-1, S the covariance of the errors. It holds
    for any weights, and counts neighbouring frequencies that share their noise once only."""
    inverse = scaled_inverse(bread)
    return inverse @ (noise.data + noise.priors) @ inverse


@dataclasses.dataclass(frozen=True, eq=False)
class ResponseTerm:
    """One frequency response as the fit sees it; of JAX for what a derivative needs."""

    frf: FrequencyResponse
    misfit: Float[Numbers, "frequencies outputs inputs 2"]
    slopes: Float[Numbers, "frequencies outputs inputs 2 all"]
    weights: Float[np.ndarray, "frequencies outputs inputs 2"]
    mixing: Mixing | None
    count: int  # of free parameters, the first of all

    @ft.cached_property
    def used(self) -> np.ndarray:
        return self.weights[..., 0] > 0

    @ft.cached_property
    def pairs(self) -> list[tuple[slice, int, int]]:
        """Where the response pairs are that have usable frequencies."""
        places = np.argwhere(np.any(self.weights, axis=(0, 3))).tolist()
        return [(slice(None), o, i) for o, i in places]

    @ft.cached_property
    def residual(self) -> Float[np.ndarray, "frequencies outputs inputs 2"]:
        """What the fit lowers."""
        return mix(self.mixing, self.weights * self.misfit)

    @ft.cached_property
    def rows(self) -> Float[np.ndarray, "frequencies outputs inputs 2 all"]:
        """Slopes of the residual."""
        return mix(self.mixing, self.weights[..., None] * self.slopes)

    @ft.cached_property
    def pulls(self) -> Float[np.ndarray, "frequencies outputs inputs 2 parameters"]:
        """How far a misfit of each point moves the gradient by each free parameter."""
        rows = self.weights[..., None] * self.slopes[..., : self.count]
        return self.weights[..., None] * mix(self.mixing, rows, twice=True)

    @ft.cached_property
    def ratio(self) -> Complex[Numbers, "frequencies outputs inputs"]:
        """Measurement over model."""
        exp = namespace_of(self.misfit).exp
        return exp(-self.misfit[..., 0] - 1j * self.misfit[..., 1])

    @ft.cached_property
    def measured_error(self) -> Float[Numbers, "frequencies outputs inputs"]:
        """Random error relative to the model."""
        xp, power = namespace_of(self.misfit), self.frf.error_exponent
        return xp.asarray(self.frf.random_error) * xp.abs(self.ratio) ** power

    @ft.cached_property
    def error(self) -> Float[Numbers, "frequencies outputs inputs"]:
        """The same, but never 0: an exact response would have infinite weight."""
        return namespace_of(self.misfit).maximum(self.measured_error, 1e-7)


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

    powers: Float[Numbers, " lengths"]
    none: float

    @property
    def amplitude(self) -> float:
        return float(np.sqrt(np.sum(self.powers)))


_NO_DISCREPANCY = Mixture(np.zeros(len(LENGTHS)), 1.0)


@dataclasses.dataclass(frozen=True, eq=False)
class ErrorBudget:
    """A problem at its solution, to first order in relative changes, and the errors there."""

    records: list[ResponseTerm]
    prior: PriorRows
    count: int  # of free parameters, the first of all
    mixtures: tuple[Mixture, Mixture] = (_NO_DISCREPANCY, _NO_DISCREPANCY)
    moved: Matrix | float = 0.0  # covariance by what may explain a local misfit

    @ft.cached_property
    def products(self) -> tuple[Matrix, Float[np.ndarray, " parameters"]]:
        """`J'J` and `J'r` of the weighted residuals over the free parameters."""
        jacobian, residual = [self.prior.slopes[:, : self.count]], [self.prior.misfit]
        for record in self.records:
            for at in record.pairs:
                jacobian.append(record.rows[at][..., : self.count].reshape(-1, self.count))
                residual.append(record.residual[at].reshape(-1))
        j, r = np.concatenate(jacobian), np.concatenate(residual)
        return j.T @ j, j.T @ r

    @property
    def bread(self) -> Matrix:
        return self.products[0]

    @property
    def gradient(self) -> Float[np.ndarray, " parameters"]:
        return self.products[1]

    @ft.cached_property
    def data_cost(self) -> float:
        """The sum of squares, without the priors."""
        pairs = ((record.residual, at) for record in self.records for at in record.pairs)
        return sum(float(np.sum(residual[at] ** 2)) for residual, at in pairs)

    @property
    def cost(self) -> float:
        return self.data_cost + float(np.sum(self.prior.misfit**2))

    @ft.cached_property
    def noise(self) -> Noise:
        """The responses' errors, with all their correlation, seen through weights and slopes."""
        data, cost = np.zeros((self.count, self.count)), 0.0
        for record in self.records:
            pulls, used = record.pulls, record.used
            model = np.where(used, np.asarray(record.frf.response) / record.ratio, 1.0)
            off = np.where(used, np.abs(record.ratio), 1.0) ** (1 - record.frf.error_exponent)
            # Magnitude and phase of the misfit are the parts of dT over T.
            columns = (pulls[..., 0, :] + 1j * pulls[..., 1, :]) / (model.conj() * off)[..., None]
            errors = record.frf.errors
            # A bound method of an `eqx.Module` is made like a model.
            data = data + type(errors).project(errors, np.where(used[..., None], columns, 0.0))
            error = np.where(used, record.error, 0.0)
            expected = expected_cost(record.mixing, record.weights * error[..., None])
            for _, o, i in record.pairs:
                cost += float(expected[o, i])
        slopes = self.prior.slopes[:, : self.count]
        return Noise(data, slopes.T @ slopes, cost)

    @property
    def fitted_noise(self) -> float:
        """Cost that the parameters take off by following the noise: their number, if white."""
        return float(np.trace(scaled_inverse(self.bread) @ self.noise.data))

    @property
    def misfit_ratio(self) -> float:
        """The data's cost over what noise alone would leave of it: about 1 for the right model."""
        return self.data_cost / max(self.noise.cost - self.fitted_noise, 1e-300)

    @property
    def root(self) -> Float[np.ndarray, "rows all"]:
        """Slopes over the random error: its singular values say what the record determines."""
        rows = []
        for record in self.records:
            sharp = np.where(record.weights > 0, 1 / record.error[..., None], 0.0)[..., None]
            rows += [sharp[at] * record.slopes[at] for at in record.pairs]
        return np.concatenate([row.reshape(-1, row.shape[-1]) for row in rows])

    @property
    def degrees_of_freedom(self) -> Float[np.ndarray, " parameters"]:
        """Of the noise estimate behind each parameter's variance; infinite where it is known.

        The variance is a sum over frequencies of noise powers, each estimated: with shares p of it
        and L the covariance of the powers' logarithms, 2 / (p'L p). Source: Satterthwaite (1946),
        "An approximate distribution of estimates of variance components".
        """
        inverse, doubt = scaled_inverse(self.bread), np.zeros(self.count)
        variance = np.diagonal(inverse @ self.noise.priors @ inverse).copy()
        for record in self.records:
            error = np.where(record.used, record.measured_error, 0.0)
            moved = record.pulls @ inverse
            share = np.sum((error[..., None, None] * moved) ** 2, axis=(2, 3))
            variance += np.sum(share, axis=(0, 1))
            covariance = record.frf.log_noise_covariance
            if covariance is not None:
                doubt += np.einsum("fop,fg,gop->p", share, covariance, share, optimize=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            freedom = 2 * variance**2 / doubt
        return np.where(doubt > 0, np.maximum(freedom, 1.0), np.inf)

    @ft.cached_property
    def by_noise(self) -> Matrix:
        """The covariance of relative changes by the noise alone."""
        return calibrated_covariance(self.bread, self.noise)

    @property
    def covariance(self) -> Matrix:
        """With what the model leaves unexplained."""
        return self.by_noise + self._unexplained[0]

    @ft.cached_property
    def _unexplained(self) -> tuple[Matrix, Matrix]:
        """Covariances by the discrepancy, under its prior and under one of a larger mean."""
        # J'W D W J of a discrepancy D of unit amplitude, for each length.
        effect = np.zeros((len(LENGTHS), self.count, self.count))
        for record in self.records:
            pulls = np.where(record.weights[..., None] > 0, record.pulls, 0.0)
            basis = kernel_basis(np.asarray(record.frf.omega).tobytes())
            pulls = np.reshape(pulls * SHARES[:, None], (len(pulls), -1))
            along = (np.swapaxes(basis, 1, 2) @ pulls).reshape(len(LENGTHS), -1, self.count)
            effect += np.swapaxes(along, 1, 2) @ along
        inverse, (one, other) = scaled_inverse(self.bread), self.mixtures
        effect_of = lambda mixture: np.tensordot(mixture.powers, effect, axes=1)
        parts = (inverse @ effect_of(mixture) @ inverse for mixture in (one, other))
        by_one, by_other = (part + self.moved for part in parts)
        return by_one, by_other

    @ft.cached_property
    def discrepancy(self) -> Discrepancy:
        """In words and numbers."""
        parts = (np.zeros_like(self.bread), *self._unexplained)
        variances = [np.diagonal(self.by_noise + part) for part in parts]
        by_noise, with_one, with_other = (np.sqrt(np.maximum(v, 0.0)) for v in variances)
        widths = np.where(with_other > FOLLOWS * with_one, "prior", "data")
        widths = np.where(with_one < FOLLOWS * by_noise, "noise", widths)
        mixture = self.mixtures[0]
        weight = mixture.powers / max(float(np.sum(mixture.powers)), 1e-300)
        length = float(np.exp(weight @ np.log(LENGTHS)))
        return Discrepancy(mixture.amplitude, length, mixture.none, tuple(widths.tolist()))


def error_budget(
    problem: Problem,
    points: Sequence[Points],
    solution: Solution,
    units: Units,
    changes: Mapping[int, Sequence[np.ndarray]] | None = None,
) -> ErrorBudget:
    """By changes relative to `units`; `changes` are slopes by some of the values themselves."""
    scale, parts, terms = rescale(solution, units), solution.sensitivity, []
    rows = zip(points, parts.misfits, parts.slopes, problem.weights, problem.mixings, strict=True)
    for number, (one, misfit, slopes, weights, mixing) in enumerate(rows):
        slopes = np.asarray(slopes) * scale
        for k, change in (changes or {}).items():
            slopes[..., k] = units[k] * change[number]
        parts = one.frf, np.asarray(misfit), slopes, np.asarray(weights), mixing
        terms.append(ResponseTerm(*parts, problem.parameters.count))
    return ErrorBudget(terms, prior_rows(solution, units), problem.parameters.count)


class Weighting(NamedTuple):
    """How the points of a fit count, by the noise and by what the model leaves unexplained."""

    points: Sequence[Points]
    budget: ErrorBudget  # at a solution, by changes relative to its own units
    by_noise: Problem | None = None  # under weights without a floor on the error, if there is one


def weighting_at(problem: Problem, points: Sequence[Points], solution: Solution) -> Weighting:
    """The responses at a solution, and what the model leaves unexplained of them."""
    budget, fixed = error_budget(problem, points, solution, units_of(solution)), set()
    if solution.at_zero:
        fixed = {k for k in solution.at_zero if budget.gradient[k] > 0}
    moving = [k for k in range(budget.count) if k not in fixed]
    mixtures = find_discrepancy(budget.records, points, budget.prior, moving)
    return Weighting(points, dataclasses.replace(budget, mixtures=mixtures))


def find_discrepancy(
    records: Sequence[ResponseTerm],
    points: Sequence[Points],
    prior: PriorRows,
    moving: Sequence[int],
) -> tuple[Mixture, Mixture]:
    """The discrepancy of a fit, under the prior and under one of a larger mean. `moving` are the
    parameters that can take up a misfit: not those that a bound holds against it."""
    columns, xp = np.asarray(moving, int), namespace_of(prior.misfit)
    # `np.median` takes ten times as long for few values.
    error = xp.sort(xp.concatenate([record.error[record.used] for record in records]))
    typical = 0.5 * (error[error.size // 2] + error[-(error.size // 2) - 1])
    lowest = xp.log(0.1 * typical)
    amplitudes = xp.exp(xp.linspace(lowest, xp.maximum(0.0, lowest + 1.4), _AMPLITUDES))
    power = xp.concatenate([np.zeros(1), amplitudes])[:, None] ** 2
    # Products of slopes and misfit under noise alone; what a discrepancy takes of them, and the
    # logarithm of the power that it adds, by length and amplitude.
    rows = xp.concatenate([prior.slopes[:, columns], prior.misfit[:, None]], axis=1)
    products, damped, grown = rows.T @ rows, 0.0, 0.0
    for record, counted in zip(records, points, strict=True):
        inverse = xp.where(record.used, record.error**-2 / counted.shared, 0.0)
        rows = xp.concatenate([record.slopes[..., columns], record.misfit[..., None]], axis=-1)
        rows = xp.where(record.used[..., None, None], rows, 0.0)
        weighted = (inverse[..., None, None] * rows).reshape(-1, len(products))
        products += weighted.T @ rows.reshape(-1, len(products))
        omega = np.asarray(counted.frf.omega)
        taken, added = _damping(omega, record.used, inverse, rows, power)
        damped, grown = damped + taken, grown + added
    # Restricted likelihoods by length and amplitude: the parameters' own changes are projected out.
    scale = xp.sqrt(xp.maximum(xp.diagonal(products), 1e-300))
    left = (products - damped) / xp.outer(scale, scale) + 1e-11 * np.eye(len(products))
    slopes, misfit = left[..., :-1, :-1], left[..., :-1, -1]
    step = xp.linalg.solve(slopes, misfit[..., None])[..., 0]
    rest = (left[..., -1, -1] - xp.sum(misfit * step, axis=-1)) * scale[-1] ** 2
    volume = xp.linalg.slogdet(slopes)[1]
    likelihoods = -0.5 * (grown + volume + rest)
    relative = xp.exp(likelihoods - xp.max(likelihoods))

    def mix(mean: float) -> Mixture:
        """The posterior under a mass at zero, and a gamma distribution above it."""
        cell = amplitudes * xp.log(amplitudes[1] / amplitudes[0])
        density = cell * amplitudes ** (_SHAPE - 1) * xp.exp(-_SHAPE * amplitudes / mean)
        density *= (1 - _NONE) / xp.maximum(xp.sum(density), 1e-300) / len(relative)
        none, some = _NONE * relative[0, 0], relative[:, 1:] * density
        total = none + xp.sum(some)
        return Mixture(xp.sum(some * amplitudes**2, axis=1) / total, none / total)

    return mix(MEAN), mix(_OTHER * MEAN)


def _damping(
    omega: np.ndarray, used: np.ndarray, inverse: Numbers, columns: Numbers, power: Numbers
) -> tuple[Numbers, Numbers]:
    """What discrepancies of each length and `power` take of products of columns, and add to noise.

    `columns` have the two parts of the misfit, and then the products' rows, on their last axes.
    """
    pairs, xp = np.any(used, axis=0), namespace_of(columns)
    inverse, columns = inverse[:, pairs].T, xp.moveaxis(columns[:, pairs], 0, 1)
    basis = kernel_basis(omega.tobytes())[:, None]  # length pair frequency rank
    weighted = xp.swapaxes(basis * inverse[:, :, None], 2, 3)
    kernel, along = weighted @ basis, weighted @ columns.reshape(*columns.shape[:2], -1)
    if xp is not np:  # eigenvectors have no derivatives where values are equal
        along = along.reshape(*along.shape[:3], *columns.shape[2:]) * SHARES[:, None]
        along = jnp.swapaxes(along, 2, 3)  # length pair part rank column
        power = power[:, :, None, None, None]
        shares = (SHARES**2)[:, None, None]
        grown = np.eye(len(kernel[0, 0])) + power * shares * kernel[:, None, :, None]
        shape = (*grown.shape[:-1], along.shape[-1])
        solved = jnp.linalg.solve(grown, jnp.broadcast_to(along[:, None], shape))
        taken = power[:, 0, 0] * jnp.einsum("lpsrv,lapsrw->lavw", along, solved)
        return taken, jnp.sum(jnp.linalg.slogdet(grown)[1], axis=(2, 3))
    # Components in which noise and discrepancy are both diagonal.
    gains, turned = np.linalg.eigh(kernel)
    along = (np.swapaxes(turned, 2, 3) @ along).reshape(*gains.shape, *columns.shape[2:])
    along = along * SHARES[:, None]
    products = along[..., :, None] * along[..., None, :]
    gains = (np.maximum(gains, 0.0)[..., None] * SHARES**2).reshape(len(basis), 1, -1)
    damped, width = power / (1 + power * gains), columns.shape[-1]
    taken = damped @ products.reshape(len(basis), -1, width**2)
    return taken.reshape(*taken.shape[:2], width, width), np.sum(np.log1p(power * gains), axis=-1)


@ft.lru_cache(maxsize=16)
def kernel_basis(omega: bytes) -> Float[np.ndarray, "lengths frequencies rank"]:
    """Roots of the kernels of all lengths at frequencies (the bytes of their array, rad/s). Only
    neighbours matter to such a process: an inverse kernel has three diagonals."""
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
