"""Parameters that keep their sign, at zero: decided at the optimum, with limits and errors there.

By its logarithm the cost has no slope near zero, and a solver may stop anywhere. What counts is the
slope of the cost by the parameter itself. At a bound the optimum is a one-sided problem: the cost
rises from it with a slope, and the limit is where the profile likelihood has risen by 2.71 / 2.
Source: Self and Liang (1987), Asymptotic properties of maximum likelihood estimators and likelihood
ratio tests under nonstandard conditions.
"""

import functools as ft
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..frequency_domain._cost import mix
from ..frequency_domain._problem import Problem
from ..frequency_domain._solve import Solution, solution_at, solve
from ._error_budget import ErrorBudget, Matrix, scaled_inverse
from ._response_term import Units, units_of
from ._verdict import Bound, LIMIT, REACH


_NEAR = 1e-2  # of the change that shows: a parameter below it is at zero
_AT_ZERO = 1e-6  # likewise, where its slopes are evaluated
_ROUNDS = 4  # of releasing parameters that do not belong at zero
_LONGEST = 1.0  # step of a logarithm, to where others go on from
_POLISHES = 10  # steps
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
WEAK = 6.0  # standard errors to zero, within which the cost is followed there
_FINE = 10  # places between two points of a profile
_FAR_OUT = 2.5  # standard errors, where a profile ends
_MOST = 12  # places to either side of it
_NULL = 1e-12  # of the largest eigenvalue of the scaled bread: of a null direction

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
    """Parameters at zero, or so near it that the data allow it, with one-sided 95 % limits."""
    parameters, parts = problem.parameters, (budget.covariance, budget.by_noise)
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
    near: Sequence[NearZero], budget: ErrorBudget, solution: Solution, units: Units
) -> tuple[tuple[Bound, ...], Units]:
    """Those that a limit determines; and units in which those count that are mixed up with others:
    another one would change by too much on the way to the limit."""
    bounds, mixed, covariance = [], {}, budget.covariance
    slight = [one.k for one in near if one.slight]
    for one in near:
        along = np.abs(covariance[:, one.k] / covariance[one.k, one.k])
        moved = along * abs(one.bound.limit / units[one.k])
        moved[[one.k, *(solution.at_zero if one.k in solution.at_zero else ())]] = 0.0
        moved[slight if one.slight else []] = 0.0
        if np.all(moved <= LIMIT):
            bounds.append(one.bound)
        elif one.k in solution.at_zero or one.changes is not None:
            mixed[one.k] = moved
    others = [j for j in range(len(covariance)) if j not in mixed]
    units = units.copy()
    for one in near:
        if one.k in mixed and np.isfinite(one.bound.limit):
            share = float(np.max(mixed[one.k][others], initial=0.0))
            units[one.k] = one.bound.limit / (share if share > LIMIT else 1.0)
    return tuple(bounds), units


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


class Profile(NamedTuple):
    """The cost along one weak parameter `k`, the others being where it is lowest.

    What a small lag does beside a delay goes by its square: towards zero the cost rises by less
    than its curvature says. Source: Venzon and Moolgavkar (1988), A method for computing
    profile-likelihood-based confidence intervals.
    """

    k: int
    values: Float[np.ndarray, "points parameters"]  # the estimate is one of the points
    distances: Float[np.ndarray, " points"]  # from it, in standard errors by the curvature
    inflations: Float[np.ndarray, " 2"]  # of these standard errors; by the noise alone
    along: Float[np.ndarray, "2 parameters"]  # changes with one standard error of `k`; likewise
    ends: bool  # whether the cost rises enough away from zero, too

    def interval(
        self, j: int, error: float, reach: float = REACH, *, model_error: bool = True
    ) -> tuple[float, float]:
        """Of parameter `j` with this standard error, within `reach` of them."""
        part = 0 if model_error else 1
        quantity, along = self.values[:, j], float(self.along[part, j])
        low, high = self._sides(quantity, error, along, reach, part)
        if j == self.k and self.distances[0] > -reach * self.inflations[part]:
            low, high = min(low, 0.0), max(high, 0.0)  # the last point towards zero is as good
        if j == self.k and not self.ends:
            return (low, np.inf) if self.values[-1, j] > 0 else (-np.inf, high)
        return low, high

    def sides_of(
        self, quantity: Float[np.ndarray, " points"], value: float, error: float, slope: Vector,
        *, model_error: bool = True,
    ) -> tuple[float, float]:  # fmt: skip
        """The sides of a quantity's interval, over those by its `slope` where they are longer."""
        part = 0 if model_error else 1
        low, high = self._sides(quantity, error, float(slope @ self.along[part]), REACH, part)
        usual = max(REACH * error, 1e-300)
        return max((value - low) / usual, 1.0), max((high - value) / usual, 1.0)

    def _sides(
        self, quantity: Float[np.ndarray, " points"], error: float, along: float, reach: float,
        part: int,
    ) -> tuple[float, float]:  # fmt: skip
        """Of an interval; `along` is the share of the error that goes with `k`."""
        places = np.arange(self.distances.size)
        fine = np.linspace(0, places[-1], _FINE * places[-1] + 1)
        columns = self.distances / self.inflations[part], quantity
        distance, value = (np.interp(fine, places, column) for column in columns)
        inside = np.abs(distance) <= reach
        aside = np.sqrt((reach**2 - distance[inside] ** 2) * max(error**2 - along**2, 0.0))
        return float(np.min(value[inside] - aside)), float(np.max(value[inside] + aside))

    def undetermined(
        self, values: Vector, errors: Vector, imprecise: Bool[np.ndarray, " parameters"]
    ) -> Bool[np.ndarray, " parameters"]:
        """The imprecise parameters, those that may be three times as large, and what changes by
        more than the limit along with one of them."""
        sizes = np.abs(values)
        ends = np.array([self.interval(j, float(error)) for j, error in enumerate(errors)])
        longest = sizes + REACH * np.maximum(2 * LIMIT * sizes, errors)
        imprecise = imprecise | (np.max(np.abs(ends), axis=1) > longest)
        if self.k < 0 or not imprecise[self.k]:
            return imprecise
        ends = np.array([self.interval(j, 0.0) for j in range(values.size)])
        return imprecise | (np.max(np.abs(ends - values[:, None]), axis=1) > LIMIT * sizes)

    def among(self, kept: np.ndarray) -> "Profile":
        """With some of the parameters alone."""
        place = int(np.argmax(kept == self.k)) if self.k in kept else -1
        return self._replace(k=place, values=self.values[:, kept], along=self.along[:, kept])


def profiles(
    problem: Problem, solution: Solution, budget: ErrorBudget, near: Sequence[NearZero]
) -> tuple[Profile, ...]:
    """Of the parameters that keep their sign and lie within a few standard errors of zero, and of
    one in each direction in which all run to infinity."""
    variances, by_noise = np.diagonal(budget.covariance), np.diagonal(budget.by_noise)
    weak = variances > 1 / WEAK**2
    weak[[one.k for one in near]] = True
    weak[_of_null_directions(budget.bread)] = True
    weak &= np.array(problem.parameters.logarithmic[: budget.count])
    weak &= (by_noise > 0) & (np.diagonal(scaled_inverse(budget.bread)) > 0)
    relative = np.sqrt(np.where(variances > 0, variances, 1.0))
    errors = units_of(solution)[: budget.count] * relative
    for one in near:
        if np.isfinite(one.bound.limit):
            errors[one.k] = one.bound.limit / 2
    some = np.flatnonzero(weak).tolist()
    return tuple(_profile(problem, solution, budget, k, float(errors[k])) for k in some)


def _profile(
    problem: Problem, solution: Solution, budget: ErrorBudget, k: int, error: float
) -> Profile:
    """Of parameter `k`, whose standard error is about this."""
    values, units = np.asarray(solution.values)[: budget.count], units_of(solution)[: budget.count]
    parts = budget.covariance, budget.by_noise
    inflations = np.sqrt([part[k, k] / scaled_inverse(budget.bread)[k, k] for part in parts])
    far, value = _FAR_OUT * float(np.max(inflations)), values[k]
    estimate = _Place(solution.z, values)
    solutions = ft.partial(_places_along, problem, solution, k, estimate, far)
    below = solutions(value / 2, value / 1000) if value else []
    above = solutions(value + error, value + 2.5 * error)
    places = [*below[::-1], estimate, *above]
    points = np.stack([place.values for place in places])
    distances = np.array([place.distance for place in places])
    distances[: len(below)] *= -1
    ends = bool(distances[-1] >= far)
    if ends:  # on along a straight line
        points = np.concatenate([points, [2 * points[-1] - points[-2]]])
        distances = np.append(distances, 2 * distances[-1] - distances[-2])
    along = np.stack([units * part[k] / np.sqrt(part[k, k]) for part in parts])
    return Profile(k, points, distances, inflations, along, ends)


def _of_null_directions(bread: Matrix) -> list[int]:
    """The parameter of the largest share in each."""
    scale = np.sqrt(np.maximum(np.diagonal(bread), 1e-300))
    sizes, directions = np.linalg.eigh(bread / np.outer(scale, scale))
    return np.argmax(np.abs(directions[:, sizes < _NULL * sizes[-1]]), axis=0).tolist()


class _Place(NamedTuple):
    """Of a profile."""

    z: Vector
    values: Vector
    distance: float = 0.0


def _places_along(
    problem: Problem, solution: Solution, k: int, estimate: _Place, far: float, *aims: float
) -> list[_Place]:
    """Places of the profile of `k` on the way to the last of the `aims`, and beyond it up to the
    distance `far`, so close to each other that straight lines connect them."""
    best, scale = linearise(problem, solution).cost, float(np.asarray(problem.parameters.scale)[k])

    def at(aim: float, nearest: _Place) -> _Place:
        z = nearest.z.copy()
        z[k] = np.log(abs(aim / scale))
        there, local = polish(problem, z, [k], solution)
        rise = max(local.cost - best, 0.0)
        return _Place(there.z, np.asarray(there.values)[: z.size], float(np.sqrt(rise)))

    places, start = [estimate], estimate.values[k]
    for aim in aims:
        places.append(at(aim, places[-1]))
    while abs(aim) > abs(start) and places[-1].distance < far and len(places) < _MOST / 2:
        aim = start + 2.5 * (aim - start)
        places.append(at(aim, places[-1]))
    while len(places) < _MOST:
        distances = np.array([place.distance for place in places])
        coarse = (np.diff(distances) > far / 3) & (distances[:-1] < far)
        if not coarse.any():
            break
        n = int(np.argmax(coarse))
        ends = places[n].values[k], places[n + 1].values[k]
        alike = abs(ends[0]) < 4 * abs(ends[1])
        middle = (ends[0] + ends[1]) / 2 if alike else np.sign(start) * np.sqrt(ends[0] * ends[1])
        places.insert(n + 1, at(middle, places[n]))
    return places[1:]
