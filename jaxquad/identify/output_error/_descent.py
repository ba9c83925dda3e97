"""The descent of an output-error fit to its minimum."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxquad._core import minimise_on_host, RUNNING, STALLED

from ..frequency_domain._problem import Problem
from ..frequency_domain._solve import Solution, solution_at
from ._filtered import filtered_point, FilteredPoint, is_filtered
from ._noise_model import NoiseModel
from ._problem import evaluate_misfits, Evaluation, OutputError


CLOSE = 1e-6  # last step of a descent, relative to 1 + |z|
_PASSES = 4  # of noise level and parameters by turns
_LEVEL = 0.01  # change of the noise level that no longer matters


class RecordNoise(NamedTuple):
    """The noise models of a record's outputs, and what their coefficients do to the misfit."""

    models: tuple[NoiseModel, ...]
    slopes: Float[np.ndarray, "samples outputs coefficients"]  # weighted as the misfit


class Descent(NamedTuple):
    """Where the descent ended, and all that the result is made from."""

    problem: OutputError  # under the final noise level
    z: Float[np.ndarray, " n"]  # free parameters and initial states
    solution: Solution
    found: Evaluation
    noise: tuple[RecordNoise, ...] = ()  # of each record, where it has a model


class Point(NamedTuple):
    """Where the descent stands. Changes of z below 1e-6 count as none: errors are far larger."""

    problem: OutputError
    z: Float[np.ndarray, " n"]
    found: Evaluation

    @property
    def cost(self) -> float:
        finite = all(np.all(np.isfinite(np.asarray(part))) for part in self.found.normal)
        return float(self.found.normal.cost) if finite else np.inf

    def slopes(self) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(self.found.normal.gradient), np.asarray(self.found.normal.hessian)

    def moved(self, change: Float[np.ndarray, " n"]) -> "Point":
        return _point(self.problem, self.z + change)


def _point(problem: OutputError, z: Float[np.ndarray, " n"]) -> Point:
    return Point(problem, z, evaluate_misfits(np.asarray(z), problem))


def _first_point(problem: OutputError, z: Float[np.ndarray, " n"]) -> Point | FilteredPoint:
    if is_filtered(problem):
        start = filtered_point(problem, z)
        if start.is_precise:
            return start
    return _point(problem, z)


def descend_by_turns(problem: OutputError, max_steps: int, tolerance: float = CLOSE) -> Descent:
    """Parameters and noise level by turns: the maximum of the likelihood of both."""
    base, steps = problem.base, 0
    count = base.parameters.count
    z = np.concatenate([np.asarray(base.parameters.start)[:count], np.zeros(problem.unknown)])
    # A factor common to all residuals moves no minimum.
    common = len(problem.terms) == problem.terms[0].weights.size == 1
    common = common and not base.quantities and not problem.unknown
    for turn in range(_PASSES):
        stop, status, taken = descend(problem, z, max_steps, tolerance)
        z, steps, found, message = stop.z, steps + taken, stop.found, message_of(status, taken)
        sizes = sizes_of(problem, found)
        changed = max(float(np.max(np.abs(np.log(size)))) for size in sizes)
        problem = problem.reweighted(sizes)
        if common or changed < _LEVEL or message or turn == _PASSES - 1:
            break
    found = found.reweighted(sizes)
    return Descent(problem, np.asarray(z), describe_stop(base, z, message, steps), found)


def describe_stop(base: Problem, z: Float[np.ndarray, " n"], message: str, steps: int) -> Solution:
    """The model, its values and the priors' slopes where the descent stopped."""
    at = np.asarray(z)[: base.parameters.count]
    low, sizes = _at_zero(base, at)
    return solution_at(base, at, message, steps)._replace(at_zero=low, units_at_zero=sizes)


_FAR = 7.0  # in ln: a parameter that shrank by a factor of 1000 ran to zero


def _at_zero(
    base: Problem, z: Float[np.ndarray, " parameters"]
) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Parameters that ran to zero, and their sizes at the start."""
    start, scale = (np.asarray(x)[: z.size] for x in (base.parameters.start, base.parameters.scale))
    logarithmic = np.array(base.parameters.logarithmic[: z.size])
    low = np.flatnonzero(logarithmic & (np.asarray(z) - start < -_FAR))
    return tuple(low.tolist()), tuple((scale[low] * np.exp(start[low])).tolist())


def sizes_of(problem: OutputError, found: Evaluation) -> list[Float[np.ndarray, " outputs"]]:
    """Standard deviations of the weighted residuals."""
    sizes = []
    for term, misfit in zip(problem.terms, found.misfits, strict=True):
        size = np.sqrt(np.sum(np.asarray(misfit) ** 2, axis=0) / term.counted)
        least = 1e-9 * np.std(np.asarray(term.y), axis=0) * np.asarray(term.weights)
        sizes.append(np.maximum(size, least))
    return sizes


def descend(
    problem: OutputError, z: Float[np.ndarray, " n"], max_steps: int, tolerance: float = CLOSE
) -> tuple[Point, int, int]:
    """The minimum near `z`, to a last step of `tolerance`; why it ended, and after what steps."""
    start = _first_point(problem, z)
    if not np.isfinite(start.cost):
        raise ValueError(
            "the simulated output of the model, or its derivative, is not finite at the starting "
            "values: the model is unstable over so long a record, or a value has the wrong size. "
            "Start from other values, cut the record with jq.records.trim, or fit in the "
            "frequency domain with jq.fit"
        )
    if isinstance(start, FilteredPoint):
        stop, status, steps = minimise_on_host(
            start, FilteredPoint.moved, max_steps, tolerance=tolerance
        )
        if stop.is_precise:
            return Point(problem, stop.z, stop.found), status, steps
        start = _point(problem, stop.z)
    return minimise_on_host(start, Point.moved, max_steps, tolerance=tolerance)


def message_of(status: int, steps: int) -> str:
    """Why the descent stopped before a minimum; empty at one."""
    if status == RUNNING:
        return f"the maximum of {steps} steps was reached"
    if status == STALLED:
        return (
            "every shorter step fails too: the simulation is not finite or not smooth nearby "
            f"(after {steps} steps)"
        )
    return ""


_STEP_FIXED_SLOPES = 1e-5  # relative; its square is the error


def with_fixed_slopes(descent: Descent) -> Evaluation:
    """The misfits' slopes by the free parameters, then the fixed, then the initial states.

    Central differences: they serve for names alone, and compile nothing anew.
    """
    parameters, found = descent.problem.base.parameters, descent.found
    count, values = parameters.count, np.asarray(descent.solution.values)
    fixed = [_slopes(descent, k, values) for k in range(count, values.size)]
    slopes = [
        jnp.concatenate([mine[:, :, :count], jnp.stack(others, axis=2), mine[:, :, count:]], axis=2)
        for mine, *others in zip(found.slopes, *fixed, strict=True)
    ]
    return found._replace(slopes=slopes)


def _slopes(descent: Descent, k: int, values: np.ndarray) -> list:
    problem = descent.problem
    ends = []
    for step in (_STEP_FIXED_SLOPES, -_STEP_FIXED_SLOPES):
        moved = values.copy()
        moved[k] *= np.exp(step)
        model = problem.base.parameters.replace(problem.base.model, moved)
        base = dataclasses.replace(problem.base, model=model)
        ends.append(evaluate_misfits(descent.z, dataclasses.replace(problem, base=base)).misfits)
    return [
        (after - before) / (2 * _STEP_FIXED_SLOPES) for after, before in zip(*ends, strict=True)
    ]
