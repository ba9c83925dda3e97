"""Where several starts led."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


_COST, _PLACE = 2e-3, 0.1  # within which two ends are one: of the cost, and in nepers


class Optimum(NamedTuple):
    """A point at which some of the starts ended; those that did not stabilise cost nan."""

    cost: float
    z: Float[np.ndarray, " n"]
    values: dict[str, float]  # of the tuned numbers
    starts: tuple[int, ...]  # which of them led here; 0 is the controller as given
    converged: bool


def scattered(
    start: Float[np.ndarray, " n"], count: int, scatter: float, seed: int
) -> Float[np.ndarray, "starts n"]:
    """The start itself, and others about it: normal by `scatter` (nepers), a Latin hypercube."""
    from scipy.special import ndtri

    if not isinstance(count, int) or count < 1 or not 0 < scatter < np.inf:
        raise ValueError(
            f"starts is {count} with a scatter of {scatter}: give 1 for the controller as it is, "
            "or more, and a scatter above 0"
        )
    if count == 1:
        return start[None]
    rng = np.random.default_rng(seed)
    cells = np.stack([rng.permutation(count - 1) for _ in range(start.size)], axis=1)
    deviates = ndtri((cells + rng.uniform(0.01, 0.99, cells.shape)) / (count - 1))
    return np.concatenate([start[None], start + scatter * deviates])


def optima(
    cost: Float[np.ndarray, " starts"],
    z: Float[np.ndarray, "starts n"],
    converged: np.ndarray,
    named,
) -> tuple[Optimum, ...]:
    """Distinct ends, the best first; `named(z)` tells the tuned numbers."""
    found: list[Optimum] = []
    for k in np.argsort(np.where(np.isnan(cost), np.inf, cost), kind="stable"):
        same = [
            i for i, o in enumerate(found)
            if abs(o.cost - cost[k]) < _COST and np.max(np.abs(o.z - z[k])) < _PLACE
        ]  # fmt: skip
        if same:
            old = found[same[0]]
            found[same[0]] = old._replace(starts=(*old.starts, int(k)))
        else:
            found.append(Optimum(float(cost[k]), z[k], named(z[k]), (int(k),), bool(converged[k])))
    return tuple(found)
