"""From a solver's stop to a result that states what it is worth."""

import dataclasses
import functools as ft
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, PyTree

from jaxquad._core import as_messages, Message
from jaxquad.models import LaggedIntegrator, StateSpace, TransferFunction
from jaxquad.spectra import FrequencyResponse

from ..frequency_domain._cost import widen_band
from ..frequency_domain._parameters import Parameters, Place
from ..frequency_domain._problem import on_device, Problem
from ..frequency_domain._refits import Origin
from ..frequency_domain._result import Fit
from ..frequency_domain._sampled import remarks_on_hold
from ..frequency_domain._solve import is_saddle, Minimum, same_responses, Solution
from ..output_error._noise import NoiseModel
from ..output_error._simulated import HasStateSpace, HasTransferFunction, linear_model
from ._accuracy import (
    Block,
    blocks_of,
    condition_number,
    cramer_rao,
    degrees_of_freedom,
    fitted_noise,
    gauss_newton,
    information_root,
    insensitivity,
    Matrix,
    misfit_ratio,
    noise_effect,
    PriorRows,
    scaled_inverse,
)
from ._error_budget import (
    Discrepancy,
    error_budget,
    ErrorBudget,
    records_of,
    Units,
    units_of,
    Weighting,
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
    runaways,
)
from ._identifiability import assess_identifiability, Information, LIMIT
from ._verdict import Bound, pooled_freedom, Verdict
from ._zero_bounds import bounds_among, near_zeros, one_sided_covariance, pulled_beyond


_NO_MINIMUM = 1e-2  # Newton decrement over cost, above which no number counts as determined

Vector = Float[np.ndarray, " parameters"]
_NEAR = 1.5  # ratio of costs within which another minimum is a rival


def assess(
    problem: Problem,
    weighting: Weighting,
    solution: Solution,
    minima: tuple[Minimum, ...] = (),
    *,
    further: Sequence[str] = (),
    origin: Origin | None = None,
) -> Fit:
    """Costs, bounds, calibrated covariance and identifiability at the solution.

    The fit gets the `further` remarks and its `origin`.
    """
    names, count = problem.parameters.names, problem.parameters.count
    frfs = [points.frf for points in weighting.points]
    start = units = units_of(solution)
    budget = error_budget(weighting.records, weighting.mixtures, solution, units)
    bread, bounds = budget.bread, ()  # by the slopes at the solution itself
    near = near_zeros(problem, solution, budget)
    still = [one.k for one in near if one.changes is not None and one.bound.value]
    step = newton_step(bread, budget.gradient, solution.at_zero, still)
    decrement = 0.5 * float(budget.gradient @ step)

    def budget_up_to_limits() -> ErrorBudget:
        """With slopes that hold up to the limits of parameters near zero."""
        records = records_of(problem, frfs, solution, units)
        for number, record in enumerate(records):
            slopes = record.slopes.copy()
            for one in near:
                if one.changes is not None:
                    slopes[..., one.k] = units[one.k] * one.changes[number]
            records[number] = dataclasses.replace(record, slopes=slopes)
        return error_budget(records, weighting.mixtures, solution, units)

    if near:
        budget = budget_up_to_limits()
        bounds, mixed = bounds_among(near, budget, solution, units)
        if not np.array_equal(mixed, units):
            units = mixed
            budget = budget_up_to_limits()
    step = step * (start / units)[: step.size]
    cost, average, information, misfit = _costs_by_noise(
        problem, weighting, solution, budget, units
    )
    cut = ft.partial(one_sided_covariance, budget=budget, names=names, bounds=bounds)
    by_noise, covariance = cut(budget.by_noise), cut(budget.covariance)
    places = problem.parameters.places
    facts = Information(
        root=information_root(budget.blocks),
        covariance=covariance,
        by_noise=by_noise,
        names=tuple(place.name for place in places),
        values=np.asarray(solution.values),
        units=units,
        order=ranks_of(places),
        same=ft.partial(same_responses, problem, solution),
    )
    used = [np.asarray(weights)[..., 0] > 0 for weights in problem.weights]
    controller = [mine & frf.of_controller for frf, mine in zip(frfs, used, strict=True)]
    dominated, points = (int(sum(map(np.count_nonzero, masks))) for masks in (controller, used))
    unfinished = decrement > _NO_MINIMUM * max(cost, 1e-9)
    if 2 * dominated > points:
        verdict = by_data = fed_back(names, dominated, points)
    elif unfinished or is_unfinished(solution, step, budget.by_noise):
        remedies = ("«start from other values»", "try many starts at once (starts=20)")
        verdict = by_data = no_minimum(names, decrement, cost, *remedies, message=solution.message)
    elif budget.discrepancy.amplitude > NO_MODEL:
        verdict = by_data = no_model(names, budget.discrepancy.amplitude)
    else:
        verdict, by_data = identifiability_of(facts, budget.prior, bounds)
        indefinite = not verdict.identifiable and not len(verdict.exact)
        if indefinite and (wider := widen_band(frfs, used)):  # may tell parameters apart
            verdict = dataclasses.replace(verdict, remedies=(wider, *verdict.remedies))
    # Those of the responses' remarks that concern the points in use, each once.
    parts = [frf.remarks_about(mine) for frf, mine in zip(frfs, used, strict=True) if frf.remarks]
    remarks = list(dict.fromkeys(remark for part in parts for remark in part))
    remarks += remarks_on_hold(frfs, used)
    if not is_fed_back(verdict):
        here = total_cost(budget.blocks, budget.prior)
        saddle = solution.converged and is_saddle(problem, solution, here, bread)
        # Few points of independent noise reach a large misfit by chance: the discrepancy has to
        # say so, too.
        doubted = misfit if budget.discrepancy.none < DOUBT else min(misfit, 1.0)
        remarks += [
            *remarks_on_fit(problem, solution, cost, decrement, doubted, verdict),
            *remarks_on_bounds(pulled_beyond(budget, names, bounds), verdict),
            *_remarks_on_growth(solution.model, frfs, used),
            *remarks_on_minima(problem, saddle, minima),
            *remarks_on_priors(budget.prior.misfit, verdict, by_data, chi_squared=doubted),
            *remarks_on_discrepancy(budget.discrepancy),
        ]
    return make_fit(
        problem,
        solution,
        bread=budget.bread,
        covariance=covariance,
        by_noise=by_noise,
        units=units[:count],
        verdict=verdict,
        decrement=decrement,
        cost=cost,
        average_cost=average,
        information=information,
        chi_squared=misfit,
        points=sum(int(np.sum(block.weights[:, 0] > 0)) for block in budget.blocks),
        freedom=degrees_of_freedom(budget.records, budget.bread, budget.noise, count),
        remarks=(*remarks, *further),
        minima=minima,
        discrepancy=budget.discrepancy,
        origin=origin,
    )


def remarks_on_minima(
    problem: Problem, is_saddle: bool, minima: tuple[Minimum, ...]
) -> list[Message]:
    """Remarks on a saddle instead of a minimum, and on other minima of nearly the best cost."""
    remarks = []
    if is_saddle:
        text = (
            "stationary, but no minimum: the cost falls to one side; «start from other values»"
            "«, or give starts=20»"
        )
        remarks.append(Message(text, "saddle"))
    true = [point for point in minima if point.is_minimum]
    rivals = [point for point in true[1:] if point.cost <= _NEAR * true[0].cost]
    if rivals:
        values = ", ".join(f"{x:.4g}" for x in rivals[0].values)
        text = (
            f"{len(rivals)} other minima cost less than {_NEAR:g} times the best; the next costs "
            f"{rivals[0].cost:.4g} at {', '.join(problem.parameters.names)} = {values}: record "
            "more, or over a wider band, to know which is right"
        )
        remarks.append(Message(text, "other minima"))
    return remarks


def newton_step(
    bread: Matrix, gradient: Vector, at_zero: Sequence[int], still: Sequence[int] = ()
) -> Vector:
    """The next Gauss-Newton step, downhill; parameters at zero do not become negative.

    Others stand `still`: those so near zero that slopes there say nothing about a step.
    """
    fixed = [*(k for k in at_zero if gradient[k] > 0), *still]
    if not fixed:
        return scaled_inverse(bread) @ gradient
    free, step = np.setdiff1d(np.arange(gradient.size), fixed), np.zeros(gradient.size)
    step[free] = scaled_inverse(bread[np.ix_(free, free)]) @ gradient[free]
    return step


def total_cost(blocks: list[Block], prior: PriorRows | None = None) -> float:
    """The sum of squares of the data, and of the priors."""
    data = sum(float(np.sum(block.residual**2)) for block in blocks)
    return data if prior is None else data + float(np.sum(prior.misfit**2))


def _costs_by_noise(
    problem: Problem, weighting: Weighting, solution: Solution, budget: ErrorBudget, units: Units
) -> tuple[float, float, float, float]:
    """Cost, average, information and misfit under weights by the noise alone.

    They compare fits of other structures.
    """
    blocks, prior, bread, noise = budget.blocks, budget.prior, budget.bread, budget.noise
    if weighting.weights is not None:
        count = problem.parameters.count
        alone = problem.weighted(weighting.weights, weighting.mixings)
        frfs = [points.frf for points in weighting.points]
        records = records_of(alone, frfs, solution, units)
        blocks = blocks_of(records)
        bread, _ = gauss_newton(blocks, prior, count)
        noise = noise_effect(records, blocks, prior, count)
    cost = total_cost(blocks, prior)
    misfit = misfit_ratio(total_cost(blocks), bread, noise)
    # A misfit beyond the noise is in no covariance of the noise.
    inflation = misfit if misfit > MISFIT**2 else 1.0
    information = cost + 2 * inflation * fitted_noise(bread, noise)
    return cost, cost / len(blocks), information, misfit


def _remarks_on_growth(
    model: PyTree, frfs: Sequence[FrequencyResponse], used: Sequence[np.ndarray]
) -> Sequence[str]:
    """Remark on a model that grows within the band of a direct estimate: no open loop does."""
    lags = isinstance(model, LaggedIntegrator) and not np.asarray(model.lag) < 0
    if lags or not any(frf.method == "direct" for frf in frfs):
        return []
    if not isinstance(model, StateSpace | TransferFunction | HasStateSpace | HasTransferFunction):
        return []
    pairs = zip(frfs, used, strict=True)
    omega = np.concatenate([np.asarray(f.omega)[np.any(m, axis=(1, 2))] for f, m in pairs])
    lowest, highest = float(np.min(omega)), float(np.max(omega))
    poles = linear_model(on_device(model)).poles
    growth = float(np.max(np.real(poles[np.abs(poles) < highest]), initial=0.0))
    return remarks_on_growth(growth) if growth > lowest else []


def identifiability_of(
    facts: Information, prior: PriorRows, bounds: tuple[Bound, ...] = ()
) -> tuple[Verdict, Verdict]:
    """What data and priors determine together, and what the data determine alone."""
    by_data = assess_identifiability(facts, bounds)
    if not len(prior.misfit):
        return by_data, by_data
    # Rows come in pairs of magnitude and phase; a prior's row counts once.
    priors = np.repeat(prior.slopes, 2, axis=0) / np.sqrt(2)
    together = facts._replace(root=np.concatenate([facts.root, priors]))
    return assess_identifiability(together, bounds), by_data


def ranks_of(places: Sequence[Place]) -> tuple[int, ...]:
    """Each parameter's place in the model's own order."""
    ordered = sorted(places, key=lambda place: (place.leaf, place.index))
    return tuple(ordered.index(place) for place in places)


def make_fit(
    problem: Problem,
    solution: Solution,
    *,
    bread: Matrix,
    covariance: Matrix,
    by_noise: Matrix,
    units: Vector,
    verdict: Verdict,
    decrement: float,
    cost: float,
    average_cost: float,
    information: float,
    chi_squared: float,
    points: int,
    remarks: tuple[str, ...],
    minima: tuple[Minimum, ...] = (),
    freedom: Vector | None = None,
    discrepancy: Discrepancy | None = None,
    noise_models: tuple[tuple[NoiseModel, ...], ...] = (),
    origin: Origin | None = None,
) -> Fit:
    """A result in physical units; both covariances are those of changes relative to `units`.

    `freedom` is that of the noise estimate, infinite without.
    """
    names, values = problem.parameters.names, np.asarray(solution.values)[: units.size]
    freedom = np.full(units.size, np.inf) if freedom is None else freedom
    pooled = pooled_freedom(freedom, np.ones(units.size))
    combinations = (one._replace(degrees_of_freedom=pooled) for one in verdict.combinations)
    verdict = dataclasses.replace(verdict, combinations=tuple(combinations))
    if runaways(problem, solution, verdict) and not is_fed_back(verdict):
        verdict = dataclasses.replace(verdict, remedies=())  # the remarks say what to do
    unbounded = np.zeros(len(names), dtype=bool)
    if verdict.undetermined:
        # A pseudo-inverse shows no variance along a null direction: there it is unbounded.
        rows = [[row.get(name, 0.0) for name in names] for row in verdict.null_directions]
        hidden = [row for row in np.array(rows) if row @ covariance @ row < (0.5 * LIMIT) ** 2]
        null = np.reshape([*hidden, *verdict.exact], (-1, len(names)))
        lost = np.array([name in verdict.undetermined for name in names])
        unbounded = lost & np.any(np.abs(null) > 1e-6, axis=0)

    def in_units(relative: Matrix) -> Matrix:
        physical = relative * np.outer(units, units)
        if unbounded.any():
            physical[unbounded, :] = physical[:, unbounded] = np.nan
        return physical

    physical = in_units(covariance)
    with np.errstate(divide="ignore"):
        percent = np.where(values == 0, np.nan, 100 * np.abs(units / values))
    return Fit(
        model=on_device(solution.model),
        names=names,
        values=values,
        standard_errors=np.where(unbounded, np.inf, np.sqrt(np.diagonal(physical))),
        covariance=physical,
        noise_covariance=in_units(by_noise),
        cramer_rao=np.where(unbounded, np.inf, cramer_rao(bread) * percent),
        insensitivity=insensitivity(bread) * percent,
        cost=cost,
        average_cost=average_cost,
        information=information,
        chi_squared=chi_squared,
        newton_decrement=decrement,
        condition=condition_number(bread),
        points=points,
        steps=solution.steps,
        verdict=verdict,
        remarks=as_messages(remarks),
        parameters=problem.parameters,
        units=units,
        relative_covariance=covariance,
        relative_noise_covariance=by_noise,
        minima=minima,
        degrees_of_freedom=freedom,
        discrepancy=discrepancy,
        noise_models=noise_models,
        origin=origin,
    )


def unfitted(
    model: PyTree, parameters: Parameters, verdict: Verdict, remarks: tuple[str, ...] = ()
) -> Fit:
    """What a fit returns where there is nothing to fit: the starting values, all marked."""
    count = parameters.count
    infinite, unknown = np.full(count, np.inf), np.full((count, count), np.nan)
    return Fit(
        model=model,
        names=parameters.names,
        values=np.asarray(parameters.values(parameters.start[:count])),
        standard_errors=infinite,
        covariance=unknown,
        noise_covariance=unknown,
        cramer_rao=infinite,
        insensitivity=infinite,
        degrees_of_freedom=infinite,
        cost=np.nan,
        average_cost=np.nan,
        information=np.nan,
        chi_squared=np.nan,
        newton_decrement=np.nan,
        condition=np.inf,
        points=0,
        steps=0,
        verdict=verdict,
        remarks=as_messages(remarks),
        parameters=parameters,
        units=np.asarray(parameters.slopes(parameters.start[:count])),
        relative_covariance=unknown,
        relative_noise_covariance=unknown,
    )
