"""From the stop of an output-error fit to a result that states what it is worth."""

import functools as ft
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxquad.records import Record

from ._accuracy import (
    calibrated_covariance,
    condition_number,
    cramer_rao,
    insensitivity,
    Known,
    scaled_inverse,
)
from ._assess import _identifiability, _known, _ranks, _rescale, _units
from ._fixed_slopes import with_fixed_slopes
from ._identifiable import Identifiability, Information
from ._output_error_descent import Descent
from ._output_error_remarks import remarks_on_colour, remarks_on_output_error
from ._reduced import gauss_newton, Reduced, reduced_rows, seen_records, signed_root
from ._remarks import remarks_on_priors
from ._result import Fit
from ._trial import found_at, OutputError, Trial


def assess_output_error(descent: Descent, records: Sequence[Record]) -> Fit:
    """Costs, bounds, covariance and identifiability at the solution."""
    problem, solution = descent.problem, descent.solution
    base, parameters, count = problem.base, problem.base.parameters, problem.base.parameters.count
    units, rescale = _units(base, solution), _rescale(solution, _units(base, solution))
    seen, known = seen_records(problem, descent.found, rescale[:count]), _known(solution, units)
    reduced = reduced_rows(seen, problem.trials, count)
    bread, gradient, noise = gauss_newton(reduced, known, count)
    rows = sum(one.misfit.size for one in seen)
    data_cost = sum(float(np.sum(one.misfit**2)) for one in seen)
    cost = data_cost + float(np.sum(known.misfit**2))
    covariance = calibrated_covariance(bread, noise)
    taken = float(np.trace(scaled_inverse(bread) @ noise.data))
    decrement = 0.5 * float(gradient @ scaled_inverse(bread) @ gradient)
    verdict = by_data = Identifiability(parameters.names, (), (), np.eye(count), (), ())
    # In units of what the noise moves: a share of the cost would grow with the record.
    if decrement <= count * max(taken, 1.0):
        verdict, by_data = _verdict(descent, reduced, known, covariance, units)
    values, slopes = np.asarray(solution.values)[:count], units[:count]
    lost = np.array([name in verdict.undetermined for name in parameters.names])
    physical = covariance * np.outer(slopes, slopes)
    physical[lost, :] = physical[:, lost] = np.nan
    percent = 100 * np.abs(slopes) / np.maximum(np.abs(values), 1e-3 * np.abs(slopes))
    fitted = count + sum(one.nuisance.shape[2] for one in seen)
    return Fit(
        model=solution.model,
        names=parameters.names,
        values=np.where(lost, np.nan, values),
        standard_errors=np.where(lost, np.inf, np.sqrt(np.diagonal(physical))),
        covariance=physical,
        cramer_rao=np.where(lost, np.inf, cramer_rao(bread) * percent),
        insensitivity=insensitivity(bread) * percent,
        cost=cost,
        average_cost=cost / sum(one.misfit.shape[1] for one in seen),
        information=_deviance(problem) + cost + 2 * taken,
        chi_squared=data_cost / max(rows - fitted, 1),
        newton_decrement=decrement,
        condition=condition_number(bread),
        points=rows,
        steps=solution.steps,
        identifiability=verdict,
        remarks=(
            *remarks_on_output_error(base, solution, records, decrement, taken),
            *remarks_on_colour([one.misfit for one in seen], bread, covariance),
            *remarks_on_priors(known.misfit, verdict, by_data),
        ),
        parameters=parameters,
        units=units[:count],
        relative_covariance=covariance,
    )


def _verdict(
    descent: Descent,
    reduced: Reduced,
    known: Known,
    covariance: Float[np.ndarray, "parameters parameters"],
    units: Float[np.ndarray, " all"],
) -> tuple[Identifiability, Identifiability]:
    """What data and priors determine; fixed parameters are looked at for names alone."""
    problem, solution, count = descent.problem, descent.solution, len(covariance)
    free = known._replace(slopes=known.slopes[:, :count])
    found = _identifiability(_information(descent, reduced, covariance, units), free)
    if units.size == count or not any(verdict.undetermined for verdict in found):
        return found
    seen = seen_records(problem, with_fixed_slopes(descent), _rescale(solution, units))
    reduced = reduced_rows(seen, problem.trials, count)
    return _identifiability(_information(descent, reduced, covariance, units), known)


def _information(
    descent: Descent,
    reduced: Reduced,
    covariance: Float[np.ndarray, "parameters parameters"],
    units: Float[np.ndarray, " all"],
) -> Information:
    count = len(reduced.aim)
    places = descent.problem.base.parameters.places[:count]
    return Information(
        root=signed_root(reduced),
        covariance=covariance,
        names=tuple(place.name for place in places),
        values=np.asarray(descent.solution.values)[:count],
        units=units[:count],
        order=_ranks(places),
        same=ft.partial(_same, descent),
    )


def _deviance(problem: OutputError) -> float:
    """Twice the logarithms of the noise levels, over all samples."""
    return sum(-2 * len(t.y) * float(np.sum(np.log(np.asarray(t.weights)))) for t in problem.trials)


def _same(descent: Descent, values: Float[np.ndarray, " parameters"]) -> bool:
    """Whether other values of the free parameters leave all simulated outputs as they are."""
    problem, found = descent.problem, descent.found
    parameters, count = problem.base.parameters, problem.base.parameters.count
    ratio = values / np.asarray(parameters.scale)[:count]
    logarithmic = np.array(parameters.logarithmic[:count])
    if np.any(logarithmic & (ratio <= 0)):
        return False
    z = np.where(logarithmic, np.log(np.where(logarithmic, ratio, 1.0)), ratio)
    moved = found_at(jnp.concatenate([jnp.asarray(z), descent.z[count:]]), problem).misfits
    return all(
        _close(np.asarray(new), np.asarray(old), trial)
        for new, old, trial in zip(moved, found.misfits, problem.trials, strict=True)
    )


def _close(new: np.ndarray, old: np.ndarray, trial: Trial) -> bool:
    size = np.std(np.asarray(trial.y), axis=0) * np.asarray(trial.weights)
    return bool(np.all(np.abs(new - old) < 1e-6 * size))
