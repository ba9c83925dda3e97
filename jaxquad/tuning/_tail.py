"""The tail of an ensemble: thousands of linear loops are searched, and limits kept on the worst."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ._cost import CostResult, Multipliers
from ._objective import Limit
from ._problem import LinearLoops
from ._quantities import QUANTITIES


SEARCHES = 2  # at most
_SLICES = 8  # of a search, each as large as what limits are kept on
_ADDED = 64  # members at most, after a search


class Search(NamedTuple):
    """What is searched."""

    draw: Callable[[int], LinearLoops]  # the slice of that number: members that no tuner has seen
    limits: tuple[Limit, ...]  # as tight as those members have to keep them; [problems, ...]


class Tail(NamedTuple):
    """What was searched, and what came of it."""

    searched: int = 0  # members
    beyond: int = 0  # of these, in the last search
    added: int = 0  # to those that limits are kept on


class Worst(NamedTuple):
    """Members to keep limits on: where they lie in their slices, the worst first."""

    slices: list[LinearLoops]
    found: list[tuple[int, int]]  # slice, and place in it
    beyond: int  # how many there are in all

    @property
    def members(self) -> int:
        """How many were searched."""
        return sum(each.members for each in self.slices)

    def put_into(self, limited: LinearLoops, places: Int[np.ndarray, " some"]) -> LinearLoops:
        """They take the `places` of others."""
        slices, chosen = np.array(self.found).T
        for k in np.unique(slices):
            mine = slices == k
            limited = limited.replaced(places[mine], self.slices[k], chosen[mine])
        return limited


def search_tail(
    search: Search,
    number: int,
    evaluate: Callable[[LinearLoops, tuple[Limit, ...]], CostResult],
    able: Bool[np.ndarray, " problems"],
) -> Worst:
    """Search for members that are beyond a limit of the linear loop in one of the problems.

    An unstable loop has no number that a limit could pull at: it is left to the certificate.
    """
    slices = [search.draw(number * _SLICES + k) for k in range(_SLICES)]
    levels = [greatest_levels(evaluate(x, search.limits), search.limits, able) for x in slices]
    ranked = sorted(
        (
            (level[k], s, int(k))
            for s, level in enumerate(levels)
            for k in np.flatnonzero(level > 0)
        ),
        reverse=True,
    )
    return Worst(slices, [(s, k) for _, s, k in ranked[:_ADDED]], len(ranked))


_LOST = 5.0  # nepers beyond a limit: the peak of a loop that is unstable, or as good as that


def greatest_levels(
    result: CostResult, limits: Sequence[Limit], able: Bool[np.ndarray, " problems"]
) -> Float[np.ndarray, " members"]:
    """How far each member is beyond the limits of the linear loop, the greatest of all problems."""
    linear = [k for k, limit in enumerate(limits) if QUANTITIES[limit.quantity].linear]
    levels = np.max([np.asarray(result.beyond[k])[able] for k in linear], axis=(0, 1))
    return np.where(np.isfinite(levels) & (levels < _LOST), levels, -np.inf)


def half_of_reserve(
    limits: Sequence[Limit], allowed: Sequence[Limit]
) -> Float[np.ndarray, "problems limits"]:
    """Half of the level from what is aimed at to what is allowed: near enough to search again."""
    level = lambda limit: np.asarray(QUANTITIES[limit.quantity].level(limit.bound))
    pairs = zip(limits, allowed, strict=True)
    return np.stack([0.5 * np.abs(level(a) - level(b)) for a, b in pairs], axis=1)


def least_critical(
    result: CostResult, limits: Sequence[Limit], able: Bool[np.ndarray, " problems"], count: int
) -> Int[np.ndarray, " some"]:
    """Which of the members that limits are kept on are furthest within them."""
    return np.argsort(greatest_levels(result, limits, able), kind="stable")[:count]


def forget_multipliers(
    multipliers: Multipliers, limits: Sequence[Limit], places: Int[np.ndarray, " some"]
) -> Multipliers:
    """Those of the members at `places` begin at 0, where the limit is one of the linear loop."""
    values = [np.array(x) for x in multipliers.values]
    for value, limit in zip(values, limits, strict=True):
        if QUANTITIES[limit.quantity].linear:
            value[:, places] = 0.0
    return multipliers._replace(values=tuple(map(jnp.asarray, values)))
