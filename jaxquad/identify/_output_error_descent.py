"""Levenberg-Marquardt by turns with the noise level, one compiled evaluation at a time.

The loop runs on the host: it is a few steps of milliseconds, and compiling it takes longer.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._output_error_trial import Found, found_at, OutputError
from ._solve import describe, Solution


_STEP = 1e-6  # largest change of z that is none: errors are far larger on any record
_SAVED = 1e-12  # of the cost, which for a thousand samples is 1e-9 of one parameter's noise
_PASSES = 4  # of noise level and parameters by turns
_LEVEL = 0.01  # change of the noise level that no longer matters
_WALL = 1e16  # damping from which no step helps any more


class Descent(NamedTuple):
    """Where the descent ended, and all that the result is made from."""

    problem: OutputError  # under the final noise level
    z: Float[Array, " n"]  # free parameters and initial states
    solution: Solution
    found: Found


class _Stop(NamedTuple):
    z: Float[np.ndarray, " n"]
    found: Found
    message: str
    steps: int


def relaxed(problem: OutputError, max_steps: int) -> Descent:
    """Parameters and noise level by turns: the maximum of the likelihood of both."""
    base, steps = problem.base, 0
    count = base.parameters.count
    z = np.concatenate([np.asarray(base.parameters.start)[:count], np.zeros(problem.unknown)])
    # A factor common to all residuals moves no minimum.
    common = len(problem.trials) == problem.trials[0].weights.size == 1
    common = common and not base.quantities and not problem.unknown
    for turn in range(_PASSES):
        stop = _descend(problem, z, max_steps)
        z, steps = stop.z, steps + stop.steps
        sizes = _sizes(problem, stop.found)
        changed = max(float(np.max(np.abs(np.log(size)))) for size in sizes)
        problem = problem.reweighted(sizes)
        if common or changed < _LEVEL or stop.message or turn == _PASSES - 1:
            break
    at = jnp.asarray(z)
    (model, values, slopes), derivatives = _describe(at[:count], base)
    converged = not stop.message
    solution = Solution(
        at[:count], model, values, slopes, stop.message, converged, steps, derivatives
    )
    return Descent(problem, at, solution, stop.found.reweighted(sizes))


_describe = eqx.filter_jit(describe)


def _sizes(problem: OutputError, found: Found) -> list[Float[np.ndarray, " outputs"]]:
    """Standard deviations of the weighted residuals."""
    sizes = []
    for trial, misfit in zip(problem.trials, found.misfits, strict=True):
        size = np.sqrt(np.mean(np.asarray(misfit) ** 2, axis=0))
        least = 1e-9 * np.std(np.asarray(trial.y), axis=0) * np.asarray(trial.weights)
        sizes.append(np.maximum(size, least))
    return sizes


def _descend(problem: OutputError, z: Float[np.ndarray, " n"], max_steps: int) -> _Stop:
    """Damped Gauss-Newton steps from `z`, damped as in `minimise`."""
    here, damping, growth = found_at(jnp.asarray(z), problem), 1e-3, 2.0
    if not _finite(here):
        raise ValueError(
            "the model's simulated output, or its slope, is not finite at the starting values: it "
            "is unstable over so long a record, or the values mean nothing; start from others, cut "
            "the record with jq.records.trim, or fit in the frequency domain"
        )
    for step in range(max_steps):
        cost, gradient, hessian = (np.asarray(part) for part in here.normal)
        extra = damping * max(np.max(np.diagonal(hessian)), 1e-300)
        change = -np.linalg.lstsq(hessian + extra * np.eye(z.size), gradient, rcond=None)[0]
        predicted = 0.5 * change @ (extra * change - gradient)
        small = damping <= 1e-2 and (
            np.max(np.abs(change) / (1 + np.abs(z))) <= _STEP or predicted <= _SAVED * cost
        )
        there = found_at(jnp.asarray(z + change), problem)
        saved = cost - float(there.normal.cost)
        better = _finite(there) and (saved > 1e-3 * predicted or small and saved >= -1e-12 * cost)
        if better:
            z, here = z + change, there
        if small:
            return _Stop(z, here, "", step + 1)
        ratio = saved / max(predicted, 1e-300) if better else 0.0
        damping *= float(np.clip(1 - (2 * ratio - 1) ** 3, 0.1, 2.0)) if better else growth
        damping, growth = max(damping, 1e-14), 2.0 if better else 2 * growth
        if damping > _WALL:
            reason = "every shorter step fails too: the simulation is not finite or smooth nearby"
            return _Stop(z, here, f"{reason} (after {step + 1} steps)", step + 1)
    return _Stop(z, here, f"the maximum of {max_steps} steps was reached", max_steps)


def _finite(found: Found) -> bool:
    return bool(np.all([np.all(np.isfinite(np.asarray(part))) for part in found.normal]))


_STEP_FIXED_SLOPES = 1e-5  # relative; its square is the error


def with_fixed_slopes(descent: Descent) -> Found:
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
        model = problem.base.parameters.replace(problem.base.model, jnp.asarray(moved))
        base = dataclasses.replace(problem.base, model=model)
        ends.append(found_at(descent.z, dataclasses.replace(problem, base=base)).misfits)
    return [
        (after - before) / (2 * _STEP_FIXED_SLOPES) for after, before in zip(*ends, strict=True)
    ]
