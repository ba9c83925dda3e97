"""Fits of models to records in the time domain, and what they are worth."""

import contextlib
import dataclasses
import functools as ft
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree

from jaxquad._core import Message, one_blas_thread, require_x64
from jaxquad.models import with_arrays
from jaxquad.records import Record

from ..frequency_domain._feedthrough import DirectDelay, remarks_on_samples
from ..frequency_domain._fit import check_priors
from ..frequency_domain._parameters import Free, select_parameters, Tie
from ..frequency_domain._problem import make_problem, Prior, require_model, require_priors
from ..frequency_domain._refits import free_again
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
    Noise as MisfitNoise,
    scaled_inverse,
)
from ..uncertainty._response_term import prior_rows, PriorRows, rescale, units_of
from ..uncertainty._verdict import identifiability_of, Information, NO_MINIMUM, Verdict
from ._descent import descend_within_samples, Descent, with_fixed_slopes
from ._noise import ARMA, AutoRegressive, Noise, orthonormal, projected_noise
from ._problem import (
    evaluate_misfits,
    Evaluation,
    feedback_response,
    KnownController,
    OutputError,
    RecordTerm,
)
from ._simulated import (
    band_filter,
    band_gain,
    check_channels,
    check_growth,
    count_states,
    DifferentialModel,
    inputs_between_samples,
    Linear,
    linear_model,
    unknown_motions,
)


_SHORT = 200_000  # samples, up to which a second thread of BLAS waits about as long as it works


def refine(
    model: PyTree | Fit,
    record: Record | Sequence[Record],
    *,
    noise: Noise | None = None,
    free: Free = None,
    tied: Mapping[str, Tie] | None = None,
    loop: KnownController | None = None,
    hold: str | None = None,
    band: tuple[float, float] | None = None,
    priors: Sequence[Prior] = (),
    max_steps: int = 64,
) -> Fit:
    """Estimate of a model's `free` parameters in the time domain: output or prediction error.

    Outputs are weighted by the variance of their residuals, which is estimated in turn with the
    parameters; `Fit.cost` is in units of it. Standard errors hold for coloured residuals. Each
    record has its own initial state, trim and noise level, which is that of its residuals: misfit /
    random error is 1 for any model, `jq.verify` on another record checks it. With a `noise` model,
    the errors of predicting each sample from those before it take the place of the residuals: an
    efficient estimate in coloured noise, and a consistent one where feedback returns noise to the
    input, as far as the noise model is right. With the controller of the `loop` the residuals are
    those of the closed loop, S (y - G u): what its references do not explain. That is consistent
    whatever the noise, and a noise model makes it efficient.

    **Arguments:**

    - `model`: its values are the start. A linear model (`jq.TransferFunction`, `jq.StateSpace`, or
        one with `transfer_function()` or `state_space()`) is discretised exactly, a
        `jq.models.DiscreteTransferFunction` (output error, or Box-Jenkins with `noise`) is at its
        samples already: `jq.identify.guess_discrete` makes a start of one. The initial state,
        biases on the state derivatives and a shift of each output are eliminated by least squares.
        Any other `eqx.Module` with `init()`, `derivative(state, inputs, disturbance)` and
        `measure(state)` is integrated by diffrax with a disturbance of zero; its initial state is
        estimated as a change of `init()`. A `jq.identify.Fit` starts from its values, with its
        free and tied parameters unless others are given.
    - `record`: a `jq.Record` or a list of them.
    - `noise`: None for white noise (output error), or a model of each output's own noise:
        `jq.identify.AutoRegressive(order)`, `jq.identify.ARMA(poles, zeros)`, or "auto" for the one
        of lowest Akaike criterion, with a `loop` always autoregressive. `Fit.noise_models` has what
        was found.
    - `free`, `tied`, `priors`: as in `jq.fit`.
    - `loop`: the controller that closed the loop in which the record was flown, as `jq.PID` or
        `jq.LADRC`: anything with a method `linear()`, taken as exact and without limits. The
        reference need not be in the record. One input and one output, held at the record's rate.
    - `hold`, `band`: as in `jq.verify`, the hold by default as each record says; model and data are
        filtered alike.
    - `max_steps`: of the solver.

    **Raises:**

    - `ValueError`: what `jq.fit` and `jq.verify` refuse, a model that cannot be simulated from
        its starting values, a band beside a noise model or a loop, and a controller that does not
        go with the record.
    - `PrecisionError`, a `ValueError`: JAX runs in 32 bits.

    Source: Klein & Morelli, Aircraft System Identification, ch. 6 (modified Newton-Raphson with
    relaxation, errors corrected for coloured residuals); Ljung, System Identification, ch. 7.
    """
    require_x64("an output-error fit")
    if isinstance(model, Record):
        require_model("refine", model)
    records = [record] if isinstance(record, Record) else list(record)
    if not records or not all(isinstance(one, Record) for one in records):
        kinds = ", ".join(sorted({type(one).__name__ for one in records})) or "nothing"
        raise ValueError(f"refine needs a jq.Record or a list of them, not {kinds}: see jq.read")
    if max_steps < 1:
        raise ValueError(f"max_steps is {max_steps}: give at least 1")
    for one in records:
        still = [n for n, y in zip(one.output_names, one.outputs.T, strict=True) if not np.ptp(y)]
        if still:
            raise ValueError(
                Message(f"output {still[0]} is constant: leave it out« with jq.records.select»")
            )
    if not (noise in (None, "auto") or isinstance(noise, AutoRegressive | ARMA)):
        raise ValueError(
            f"noise is {noise!r}: give None (white), jq.identify.AutoRegressive(order), "
            'jq.identify.ARMA(poles, zeros) or "auto"'
        )
    if noise is not None and band is not None:
        raise ValueError(
            f"band {band} rad/s and a noise model exclude each other: outside the band there is no "
            "noise left to model. Give noise alone: it weights each frequency by its noise"
        )
    if loop is not None and band is not None:
        raise ValueError(
            f"band {band} rad/s and a loop exclude each other: leave the band out, a noise model "
            'weights each frequency by its noise (noise="auto")'
        )
    longest = max(one.samples for one in records)
    near = isinstance(model, Fit)
    if isinstance(model, Fit):  # its choice of parameters holds where no other is given
        if tied is None:
            tied = {place.name: tie for place, tie in model.parameters.ties}
        free = free_again(model.parameters) if free is None else free
        model = model.model
    else:
        require_model("refine", model)
    model = with_arrays(model)
    parameters = select_parameters(model, free, tied)
    require_priors(model, priors)
    base = make_problem(model, parameters, (), priors=priors)
    if noise == "auto" and loop is not None:
        noise = AutoRegressive()  # a loop shapes its noise by more poles than a few zeros follow
    with one_blas_thread() if longest <= _SHORT else contextlib.nullcontext():
        terms = tuple(_term(model, one, hold, band, loop) for one in records)
        changed = {p.leaf for p in parameters.places} | {p.leaf for p, _ in parameters.ties}
        leaves = jax.tree.leaves(eqx.filter(model, eqx.is_inexact_array))
        still = [k for k, leaf in enumerate(leaves) if not np.any(np.asarray(leaf))]
        zeros = tuple(k for k in still if k not in changed)
        problem = _with_units(OutputError(base, terms, zeros))
        descent, limits = descend_within_samples(problem, noise, max_steps, near=near)
        check_priors(base, descent.solution)
        return assess_output_error(descent, records, remarks_on_samples(base, limits, records))


def _term(
    model: PyTree,
    record: Record,
    hold: str | None,
    band: tuple[float, float] | None,
    loop: KnownController | None,
) -> RecordTerm:
    differential = isinstance(model, DifferentialModel) and not isinstance(model, Linear)
    plant = None if differential else linear_model(model)
    u, between = inputs_between_samples(record, hold, plant)
    gain = band_gain(band, record)
    feedback = None if loop is None else np.asarray(feedback_response(loop, record, between))
    if plant is None:
        if loop is not None:
            raise ValueError(
                f"{type(model).__name__} is given by its differential equation, but a loop needs a "
                "linear model: give a jq.TransferFunction or a jq.StateSpace"
            )
        motions, start = None, np.ones(count_states(model))
        measured = jnp.size(model.measure(model.init()))
        if measured != len(record.output_names):
            raise ValueError(
                Message(
                    f"the model measures {measured} outputs, the record has "
                    f"{', '.join(record.output_names)}: «pick channels with jq.records.select»"
                )
            )
    else:
        check_channels(plant, record)
        remedy = "cut the record« with jq.records.trim», or fit frequency responses"
        check_growth(plant, record.duration, f"{remedy}, which need no simulation")
        motions, start = unknown_motions(plant, record.duration)[:2], np.zeros(0)
    y = band_filter(np.asarray(record.outputs), gain)
    weights = 1 / np.std(y, axis=0)
    return RecordTerm(u, y, weights, gain, motions, start, record.dt, between, feedback=feedback)


def _with_units(problem: OutputError) -> OutputError:
    """Initial states in units that each move the output by its own size, as far as they show."""
    if not problem.unknown:
        return problem
    count = problem.base.parameters.count
    z = np.concatenate([problem.base.parameters.start[:count], np.zeros(problem.unknown)])
    slopes = evaluate_misfits(z, problem).slopes
    terms, at = [], count
    for term, by_record in zip(problem.terms, slopes, strict=True):
        mine = np.asarray(by_record)[:, :, at : at + term.start.size]
        sizes = np.sqrt(np.mean(mine**2, axis=(0, 1)))
        if not np.all(np.isfinite(sizes)):
            raise ValueError(
                "the model cannot be integrated over the record from its starting values: it "
                "diverges or is too stiff. Start from other values, or cut the record with "
                "jq.records.trim"
            )
        shows = sizes > 1e-6 * np.max(sizes, initial=0.0)
        start = np.where(shows, 1 / np.where(shows, sizes, 1.0), 0.0)
        terms.append(dataclasses.replace(term, start=start))
        at += term.start.size
    return dataclasses.replace(problem, terms=tuple(terms))


_NOTHING = 0.01  # share of the output's power: a model that explains less has no response
_LEFT = 1e-2  # share of what the noise moves that a step may still save

Vector = Float[np.ndarray, " all"]


class Projected(NamedTuple):
    """Misfit and slopes of one record, orthogonal to what else is fitted to it."""

    misfit: Float[np.ndarray, "samples outputs"]
    slopes: Float[np.ndarray, "samples outputs all"]  # of the misfit, by relative changes
    nuisance: Float[np.ndarray, "samples outputs unknowns"]  # orthonormal


class Reduced(NamedTuple):
    """All records, in orthonormal combinations of their slopes; free parameters first."""

    records: list[Projected]
    root: Float[np.ndarray, "all all"]  # slopes
    aim: Vector  # misfit
    noise: Float[np.ndarray, "all all"]  # covariance of the noise in the misfit
    output: Vector  # measured output


def assess_output_error(
    descent: Descent, records: Sequence[Record], remarks: Sequence[Message] = ()
) -> Fit:
    """Costs, bounds, covariance and identifiability at the solution."""
    problem, solution = descent.problem, descent.solution
    base, parameters, count = problem.base, problem.base.parameters, problem.base.parameters.count
    units = units_of(solution)
    scale, prior = rescale(solution, units), prior_rows(solution, units)
    reduced = _reduce(descent, descent.evaluation, scale[:count])
    projected = reduced.records
    root, slopes = reduced.root[:, :count], prior.slopes[:, :count]
    bread = root.T @ root + slopes.T @ slopes
    gradient = root.T @ reduced.aim + slopes.T @ prior.misfit
    noise = MisfitNoise(root.T @ reduced.noise @ root, slopes.T @ slopes, 0.0)
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
    by_user = sum(not isinstance(quantity, DirectDelay) for quantity in base.quantities)
    pulls = np.asarray(prior.misfit)[:by_user]
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
            *(remarks_on_priors(pulls, verdict, by_data) if pulls.size else ()),
            *remarks,
        ),
        noise_models=tuple(noise.models for noise in descent.noise),
    )


def _reduce(descent: Descent, evaluation: Evaluation, scale: Vector) -> Reduced:
    """Slopes by relative changes, orthogonal to initial state, trim and noise model of each record:
    errors are those of a joint estimate, in a closed loop too."""
    projected, at, every = [], scale.size, scale.size
    noises = [noise.slopes for noise in descent.noise] or [None] * len(evaluation.misfits)
    terms, count = descent.problem.terms, descent.problem.base.parameters.count
    for term, misfit, slopes, columns, noise in zip(terms, *evaluation[:3], noises, strict=True):
        slopes, states = np.asarray(slopes), term.start.size
        others = [np.asarray(columns), slopes[:, :, at : at + states], noise]
        others = [part for part in others if part is not None and part.shape[2]]
        basis = orthonormal(others[0] if len(others) == 1 else np.concatenate(others, axis=2))
        mine = slopes[:, :, :every] * scale
        rows, flat = mine.reshape(-1, every), basis.reshape(-1, basis.shape[2])
        # Series are rows in memory: so are their products.
        left = (rows.T - (rows.T @ flat) @ flat.T).T.reshape(mine.shape)
        projected.append(Projected(np.asarray(misfit), left, basis))
        at += states
    stacked = [one.slopes.reshape(-1, every).T for one in projected]
    stacked = np.concatenate([*stacked, np.zeros((every, every))], axis=1)
    basis, root = np.linalg.qr(stacked.T)
    aim, output, noise, at = np.zeros(every), np.zeros(every), np.zeros((every, every)), 0
    for one, term in zip(projected, terms, strict=True):
        flat = basis[at : at + one.misfit.size]
        mine = flat.reshape(one.slopes.shape)
        aim += one.misfit.reshape(-1) @ flat
        output += np.asarray(term.measured).reshape(-1) @ flat
        noise += projected_noise(mine, one.misfit, one.nuisance, count)
        at += one.misfit.size
    return Reduced(projected, root, aim, noise, output)


def _verdict(
    descent: Descent, reduced: Reduced, prior: PriorRows, covariance: Matrix, units: Vector
) -> tuple[Verdict, Verdict]:
    """What data and priors determine; fixed parameters are looked at for names alone."""
    solution, count = descent.solution, len(covariance)

    def information(reduced: Reduced) -> Information:
        # Slopes of the output in units of their noise. The even rows tell the way of the response:
        # the first one is the part along the measured output, zeros stand for the others.
        ways, vectors = np.linalg.eigh(reduced.noise)
        whitened = vectors / np.sqrt(np.maximum(ways, max(1e-12 * ways[-1], 1e-30)))
        root, along = -whitened.T @ reduced.root, whitened.T @ reduced.output
        turned = np.linalg.qr(np.column_stack([along, np.eye(along.size)]))[0]
        turned[:, 0] *= np.sign(turned[:, 0] @ along) or 1.0
        rows = turned.T @ root
        spaced = np.zeros((2 * len(rows), rows.shape[1]))
        spaced[0], spaced[1 : 2 * len(rows) - 2 : 2] = rows[0], rows[1:]
        places = descent.problem.base.parameters.places[: reduced.aim.size]
        return Information(
            root=spaced,
            covariance=covariance,
            without=covariance,
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
    reduced = _reduce(descent, with_fixed_slopes(descent), rescale(solution, units))
    return identifiability_of(information(reduced), prior)


def _same_outputs(descent: Descent, values: Float[np.ndarray, " parameters"]) -> bool:
    """Whether other values of the free parameters leave all simulated outputs as they are."""
    problem = descent.problem
    if (z := problem.base.parameters.coordinates(values)) is None:
        return False
    other = evaluate_misfits(np.concatenate([z, descent.z[z.size :]]), problem).misfits
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
    return remarks


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
