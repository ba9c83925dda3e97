"""The error budget of a fit: what noise and model error do to the parameters at the solution."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad.spectra import FrequencyResponse

from ..frequency_domain._cost import Points, Weights
from ..frequency_domain._mixing import Mixing
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
)
from ._discrepancy import (
    describe_discrepancy,
    Discrepancy,
    discrepancy_effect,
    find_discrepancy,
    Mixture,
)


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
