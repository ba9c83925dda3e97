"""Multipliers of an augmented Lagrangian for limits, and the rounds that adjust them.

Source: Nocedal and Wright, Numerical Optimization, 2nd ed., section 17.4.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxquad._core import as_array

from ._cost import CostResult, count_members, Multipliers
from ._objective import Limit
from ._problem import Problem


MET = 2e-3  # beyond a limit, as a level: 0.2 %
_STIFFNESS, _STIFFER = 4.0, 4.0
_STALLED = 0.9  # of what a limit was missed by before: it falls no further
_AS_GOOD = 1.05  # of the least miss: of rounds that miss limits so nearly alike, the cost decides


def initial_multipliers(problem: Problem, limits: Sequence[Limit], problems: int) -> Multipliers:
    """Before anything is known of the limits."""
    sizes = [count_members(problem, limit) for limit in limits]
    values = tuple(as_array(np.zeros((problems, size))) for size in sizes)
    return Multipliers(values, as_array(np.full((problems, len(sizes)), _STIFFNESS)))


def update_multipliers(
    result: CostResult,
    multipliers: Multipliers,
    before: Float[np.ndarray, "problems limits"],
    on: Bool[np.ndarray, " problems"],
) -> tuple[Multipliers, Float[np.ndarray, "problems limits"]]:
    """The next multipliers of problems that are `on`, and how far each limit is missed.

    A limit becomes stiffer where it is missed by more than a quarter of what it was `before`.
    """
    keep, values, most = np.asarray(on)[:, None], [], []
    stiffness = np.asarray(multipliers.stiffness)
    for k, beyond in enumerate(map(np.asarray, result.beyond)):
        old = np.asarray(multipliers.values[k])
        raised = np.maximum(old + stiffness[:, k : k + 1] * beyond, 0)
        values.append(as_array(np.where(keep, raised, old)))
        most.append(beyond.max(axis=1))
    missed = np.stack(most, axis=1)
    slow = missed > np.maximum(0.25 * before, MET)
    stiffer = np.where(slow & keep, _STIFFER, 1.0) * stiffness
    return Multipliers(tuple(values), as_array(stiffer)), missed


class Rounds:
    """Where each round of multipliers ended, and whether another one is worth it."""

    def __init__(self) -> None:
        self.points: list[Float[np.ndarray, "problems n"]] = []
        self.costs: list[Float[np.ndarray, " problems"]] = []
        self.missed: list[Float[np.ndarray, " problems"]] = []

    def add(self, z: np.ndarray, cost: np.ndarray, beyond: np.ndarray) -> None:
        self.points.append(np.array(z))
        self.costs.append(np.asarray(cost))
        self.missed.append(np.maximum(beyond, 0).sum(axis=1))

    @property
    def stalled(self) -> Bool[np.ndarray, " problems"]:
        """Which problems miss limits by more than 2 %, and came no nearer to them in two rounds."""
        if len(self.missed) < 3:
            return np.zeros(len(self.points[0]), bool)
        least, last, now = np.min(self.missed[:-2], axis=0), *self.missed[-2:]
        return (now > 10 * MET) & (np.minimum(last, now) > _STALLED * least)

    def best(self) -> Float[np.ndarray, "problems n"]:
        """The last round's end where it meets the limits, else the one that misses them least."""
        missed, costs = np.stack(self.missed), np.stack(self.costs)
        near = missed <= _AS_GOOD * missed.min(axis=0)
        chosen = np.argmin(np.where(near, costs, np.inf), axis=0)
        chosen = np.where(missed[-1] <= 2 * MET, len(missed) - 1, chosen)
        return np.stack([self.points[r][k] for k, r in enumerate(chosen)])
