"""The descent of an output-error fit: noise level, or noise model, and parameters by turns."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxquad._core import minimise_on_host, RUNNING, STALLED

from ..frequency_domain._feedthrough import (
    find_samples,
    free_delays,
    limited,
    sample_limits,
    SampleLimit,
    Solved,
)
from ..frequency_domain._parameters import UNCHANGED
from ..frequency_domain._problem import Problem
from ..frequency_domain._sampled import Aliases, direct_part, whole_samples
from ..frequency_domain._solve import Solution, solution_at
from ._filtered import filtered_point, FilteredPoint, is_filtered
from ._noise import (
    ARMA,
    AutoRegressive,
    estimate_noise,
    make_whitener,
    Noise,
    NoiseModel,
    shock_slopes,
    shocks_of,
    WHITE,
)
from ._problem import evaluate_misfits, Evaluation, OutputError
from ._simulated import sample_interval


CLOSE = 1e-6  # last step of a descent, relative to 1 + |z|
_PASSES = 4  # of noise level and parameters by turns
_LEVEL = 0.01  # change of the noise level that no longer matters
_FAR = 7.0  # in ln: a parameter that shrank by a factor of 1000 ran to zero
_TURNS = 40  # of noise models and parameters, at most
_FREE = 2  # turns that choose the orders; later ones keep them
_NEAR = 1e-4  # last step of each turn's descent; Gauss-Newton leaves about its square
_STILL = 0.01  # standard errors: a change of the estimate that no longer matters
_NEXT = 0.3  # standard errors between ends of turns that are taken for one
_STEP_FIXED_SLOPES = 1e-5  # relative; its square is the error

Vector = Float[np.ndarray, " n"]  # free parameters and initial states
Residuals = list[Float[np.ndarray, "samples outputs"]]  # of each record
Begin = tuple[OutputError, Vector, Evaluation, int]  # residuals of unit size; steps
Models = list[list[NoiseModel]]  # of each output of each record


class RecordNoise(NamedTuple):
    """The noise models of a record's outputs, and what their coefficients do to the misfit."""

    models: tuple[NoiseModel, ...]
    slopes: Float[np.ndarray, "samples outputs coefficients"]  # weighted as the misfit


class Descent(NamedTuple):
    """Where the descent ended, and all that the result is made from."""

    problem: OutputError  # under the final noise level
    z: Vector
    solution: Solution
    evaluation: Evaluation
    noise: tuple[RecordNoise, ...] = ()  # of each record, where it has a model


class Point(NamedTuple):
    """Where the descent stands. Changes of z below 1e-6 count as none: errors are far larger."""

    problem: OutputError
    z: Vector
    evaluation: Evaluation

    @property
    def cost(self) -> float:
        finite = all(np.all(np.isfinite(np.asarray(part))) for part in self.evaluation.normal)
        return float(self.evaluation.normal.cost) if finite else np.inf

    def slopes(self) -> tuple[np.ndarray, np.ndarray]:
        normal = self.evaluation.normal
        return np.asarray(normal.gradient), np.asarray(normal.hessian)

    def errors_of(self, change: Vector) -> float:
        """A change of z in standard errors."""
        return float(np.sqrt(max(change @ self.slopes()[1] @ change, 0.0)))

    def moved(self, change: Vector) -> "Point":
        return Point.at(self.problem, self.z + change)

    @staticmethod
    def at(problem: OutputError, z: Vector) -> "Point":
        return Point(problem, z, evaluate_misfits(np.asarray(z), problem))


def descend(
    problem: OutputError, z: Vector, max_steps: int, tolerance: float = CLOSE
) -> tuple[Point, int, str]:
    """The minimum near `z`, to a last step of `tolerance`; the steps, and why it is none."""
    start = filtered_point(problem, z) if is_filtered(problem) else None
    if start is None or not start.is_precise:
        start = Point.at(problem, z)
    if not np.isfinite(start.cost):
        raise ValueError(
            "the simulated output of the model, or its derivative, is not finite at the starting "
            "values: the model is unstable over so long a record, or a value has the wrong size. "
            "Start from other values, cut the record with jq.records.trim, or fit in the "
            "frequency domain with jq.fit"
        )
    options = {"max_steps": max_steps, "tolerance": tolerance}
    move = lambda point, change: point.moved(change)
    stop, status, steps = minimise_on_host(start, move, **options)
    if isinstance(stop, FilteredPoint) and stop.is_precise:
        stop = Point(problem, stop.z, stop.evaluation)
    elif isinstance(stop, FilteredPoint):
        stop, status, steps = minimise_on_host(Point.at(problem, stop.z), move, **options)
    message = ""
    if status == RUNNING:
        message = f"the maximum of {steps} steps was reached"
    if status == STALLED:
        message = (
            "every shorter step fails too: the simulation is not finite or not smooth nearby "
            f"(after {steps} steps)"
        )
    return stop, steps, message


def descend_by_turns(
    problem: OutputError, max_steps: int, z: Vector | None = None, *, tolerance: float = CLOSE
) -> Descent:
    """Parameters and noise level by turns: the maximum of the likelihood of both."""
    base, steps = problem.base, 0
    z = _start_of(problem) if z is None else z
    # A factor common to all residuals moves no minimum.
    common = len(problem.terms) == problem.terms[0].weights.size == 1
    common = common and not base.quantities and not problem.unknown
    for turn in range(_PASSES):
        stop, more, message = descend(problem, z, max_steps, tolerance)
        z, steps = stop.z, steps + more
        sizes = sizes_of(problem, stop.evaluation)
        changed = max(float(np.max(np.abs(np.log(size)))) for size in sizes)
        problem = problem.reweighted(sizes)
        if common or changed < _LEVEL or message or turn == _PASSES - 1:
            break
    solution = _solution(base, z, message, steps)
    return Descent(problem, np.asarray(z), solution, stop.evaluation.reweighted(sizes))


def descend_within_samples(
    problem: OutputError, noise: Noise | None, max_steps: int, *, near: bool
) -> tuple[Descent, list[SampleLimit]]:
    """The descent; where a held input passes directly after a free delay, at its best sample.

    With what the sample tells of a delay of which the rest of the record tells less.
    """
    base, count = problem.base, problem.base.parameters.count
    sampled = dataclasses.replace(base, conditions=(UNCHANGED,) * len(problem.terms), aliases=())
    linear = all(term.motions is not None for term in problem.terms)
    if linear and eqx.filter_eval_shape(direct_part, base.model) is not None:
        direct = direct_part(base.model)
        assert direct is not None
        samples = [whole_samples(direct[1], term.dt) for term in problem.terms]
        parts = [
            Aliases.of_direct(term.dt, np.asarray(n)) if term.hold == "zero" else None
            for term, n in zip(problem.terms, samples, strict=True)
        ]
        sampled = dataclasses.replace(sampled, aliases=tuple(parts))
    delays = free_delays(sampled)

    def descend_from(
        sampled: Problem, z: Vector | None, noise: Noise | None, near: bool = True
    ) -> Descent:
        these = problem
        if delays:
            terms = [
                term if part is None else dataclasses.replace(term, direct_samples=part.samples)
                for term, part in zip(problem.terms, sampled.aliases, strict=True)
            ]
            limited = dataclasses.replace(base, quantities=sampled.quantities, prior=sampled.prior)
            these = dataclasses.replace(problem, base=limited, terms=tuple(terms))
        if noise is None:
            return descend_by_turns(these, max_steps, z)
        return descend_with_noise(these, noise, max_steps, z, near=near)

    def solve(sampled: Problem, z: Vector, noise: Noise | None = noise) -> Solved:
        end = descend_from(sampled, z, noise)
        rows = [np.asarray(part)[..., :count].reshape(-1, count) for part in end.evaluation.slopes]
        rows.append(np.asarray(end.solution.sensitivity.prior_slopes)[:, :count])
        misfit = sum(float(np.sum(np.asarray(part) ** 2)) for part in end.evaluation.misfits)
        terms = end.problem.terms
        level = sum(len(term.y) * float(np.sum(np.log(np.asarray(term.weights)))) for term in terms)
        information = sum((row.T @ row for row in rows), np.zeros((count, count)))
        return Solved(end, np.asarray(end.z)[:count], misfit - 2 * level, information)

    if not delays:
        return descend_from(sampled, None, noise, near), []
    # Which sample it is shows without a noise model.
    by_level = lambda sampled, z: solve(sampled, z, None)
    sampled, solved = find_samples(sampled, _start_of(problem)[:count], delays, by_level)
    limits, z = sample_limits(sampled, solved.z, delays, solve)
    return descend_from(limited(sampled, limits) if limits else sampled, z, noise), limits


def _start_of(problem: OutputError) -> Vector:
    parameters = problem.base.parameters
    values = np.asarray(parameters.start)[: parameters.count]
    return np.concatenate([values, np.zeros(problem.unknown)])


def _solution(base: Problem, z: Vector, message: str, steps: int) -> Solution:
    """The model, its values and the priors' slopes; with parameters that ran to zero, and sizes."""
    at = np.asarray(z)[: base.parameters.count]
    start, scale = (
        np.asarray(x)[: at.size] for x in (base.parameters.start, base.parameters.scale)
    )
    logarithmic = np.array(base.parameters.logarithmic[: at.size])
    low = np.flatnonzero(logarithmic & (at - start < -_FAR))
    sizes = tuple((scale[low] * np.exp(start[low])).tolist())
    solution = solution_at(base, at, message, steps)
    return solution._replace(at_zero=tuple(low.tolist()), units_at_zero=sizes)


def sizes_of(problem: OutputError, evaluation: Evaluation) -> list[Float[np.ndarray, " outputs"]]:
    """Standard deviations of the weighted residuals."""
    sizes = []
    for term, misfit in zip(problem.terms, evaluation.misfits, strict=True):
        size = np.sqrt(np.sum(np.asarray(misfit) ** 2, axis=0) / term.counted)
        least = 1e-9 * np.std(np.asarray(term.y), axis=0) * np.asarray(term.weights)
        sizes.append(np.maximum(size, least))
    return sizes


class _End(NamedTuple):
    """Where the turns ended."""

    plain: OutputError  # the problem of the residuals themselves
    problem: OutputError  # that of their shocks
    stop: Point
    steps: int
    message: str
    residuals: Residuals
    models: Models


def descend_with_noise(
    problem: OutputError, noise: Noise, max_steps: int, start: Vector | None = None, *, near: bool
) -> Descent:
    """Parameters and noise models by turns: the least mean square of one-step prediction errors.

    They begin with the noise that the starting values leave. If these are not known to be `near`,
    they begin once more with what output error leaves, and the likelier end counts: far off, a
    noise model takes for noise what the values do not explain, and in a closed loop output error
    is far off itself.
    Source: Ljung, System Identification, sec. 7.2 and 13.4 (direct method in a closed loop).
    """

    def akaike(end: _End) -> float:
        """Akaike's criterion, with the deviation of all samples' shocks that of those predicted."""
        total = 0.0
        sizes = sizes_of(end.problem, end.stop.evaluation)
        for term, size, models in zip(end.problem.terms, sizes, end.models, strict=True):
            total += 2 * len(term.y) * float(np.sum(np.log(size / np.asarray(term.weights))))
            total += 2 * sum(sum(model.order) for model in models)
        return total if np.isfinite(total) else np.inf

    def begin(after_output_error: bool) -> Begin:
        if not after_output_error:
            z = _start_of(problem) if start is None else start
            evaluation = evaluate_misfits(z, problem)
            if all(np.all(np.isfinite(misfit)) for misfit in evaluation.misfits):
                sizes = sizes_of(problem, evaluation)
                return problem.reweighted(sizes), z, evaluation.reweighted(sizes), 0
        first = descend_by_turns(problem, max_steps, start, tolerance=_near(problem))
        return first.problem, np.asarray(first.z), first.evaluation, first.solution.steps

    ends: list[_End] = []
    for after in (False,) if near else (False, True):
        ends.append(_alternate(*begin(after), noise, max_steps, ends))
    plain, problem, stop, steps, message, residuals, models = min(ends, key=akaike)
    noises = []
    for term, residual, row in zip(plain.terms, residuals, models, strict=True):
        blocks = [shock_slopes(v, model) for v, model in zip(residual.T, row, strict=True)]
        slopes, at = np.zeros((*residual.shape, sum(block.shape[1] for block in blocks))), 0
        for output, block in enumerate(blocks):
            slopes[:, output, at : at + block.shape[1]] = block
            at += block.shape[1]
        sizes = np.array([model.deviation for model in row]) / np.asarray(term.weights)
        pairs = zip(row, sizes, strict=True)
        scaled = [dataclasses.replace(model, deviation=float(size)) for model, size in pairs]
        noises.append(RecordNoise(tuple(scaled), slopes))
    sizes = sizes_of(problem, stop.evaluation)
    solution = _solution(problem.base, stop.z, message, steps)
    evaluation = stop.evaluation.reweighted(sizes)
    return Descent(
        problem.reweighted(sizes), np.asarray(stop.z), solution, evaluation, tuple(noises)
    )


def _near(problem: OutputError) -> float:
    """The last step of each turn's descent. Coefficients in z are known to many more digits."""
    return _NEAR if sample_interval(problem.base.model) is None else CLOSE


def _alternate(
    plain: OutputError, z: Vector, evaluation: Evaluation, steps: int, noise: Noise,
    max_steps: int, ends: Sequence[_End],
) -> _End:  # fmt: skip
    """The end of the turns from a start; one of the `ends`, if the first turn leads next to it."""
    # Least squares alone makes the initial state follow slow noise, at the price of a jump in the
    # first samples: residuals of one that suits coloured noise.
    misfits = [np.asarray(misfit) for misfit in evaluation.misfits]
    kinds: list[list[Noise]] = [[AutoRegressive()] * misfit.shape[1] for misfit in misfits]
    residuals = _residuals(evaluation, _estimate_all(misfits, kinds))
    kinds = [[noise] * term.y.shape[1] for term in plain.terms]
    for turn in range(_TURNS):
        models = _estimate_all(residuals, kinds)
        if turn >= _FREE:
            of_order = lambda p, z: ARMA(p, z) if z else AutoRegressive(p)
            kinds = [[of_order(*model.order) for model in row] for row in models]
        # The problem of the shocks, in units of their deviation.
        terms = [
            dataclasses.replace(
                term,
                whitener=make_whitener(row, len(term.y)),
                weights=term.weights / np.array([model.deviation for model in row]),
            )
            for term, row in zip(plain.terms, models, strict=True)
        ]
        problem = dataclasses.replace(plain, terms=tuple(terms))
        stop, more, message = descend(problem, z, max_steps, _near(problem))
        change, steps, z = stop.z - z, steps + more, stop.z
        for end in () if turn else ends:
            if stop.errors_of(z - end.stop.z) < _NEXT:
                return end
        residuals = _residuals(evaluate_misfits(np.asarray(z), plain), models)
        if message or (turn and stop.errors_of(change) < _STILL):
            break
    else:
        message = f"the noise model still changed after {_TURNS} turns"
    return _End(plain, problem, stop, steps, message, residuals, models)


def _estimate_all(residuals: Residuals, kinds: list[list[Noise]]) -> Models:
    # Residuals have unit size, unless the record is exact and they are rounding.
    estimate = lambda v, kind: estimate_noise(v, kind) if np.mean(v**2) > 0.25 else WHITE
    return [
        [estimate(v, kind) for v, kind in zip(residual.T, row, strict=True)]
        for residual, row in zip(residuals, kinds, strict=True)
    ]


def _residuals(plain: Evaluation, models: Models) -> Residuals:
    """Residuals with initial state, trim and shift as the noise models weigh them."""
    residuals = []
    for misfit, columns, row in zip(plain.misfits, plain.columns, models, strict=True):
        misfit, columns = np.asarray(misfit), np.asarray(columns)
        shocks = [
            shocks_of(v, model) / model.deviation for v, model in zip(misfit.T, row, strict=True)
        ]
        ways = [shocks_of(columns[:, o], model) / model.deviation for o, model in enumerate(row)]
        ways = np.concatenate(ways)
        scale = np.maximum(np.linalg.norm(ways, axis=0), 1e-300)
        unknowns = np.linalg.lstsq(ways / scale, np.concatenate(shocks), rcond=1e-9)[0] / scale
        residuals.append(misfit - columns @ unknowns)
    return residuals


def with_fixed_slopes(descent: Descent) -> Evaluation:
    """The misfits' slopes by the free parameters, then the fixed, then the initial states. Central
    differences: they serve for names alone, and compile nothing anew."""
    problem, step = descent.problem, _STEP_FIXED_SLOPES
    parameters, values = problem.base.parameters, np.asarray(descent.solution.values)
    count, fixed = parameters.count, []
    for k in range(count, values.size):
        ends = []
        for change in (step, -step):
            moved = values.copy()
            moved[k] *= np.exp(change)
            model = parameters.replace(problem.base.model, moved)
            base = dataclasses.replace(problem.base, model=model)
            other = dataclasses.replace(problem, base=base)
            ends.append(evaluate_misfits(descent.z, other).misfits)
        fixed.append([(after - before) / (2 * step) for after, before in zip(*ends, strict=True)])
    slopes = [
        jnp.concatenate([mine[:, :, :count], jnp.stack(others, axis=2), mine[:, :, count:]], axis=2)
        for mine, *others in zip(descent.evaluation.slopes, *fixed, strict=True)
    ]
    return descent.evaluation._replace(slopes=slopes)
