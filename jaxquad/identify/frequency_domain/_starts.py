"""Many starting points, solved side by side, and where each of them ended."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxquad._core import CONVERGED, decrement, minimise, RUNNING, STALLED, TOLERANCE

from ._parameters import Parameters
from ._problem import Problem, problem_normal, residuals
from ._solve import least_squares, Solution, solution_at, stopped_early


MINIMUM = "minimum"
FLAT = "flat: some change of parameters does not change the cost"
SADDLE = "stationary, but no minimum: the cost falls to one side"
WALL = "no minimum: no shorter step lowers the cost, yet its slope is not zero"
UNFINISHED = "the maximum number of steps was reached"
NOT_FINITE = "the model is not finite at the start"


class Minimum(NamedTuple):
    """A point at which the fits from some of the starts ended."""

    cost: float  # sum of squares
    z: Float[np.ndarray, " parameters"]
    values: Float[np.ndarray, " parameters"]  # physical
    starts: tuple[int, ...]  # which of them led here
    decrement: float  # Newton decrement: half of what one more step would save of the cost
    curvature: float  # smallest eigenvalue of the cost's Hessian, scaled to unit diagonal
    kind: str  # "minimum", or what it is instead

    @property
    def is_minimum(self) -> bool:
        """Whether slope and curvature are those of a minimum, isolated or flat."""
        return self.kind in (MINIMUM, FLAT)


def spread_starts(
    parameters: Parameters, count: int, *, fastest: float, factor: float = 5.0, seed: int = 0
) -> Float[np.ndarray, "starts parameters"]:
    """Starting vectors `z`: the given start, then a Latin hypercube around it.

    Parameters that keep their sign spread evenly in the logarithm, those that may cross zero over
    twice their scale. A parameter whose name ends in `delay` stays below half a turn at the fastest
    frequency, beyond which minima repeat with each turn.

    **Arguments:**

    - `fastest`: the highest frequency in rad/s.
    - `factor`: how far to spread to both sides, above 1.

    **Raises:** ValueError for no starts, or a factor that spreads nothing.
    """
    if count < 1:
        raise ValueError(f"starts is {count}: give 1 for the given start alone, or more")
    if not (1 < factor < np.inf and 0 < fastest < np.inf):
        raise ValueError(
            f"factor {factor} and fastest frequency {fastest} rad/s: give a finite factor above 1, "
            "for instance 5, and a positive frequency"
        )
    n, rng = parameters.count, np.random.default_rng(seed)
    start, scale = (np.asarray(x)[:n] for x in (parameters.start, parameters.scale))
    cells = np.stack([rng.permutation(count - 1) for _ in range(n)], axis=1).reshape(count - 1, n)
    unit = (cells + rng.uniform(size=cells.shape)) / max(count - 1, 1)
    logarithmic = np.array(parameters.logarithmic[:n])
    reach = np.where(logarithmic, np.log(factor), 2.0)
    low, high = start - reach, start + reach
    for k, name in enumerate(parameters.names):
        if name.split(".")[-1].split("[")[0].endswith("delay") and logarithmic[k]:
            most = max(np.log(np.pi / fastest / abs(scale[k])), start[k])
            high[k] = min(high[k], most)
    return np.concatenate([start[None], low + (high - low) * unit])


def solve_from_many(
    problem: Problem,
    starts: Float[np.ndarray, "starts parameters"],
    solver: eqx.Module | None,
    max_steps: int,
) -> tuple[Solution, tuple[Minimum, ...]]:
    """Solve from every start in one call.

    Starts of the default solver run side by side, those of an optimistix solver one by one, since
    its LAPACK calls can hang under `vmap`.

    **Returns:** the best solution, a minimum before a lower point that is none; and all distinct
    points, sorted by cost.

    **Raises:** ValueError where no start has a finite response.
    """
    stops = jax.tree.map(np.asarray, _solve_all(problem, np.asarray(starts), solver, max_steps))
    z, status, steps, normal, left, bent = stops
    costs, groups = normal.cost, list[list[int]]()

    def same(one: int, other: int) -> bool:
        """Those within a millionth of the cost are one."""
        floor, difference = 1e-6 * (costs[one] + 1e-6), np.asarray(z[one] - z[other])
        if abs(costs[other] - costs[one]) > floor:
            return False
        near = bool(np.max(np.abs(difference)) <= 1e-4)
        return near or bool(0.5 * difference @ normal.hessian[one] @ difference <= floor)

    for k in (int(k) for k in np.argsort(costs) if np.isfinite(costs[k])):
        group = next((group for group in groups if same(group[0], k)), None)
        groups.append([k]) if group is None else group.append(k)
    if not groups:
        raise ValueError(
            f"the model's response is not finite at any of {len(starts)} starts: check the model "
            "at its starting values with model.frequency_response(omega)"
        )
    minima = []
    for k, *others in groups:
        curvature, cost = -np.inf, float(costs[k])
        if np.all(np.isfinite(bent[k])):
            size = np.sqrt(np.maximum(np.abs(np.diagonal(bent[k])), 1e-300))
            curvature = float(np.linalg.eigvalsh(bent[k] / np.outer(size, size))[0])
        # Noise-free data leave a cost of rounding errors, of which no share means anything.
        if left[k] > 1e-6 * cost + 1e-12:
            kind = UNFINISHED if status[k] == RUNNING else WALL
        elif curvature < -1e-6:
            kind = SADDLE
        else:
            kind = MINIMUM if curvature > 1e-9 else FLAT
        values, led = np.asarray(problem.parameters.values(z[k])), tuple(sorted([k, *others]))
        minima.append(Minimum(2 * cost, z[k], values, led, float(left[k]), curvature, kind))
    best = min(minima, key=lambda point: (not point.is_minimum, point.cost))
    if lost := tuple(k for k in range(len(z)) if not np.isfinite(costs[k])):
        values = np.asarray(problem.parameters.values(z[lost[0]]))
        minima.append(Minimum(np.inf, z[lost[0]], values, lost, np.inf, -np.inf, NOT_FINITE))
    reason, count = (int(part[best.starts[0]]) for part in (status, steps))
    message = "" if best.is_minimum else best.kind
    if message and reason in (RUNNING, STALLED):
        message = stopped_early(reason, count)
    return solution_at(problem, best.z, message, count), tuple(minima)


@eqx.filter_jit
def _solve_all(problem, starts, solver, max_steps) -> tuple:
    """Of every start: `z`, status and steps of its stop; there the normal equations, the Newton
    decrement, and second derivatives of half the cost."""

    def normal_at(z):
        return problem_normal(z, problem)

    if solver is None:
        side_by_side = jax.vmap(normal_at, in_axes=-1, out_axes=-1)
        state = minimise(side_by_side, starts.T, max_steps, TOLERANCE)
        z, status, steps = state.z.T, state.status, state.steps
    else:
        solve = lambda z0: least_squares(residuals, z0, problem, solver=solver, max_steps=max_steps)
        stop = jax.lax.map(solve, starts)
        z, steps = stop.z, stop.steps
        status = jnp.where(stop.converged, CONVERGED, RUNNING)
    normal = jax.vmap(normal_at)(z)
    # Forward over forward: a model need not support reverse differentiation.
    bent = jax.vmap(jax.jacfwd(lambda z: normal_at(z).gradient))(z)
    return z, status, steps, normal, jax.vmap(decrement)(normal), bent
