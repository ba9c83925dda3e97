"""The error budget of a fit: noise, and what the model leaves unexplained of a response."""

import dataclasses
import functools as ft
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad.spectra import ErrorCovariance

from ..frequency_domain._cost import expected_cost, Points
from ..frequency_domain._problem import Problem
from ..frequency_domain._solve import Solution
from ._discrepancy import (
    Discrepancy,
    find_discrepancy,
    kernel_basis,
    LENGTHS,
    Mixture,
    NO_DISCREPANCY,
    SHARES,
)
from ._response_term import (
    diagonal,
    PerFit,
    prior_rows,
    PriorRows,
    rescale,
    ResponseTerm,
    Units,
    units_of,
)


FOLLOWS = 1.25  # factor by which such a width grows

Matrix = Float[np.ndarray, "*members parameters parameters"]


class Noise(NamedTuple):
    """What the noise does: J'W S W J of data and of priors, and its share of the cost."""

    data: Matrix
    priors: Matrix
    cost: PerFit  # expected cost of the noise before any parameter is fitted to it


def scaled_inverse(matrix: Matrix) -> Matrix:
    """Pseudo-inverse after unit scaling of the diagonal."""
    return _scaled_inverse(matrix.tobytes(), matrix.shape)


@ft.lru_cache(maxsize=64)
def _scaled_inverse(elements: bytes, shape: tuple[int, ...]) -> Matrix:
    # Ten parts of an assessment ask for the inverse of the same matrix.
    matrix = np.frombuffer(elements).reshape(shape)
    scale = np.sqrt(diagonal(matrix))
    scale = np.where(scale > 0, scale, 1.0)
    both = scale[..., :, None] * scale[..., None, :]
    return np.linalg.pinv(matrix / both, rcond=1e-13, hermitian=True) / both


def calibrated_covariance(bread: Matrix, noise: Noise) -> Matrix:
    """Sandwich covariance: (J'WJ)^-1 J'W S W J (J'WJ)^-1, S the covariance of the errors. It holds
    for any weights, and counts neighbouring frequencies that share their noise once only."""
    inverse = scaled_inverse(bread)
    return inverse @ (noise.data + noise.priors) @ inverse


@dataclasses.dataclass(frozen=True, eq=False)
class ErrorBudget:
    """A problem at its solution, to first order in relative changes, and the errors there; or those
    of many fits of one response, on a first axis of members."""

    records: list[ResponseTerm]
    prior: PriorRows
    count: int  # of free parameters, the first of all
    mixtures: tuple[Mixture, Mixture] = (NO_DISCREPANCY, NO_DISCREPANCY)
    moved: Matrix | float = 0.0  # covariance by a resonance that the model may lack
    resonance: PerFit = 0.0  # its probability

    @ft.cached_property
    def products(self) -> tuple[Matrix, Float[np.ndarray, "*members parameters"]]:
        """`J'J` and `J'r` of the weighted residuals over the free parameters."""
        jacobian, residual = [self.prior.slopes[..., : self.count]], [self.prior.misfit]
        for record in self.records:
            for o, i in record.pairs:
                rows = record.rows[..., o, i, :, : self.count]
                jacobian.append(rows.reshape(*rows.shape[:-3], -1, self.count))
                residual.append(record.residual[..., o, i, :].reshape(*rows.shape[:-3], -1))
        j, r = np.concatenate(jacobian, axis=-2), np.concatenate(residual, axis=-1)
        across = np.swapaxes(j, -1, -2)
        return across @ j, (across @ r[..., None])[..., 0]

    @property
    def bread(self) -> Matrix:
        return self.products[0]

    @property
    def gradient(self) -> Float[np.ndarray, "*members parameters"]:
        return self.products[1]

    @ft.cached_property
    def data_cost(self) -> PerFit:
        """The sum of squares, without the priors."""
        pairs = ((record.residual, *pair) for record in self.records for pair in record.pairs)
        parts = (np.sum(residual[..., o, i, :] ** 2, axis=(-2, -1)) for residual, o, i in pairs)
        return sum(parts, np.zeros(()))

    @property
    def cost(self) -> PerFit:
        return self.data_cost + np.sum(self.prior.misfit**2, axis=-1)

    @ft.cached_property
    def noise(self) -> Noise:
        """The responses' errors, with all their correlation, seen through weights and slopes."""
        data, cost = np.zeros((self.count, self.count)), np.zeros(())
        for record in self.records:
            pulls, used = record.pulls, record.used
            model = np.where(used, np.asarray(record.frf.response) / record.ratio, 1.0)
            off = np.where(used, np.abs(record.ratio), 1.0) ** (1 - record.frf.error_exponent)
            # Magnitude and phase of the misfit are the parts of dT over T.
            columns = (pulls[..., 0, :] + 1j * pulls[..., 1, :]) / (model.conj() * off)[..., None]
            columns, errors = np.where(used[..., None], columns, 0.0), record.frf.errors
            if isinstance(errors, list):
                data = data + ErrorCovariance.project_each(errors, columns)
            else:  # a bound method of an `eqx.Module` is made like a model
                data = data + type(errors).project(errors, columns)
            error = np.where(used, record.error, 0.0)
            expected = expected_cost(record.mixing, record.weights * error[..., None])
            for o, i in record.pairs:
                cost = cost + expected[..., o, i]
        slopes = self.prior.slopes[..., : self.count]
        return Noise(data, np.swapaxes(slopes, -1, -2) @ slopes, cost)

    @property
    def fitted_noise(self) -> PerFit:
        """Cost that the parameters take off by following the noise: their number, if white."""
        return np.trace(scaled_inverse(self.bread) @ self.noise.data, axis1=-2, axis2=-1)

    @property
    def misfit_ratio(self) -> PerFit:
        """The data's cost over what noise alone would leave of it: about 1 for the right model."""
        return self.data_cost / np.maximum(self.noise.cost - self.fitted_noise, 1e-300)

    @property
    def root(self) -> Float[np.ndarray, "*members rows all"]:
        """Slopes over the random error: its singular values say what the record determines."""
        rows = []
        for record in self.records:
            sharp = np.where(record.weights > 0, 1 / record.error[..., None], 0.0)[..., None]
            sharp = sharp * record.slopes
            rows += [sharp[..., o, i, :, :] for o, i in record.pairs]
        lined_up = (row.reshape(*row.shape[:-3], -1, row.shape[-1]) for row in rows)
        return np.concatenate([*lined_up], axis=-2)

    @ft.cached_property
    def degrees_of_freedom(self) -> Float[np.ndarray, "*members parameters"]:
        """Of the noise estimate behind each parameter's variance; infinite where it is known.

        The variance is a sum over frequencies of noise powers, each estimated: with shares p of it
        and L the covariance of the powers' logarithms, 2 / (p'L p). Source: Satterthwaite (1946),
        "An approximate distribution of estimates of variance components".
        """
        inverse, doubt = scaled_inverse(self.bread), np.zeros(self.count)
        variance = diagonal(inverse @ self.noise.priors @ inverse)
        for record in self.records:
            error, shape = np.where(record.used, record.measured_error, 0.0), record.pulls.shape
            moved = record.pulls.reshape(*shape[:-5], -1, self.count) @ inverse
            share = np.sum((error[..., None, None] * moved.reshape(shape)) ** 2, axis=(-3, -2))
            variance = variance + np.sum(share, axis=(-3, -2))
            if (covariance := record.frf.log_noise_covariance) is not None:
                together = np.asarray(covariance) @ share.reshape(*share.shape[:-2], -1)
                doubt = doubt + np.sum(share * together.reshape(share.shape), axis=(-3, -2))
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

    @property
    def without_resonance(self) -> Matrix:
        """With all but a resonance, which widens intervals, and makes no direction a null one."""
        return self.covariance - self.moved

    @ft.cached_property
    def _unexplained(self) -> tuple[Matrix, Matrix]:
        """Covariances by the discrepancy, under its prior and under one of a larger mean."""
        # J'W D W J of a discrepancy D of unit amplitude, for each length.
        effect = np.zeros((len(LENGTHS), self.count, self.count))
        for record in self.records:
            pulls = np.where(record.weights[..., None] > 0, record.pulls, 0.0) * SHARES[:, None]
            *members, frequencies = pulls.shape[:-4]
            pulls = pulls.reshape(*members, 1, frequencies, -1)
            basis = kernel_basis(np.asarray(record.frf.omega).tobytes())
            along = np.swapaxes(basis, 1, 2) @ pulls
            along = along.reshape(*along.shape[:-2], -1, self.count)
            effect = effect + np.swapaxes(along, -2, -1) @ along
        inverse = scaled_inverse(self.bread)

        def covariance(mixture: Mixture) -> Matrix:
            shares = mixture.powers[..., None, :] @ effect.reshape(*effect.shape[:-2], -1)
            return inverse @ shares.reshape(inverse.shape) @ inverse

        parts = map(covariance, self.mixtures)
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
        numbers = float(mixture.amplitude), length, float(mixture.none)
        return Discrepancy(*numbers, tuple(widths.tolist()))


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
    shared = [one.shared for one in points]
    mixtures = find_discrepancy(budget.records, shared, budget.prior, moving)
    return Weighting(points, dataclasses.replace(budget, mixtures=mixtures))
