"""Gains that give every design the same Ms and the same activity on a plant's nominal loop."""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxquad.loops import LoopAnalysis

from .designs import Belief, controller, Design
from .linear import analysed
from .rigs import lateness, linear_axis, rig


WIDTH = 32  # members of every ensemble, so that all cases share what is compiled
_STARTS, _STEP = 6, 1e-4
_HOPELESS = 1e6  # Ms and activity of loops that are unstable


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


def nominal_loops(
    design: Design, level: dict[str, Any], dt: float, gains: dict[str, Any] | None = None
) -> LoopAnalysis:
    """The nominal linear loop, `WIDTH` times: with other `gains` by member if they are given."""
    belief = nominal_belief(level)
    wanted = design._replace(gains=design.gains | (gains or {}))
    plain = wanted._replace(data=wanted.data | {"law": "pid" if design.law == "pid" else "ladrc"})
    axis = linear_axis(level, WIDTH, {})
    return analysed(axis, controller(plain, belief, dt=dt), lateness(level, WIDTH))


def nominal_belief(level: dict[str, Any]) -> Belief:
    """That of the first axis, in `WIDTH` copies."""
    at = rig(level, WIDTH)
    gain, inertia, limit = (x[:1] for x in (at.torque_gain, at.inertia, at.limit))
    return Belief(gain, inertia, gain / inertia, limit, at.volts[:1])


def _matched(name: str, data: dict[str, Any], suite: dict[str, Any], plant: str) -> Matched:
    targets, free = suite["targets"], data.get("free")
    goal = np.log([targets["sensitivity_peak"][plant], targets["activity"]])
    design = Design(name, data, dict(data.get("gains", {})))
    numbers = ft.partial(_reached, design, suite["plants"][plant], suite["dt"])
    if not free:
        peak, activity = np.exp(numbers(np.zeros((0, 1)))[:, 0])
        unstable = peak > 0.99 * _HOPELESS
        peak, activity = (np.inf if unstable else float(x) for x in (peak, activity))
        return Matched(design, plant, peak, activity, False, "its gains are as printed")
    logs = solve(numbers, goal, np.log(list(free.values())))
    reached = numbers(logs[:, None])[:, 0]
    met = bool(np.all(np.abs(reached - goal) < targets["tolerance"]))
    solved = design._replace(gains=dict(zip(free, np.exp(logs).tolist(), strict=True)))
    peak, activity = np.exp(reached).tolist()
    why = "" if met else f"the nearest of {_STARTS} searches"
    return Matched(solved, plant, peak, activity, met, why)


def _reached(design: Design, level: dict[str, Any], dt: float, logs: np.ndarray) -> np.ndarray:
    """ln Ms and ln activity at up to `WIDTH` pairs of ln gains [2, n]; at its own, of none."""
    gains = {}
    for name, row in zip(design.data.get("free", ()), np.exp(logs), strict=True):
        gains[name] = np.append(row, np.full(WIDTH - row.size, row[0]))
    loops = nominal_loops(design, level, dt, gains)
    b = float(nominal_belief(level).gain[0, 0])
    values = np.array([loops.sensitivity_peak, b * np.asarray(loops.noise_gain)])
    return np.log(np.where(np.isfinite(values), values, _HOPELESS))[:, : logs.shape[1]]


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
