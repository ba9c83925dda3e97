"""From the stop of an output-error fit to a result that states what it is worth."""

import functools as ft
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad._core import Message
from jaxquad.records import Record

from ..frequency_domain._result import Fit
from ..uncertainty._assess import (
    is_unfinished,
    make_fit,
    no_minimum,
    no_model,
    remarks_on_priors,
    runaways,
)
from ..uncertainty._error_budget import (
    calibrated_covariance,
    Matrix,
    Noise,
    prior_rows,
    PriorRows,
    rescale,
    scaled_inverse,
    units_of,
)
from ..uncertainty._verdict import identifiability_of, Information, NO_MINIMUM, Verdict
from ._coloured_noise import orthogonal_factors, orthonormal, projected_noise
from ._descent import Descent, with_fixed_slopes
from ._problem import evaluate_misfits, Evaluation, RecordTerm


_NOTHING = 0.01  # share of the output's power: a model that explains less has no response
_LEFT = 1e-2  # share of what the noise moves that a step may still save

Vector = Float[np.ndarray, " all"]


class Projected(NamedTuple):
    """Misfit and slopes of one record, orthogonal to what else is fitted to it."""

    misfit: Float[np.ndarray, "samples outputs"]
    slopes: Float[np.ndarray, "samples outputs all"]  # of the misfit, by relative changes
    nuisance: Float[np.ndarray, "samples outputs unknowns"]  # orthonormal


class Reduced(NamedTuple):
    """In the coordinates of orthonormal combinations of the slopes; free parameters first."""

    root: Float[np.ndarray, "all all"]  # slopes
    aim: Vector  # misfit
    noise: Float[np.ndarray, "all all"]  # covariance of the noise in the misfit
    output: Vector  # measured output


def assess_output_error(descent: Descent, records: Sequence[Record]) -> Fit:
    """Costs, bounds, covariance and identifiability at the solution."""
    problem, solution = descent.problem, descent.solution
    base, parameters, count = problem.base, problem.base.parameters, problem.base.parameters.count
    units = units_of(solution)
    scale, prior = rescale(solution, units), prior_rows(solution, units)
    projected = _project_records(descent, descent.evaluation, scale[:count])
    reduced = _reduce_rows(projected, problem.terms, count)
    root, slopes = reduced.root[:, :count], prior.slopes[:, :count]
    bread = root.T @ root + slopes.T @ slopes
    gradient = root.T @ reduced.aim + slopes.T @ prior.misfit
    noise = Noise(root.T @ reduced.noise @ root, slopes.T @ slopes, 0.0)
    rows = sum(int(np.sum(term.counted)) for term in problem.terms)
    data_cost = sum(float(np.sum(one.misfit**2)) for one in projected)
    cost = data_cost + float(np.sum(prior.misfit**2))
    covariance = calibrated_covariance(bread, noise)
    taken = float(np.trace(scaled_inverse(bread) @ noise.data))
    step = scaled_inverse(bread) @ gradient
    decrement = 0.5 * float(gradient @ step)
    # The share of the outputs' power that the inputs explain, without initial state and trim.
    total = 0.0
    for one, term in zip(projected, problem.terms, strict=True):
        basis = one.nuisance.reshape(-1, one.nuisance.shape[2])
        output = np.asarray(term.measured).reshape(-1)
        total += float(np.sum(output**2) - np.sum((basis.T @ output) ** 2))
    explained = 1 - data_cost / total if total > 0 else 1.0
    # In units of what the noise moves: a share of the cost would grow with the record.
    if decrement > count * max(taken, 1.0) or is_unfinished(solution, step, covariance):
        remedy = "«start from other values», for instance those of jq.fit"
        verdict = by_data = no_minimum(
            parameters.names, decrement, cost, remedy, message=solution.message
        )
    elif solution.at_zero and explained < _NOTHING:
        verdict = by_data = no_model(parameters.names, 1 - explained)
    else:
        verdict, by_data = _verdict(descent, reduced, prior, covariance, units)
    fitted = count + sum(one.nuisance.shape[2] for one in projected)
    samples = sum(one.misfit.size for one in projected)
    fitted_to_noise = taken + sum(sum(m.order) for one in descent.noise for m in one.models)
    levels = [float(np.sum(np.log(np.asarray(term.weights)))) for term in problem.terms]
    terms = zip(problem.terms, levels, strict=True)
    deviance = sum(-2 * len(term.y) * level for term, level in terms)
    information = deviance + cost * samples / rows + 2 * fitted_to_noise
    return make_fit(
        base,
        solution,
        bread=bread,
        covariance=covariance,
        by_noise=covariance,
        units=units[:count],
        verdict=verdict,
        decrement=decrement,
        cost=cost,
        average_cost=cost / sum(one.misfit.shape[1] for one in projected),
        information=information,
        chi_squared=data_cost / max(rows - fitted, 1),
        points=rows,
        remarks=(
            *_remarks_on_output_error(descent, records, decrement, taken, verdict),
            *_remarks_on_colour(descent, bread, covariance),
            *remarks_on_priors(prior.misfit, verdict, by_data),
        ),
        noise_models=tuple(noise.models for noise in descent.noise),
    )


def _project_records(descent: Descent, evaluation: Evaluation, scale: Vector) -> list[Projected]:
    """Each record with slopes by relative changes, orthogonal to what else is fitted to it.

    That is its initial state, its trim and its noise model: the errors are those of a joint
    estimate, in a closed loop too, where the input depends on the noise.
    """
    projected, at = [], scale.size
    noises = [noise.slopes for noise in descent.noise] or [None] * len(evaluation.misfits)
    parts = zip(descent.problem.terms, *evaluation[:3], noises, strict=True)
    for term, misfit, slopes, columns, noise in parts:
        slopes, states = np.asarray(slopes), term.start.size
        others = [np.asarray(columns), slopes[:, :, at : at + states], noise]
        others = [part for part in others if part is not None and part.shape[2]]
        basis = orthonormal(others[0] if len(others) == 1 else np.concatenate(others, axis=2))
        mine = slopes[:, :, : scale.size] * scale
        rows, flat = mine.reshape(-1, scale.size), basis.reshape(-1, basis.shape[2])
        # Series are rows in memory: so are their products.
        left = (rows.T - (rows.T @ flat) @ flat.T).T.reshape(mine.shape)
        projected.append(Projected(np.asarray(misfit), left, basis))
        at += states
    return projected


def _reduce_rows(
    projected: Sequence[Projected], terms: Sequence[RecordTerm], count: int
) -> Reduced:
    """Slopes, misfit, noise and output in one orthonormal basis of the slopes of all records."""
    every = projected[0].slopes.shape[2]
    stacked = [one.slopes.reshape(-1, every).T for one in projected]
    stacked = np.concatenate([*stacked, np.zeros((every, every))], axis=1)
    basis, root = orthogonal_factors(stacked.T)
    aim, output, noise, at = np.zeros(every), np.zeros(every), np.zeros((every, every)), 0
    for one, term in zip(projected, terms, strict=True):
        flat = basis[at : at + one.misfit.size]
        mine = flat.reshape(one.slopes.shape)
        aim += one.misfit.reshape(-1) @ flat
        output += np.asarray(term.measured).reshape(-1) @ flat
        noise += projected_noise(mine, one.misfit, one.nuisance, count)
        at += one.misfit.size
    return Reduced(root, aim, noise, output)


def _verdict(
    descent: Descent, reduced: Reduced, prior: PriorRows, covariance: Matrix, units: Vector
) -> tuple[Verdict, Verdict]:
    """What data and priors determine; fixed parameters are looked at for names alone."""
    solution, terms, count = descent.solution, descent.problem.terms, len(covariance)

    def information(reduced: Reduced) -> Information:
        places = descent.problem.base.parameters.places[: reduced.aim.size]
        return Information(
            root=_signed_root(reduced),
            covariance=covariance,
            by_noise=covariance,
            places=places,
            values=np.asarray(solution.values)[: reduced.aim.size],
            units=units[: reduced.aim.size],
            same=ft.partial(_same_outputs, descent),
        )

    free = prior._replace(slopes=prior.slopes[:, :count])
    verdicts = identifiability_of(information(reduced), free)
    if units.size == count or not any(verdict.undetermined for verdict in verdicts):
        return verdicts
    projected = _project_records(descent, with_fixed_slopes(descent), rescale(solution, units))
    return identifiability_of(information(_reduce_rows(projected, terms, count)), prior)


def _signed_root(reduced: Reduced) -> Float[np.ndarray, "rows all"]:
    """Slopes of the output in units of their noise, whose even rows tell the way of the response.

    The first row is the part along the measured output; zeros stand for the other even ones.
    """
    values, vectors = np.linalg.eigh(reduced.noise)
    values = np.maximum(values, max(1e-12 * values[-1], 1e-30))
    whitened = vectors / np.sqrt(values)
    root, along = -whitened.T @ reduced.root, whitened.T @ reduced.output
    turned = np.linalg.qr(np.column_stack([along, np.eye(along.size)]))[0]
    turned[:, 0] *= np.sign(turned[:, 0] @ along) or 1.0
    rows = turned.T @ root
    spaced = np.zeros((2 * len(rows), rows.shape[1]))
    spaced[0], spaced[1 : 2 * len(rows) - 2 : 2] = rows[0], rows[1:]
    return spaced


def _same_outputs(descent: Descent, values: Float[np.ndarray, " parameters"]) -> bool:
    """Whether other values of the free parameters leave all simulated outputs as they are."""
    problem, parameters = descent.problem, descent.problem.base.parameters
    count = parameters.count
    ratio = values / np.asarray(parameters.scale)[:count]
    logarithmic = np.array(parameters.logarithmic[:count])
    if np.any(logarithmic & (ratio <= 0)):
        return False
    z = np.where(logarithmic, np.log(np.where(logarithmic, ratio, 1.0)), ratio)
    other = evaluate_misfits(np.concatenate([np.asarray(z), descent.z[count:]]), problem).misfits
    for new, old, term in zip(other, descent.evaluation.misfits, problem.terms, strict=True):
        size = np.std(np.asarray(term.y), axis=0) * np.asarray(term.weights)
        if not np.all(np.abs(np.asarray(new) - np.asarray(old)) < 1e-6 * size):
            return False
    return True


def _remarks_on_output_error(
    descent: Descent, records: Sequence[Record], decrement: float, taken: float, verdict: Verdict
) -> list[Message]:
    """Runaway parameters, missing convergence, and feedback."""
    solution, no_minimum = descent.solution, decrement > _LEFT * max(taken, 1.0)
    remarks = runaways(descent.problem.base, solution, verdict)
    if not solution.converged and (no_minimum or not remarks):
        remarks.append(Message(f"the solver stopped early: {solution.message}", "stopped early"))
    if no_minimum:
        remarks.append(
            Message(
                f"no minimum: one more Gauss-Newton step would lower the cost by "
                f"{2 * decrement:.3g}, where the noise alone accounts for {taken:.3g}; «start from "
                "other values», for instance those of jq.fit",
                NO_MINIMUM,
            )
        )
    names = dict.fromkeys(name for record in records for name in record.reference_names)
    closed = any(term.feedback is not None for term in descent.problem.terms)
    if names and not closed:
        doubt, instead = (
            "output error is biased where feedback returns the noise to the input; fit",
            " instead",
        )
        if descent.noise:
            doubt, instead = (
                "the estimate is unbiased only as far as the noise model describes the noise; "
                "compare",
                "",
            )
        text = (
            f"the record has references ({', '.join(names)}), so a loop may have been closed: "
            f"{doubt} the joint estimate{instead}"
            "«joint estimate|, jq.frequency_response(..., estimator=jq.spectra.JointInputOutput())»"
        )
        remarks.append(Message(text, "feedback"))
    text = (
        "the noise level is estimated from the residuals, so misfit / random error is 1 for any "
        "model: check the model by «jq.verify» on another record"
    )
    return [*remarks, Message(text, "noise level")]


def _remarks_on_colour(descent: Descent, bread: Matrix, covariance: Matrix) -> list[Message]:
    """Remark on residuals whose colour changes the standard errors."""
    white = np.diagonal(scaled_inverse(bread))
    ratio = np.sqrt(np.diagonal(covariance) / np.maximum(white, 1e-300))
    ratio = ratio[ratio > 1e-3]  # what nothing determines has none
    most = float(ratio[np.argmax(np.abs(np.log(ratio)))]) if ratio.size else 1.0
    if 0.67 < most < 1.5:
        return []
    misfits = [np.asarray(one) for one in descent.evaluation.misfits]
    pairs = [np.sum(one[1:] * one[:-1], axis=0) / np.sum(one**2, axis=0) for one in misfits]
    correlation = max(np.concatenate(pairs), key=abs)
    if descent.noise:
        subject, advice = "the noise model leaves the residuals", "try one of higher order"
    else:
        subject, advice = "the residuals are", 'noise="auto" weights them by their spectrum'
    text = (
        f"{subject} coloured (lag-one correlation {correlation:.2f}): standard errors allow for "
        f"it, and are up to {most:.2g} times those under white noise; {advice}"
    )
    return [Message(text, "coloured residuals")]
