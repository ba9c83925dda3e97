"""Multipliers of the limits, from one descent to the next."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ._cost import Pull, Told
from ._limit import Limit
from ._problem import Problem
from ._quantities import OF_THE_LOOP


MET = 2e-3  # beyond a limit, as a level: 0.2 %
_STIFFNESS, _STIFFER = 4.0, 4.0
_STALLED = 0.9  # of what a limit was missed by before: it falls no further
_AS_GOOD = 1.05  # of the least miss: of rounds that miss limits so nearly alike, the cost decides


def no_pull(problem: Problem, limits: Sequence[Limit], problems: int) -> Pull:
    """Before anything is known of the limits."""
    sizes = [_constraints(problem, limit) for limit in limits]
    multipliers = tuple(jnp.asarray(np.zeros((problems, size))) for size in sizes)
    return Pull(multipliers, jnp.asarray(np.full((problems, len(sizes)), _STIFFNESS)))


def pulled(
    told: Told,
    pull: Pull,
    before: Float[np.ndarray, "problems limits"],
    on: Bool[np.ndarray, " problems"],
) -> tuple[Pull, Float[np.ndarray, "problems limits"]]:
    """The next multipliers for problems that are `on`, and how far each limit is missed.

    Where a limit is missed by more than a quarter of what it was `before`, it becomes stiffer.
    """
    keep, multipliers, most = np.asarray(on)[:, None], [], []
    stiffness = np.asarray(pull.stiffness)
    for k, beyond in enumerate(map(np.asarray, told.beyond)):
        old = np.asarray(pull.multipliers[k])
        raised = np.maximum(old + stiffness[:, k : k + 1] * beyond, 0)
        multipliers.append(jnp.asarray(np.where(keep, raised, old)))
        most.append(beyond.max(axis=1))
    missed = np.stack(most, axis=1)
    slow = missed > np.maximum(0.25 * before, MET)
    stiffer = np.where(slow & keep, _STIFFER, 1.0) * stiffness
    return Pull(tuple(multipliers), jnp.asarray(stiffer)), missed


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
        """Which problems have twice come no nearer to limits that they miss by more than 2 %."""
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


def _constraints(problem: Problem, limit: Limit) -> int:
    """One for each member that a limit is kept on."""
    wide = problem.wide if limit.quantity in OF_THE_LOOP else None
    return problem.members if wide is None else wide.members
