"""Parameters that keep their sign, at zero: decided at the optimum.

By its logarithm the cost has no slope near zero, and a solver may stop anywhere. What counts is the
slope of the cost by the parameter itself.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ._cost import mix
from ._problem import Problem
from ._solve import Solution, solution_at, solve


_NEAR = 1e-2  # of the change that shows: a parameter below it is at zero
_AT_ZERO = 1e-6  # likewise, where its slopes are evaluated
_ROUNDS = 4  # of releasing parameters that do not belong at zero
_SMALLEST = 60.0  # in ln, below the start: 1e-26 of it

Vector = Float[np.ndarray, " parameters"]


class Linearised(NamedTuple):
    """Weighted residuals at a solution and their slopes by `z`."""

    residual: Float[np.ndarray, " residuals"]
    jacobian: Float[np.ndarray, "residuals parameters"]

    @property
    def cost(self) -> float:
        return float(self.residual @ self.residual)

    @property
    def visible(self) -> Vector:
        """The change of each `z` that stands out from the scatter of the residuals."""
        freedom = max(self.residual.size - self.jacobian.shape[1], 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.sqrt(self.cost / freedom) / np.sqrt(np.sum(self.jacobian**2, axis=0))


def linearise(problem: Problem, solution: Solution) -> Linearised:
    """The weighted residuals at a solution, those of the priors last."""
    jacobian, parts, count = [], solution.sensitivity, problem.parameters.count
    for weights, mixing, slopes in zip(problem.weights, problem.mixings, parts.slopes, strict=True):
        weights = np.asarray(weights)
        with np.errstate(invalid="ignore", over="ignore"):  # a model that is not finite there
            scaled = weights[..., None] * np.asarray(slopes)[..., :count]
            jacobian.append(mix(mixing, scaled)[weights > 0])
    jacobian = np.concatenate([*jacobian, np.asarray(parts.prior_slopes)[:, :count]])
    return Linearised(parts.weighted(problem), jacobian)


def solve_within_bounds(
    problem: Problem, z: Vector, solver: eqx.Module | None, max_steps: int
) -> Solution:
    """Solve from `z`; parameters that belong at zero are there, wherever the path to it ended."""
    solution = solve(problem, z, solver, max_steps)
    return settle_at_bounds(problem, solution, solver, max_steps)


def settle_at_bounds(
    problem: Problem, solution: Solution, solver: eqx.Module | None, max_steps: int
) -> Solution:
    """The solution with its parameters at zero marked; a better one if they do not belong there."""
    logarithmic = np.array(problem.parameters.logarithmic[: solution.z.size])
    least = np.asarray(problem.parameters.start)[: solution.z.size] - _SMALLEST
    for _ in range(_ROUNDS):
        lost = (solution.z < least) & logarithmic
        if lost.any():  # where a value is a number that its slopes can be seen at
            z = np.where(lost, least, solution.z)
            solution = solution_at(problem, z, steps=solution.steps)
        local = linearise(problem, solution)
        visible, z = local.visible, np.asarray(solution.z)
        # Parameters near zero could grow a hundred times without being seen.
        near = np.isfinite(visible) & (visible > 1 / _NEAR) & logarithmic
        low = np.flatnonzero(near).tolist()
        if not low:
            return solution
        from scipy.optimize import lsq_linear

        # The Gauss-Newton step under which none near zero becomes negative; of these the value to
        # go to, in units of what shows.
        units, smallest = np.ones(z.size), np.full(z.size, -np.inf)
        units[low], smallest[low] = visible[low], 0.0
        bounds, rows = (smallest, np.inf), local.jacobian * units
        step = lsq_linear(rows, -local.residual, bounds, method="bvls").x
        if not any(step[k] > _NEAR for k in low):
            at = z.copy()
            at[low] += np.log(_AT_ZERO * visible[low])
            return _as_zero(problem, polish(problem, at, low, solution)[0], low)
        change = step.copy()
        change[low] = np.log(np.maximum(step[low], _AT_ZERO) * visible[low])
        solution = solve(problem, z + change, solver, max_steps)
    return solution


def polish(
    problem: Problem, z: Vector, fixed: Sequence[int], start: Solution, rounds: int = 3
) -> tuple[Solution, Linearised]:
    """The optimum over the other parameters, from near it, by undamped Gauss-Newton steps."""
    free = np.setdiff1d(np.arange(z.size), fixed)
    solution = solution_at(problem, z, steps=start.steps)
    local = linearise(problem, solution)
    for _ in range(rounds):
        if not (np.isfinite(local.cost) and np.all(np.isfinite(local.jacobian))):
            break  # so far out that the model has no numbers
        step = np.linalg.lstsq(local.jacobian[:, free], -local.residual, rcond=1e-10)[0]
        z = z.copy()
        z[free] += step
        moved = solution_at(problem, z, steps=start.steps)
        there = linearise(problem, moved)
        if not there.cost <= local.cost:
            break
        solution, local = moved, there
        if np.max(np.abs(step), initial=0.0) < 1e-9:
            break
    return solution, local


def _as_zero(problem: Problem, solution: Solution, low: Sequence[int]) -> Solution:
    """The same with values of exactly 0, where the model has a response there."""
    units = solution.slopes[list(low)] / _AT_ZERO
    marked = solution._replace(at_zero=tuple(low), units_at_zero=tuple(units.tolist()))
    z = solution.z.copy()
    z[low] = -np.inf  # the logarithm of 0
    at = solution_at(problem, z)
    # A response of 0 has a magnitude of -inf.
    if not all(np.all(misfit < np.inf) for misfit in at.sensitivity.misfits):
        return marked
    return marked._replace(values=at.values, model=at.model)
