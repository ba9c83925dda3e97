"""Gains that give every design the same Ms and the same activity on a plant's nominal loop."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .designs import Design
from .nominal import HOPELESS, loops_at, WIDTH
from .pid_shape import shaped


_STARTS, _STEP = 6, 1e-4


class Matched(NamedTuple):
    """A design on a plant, with what its nominal loop reaches."""

    design: Design
    plant: str
    sensitivity_peak: float
    activity: float
    matched: bool
    why: str  # not matched, if it is not


Numbers = Callable[[np.ndarray], np.ndarray]  # ln gains [2, n] to ln Ms and ln activity [2, n]


def match(data: dict[str, Any], plant: str) -> dict[str, Matched]:
    """Every design of the suite on one plant."""
    found: dict[str, Matched] = {}
    for name, design in data["designs"].items():
        if "as" in design:
            like = found[design["as"]]
            found[name] = like._replace(design=Design(name, design, like.design.gains))
        else:
            found[name] = _matched(name, design, data, plant)
    return found


def _matched(name: str, data: dict[str, Any], suite: dict[str, Any], plant: str) -> Matched:
    targets, free = suite["targets"], data.get("free")
    goal = np.log([targets["sensitivity_peak"][plant], targets["activity"]])
    level, dt = suite["plants"][plant], suite["dt"]
    design = Design(name, data, dict(data.get("gains", {})))
    if not free:
        peak, activity = np.exp(loops_at(design, level, dt, {})[1][:, 0])
        unstable = peak > 0.99 * HOPELESS
        peak, activity = (np.inf if unstable else float(x) for x in (peak, activity))
        return Matched(design, plant, peak, activity, False, "its gains are as printed")

    def numbers(logs: np.ndarray) -> np.ndarray:
        return loops_at(design, level, dt, dict(zip(free, np.exp(logs), strict=True)))[1]

    logs = solve(numbers, goal, np.log(list(free.values())))
    solved = design._replace(gains=dict(zip(free, np.exp(logs).tolist(), strict=True)))
    if "shape" in data:
        solved = shaped(solved, level, dt, goal)
    reached = loops_at(solved, level, dt, {})[1][:, 0]
    met = bool(np.all(np.abs(reached - goal) < targets["tolerance"]))
    peak, activity = np.exp(reached).tolist()
    why = "" if met else f"the nearest of {_STARTS} searches"
    return Matched(solved, plant, peak, activity, met, why)


def solve(numbers: Numbers, goal: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """A pair of gains in bounds, the second not below the first, that meets the goal.

    Searches start from the best points of a 16 x 16 grid, the fastest first, and end with the first
    that meets it. If none does it is the pair that comes nearest.
    """
    from scipy.optimize import least_squares

    aside = _STEP * np.array([[1, -1, 0, 0], [0, 0, 1, -1]])

    def residual(logs: np.ndarray) -> np.ndarray:
        return numbers(logs[:, None])[:, 0] - goal

    def slopes(logs: np.ndarray) -> np.ndarray:
        found = numbers(logs[:, None] + aside)
        return (found[:, ::2] - found[:, 1::2]) / (2 * _STEP)

    jacobian: Any = slopes
    limits: dict[str, Any] = {"xtol": 1e-10, "max_nfev": 40}
    ends = []
    for start in _starts(numbers, goal, bounds):
        search = least_squares(residual, start, jac=jacobian, bounds=bounds.T, **limits)
        miss = float(np.max(np.abs(search.fun)))
        if search.x[1] >= search.x[0]:
            ends.append((miss, search.x))
            if miss < 1e-6:
                return search.x
    if not ends:
        raise ValueError(f"no gains within {np.exp(bounds).tolist()}: widen the bounds")
    return min(ends, key=lambda end: end[0])[1]


def _starts(numbers: Numbers, goal: np.ndarray, bounds: np.ndarray) -> list[np.ndarray]:
    # Inside of the bounds, on which a search cannot start.
    axes = [np.linspace(low, high, 18)[1:-1] for low, high in bounds]
    grid = np.stack(np.meshgrid(*axes, indexing="ij")).reshape(2, -1)
    found = np.concatenate(
        [numbers(grid[:, k : k + WIDTH]) for k in range(0, grid.shape[1], WIDTH)], axis=1
    )
    miss = np.max(np.abs(found - goal[:, None]), axis=0)
    miss = np.where(grid[1] >= grid[0], miss, np.inf)
    best = [grid[:, k] for k in np.argsort(miss)[:_STARTS]]
    return sorted(best, key=lambda x: -x[0])
