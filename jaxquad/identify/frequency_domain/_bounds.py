"""Parameters that keep their sign, at zero: decided at the optimum, with the limit they stay below.

At a bound the optimum is a one-sided problem: the cost rises from it with a slope, and the limit is
where the profile likelihood has risen by 2.71 / 2.
Source: Self and Liang (1987), Asymptotic properties of maximum likelihood estimators and likelihood
ratio tests under nonstandard conditions.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..uncertainty._accuracy import Matrix, scaled_inverse
from ._mixing import mix
from ._problem import Problem
from ._solve import Solution, solution_at, solve


_RISE = 2.71  # of the cost, at the end of a one-sided 95 % interval
_NEAR = 1e-2  # of the change that shows: a parameter below it is at zero
_AT_ZERO = 1e-6  # likewise, where its slopes are evaluated
_ROUNDS = 4  # of releasing parameters that do not belong at zero
_EVALUATIONS = 12  # of the profile
_CLOSE = 0.02  # of the rise
_SMALLEST = 60.0  # in ln, below the start: 1e-26 of it

Point = Float[np.ndarray, " parameters"]


class _Local(NamedTuple):
    """Weighted residuals at a solution and their slopes by `z`."""

    residual: Float[np.ndarray, " residuals"]
    jacobian: Float[np.ndarray, "residuals parameters"]

    @property
    def cost(self) -> float:
        return float(self.residual @ self.residual)

    @property
    def shown(self) -> Point:
        """The change of each `z` that stands out from the scatter of the residuals."""
        freedom = max(self.residual.size - self.jacobian.shape[1], 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.sqrt(self.cost / freedom) / np.sqrt(np.sum(self.jacobian**2, axis=0))


def solve_within_bounds(
    problem: Problem, z: Point, solver: eqx.Module | None, max_steps: int
) -> Solution:
    """Solve from `z`; parameters that belong at zero are there, wherever the path to it ended."""
    solution = solve(problem, z, solver, max_steps)
    return settle_at_bounds(problem, solution, solver, max_steps)


def settle_at_bounds(
    problem: Problem, solution: Solution, solver: eqx.Module | None, max_steps: int
) -> Solution:
    """The solution with its parameters at zero marked; a better one if they do not belong there.

    By its logarithm the cost has no slope near zero, and a solver may stop anywhere. What counts is
    the slope of the cost by the parameter itself.
    """
    for _ in range(_ROUNDS):
        solution = _above_underflow(problem, solution)
        local = _look(problem, solution)
        low = _near_zero(problem, local)
        if not low:
            return solution
        shown, z = local.shown, np.asarray(solution.z)
        step = _one_sided_step(local, low)
        released = [k for k in low if step[k] > _NEAR]
        if not released:
            at = z.copy()
            at[low] += np.log(_AT_ZERO * shown[low])
            return _as_zero(problem, _polished(problem, at, low, solution)[0], low)
        change = step.copy()
        change[low] = np.log(np.maximum(step[low], _AT_ZERO) * shown[low])
        solution = solve(problem, z + change, solver, max_steps)
    return solution


def _above_underflow(problem: Problem, solution: Solution) -> Solution:
    """The same where a value is a number that its slopes can be seen at."""
    z, count = solution.z, problem.parameters.count
    least = np.asarray(problem.parameters.start)[:count] - _SMALLEST
    lost = (z < least) & problem.parameters.logarithmic[:count]
    return _at(problem, np.where(lost, least, z), solution) if lost.any() else solution


def _look(problem: Problem, solution: Solution) -> _Local:
    residual, jacobian = [], []
    parts, count = solution.sensitivity, problem.parameters.count
    terms = zip(problem.weights, problem.mixings, parts.misfits, parts.slopes, strict=True)
    for weights, mixing, misfit, slopes in terms:
        weights = np.asarray(weights)
        used = weights > 0
        with np.errstate(invalid="ignore", over="ignore"):  # a model that is not finite there
            residual.append(mix(mixing, weights * np.asarray(misfit))[used])
            scaled = weights[..., None] * np.asarray(slopes)[..., :count]
            jacobian.append(mix(mixing, scaled)[used])
    r = np.concatenate([*residual, np.asarray(parts.prior_misfits)])
    return _Local(r, np.concatenate([*jacobian, np.asarray(parts.prior_slopes)[:, :count]]))


def _near_zero(problem: Problem, local: _Local) -> list[int]:
    """Parameters that keep their sign, and could grow a hundred times without being seen."""
    shown = local.shown
    far = np.isfinite(shown) & (shown > 1 / _NEAR)
    return np.flatnonzero(far & problem.parameters.logarithmic[: shown.size]).tolist()


def _one_sided_step(local: _Local, low: Sequence[int]) -> Point:
    """The Gauss-Newton step under which no parameter near zero becomes negative.

    Of `z`, but of the parameters near zero: the value to go to, in units of what shows.
    """
    from scipy.optimize import lsq_linear

    units, least = np.ones(local.jacobian.shape[1]), np.full(local.jacobian.shape[1], -np.inf)
    units[low], least[low] = local.shown[low], 0.0
    return lsq_linear(local.jacobian * units, -local.residual, (least, np.inf), method="bvls").x


def _polished(
    problem: Problem, z: Point, held: Sequence[int], like: Solution, rounds: int = 3
) -> tuple[Solution, _Local]:
    """The optimum over the other parameters, from near it, by undamped Gauss-Newton steps."""
    free = np.setdiff1d(np.arange(z.size), held)
    solution = _at(problem, z, like)
    local = _look(problem, solution)
    for _ in range(rounds):
        if not (np.isfinite(local.cost) and np.all(np.isfinite(local.jacobian))):
            break  # so far out that the model has no numbers
        step = np.linalg.lstsq(local.jacobian[:, free], -local.residual, rcond=1e-10)[0]
        z = z.copy()
        z[free] += step
        moved = _at(problem, z, like)
        there = _look(problem, moved)
        if not there.cost <= local.cost:
            break
        solution, local = moved, there
        if np.max(np.abs(step), initial=0.0) < 1e-9:
            break
    return solution, local


def _at(problem: Problem, z: Point, like: Solution) -> Solution:
    return solution_at(problem, z, steps=like.steps)


def _as_zero(problem: Problem, solution: Solution, low: Sequence[int]) -> Solution:
    """The same with values of exactly 0, where the model has a response there."""
    units = solution.slopes[list(low)] / _AT_ZERO
    marked = solution._replace(at_zero=tuple(low), units_at_zero=tuple(units.tolist()))
    z = solution.z.copy()
    z[low] = -np.inf  # the logarithm of 0
    at = solution_at(problem, z)
    # A response of 0 has a magnitude of -inf.
    if not all(np.all(each < np.inf) for each in at.sensitivity.misfits):
        return marked
    return marked._replace(values=at.values, model=at.model)


def one_sided_limits(
    problem: Problem, solution: Solution, k: int, inflations: Sequence[float]
) -> tuple[list[float], float]:
    """Where a parameter that may be zero leaves its one-sided 95 % interval, in its own unit.

    **Arguments:**

    - `problem`, `solution`: with the parameter at zero, or at so small a value that it might be.
    - `k`: which parameter.
    - `inflations`: its variance over what the curvature of the cost says, one for each limit.

    **Returns:** the limits, with the parameter's sign, infinite where the cost does not rise so
    far; and how far beyond zero the cost would be lowest, without a sign.
    """
    local, unit = _look(problem, solution), float(np.asarray(solution.slopes)[k])
    slope, curvature = _rise_from(local, k)
    limits = [unit * _limit(problem, solution, local, k, _RISE * each) for each in inflations]
    return limits, abs(unit) * slope / curvature


def changes_up_to(
    problem: Problem, solution: Solution, k: int, limit: float
) -> list[Float[np.ndarray, "frequencies outputs inputs 2"]]:
    """Changes of the misfits from here to a limit of parameter `k`, over that of its value."""
    z, value = np.array(solution.z), float(np.asarray(solution.values)[k])
    z[k] = np.log(abs(limit / float(np.asarray(problem.parameters.scale)[k])))
    there = solution_at(problem, z).sensitivity.misfits
    pairs = zip(there, solution.sensitivity.misfits, strict=True)
    return [(np.asarray(new) - np.asarray(old)) / (limit - value) for new, old in pairs]


def _limit(problem: Problem, solution: Solution, local: _Local, k: int, wanted: float) -> float:
    """By which factor parameter `k` grows until the cost has risen by what is wanted."""
    if not wanted > 0:  # of a variance that rounding left negative
        return np.inf
    z = np.asarray(solution.z)

    def rise(times: float) -> float:
        at = z.copy()
        at[k] += np.log(times)
        cost = _polished(problem, at, [k], solution)[1].cost
        return cost - local.cost if np.isfinite(cost) else np.inf

    low, high, times = 1.0, np.inf, 1 + _first_guess(local, k, wanted)
    for _ in range(_EVALUATIONS):
        found = rise(times)
        if abs(found - wanted) <= _CLOSE * wanted:
            break
        low, high = (times, high) if found < wanted else (low, times)
        times *= np.clip(np.sqrt(wanted / max(found, 1e-300)), 0.2, 5.0)
        if not low < times < high:
            times = np.sqrt(low * min(high, 100 * low))
    else:
        times = times if np.isfinite(high) else np.inf
    return float(times)


def _first_guess(local: _Local, k: int, wanted: float) -> float:
    """By the slope and the curvature at zero, over the value at which these are known."""
    slope, curvature = _rise_from(local, k)
    return (np.sqrt(slope**2 + curvature * wanted) - slope) / curvature


def _rise_from(local: _Local, k: int) -> tuple[float, float]:
    """Slope and curvature of the profile, over the value at which these are known."""
    jacobian = local.jacobian
    slope = float(jacobian[:, k] @ local.residual)
    curvature = 1 / max(float(scaled_inverse(jacobian.T @ jacobian)[k, k]), 1e-300)
    return max(slope, 0.0), curvature


_FAR = 50.0  # standard deviations, beyond which the hazard's digits cancel


def _remaining(below: float) -> float:
    """Second moment of a standard normal distribution beyond `below`, about that point."""
    from scipy.special import log_ndtr

    if below > _FAR:
        return 2 / below**2 - 10 / below**4 + 74 / below**6
    hazard = np.exp(-0.5 * below**2 - log_ndtr(-below)) / np.sqrt(2 * np.pi)
    return max(1 - below * (hazard - below), 0.0)


def one_sided(covariance: Matrix, k: int, optimum: float) -> Matrix:
    """The covariance where parameter `k` is at zero, from that of an unconstrained fit.

    What is left of its normal distribution above zero has this second moment about zero, and what
    the other parameters make of it. `optimum` is where it would be without the bound.
    """
    variance = covariance[k, k]
    if not variance > 0:  # of a matrix that rounding left singular
        return covariance
    below = max(-optimum / np.sqrt(variance), 0.0)
    moment = variance * _remaining(below)
    along = covariance[:, k] / variance
    return covariance + np.outer(along, along) * (moment - variance)


def apart_at_zero(
    covariance: Matrix, bread: Matrix, gradient: Float[np.ndarray, " parameters"], zeros: list[int]
) -> tuple[Matrix, dict[int, float]]:
    """Covariance and Gauss-Newton steps of parameters at zero, each while the others stay there.

    Two lags at zero do the same to a response: without their bounds one could grow without limit
    as the other becomes negative.
    """
    meat = bread @ covariance @ bread
    free = np.setdiff1d(np.arange(len(bread)), zeros)
    found, steps = np.zeros_like(covariance), dict[int, float]()
    found[np.ix_(free, free)] = _sandwich(bread, meat, free)[0]
    for k in zeros:
        beside = np.append(free, k)
        own, inverse = _sandwich(bread, meat, beside)
        along = np.zeros(len(bread))
        along[beside] = own[:, -1] / max(float(own[-1, -1]), 1e-300)
        found += np.outer(along, along) * own[-1, -1]
        steps[k] = -float(inverse[-1] @ gradient[beside])
    return found, steps


def inflation_at_zero(covariance: Matrix, bread: Matrix, k: int, others: Sequence[int]) -> float:
    """The variance of parameter `k` over what the curvature says, while `others` stay at zero."""
    some = np.append(np.setdiff1d(np.arange(len(bread)), [k, *others]), k)
    own, inverse = _sandwich(bread, bread @ covariance @ bread, some)
    return float(own[-1, -1] / inverse[-1, -1])


Some = Float[np.ndarray, "some some"]


def _sandwich(bread: Matrix, meat: Matrix, some: Int[np.ndarray, " some"]) -> tuple[Some, Some]:
    """The covariance of some parameters while the others are held, and the inverse bread."""
    inverse = scaled_inverse(bread[np.ix_(some, some)])
    return inverse @ meat[np.ix_(some, some)] @ inverse, inverse
