"""From a solver's stop to a result that states what it is worth."""

import dataclasses
import functools as ft
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad.models import LaggedIntegrator, StateSpace, TransferFunction
from jaxquad.spectra import FrequencyResponse

from ..frequency_domain._aside import look_aside
from ..frequency_domain._cost import Points, Weights, widen_band
from ..frequency_domain._held import remarks_on_hold
from ..frequency_domain._mixing import Mixing
from ..frequency_domain._parameters import Place
from ..frequency_domain._problem import on_device, Problem
from ..frequency_domain._refits import Origin
from ..frequency_domain._result import Fit
from ..frequency_domain._solve import same_responses, Solution
from ..frequency_domain._starts import Minimum, remarks_on_minima
from ..output_error._simulated import HasStateSpace, HasTransferFunction, linear_model
from ._accuracy import (
    Block,
    blocks_of,
    degrees_of_freedom,
    fitted_noise,
    gauss_newton,
    information_root,
    Matrix,
    misfit_ratio,
    Noise,
    noise_effect,
    PriorRows,
    ResponseTerm,
    scaled_inverse,
)
from ._discrepancy import (
    find_discrepancy,
    Mixture,
)
from ._fit_remarks import (
    DOUBT,
    fed_back,
    is_fed_back,
    is_unfinished,
    MISFIT,
    no_minimum,
    NO_MODEL,
    no_model,
    remarks_on_bounds,
    remarks_on_discrepancy,
    remarks_on_fit,
    remarks_on_growth,
    remarks_on_priors,
)
from ._identifiability import assess_identifiability, Information
from ._make_fit import Costs, Estimate, make_fit
from ._seen import (
    bounds_among,
    halved,
    near_zeros,
    prior_rows,
    pulled_beyond,
    records_of,
    see,
    Seen,
    units_of,
    with_changes,
    with_tangled,
)
from ._verdict import Bound, Verdict


class Counted(NamedTuple):
    """How the points of a fit count: as the noise says, and with what the model does not explain.

    `records` are at the solution, by changes relative to its own units. `weights` are those by the
    noise alone, where those of the problem have a floor on the error.
    """

    points: Sequence[Points]
    records: list[ResponseTerm]
    weights: Sequence[Weights] | None
    mixings: Sequence[Mixing | None] | None
    found: tuple[Mixture, Mixture]


def assess(
    problem: Problem,
    counted: Counted,
    solution: Solution,
    minima: tuple[Minimum, ...] = (),
    *,
    further: Sequence[str] = (),
    origin: Origin | None = None,
) -> Fit:
    """Costs, bounds, calibrated covariance and identifiability at the solution.

    The fit gets the `further` remarks and its `origin`.
    """
    frfs, count = [each.frf for each in counted.points], problem.parameters.count
    seen, units, bounds, bread, newton = _see(problem, counted, solution)
    here = _cost(seen.blocks, seen.prior)
    falls_aside = look_aside(problem, solution.z, here, bread, solution.aside)
    costs = _costs_by_noise(problem, counted, solution, seen, units)
    cut = ft.partial(halved, seen=seen, names=problem.parameters.names, bounds=bounds)
    by_noise, covariance = cut(seen.by_noise), cut(seen.covariance)
    facts = _information(problem, solution, seen.blocks, (covariance, by_noise), units)
    verdict, by_data = _judge(problem, solution, seen, facts, bounds, newton, costs.cost)
    estimate = Estimate(seen.bread, covariance, by_noise, units[:count], verdict, newton.decrement)
    remarks = [
        *_remarks_on_used(problem, frfs),
        *remarks_on_hold(frfs, [np.asarray(each)[..., 0] > 0 for each in problem.weights]),
    ]
    if not is_fed_back(verdict):
        doubted = _doubted(seen, costs)
        remarks += [
            *remarks_on_fit(problem, solution, costs.cost, newton.decrement, doubted, verdict),
            *remarks_on_bounds(pulled_beyond(seen, problem.parameters.names, bounds), verdict),
            *_remarks_on_growth(problem, solution, frfs),
            *remarks_on_minima(problem, solution.converged and falls_aside(), minima),
            *remarks_on_priors(seen.prior.misfit, verdict, by_data, chi_squared=doubted),
            *remarks_on_discrepancy(seen.discrepancy),
        ]
    return make_fit(
        problem,
        solution,
        estimate,
        costs,
        points=sum(int(np.sum(block.weights[:, 0] > 0)) for block in seen.blocks),
        freedom=degrees_of_freedom(seen.records, seen.bread, seen.noise, count),
        remarks=(*remarks, *further),
        minima=minima,
        discrepancy=seen.discrepancy,
        origin=origin,
    )


class _Newton(NamedTuple):
    """The next step of Gauss and Newton, and half of what it takes off the cost."""

    step: Float[np.ndarray, " parameters"]
    decrement: float


class _AtSolution(NamedTuple):
    """What the records say, by changes relative to units, and parameters that may be zero."""

    seen: Seen
    units: Float[np.ndarray, " all"]
    bounds: tuple[Bound, ...]
    bread: Matrix  # by the slopes at the solution itself
    newton: _Newton


def _see(problem: Problem, counted: Counted, solution: Solution) -> _AtSolution:
    start = units = units_of(solution)
    seen = tangent = see(counted.records, counted.found, solution, units)
    near = near_zeros(problem, solution, seen, units)
    still = [one.k for one in near if one.changes is not None and one.bound.value]
    step = newton_step(seen.bread, seen.gradient, solution.at_zero, still)
    decrement = 0.5 * float(seen.gradient @ step)
    bounds, frfs = (), [points.frf for points in counted.points]

    def see_again() -> Seen:
        records = with_changes(records_of(problem, frfs, solution, units), near, units)
        return see(records, counted.found, solution, units)

    if near:
        seen = see_again()
        bounds, tangled = bounds_among(near, seen, solution, units)
        if tangled:
            units = with_tangled(units, near, tangled)
            seen = see_again()
    newton = _Newton(step * (start / units)[: step.size], decrement)
    return _AtSolution(seen, units, bounds, tangent.bread, newton)


def _costs_by_noise(
    problem: Problem,
    counted: Counted,
    solution: Solution,
    seen: Seen,
    units: Float[np.ndarray, " all"],
) -> Costs:
    """Cost and misfit under weights by the noise alone: they compare fits of other structures."""
    plain, prior = seen, seen.prior
    if counted.weights is not None:
        alone, frfs = problem.weighted(counted.weights, counted.mixings), counted.points
        records = records_of(alone, [each.frf for each in frfs], solution, units)
        plain = _look(records, prior, problem.parameters.count)
    return _costs(plain.blocks, prior, plain.bread, plain.noise)


def _doubted(seen: Seen, costs: Costs) -> float:
    """The misfit that remarks are about.

    Few points of their own noise reach a large one by chance: the discrepancy has to say so, too.
    """
    misfit = costs.chi_squared
    return misfit if seen.discrepancy.none < DOUBT else min(misfit, 1.0)


def _judge(
    problem: Problem,
    solution: Solution,
    seen: Seen,
    facts: Information,
    bounds: tuple[Bound, ...],
    newton: _Newton,
    cost: float,
) -> tuple[Verdict, Verdict]:
    """What data and priors determine together, and what the data determine alone."""
    names, frfs = problem.parameters.names, [each.frf for each in seen.records]
    step, decrement = newton
    dominated, used = _count_dominated(problem, frfs)
    if 2 * dominated > used:
        verdict = fed_back(names, dominated, used)
    elif decrement > _NO_MINIMUM * max(cost, 1e-9) or is_unfinished(solution, step, seen.by_noise):
        remedies = ("«start from other values»", "try many starts at once (starts=20)")
        verdict = no_minimum(names, decrement, cost, *remedies, message=solution.message)
    elif seen.discrepancy.amplitude > NO_MODEL:
        verdict = no_model(names, seen.discrepancy.amplitude)
    else:
        both, by_data = identifiability_of(facts, seen.prior, bounds)
        return _with_wider_band(both, problem, frfs), by_data
    return verdict, verdict


class _Look(NamedTuple):
    """What the weights alone make of the records."""

    blocks: list[Block]
    bread: Matrix
    noise: Noise


def _look(records: list[ResponseTerm], prior: PriorRows, count: int) -> _Look:
    blocks = blocks_of(records)
    bread, _ = gauss_newton(blocks, prior, count)
    return _Look(blocks, bread, noise_effect(records, blocks, prior, count))


def _costs(blocks: list[Block], prior: PriorRows, bread: Matrix, noise: Noise) -> Costs:
    cost = _cost(blocks, prior)
    misfit = misfit_ratio(_cost(blocks), bread, noise)
    # A misfit beyond the noise is in no covariance of the noise.
    inflation = misfit if misfit > MISFIT**2 else 1.0
    information = cost + 2 * inflation * fitted_noise(bread, noise)
    return Costs(cost, cost / len(blocks), information, misfit)


def _cost(blocks: list[Block], prior: PriorRows | None = None) -> float:
    """The sum of squares of the data, and of the priors."""
    data = sum(float(np.sum(block.residual**2)) for block in blocks)
    return data if prior is None else data + float(np.sum(prior.misfit**2))


def records_at(
    problem: Problem, points: Sequence[Points], solution: Solution
) -> list[ResponseTerm]:
    """The responses at a solution, by changes relative to its own units."""
    frfs = [each.frf for each in points]
    return records_of(problem, frfs, solution, units_of(solution))


def discrepancy_at(
    records: list[ResponseTerm], points: Sequence[Points], solution: Solution
) -> tuple[Mixture, Mixture]:
    """What the model leaves unexplained at a solution."""
    count, prior = solution.z.size, prior_rows(solution, units_of(solution))
    held = set()
    if solution.at_zero:
        gradient = gauss_newton(blocks_of(records), prior, count)[1]
        held = {k for k in solution.at_zero if gradient[k] > 0}
    return find_discrepancy(records, points, prior, [k for k in range(count) if k not in held])


def _with_wider_band(
    verdict: Verdict, problem: Problem, frfs: Sequence[FrequencyResponse]
) -> Verdict:
    """With the advice to excite a wider band first, where a wider one may tell parameters apart."""
    if verdict.identifiable or len(verdict.exact):
        return verdict
    wider = widen_band(frfs, [np.asarray(each)[..., 0] > 0 for each in problem.weights])
    remedies = (wider, *verdict.remedies) if wider else verdict.remedies
    return dataclasses.replace(verdict, remedies=remedies)


def _count_dominated(problem: Problem, frfs: Sequence[FrequencyResponse]) -> tuple[int, int]:
    """Points in use that show a controller, and all in use."""
    used = [np.asarray(weights)[..., 0] > 0 for weights in problem.weights]
    dominated = [mine & frf.of_controller for frf, mine in zip(frfs, used, strict=True)]
    return int(sum(map(np.count_nonzero, dominated))), int(sum(map(np.count_nonzero, used)))


def _remarks_on_used(problem: Problem, frfs: Sequence[FrequencyResponse]) -> list[str]:
    """Those of the responses' remarks that concern the points in use, each once."""
    used = [np.asarray(weights)[..., 0] > 0 for weights in problem.weights]
    pairs = [(frf, mine) for frf, mine in zip(frfs, used, strict=True) if frf.remarks]
    parts = [frf.remarks_about(mine) for frf, mine in pairs]
    return list(dict.fromkeys(remark for part in parts for remark in part))


def _remarks_on_growth(
    problem: Problem, solution: Solution, frfs: Sequence[FrequencyResponse]
) -> list[str]:
    """Remark on a model that grows within the band of a direct estimate: no open loop does."""
    model = solution.model
    lags = isinstance(model, LaggedIntegrator) and not np.asarray(model.lag) < 0
    if lags or not any(frf.method == "direct" for frf in frfs):
        return []
    if not isinstance(model, StateSpace | TransferFunction | HasStateSpace | HasTransferFunction):
        return []
    pairs = zip(frfs, problem.weights, strict=True)
    used = [
        np.asarray(frf.omega)[np.any(np.asarray(w)[..., 0] > 0, axis=(1, 2))] for frf, w in pairs
    ]
    omega = np.concatenate(used)
    lowest, highest = float(np.min(omega)), float(np.max(omega))
    poles = linear_model(on_device(model)).poles
    growth = float(np.max(np.real(poles[np.abs(poles) < highest]), initial=0.0))
    return remarks_on_growth(growth) if growth > lowest else []


def newton_step(
    bread: Float[np.ndarray, "parameters parameters"],
    gradient: Float[np.ndarray, " parameters"],
    at_zero: Sequence[int],
    still: Sequence[int] = (),
) -> Float[np.ndarray, " parameters"]:
    """The next Gauss-Newton step, downhill; parameters at zero do not become negative.

    Others stand `still`: those so near zero that slopes there say nothing about a step.
    """
    held = [*(k for k in at_zero if gradient[k] > 0), *still]
    if not held:
        return scaled_inverse(bread) @ gradient
    free, step = np.setdiff1d(np.arange(gradient.size), held), np.zeros(gradient.size)
    step[free] = scaled_inverse(bread[np.ix_(free, free)]) @ gradient[free]
    return step


def _information(
    problem: Problem,
    solution: Solution,
    blocks: list[Block],
    covariances: tuple[Matrix, Matrix],
    units: Float[np.ndarray, " all"],
) -> Information:
    """What the data say; the covariances are those with model error and by the noise alone."""
    places = problem.parameters.places
    return Information(
        root=information_root(blocks),
        covariance=covariances[0],
        by_noise=covariances[1],
        names=tuple(place.name for place in places),
        values=np.asarray(solution.values),
        units=units,
        order=ranks_of(places),
        same=ft.partial(same_responses, problem, solution),
    )


def identifiability_of(
    facts: Information, prior: PriorRows, bounds: tuple[Bound, ...] = ()
) -> tuple[Verdict, Verdict]:
    """What data and priors determine together, and what the data determine alone."""
    if not len(prior.misfit):
        verdict = assess_identifiability(facts, bounds)
        return verdict, verdict
    # Rows come in pairs of magnitude and phase; a prior's row counts once.
    priors = np.repeat(prior.slopes, 2, axis=0) / np.sqrt(2)
    return assess_identifiability(
        facts._replace(root=np.concatenate([facts.root, priors])), bounds
    ), assess_identifiability(facts, bounds)


def ranks_of(places: Sequence[Place]) -> tuple[int, ...]:
    """Each parameter's place in the model's own order."""
    ordered = sorted(places, key=lambda place: (place.leaf, place.index))
    return tuple(ordered.index(place) for place in places)


_NO_MINIMUM = 1e-2  # Newton decrement over cost, above which no number counts as determined
