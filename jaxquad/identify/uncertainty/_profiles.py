"""The cost along one weak parameter: how far it, and what moves along with it, may be off.

By its logarithm a parameter near zero, or in a direction in which several run to infinity, has a
cost that its curvature does not describe. Source: Venzon and Moolgavkar (1988), A method for
computing profile-likelihood-based confidence intervals.
"""

import functools as ft
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..frequency_domain._problem import Problem
from ..frequency_domain._solve import Solution
from ._error_budget import ErrorBudget, Matrix, scaled_inverse
from ._response_term import units_of
from ._verdict import LIMIT, REACH
from ._zero_bounds import linearise, NearZero, polish, Vector


WEAK = 6.0  # standard errors to zero, within which the cost is followed there
_FINE = 10  # places between two points of a profile
_FAR_OUT = 4.0  # standard errors, where a profile ends
_MOST = 20  # places to either side of it
_MULTIPLES = (1.0, 1.25, 1.5, 2.0)  # of an interval, which its sides are made for
_JUMP = 0.02  # of the way there, between two minima of the other parameters
_NEXT = 1e-9  # standard errors, between places of equal cost
_NULL = 1e-12  # of the largest eigenvalue of the scaled bread: of a null direction


class Profile(NamedTuple):
    """The cost along one weak parameter `k`, the others being where it is lowest.

    What a small lag does beside a delay goes by its square: towards zero the cost rises by less
    than its curvature says.
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
        """Of an interval; `along` is the share of the error that goes with `k`.

        Readers double an error. Where the cost rises ever less farther out, a side is half of that
        at twice the reach.
        """
        places = np.arange(self.distances.size)
        fine = np.linspace(0, places[-1], _FINE * places[-1] + 1)
        columns = self.distances / self.inflations[part], quantity
        distance, value = (np.interp(fine, places, column) for column in columns)
        estimate = float(quantity[np.sum(self.distances < 0)])
        value = value - estimate
        low = high = 0.0
        for times in _MULTIPLES:
            inside = np.abs(distance) <= times * reach
            left = (times * reach) ** 2 - distance[inside] ** 2
            aside = np.sqrt(left * max(error**2 - along**2, 0.0))
            low = min(low, float(np.min(value[inside] - aside)) / times)
            high = max(high, float(np.max(value[inside] + aside)) / times)
        return estimate + low, estimate + high

    def reached(self) -> Vector:
        """The largest size of each other parameter within the interval of this one."""
        inside = np.abs(self.distances) <= REACH * self.inflations[0]
        sizes = np.max(np.abs(self.values[inside]), axis=0)
        return np.where(np.arange(sizes.size) == self.k, 0.0, sizes)

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
    variances, by_noise = np.diagonal(budget.without_resonance), np.diagonal(budget.by_noise)
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
    parts = budget.without_resonance, budget.by_noise
    inflations = np.sqrt([part[k, k] / scaled_inverse(budget.bread)[k, k] for part in parts])
    far, value = _FAR_OUT * float(np.max(inflations)), values[k]
    estimate = _Place(solution.z, values)
    solutions = ft.partial(_places_along, problem, solution, k, estimate, far)
    below = solutions(value / 2, value / 1000) if value else []
    above = solutions(value + error, value + 2.5 * error)
    places = [*below[::-1], estimate, *above]
    points = np.stack([place.values for place in places])
    distances = np.array([place.distance for place in places])
    distances[: len(below)] = np.minimum(-distances[: len(below)], -_NEXT)  # in order
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
        changes = np.array([np.abs(place.values[k] - start) for place in places])
        coarse = (np.diff(distances) > far / 3) & (distances[:-1] < far)
        coarse &= np.diff(changes) > _JUMP * changes[1:]
        if not coarse.any():
            break
        n = int(np.argmax(coarse))
        ends = places[n].values[k], places[n + 1].values[k]
        alike = abs(ends[0]) < 4 * abs(ends[1])
        middle = (ends[0] + ends[1]) / 2 if alike else np.sign(start) * np.sqrt(ends[0] * ends[1])
        places.insert(n + 1, at(middle, places[n]))
    return places[1:]
