"""From a solver's stop to a result that states what it is worth."""

import functools as ft
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxquad.spectra import FrequencyResponse

from ._accuracy import (
    Block,
    blocks_of,
    calibrated_covariance,
    condition_number,
    cramer_rao,
    fitted_noise,
    gauss_newton,
    information_root,
    insensitivity,
    Known,
    misfit_ratio,
    noise_effect,
    Record,
    scaled_inverse,
)
from ._identifiability import decide, Identifiability, Information
from ._parameters import Place
from ._problem import Problem
from ._remarks import (
    FAILED,
    MISFIT,
    ran_to_zero,
    remarks_on_fit,
    remarks_on_leakage,
    remarks_on_priors,
)
from ._result import Fit
from ._solve import same_responses, Solution
from ._starts import Minimum, remarks_on_minima


def assess(
    problem: Problem,
    frfs: Sequence[FrequencyResponse],
    solution: Solution,
    minima: tuple[Minimum, ...] = (),
) -> Fit:
    """Costs, bounds, calibrated covariance and identifiability at the solution."""
    parameters, count = problem.parameters, problem.parameters.count
    units = _units(problem, solution)
    records = _records(problem, frfs, solution, units)
    blocks, known = blocks_of(records), _known(solution, units)
    bread, gradient = gauss_newton(blocks, known, count)
    noise = noise_effect(records, blocks, known, count)
    data_cost = sum(float(np.sum((block.weights * block.misfit) ** 2)) for block in blocks)
    cost = data_cost + float(np.sum(known.misfit**2))
    misfit = misfit_ratio(data_cost, bread, noise)
    # A misfit beyond the noise is in no covariance of the noise: widen the errors to match it.
    inflation = misfit if misfit > MISFIT**2 else 1.0
    covariance = calibrated_covariance(bread, noise, inflation)
    decrement = _decrement(bread, gradient, ran_to_zero(problem, solution))
    verdict = by_data = Identifiability(parameters.names, (), (), np.eye(count), (), ())
    if decrement <= FAILED * max(cost, 1e-9):
        facts = _information(problem, solution, blocks, covariance, units, inflation)
        verdict, by_data = _identifiability(facts, known)
    values, slopes = np.asarray(solution.values)[:count], units[:count]
    lost = np.array([name in verdict.undetermined for name in parameters.names])
    physical = covariance * np.outer(slopes, slopes)
    physical[lost, :] = physical[:, lost] = np.nan
    percent = 100 * np.abs(slopes) / np.maximum(np.abs(values), 1e-3 * np.abs(slopes))
    return Fit(
        model=solution.model,
        names=parameters.names,
        values=np.where(lost, np.nan, values),
        standard_errors=np.where(lost, np.inf, np.sqrt(np.diagonal(physical))),
        covariance=physical,
        cramer_rao=np.where(lost, np.inf, cramer_rao(bread) * percent),
        insensitivity=insensitivity(bread) * percent,
        cost=cost,
        average_cost=cost / len(blocks),
        information=cost + 2 * inflation * fitted_noise(bread, noise),
        chi_squared=misfit,
        newton_decrement=decrement,
        condition=condition_number(bread),
        points=sum(int(np.sum(block.weights[:, 0] > 0)) for block in blocks),
        steps=solution.steps,
        identifiability=verdict,
        remarks=(
            *dict.fromkeys(remark for frf in frfs for remark in frf.remarks),
            *remarks_on_fit(problem, solution, cost, decrement, misfit),
            *remarks_on_minima(problem, solution, bread, minima),
            *remarks_on_leakage(problem, frfs, solution),
            *remarks_on_priors(known.misfit, verdict, by_data),
        ),
        parameters=parameters,
        units=units[:count],
        relative_covariance=covariance,
        minima=minima,
    )


def _decrement(
    bread: Float[np.ndarray, "parameters parameters"],
    gradient: Float[np.ndarray, " parameters"],
    at_zero: Sequence[int],
) -> float:
    """What a Gauss-Newton step lowers the cost by; parameters at zero do not become negative."""
    held = [k for k in at_zero if gradient[k] > 0]
    free = np.setdiff1d(np.arange(gradient.size), held)
    inverse = scaled_inverse(bread[np.ix_(free, free)])
    return 0.5 * float(gradient[free] @ inverse @ gradient[free])


def _units(problem: Problem, solution: Solution) -> Float[np.ndarray, " all"]:
    """What relative changes are relative to: the value, or the start of one that ran to zero.

    Relative to itself, a lag that ran to zero would look as if it had no effect, while in truth it
    trades off with the delay.
    """
    units = np.asarray(solution.slopes).copy()
    scale, start = (np.asarray(x) for x in (problem.parameters.scale, problem.parameters.start))
    for k in ran_to_zero(problem, solution):
        units[k] = scale[k] * np.exp(start[k]) if units[k] != 0 else units[k]
    return units


def _rescale(solution: Solution, units: Float[np.ndarray, " all"]) -> Float[np.ndarray, " all"]:
    """From derivatives by z to derivatives by changes relative to `units`."""
    slopes = np.asarray(solution.slopes)
    return np.where(slopes == 0, 1.0, units / np.where(slopes == 0, 1.0, slopes))


def _records(
    problem: Problem,
    frfs: Sequence[FrequencyResponse],
    solution: Solution,
    units: Float[np.ndarray, " all"],
) -> list[Record]:
    scale, parts = _rescale(solution, units), solution.sensitivity
    weights = [np.asarray(each) for each in problem.weights]
    misfits = [np.asarray(each) for each in parts.misfits]
    slopes = [np.asarray(each) * scale for each in parts.slopes]
    return [Record(*each) for each in zip(frfs, misfits, slopes, weights, strict=True)]


def _known(solution: Solution, units: Float[np.ndarray, " all"]) -> Known:
    derivatives = solution.sensitivity
    slopes = np.asarray(derivatives.prior_slopes) * _rescale(solution, units)
    return Known(np.asarray(derivatives.prior_misfits), slopes)


def _information(
    problem: Problem,
    solution: Solution,
    blocks: list[Block],
    covariance: Float[np.ndarray, "parameters parameters"],
    units: Float[np.ndarray, " all"],
    inflation: float,
) -> Information:
    """What the data say, with errors as wide as they are printed."""
    places = problem.parameters.places
    return Information(
        root=information_root(blocks) / np.sqrt(inflation),
        covariance=covariance,
        names=tuple(place.name for place in places),
        values=np.asarray(solution.values),
        units=units,
        order=_ranks(places),
        same=ft.partial(same_responses, problem, solution),
    )


def _identifiability(facts: Information, known: Known) -> tuple[Identifiability, Identifiability]:
    """What data and priors determine together, and what the data determine alone."""
    if not len(known.misfit):
        verdict = decide(facts)
        return verdict, verdict
    # Rows come in pairs of magnitude and phase; a prior's row counts once.
    priors = np.repeat(known.slopes, 2, axis=0) / np.sqrt(2)
    return decide(facts._replace(root=np.concatenate([facts.root, priors]))), decide(facts)


def _ranks(places: Sequence[Place]) -> tuple[int, ...]:
    """Each parameter's place in the model's own order."""
    ordered = sorted(places, key=lambda place: (place.leaf, place.index))
    return tuple(ordered.index(place) for place in places)
