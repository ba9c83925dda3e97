"""Parameters that keep their sign, at zero: decided at the optimum, with limits and errors there.

By its logarithm the cost has no slope near zero, and a solver may stop anywhere. What counts is the
slope of the cost by the parameter itself. At a bound the optimum is a one-sided problem: the cost
rises from it with a slope, and the limit is where the profile likelihood has risen by 2.71 / 2.
Source: Self and Liang (1987), Asymptotic properties of maximum likelihood estimators and likelihood
ratio tests under nonstandard conditions.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..frequency_domain._cost import mix
from ..frequency_domain._problem import Problem
from ..frequency_domain._solve import Solution, solution_at, solve
from ._error_budget import ErrorBudget, Matrix, scaled_inverse
from ._response_term import Units
from ._verdict import Bound, LIMIT


_NEAR = 1e-2  # of the change that shows: a parameter below it is at zero
_AT_ZERO = 1e-6  # likewise, where its slopes are evaluated
_ROUNDS = 4  # of releasing parameters that do not belong at zero
_LONGEST = 1.0  # step of a logarithm, to where others go on from
_POLISHES = 10  # steps
_BEYOND = 2.0  # limits, where others take a parameter at the ends of their intervals
_SHORTER = 4  # tries, each of a quarter of the step before it
_LITTLE = 1e-3  # fall of the cost, of that per residual, that no limit shows
_SMALLEST = 60.0  # in ln, below the start: 1e-26 of it
_RISE = 2.71  # of the cost, at the end of a one-sided 95 % interval
_EVALUATIONS = 12  # of the profile
_CLOSE = 0.02  # of the rise
_FAR = 50.0  # standard deviations, beyond which the hazard's digits cancel
# A tenth of the magnitude and 6 deg of phase are less than a design's margins leave open, so what a
# parameter does to the loop is well enough determined, whatever its share of it.
_SLIGHT = 0.1
_FEW = 0.1  # of the limit: below it the slopes at a value say little about the way to the limit
_ONE_SIDED = 1.645  # standard errors that reach from the middle of a one-sided 95 % interval

Vector = Float[np.ndarray, " parameters"]


class Linearised(NamedTuple):
    """Weighted residuals at a solution, those of the priors last, and their slopes by `z`."""

    residual: Float[np.ndarray, " residuals"]
    jacobian: Float[np.ndarray, "residuals parameters"]

    @property
    def cost(self) -> float:
        return float(self.residual @ self.residual)


def linearise(problem: Problem, solution: Solution) -> Linearised:
    jacobian, parts, count = [], solution.sensitivity, problem.parameters.count
    for weights, mixing, slopes in zip(problem.weights, problem.mixings, parts.slopes, strict=True):
        weights = np.asarray(weights)
        with np.errstate(invalid="ignore", over="ignore"):  # a model that is not finite there
            scaled = weights[..., None] * np.asarray(slopes)[..., :count]
            jacobian.append(mix(mixing, scaled)[weights > 0])
    jacobian = np.concatenate([*jacobian, np.asarray(parts.prior_slopes)[:, :count]])
    return Linearised(parts.weighted(problem), jacobian)


def solve_within_bounds(
    problem: Problem, start: Vector | Solution, solver: eqx.Module | None, max_steps: int
) -> Solution:
    """Solve from `z`, or go on from a solution, until all that belongs at zero is marked as there.
    It is so wherever the path to it ended; what does not belong there is released."""
    is_solved = isinstance(start, Solution)
    solution = start if is_solved else solve(problem, start, solver, max_steps)
    logarithmic = np.array(problem.parameters.logarithmic[: solution.z.size])
    least = np.asarray(problem.parameters.start)[: solution.z.size] - _SMALLEST
    for _ in range(_ROUNDS):
        lost = (solution.z < least) & logarithmic
        if lost.any():  # where a value is a number that its slopes can be seen at
            z = np.where(lost, least, solution.z)
            solution = solution_at(problem, z, steps=solution.steps)
        local, z = linearise(problem, solution), np.asarray(solution.z)
        # The change of each `z` that stands out from the scatter of the residuals.
        freedom = max(local.residual.size - z.size, 1)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            visible = np.sqrt(local.cost / freedom) / np.sqrt(np.sum(local.jacobian**2, axis=0))
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
        if any(step[k] > _NEAR for k in low):
            change = np.where(logarithmic, np.clip(step, -_LONGEST, _LONGEST), step)
            change[low] = np.log(np.maximum(step[low], _AT_ZERO) * visible[low])
            solution = solve(problem, z + change, solver, max_steps)
            continue
        z = z.copy()
        z[low] += np.log(_AT_ZERO * visible[low])
        solution = polish(problem, z, low, solution)[0]
        sizes = tuple((solution.slopes[low] / _AT_ZERO).tolist())
        marked = solution._replace(at_zero=tuple(low), units_at_zero=sizes)
        z = solution.z.copy()
        z[low] = -np.inf  # the logarithm of 0
        at = solution_at(problem, z)
        # Values of exactly 0, where the model has a response there: one of 0 is -inf in magnitude.
        if all(np.all(misfit < np.inf) for misfit in at.sensitivity.misfits):
            return marked._replace(values=at.values, model=at.model)
        return marked
    return solution


def polish(
    problem: Problem, z: Vector, fixed: Sequence[int], start: Solution
) -> tuple[Solution, Linearised]:
    """The optimum over the other parameters, from near it, by Gauss-Newton steps that go down."""
    free = np.setdiff1d(np.arange(z.size), fixed)
    solution = solution_at(problem, z, steps=start.steps)
    local = linearise(problem, solution)
    logarithmic = np.array(problem.parameters.logarithmic)[free]
    for _ in range(_POLISHES):
        if not (np.isfinite(local.cost) and np.all(np.isfinite(local.jacobian))):
            break  # so far out that the model has no numbers
        step = np.linalg.lstsq(local.jacobian[:, free], -local.residual, rcond=1e-10)[0]
        for _ in range(_SHORTER):
            z = solution.z.copy()
            # The step of the values themselves, none to less than a tenth of it.
            z[free] += np.where(logarithmic, np.log(np.maximum(1 + step, 0.1)), step)
            moved = solution_at(problem, z, steps=start.steps)
            there = linearise(problem, moved)
            if there.cost <= local.cost:
                break
            step = step / 4
        else:
            break
        fall, solution, local = local.cost - there.cost, moved, there
        if fall < _LITTLE * local.cost / local.residual.size:
            break
    return solution, local


class NearZero(NamedTuple):
    """A parameter that may be zero, how far from it the data allow, and what it does up to there.

    `changes` are those of the misfits by its value, as the way to the limit has them on average,
    where the slopes at the value itself say little about the rest of the way; else None. `slight`
    is whether all of that way moves the responses by little.
    """

    k: int
    bound: Bound
    changes: list[Float[np.ndarray, "frequencies outputs inputs 2"]] | None
    slight: bool


def near_zeros(problem: Problem, solution: Solution, budget: ErrorBudget) -> list[NearZero]:
    """Parameters at zero, or so near it that the data allow it, with one-sided 95 % limits, before
    what a resonance may move."""
    parameters, parts = problem.parameters, (budget.without_resonance, budget.by_noise)
    possible = np.sqrt(np.diagonal(budget.covariance)) * _ONE_SIDED > 1
    possible |= np.sqrt(np.diagonal(budget.by_noise)) > LIMIT
    possible &= np.array(parameters.logarithmic[: parameters.count])
    possible[list(solution.at_zero)] = True
    near, curvature = [], scaled_inverse(budget.bread)
    for k in np.flatnonzero(possible & (np.diagonal(budget.bread) > 0)).tolist():
        others = [j for j in solution.at_zero if j != k]
        inflations = [float(part[k, k] / curvature[k, k]) for part in parts]
        if others:  # these stay at zero
            some = np.append(np.setdiff1d(np.arange(len(curvature)), [k, *others]), k)
            pairs = [_sandwich(budget.bread, budget.bread @ c @ budget.bread, some) for c in parts]
            inflations = [float(c[-1, -1] / inverse[-1, -1]) for c, inverse in pairs]
        (limit, by_noise), beyond = one_sided_limits(problem, solution, k, inflations)
        value = float(np.asarray(solution.values)[k])
        bound = Bound(parameters.names[k], value, limit, by_noise, beyond)
        if not np.isfinite(limit):
            near.append(NearZero(k, bound, None, slight=False))
            continue
        z = np.array(solution.z)
        z[k] = np.log(abs(limit / float(np.asarray(parameters.scale)[k])))
        there, here = solution_at(problem, z).sensitivity.misfits, solution.sensitivity.misfits
        steps = [np.asarray(new) - np.asarray(old) for new, old in zip(there, here, strict=True)]
        changes = [step / (limit - value) for step in steps]
        used = (record.weights > 0 for record in budget.records)
        sizes = [np.abs(c[mine]) for c, mine in zip(changes, used, strict=True)]
        largest = max(float(np.max(size, initial=0.0)) for size in sizes)
        few, slight = abs(value) < _FEW * abs(limit), largest * abs(limit) < _SLIGHT
        near.append(NearZero(k, bound, changes if few else None, slight))
    return near


def one_sided_limits(
    problem: Problem, solution: Solution, k: int, inflations: Sequence[float]
) -> tuple[list[float], float]:
    """Where parameter `k`, which may be zero, leaves its one-sided 95 % interval, in its own unit.

    `inflations` are its variance over what the curvature of the cost says, one for each limit.
    Limits have the parameter's sign, and are infinite where the cost does not rise so far. The last
    number is how far beyond zero the cost would be lowest, without a sign.
    """
    local, unit = linearise(problem, solution), float(np.asarray(solution.slopes)[k])
    # Slope and curvature of the profile, over the value at which these are evaluated.
    jacobian = local.jacobian
    slope = max(float(jacobian[:, k] @ local.residual), 0.0)
    curvature = 1 / max(float(scaled_inverse(jacobian.T @ jacobian)[k, k]), 1e-300)

    def growth_for(wanted: float, times: float) -> float:
        """By which factor parameter `k` grows until the cost has risen by what is wanted."""
        (low, below), (high, above) = (1.0, 0.0), (np.inf, np.inf)
        for _ in range(_EVALUATIONS):
            z = np.asarray(solution.z).copy()
            z[k] += np.log(times)
            cost = polish(problem, z, [k], solution)[1].cost
            rise = cost - local.cost if np.isfinite(cost) else np.inf
            if abs(rise - wanted) <= _CLOSE * wanted:
                return float(times)
            if rise < wanted:
                low, below = times, max(rise, 0.0)
            else:
                high, above = times, rise
            if np.isfinite(above):  # where a straight line of its root is there
                times = np.interp(np.sqrt(wanted), np.sqrt([below, above]), [low, high])
            else:
                times *= np.clip(np.sqrt(wanted / max(rise, 1e-300)), 0.2, 5.0)
            if not low < times < high:
                times = np.sqrt(low * min(high, 100 * low))
        return float(times if np.isfinite(high) else np.inf)

    limits = []
    for inflation in inflations:
        wanted = _RISE * inflation
        if not 0 < wanted < np.inf:  # a variance that is infinite, or left negative by rounding
            limits.append(unit * np.inf)
            continue
        guess = (np.sqrt(slope**2 + curvature * wanted) - slope) / curvature
        limits.append(unit * growth_for(wanted, 1 + guess))
    return limits, abs(unit) * slope / curvature


def bounds_among(
    near: Sequence[NearZero], budget: ErrorBudget, solution: Solution, units: Units,
    reached: Vector,
) -> tuple[tuple[Bound, ...], Units]:  # fmt: skip
    """Those that a limit determines; and units in which those count that are mixed up with others:
    another one would change by too much on the way to the limit, or takes them far beyond it, to
    what the profiles have `reached`."""
    bounds, mixed, covariance = [], {}, budget.without_resonance
    slight = [one.k for one in near if one.slight]
    for one in near:
        along = np.abs(covariance[:, one.k] / covariance[one.k, one.k])
        moved = along * abs(one.bound.limit / units[one.k])
        moved[[one.k, *(solution.at_zero if one.k in solution.at_zero else ())]] = 0.0
        moved[slight if one.slight else []] = 0.0
        if np.all(moved <= LIMIT) and reached[one.k] <= _BEYOND * abs(one.bound.limit):
            by_resonance = float(np.asarray(budget.moved)[one.k, one.k]) * units[one.k] ** 2
            bounds.append(_further(one.bound, _RISE * by_resonance))
        elif one.k in solution.at_zero or one.changes is not None:
            mixed[one.k] = moved
    others = [j for j in range(len(covariance)) if j not in mixed]
    units = units.copy()
    for one in near:
        if one.k in mixed and np.isfinite(one.bound.limit):
            share = float(np.max(mixed[one.k][others], initial=0.0))
            units[one.k] = one.bound.limit / (share if share > LIMIT else 1.0)
    return tuple(bounds), units


def _further(bound: Bound, rise: float) -> Bound:
    """With a limit at which the square of the distance from the minimum has risen by more."""
    reach = np.hypot(abs(bound.limit - bound.value) + bound.beyond, np.sqrt(rise)) - bound.beyond
    return bound._replace(limit=float(bound.value + np.copysign(reach, bound.limit)))


def without_bounds(
    covariance: Matrix, budget: ErrorBudget, zeros: Sequence[int]
) -> tuple[Matrix, dict[int, float]]:
    """The covariance without bounds, and where parameters at zero would go without them, one by
    one: of two lags, one could grow without limit as the other becomes negative."""
    bread = budget.bread
    if len(zeros) < 2:
        step = -scaled_inverse(bread) @ budget.gradient
        return covariance, {k: float(step[k]) for k in zeros}
    meat = bread @ covariance @ bread
    free = np.setdiff1d(np.arange(len(bread)), zeros)
    total, steps = np.zeros_like(covariance), dict[int, float]()
    total[np.ix_(free, free)] = _sandwich(bread, meat, free)[0]
    for k in zeros:
        some = np.append(free, k)
        mine, inverse = _sandwich(bread, meat, some)
        along = np.zeros(len(bread))
        along[some] = mine[:, -1] / max(float(mine[-1, -1]), 1e-300)
        total += np.outer(along, along) * mine[-1, -1]
        steps[k] = -float(inverse[-1] @ budget.gradient[some])
    return total, steps


def _sandwich(bread: Matrix, meat: Matrix, some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The covariance of some parameters while the others are fixed, and the inverse bread."""
    inverse = scaled_inverse(bread[np.ix_(some, some)])
    return inverse @ meat[np.ix_(some, some)] @ inverse, inverse


def one_sided(covariance: Matrix, k: int, optimum: float) -> Matrix:
    """The covariance where parameter `k` is at zero: what is left of its normal distribution has
    this second moment about zero. `optimum` is where it would be without the bound."""
    from scipy.special import log_ndtr

    variance = covariance[k, k]
    if not variance > 0:  # of a matrix that rounding left singular
        return covariance
    below = max(-optimum / np.sqrt(variance), 0.0)
    # Second moment of a standard normal distribution beyond `below`, about that point.
    if below > _FAR:
        remaining = 2 / below**2 - 10 / below**4 + 74 / below**6
    else:
        hazard = np.exp(-0.5 * below**2 - log_ndtr(-below)) / np.sqrt(2 * np.pi)
        remaining = max(1 - below * (hazard - below), 0.0)
    along = covariance[:, k] / variance
    return covariance + np.outer(along, along) * (variance * remaining - variance)
