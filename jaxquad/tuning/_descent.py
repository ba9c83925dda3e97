"""Two descents: L-BFGS, where an evaluation serves many problems, and Levenberg-Marquardt."""

import functools as ft
from collections.abc import Callable, Generator, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxquad._core import require_all_positive
from jaxquad.simulation import SampleResult, scan_loop

from ._objective import (
    is_gated,
    Limit,
    Mean,
    Objective,
    Penalty,
    QUANTITIES,
    risk_text,
    split_quantities,
    stability_gate,
)
from ._problem import Coordinates, Problem


Vector = Float[np.ndarray, " n"]
Pairs = list[tuple[Vector, Vector]]  # steps, and by how much the gradient changed along each
Evaluate = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
# values [problems] and gradients [problems, n] at points [problems, n] of problems that are on


class LBFGS(eqx.Module):
    """L-BFGS with a strong-Wolfe line search that mostly accepts its first trial.

    A trial without a finite cost is halved. Source: Nocedal and Wright, Numerical Optimization,
    algorithms 7.4, 3.5 and 3.6.

    **Arguments:**

    - `evaluations`: the most gradients.
    - `tolerance`: it stops where a step lowers the cost by less than this twice in a row (costs are
        logarithms, so 1e-4 is 0.01 %).
    - `gradient_tolerance`: it stops where the gradient's greatest entry is below this.
    - `memory`: pairs of steps and gradients that are kept.
    - `longest_step`, `first_step`: nepers by which any parameter moves at most, and at first.

    **Raises:**

    - `ValueError`: a count is below 1, or a step is not above 0.
    """

    evaluations: int = 100
    tolerance: float = 1e-4
    gradient_tolerance: float = 1e-4
    memory: int = 10
    longest_step: float = 0.5
    first_step: float = 0.1

    def __check_init__(self):
        if self.evaluations < 1 or self.memory < 1:
            raise ValueError(
                f"evaluations is {self.evaluations} and memory {self.memory}: give 1 or more"
            )
        require_all_positive(longest_step=self.longest_step, first_step=self.first_step)


class Descent(NamedTuple):
    z: Float[np.ndarray, "problems n"]
    value: Float[np.ndarray, " problems"]
    gradient: Float[np.ndarray, "problems n"]
    evaluations: Int[np.ndarray, " problems"]
    converged: Bool[np.ndarray, " problems"]
    reasons: tuple[str, ...]
    pairs: tuple[Pairs, ...]  # of each problem: what is known of the curvature


class _Point(NamedTuple):
    z: Vector
    value: float
    gradient: Vector

    @property
    def finite(self) -> bool:
        return bool(np.isfinite(self.value) and np.all(np.isfinite(self.gradient)))


_TRIALS = 7  # of a line search
_End = tuple[_Point, bool, str, Pairs]
_Descending = Generator[Vector, tuple[float, Vector], _End]
_Searching = Generator[Vector, tuple[float, Vector], tuple[_Point | None, int]]


def minimise(
    evaluate: Evaluate, start: Float[np.ndarray, "problems n"], method: LBFGS, *,
    on: Bool[np.ndarray, " problems"] | None = None,
    enough: Callable[[int, float], bool] = lambda problem, value: False,
    pairs: Sequence[Pairs] | None = None,
) -> Descent:  # fmt: skip
    """Run all problems in lockstep: `evaluate(z, on)` gives values and gradients of those `on`.

    `enough(problem, value)` ends a problem early. `pairs` are those of a descent before.
    """
    z = np.array(start, float)
    on = np.ones(len(z), bool) if on is None else np.array(on)
    curvature = [Pairs() for _ in z] if pairs is None else pairs
    searches = [_lbfgs(x, method, ft.partial(enough, k), curvature[k]) for k, x in enumerate(z)]
    ends: list[_End] = [
        (_Point(x, np.nan, np.full_like(x, np.nan)), False, "not started", curvature[k])
        for k, x in enumerate(z)
    ]
    counts = np.zeros(len(z), int)
    z = np.stack([next(search) for search in searches])
    while on.any():
        values, gradients = evaluate(z, on)
        counts += on
        for k in np.flatnonzero(on):
            try:
                z[k] = searches[k].send((float(values[k]), np.array(gradients[k], float)))
            except StopIteration as stop:
                ends[k], on[k] = stop.value, False
                z[k] = stop.value[0].z
    points, converged, reasons, learnt = zip(*ends, strict=True)  # type: ignore[misc]
    z, value, gradient = (np.stack(x) for x in zip(*points, strict=True))
    return Descent(z, value, gradient, counts, np.array(converged), tuple(reasons), tuple(learnt))


def _lbfgs(z: Vector, method: LBFGS, enough: Callable[[float], bool], pairs: Pairs) -> _Descending:
    point = _Point(z, *(yield z))
    left, idle = method.evaluations - 1, 0
    if not point.finite:
        return point, False, "the cost is not finite at the start", pairs
    while True:
        if enough(point.value):
            return point, True, "good enough", pairs
        if np.max(np.abs(point.gradient)) <= method.gradient_tolerance:
            return point, True, "the gradient vanishes", pairs
        if left <= 0:
            return point, False, f"stopped after {method.evaluations} evaluations", pairs
        direction = _direction(point.gradient, pairs)
        if direction @ point.gradient >= 0:  # rounding has spoilt the pairs
            pairs, direction = [], -point.gradient
        # Without pairs the gradient's size says nothing about that of a step.
        longest = np.max(np.abs(direction))
        step = min(1.0, method.longest_step / longest) if pairs else method.first_step / longest
        lower, left = yield from _search_line(point, direction, step, left, method.longest_step)
        if lower is None and pairs:
            pairs = []  # once more, downhill
            continue
        if lower is None:
            return point, idle > 0, "no step lowers the cost any further", pairs
        s, y = lower.z - point.z, lower.gradient - point.gradient
        if s @ y > 1e-10 * (y @ y):
            pairs = [*pairs, (s, y)][-method.memory :]
        idle = idle + 1 if point.value - lower.value < method.tolerance else 0
        point = lower
        if idle == 2:
            return point, True, "the cost no longer falls", pairs


def _direction(gradient: Vector, pairs: Pairs) -> Vector:
    """Minus the inverse Hessian of the pairs times the gradient, by the two-loop recursion."""
    q, shares = gradient.copy(), []
    for s, y in reversed(pairs):
        share = (s @ q) / (s @ y)
        q, shares = q - share * y, [share, *shares]
    if pairs:
        s, y = pairs[-1]
        q = q * (s @ y) / (y @ y)
    for (s, y), share in zip(pairs, shares, strict=True):
        q = q + (share - (y @ q) / (s @ y)) * s
    return -q


def _search_line(
    start: _Point, direction: Vector, step: float, left: int, longest: float
) -> _Searching:
    """A point that meets the strong Wolfe conditions, or the best that lowers the cost; else None.

    Returns it with the evaluations that are left.
    """
    slope, most = float(start.gradient @ direction), longest / np.max(np.abs(direction))
    low, low_slope, high, best = (0.0, start.value), slope, None, None
    for _ in range(_TRIALS):
        if left <= 0:
            break
        z = start.z + step * direction
        point = _Point(z, *(yield z))
        left -= 1
        if not point.finite:
            high, step = (step, np.inf), low[0] + 0.5 * (step - low[0])
            continue
        here = float(point.gradient @ direction)
        if point.value > start.value + 1e-4 * step * slope or point.value >= low[1]:
            high = (step, point.value)
        else:
            best = point
            if abs(here) <= -0.9 * slope or (high is None and here < 0 and step >= most):
                break
            if here > 0 if high is None else here * (high[0] - low[0]) >= 0:
                high = low
            low, low_slope = (step, point.value), here
        if high is not None:
            step = _within(low, low_slope, high)
            continue
        # Where the slope would vanish if it changed as from the start, but not too far.
        share = slope / (slope - low_slope) if low_slope > slope else np.inf
        step = min(low[0] * float(np.clip(share, 1.5, 4.0)), most)
    return best, left


def _within(low: tuple[float, float], slope: float, high: tuple[float, float]) -> float:
    """The minimum of the parabola through both ends, well inside."""
    width = high[0] - low[0]
    if not np.isfinite(high[1]):
        return low[0] + 0.5 * width
    bend = (high[1] - low[1] - slope * width) / width**2
    share = -slope / (2 * bend * width) if bend > 0 else 0.5
    return low[0] + width * float(np.clip(share, 0.1, 0.9))


_LEAST = 1e-12


class GaussNewton(eqx.Module):
    """Least squares on the tracking errors of all members, by Levenberg-Marquardt.

    Residuals are sqrt(t) times the errors, so tracking counts as ITSE, the integral of t error^2;
    ITAE itself is no sum of squares. Each member's errors are in units of their size at the start,
    which stands for the logarithm, and penalties enter by their square roots.

    **Arguments:**

    - `steps`: the most steps.
    - `tolerance`: relative, of cost and parameters.
    - `stride`: samples that share a residual.

    **Raises:**

    - `ValueError`: `steps` or `stride` is below 1. A tune raises it for terms other than ITAE, for
        risks other than the mean and for limits, none of which are sums of squares.
    """

    steps: int = 30
    tolerance: float = 1e-4
    stride: int = 10

    def __check_init__(self):
        if self.steps < 1 or self.stride < 1:
            raise ValueError(f"steps is {self.steps} and stride {self.stride}: give 1 or more")


class _Squares(eqx.Module):
    coordinates: Coordinates
    problem: Problem
    penalties: Sequence[Penalty]
    scale: Float[Array, "axes members"]  # of the squared errors' sums
    stride: int = eqx.field(static=True)


def require_squares(objective: Objective, limits: Sequence[Limit]) -> None:
    odd = [name for name in objective.terms if name != "itae"]
    odd += [f"limit on {limit.quantity}" for limit in limits]
    if not isinstance(objective.risk, Mean):
        odd.append(f"risk {risk_text(objective.risk)}")
    if odd:
        raise ValueError(
            f"GaussNewton cannot minimise {', '.join(odd)}: no sum of squares. Take LBFGS(), "
            "or the term itae with penalties and the mean risk"
        )


def minimise_squares(
    coordinates: Coordinates, problem: Problem, objective: Objective,
    start: Float[np.ndarray, " n"], method: GaussNewton,
) -> tuple[Float[np.ndarray, " n"], int, bool]:  # fmt: skip
    """Where the descent ended, its steps, and whether it converged."""
    import lineax as lx
    import optimistix as optx

    units = jnp.ones((problem.linear.assumed_inertia.shape[0], problem.members))
    squares = _Squares(coordinates, problem, objective.penalties, units, method.stride)
    size = jnp.sum(_errors(jnp.asarray(start), squares) ** 2, axis=0)
    squares = eqx.tree_at(
        lambda s: s.scale, squares, jnp.sum(size, axis=0, keepdims=True) + 0 * size
    )
    solver = optx.LevenbergMarquardt(
        rtol=method.tolerance, atol=method.tolerance, linear_solver=lx.Normal(lx.Cholesky())
    )
    with jax.numpy_dtype_promotion("standard"):
        solution = optx.least_squares(
            _linearised, solver, jnp.asarray(start), squares, max_steps=method.steps, throw=False
        )
    done = bool(solution.result == optx.RESULTS.successful)
    return np.asarray(solution.value), int(solution.stats["num_steps"]), done


def _residuals(z: Float[Array, " n"], squares: _Squares) -> tuple[Array, Array]:
    members = squares.problem.members
    tracking = _errors(z, squares) / jnp.sqrt(squares.scale + _LEAST)[None]
    controller = squares.coordinates.controller_at(z)
    flights, linear = split_quantities({p.quantity for p in squares.penalties} | {"abscissa"})
    numbers = squares.problem.linear.numbers(controller, linear)
    if flights:
        numbers |= squares.problem.in_time(controller, flights)
    gate = stability_gate(numbers["abscissa"])
    costs = [
        p(
            QUANTITIES[p.quantity].combine_axes(numbers[p.quantity]),
            gate if is_gated(p.quantity) else gate + 1,
        )
        for p in squares.penalties
    ]
    bounds = jnp.sqrt(jnp.stack(costs) + _LEAST) if costs else jnp.zeros((0, members))
    # ITSE goes as the square of ITAE: half of it, for the same change of the cost.
    return tracking / np.sqrt(2 * members), bounds / np.sqrt(members)


_linearised = eqx.filter_custom_jvp(_residuals)


@_linearised.def_jvp
def _with_columns(primals: PyTree, tangents: PyTree) -> PyTree:
    # A column for each parameter, one flight after the other: linearised, the loop would store all.
    (z, _), run = primals, lambda z: _residuals(z, primals[1])
    column = lambda unit: jax.jvp(run, (z,), (unit,))[1]
    columns = jax.lax.map(column, jnp.eye(z.size, dtype=z.dtype))
    return run(z), jax.tree.map(lambda c: jnp.tensordot(tangents[0], c, 1), columns)


class _Errors(eqx.Module):
    """Stores the error of every sample, rad."""

    def begin(self, like: Array) -> None:
        return None

    def update(self, total: None, now: SampleResult) -> tuple[None, Array]:
        return total, now.reference - now.angle


def _errors(z: Float[Array, " n"], squares: _Squares) -> Float[Array, "points axes members"]:
    """sqrt(t) error every few samples, t from the last event."""
    problem, stride = squares.problem, squares.stride
    loop = problem.loop_around(squares.coordinates.controller_at(z))
    stored = scan_loop(loop, problem.flight, _Errors())[1]
    index = np.arange(int(problem.window.first), int(problem.window.last) + 1, stride)
    since = np.min([np.where(index >= a, index - a, np.inf) for a, _ in problem.parts], axis=0)
    weight = np.sqrt(since * loop.dt * loop.dt * stride)
    return stored[index] * weight[:, None, None]
