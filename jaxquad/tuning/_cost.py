"""What a descent lowers: the cost of many designs at once with its gradient, or its residuals."""

import functools as ft
import sys
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxquad._compile import brief_options, Jit
from jaxquad._core import as_array
from jaxquad.control import ObserverController
from jaxquad.simulation import SampleResult, scan_loop

from ._objective import (
    is_gated,
    Limit,
    Mean,
    Objective,
    Penalty,
    QUANTITIES,
    risk_text,
    soft,
    split_quantities,
    stability_gate,
    Worst,
)
from ._problem import Coordinates, Problem


_BARRIER = 0.01  # weight of the barrier before observers that are slower than the feedback
SMOOTHING = 1e-6  # 1/s, of the abscissa: its derivative is off by as much, relative to 1 1/s

Tree = TypeVar("Tree")


def stack_copies(tree: Tree, count: int) -> Tree:
    """`count` problems with the same numbers, on a leading axis."""
    arrays, rest = eqx.partition(tree, eqx.is_array)
    stack = lambda x: as_array(np.broadcast_to(np.asarray(x), (count, *x.shape)))
    return eqx.combine(jax.tree.map(stack, arrays), rest)


def take_problem(tree: Tree, index: int) -> Tree:
    """The problem with that index on the leading axis."""
    arrays, rest = eqx.partition(tree, eqx.is_array)
    return eqx.combine(jax.tree.map(lambda x: as_array(np.asarray(x)[index]), arrays), rest)


class Subproblem(NamedTuple):
    """What is minimised: the abscissa, down to `rate`, or the objective with its limits."""

    objective: Objective  # arrays [problems, ...]
    limits: tuple[Limit, ...]  # the same
    multipliers: tuple[Float[Array, "problems members"], ...]  # of each limit, for each member
    stiffness: Float[Array, "problems limits"]
    fly: Bool[Array, " problems"]  # the second phase
    rate: Float[Array, " problems"]  # 1/s


class CostResult(NamedTuple):
    """One evaluation of the cost of each problem."""

    value: Float[Array, " problems"]
    gradient: Float[Array, "problems n"]
    cost: Float[Array, " problems"]  # the objective, without what limits add
    costs: Float[Array, "problems members"]
    numbers: dict[str, Float[Array, "problems members"]]  # of each member's worst axis
    limited: tuple[Float[Array, "problems members"], ...]  # quantity of each limit, by member
    beyond: tuple[Float[Array, "problems members"], ...]  # as levels: above 0, missed


@ft.partial(Jit, options=brief_options)
def evaluate_cost(
    z: Float[Array, "problems n"],
    on: Bool[Array, " problems"],
    coordinates: Coordinates,
    problem: Problem,
    subproblem: Subproblem,
) -> CostResult:
    """Value and gradient for each problem that is `on`; zeros for the others.

    A problem by itself is evaluated in any case.
    """
    arrays, rest = eqx.partition(subproblem, eqx.is_array)
    if len(z) == 1:
        alone = eqx.combine(jax.tree.map(lambda x: x[0], arrays), rest)
        result = _evaluate_one(z[0], coordinates, problem, alone)
        return jax.tree.map(lambda x: x[None], result)
    common, fixed = eqx.partition((coordinates, problem), eqx.is_array)

    @jax.jit  # traced once, for its shapes and for its use
    def run(z: Array, mine: PyTree, common: PyTree) -> CostResult:
        of, members = eqx.combine(common, fixed)
        return _evaluate_one(z, of, members, eqx.combine(mine, rest))

    def one(arguments: tuple[Array, Array, PyTree]) -> CostResult:
        z, on, mine = arguments
        shapes = jax.eval_shape(run, z, mine, common)
        skip = lambda *_: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        return jax.lax.cond(on, run, skip, z, mine, common)

    # One after the other: the members of each fill the machine, and none waits for another's phase.
    return jax.lax.map(one, (z, on, arrays))


def _evaluate_one(
    z: Float[Array, " n"], coordinates: Coordinates, problem: Problem, subproblem: Subproblem
) -> CostResult:
    run = jax.value_and_grad(_cost, has_aux=True)
    (value, others), gradient = run(z, coordinates, problem, subproblem)
    return CostResult(value, gradient, *others)


def _cost(
    z: Float[Array, " n"], coordinates: Coordinates, problem: Problem, subproblem: Subproblem
) -> tuple[Float[Array, ""], PyTree]:
    controller = coordinates.controller_at(z)
    objective, limits = subproblem.objective, subproblem.limits
    wanted = objective.quantities | {limit.quantity for limit in limits}
    in_flight, linear = split_quantities(wanted)
    numbers = problem.linear.numbers(controller, linear, SMOOTHING)
    slowest = jnp.max(numbers["abscissa"], axis=0)
    unknown = {name: jnp.ones_like(numbers["abscissa"]) for name in in_flight}
    if in_flight:
        fly = lambda c: problem.in_time(c, in_flight)
        numbers |= jax.lax.cond(subproblem.fly, fly, lambda c: unknown, controller)
    costs = objective.costs({name: x[:, : problem.counted] for name, x in numbers.items()})
    worst = {name: QUANTITIES[name].combine_axes(x, worst=True) for name, x in numbers.items()}
    # Limits of the linear loop, which is cheap, are kept on many more members.
    bounded, names = dict(worst), {x.quantity for x in limits if QUANTITIES[x.quantity].linear}
    if problem.limited is not None and names:
        wide = problem.limited.numbers(controller, names, SMOOTHING)
        bounded |= {n: QUANTITIES[n].combine_axes(wide[n], worst=True) for n in names}
    limited = tuple(bounded[x.quantity][: count_members(problem, x)] for x in limits)
    beyond = tuple(limit.beyond(x) for limit, x in zip(limits, limited, strict=True))
    cost = objective.risk(costs)
    settling = jnp.mean(soft(slowest - subproblem.rate))
    # The augmented Lagrangian of Powell, Hestenes and Rockafellar.
    penalty = jnp.zeros(())
    for k, levels in enumerate(beyond):
        multiplier, stiffness = subproblem.multipliers[k], subproblem.stiffness[k]
        forced = jnp.maximum(multiplier + stiffness * levels, 0)
        penalty = penalty + jnp.sum(forced**2 - multiplier**2) / (2 * stiffness)
    total = jnp.where(subproblem.fly, cost + penalty, settling)
    if isinstance(controller, ObserverController):
        total = total + _BARRIER * controller.observer_barrier(coordinates.arrays)
    return total, (cost, costs, worst, limited, beyond)


def count_members(problem: Problem, limit: Limit) -> int:
    """How many members a limit is kept on: a mean, as an objective, leaves out the added ones."""
    if QUANTITIES[limit.quantity].linear and problem.limited is not None:
        return problem.limited.members
    return problem.members if isinstance(limit.over, Worst) else problem.counted


class Evaluation(NamedTuple):
    """One evaluation of all problems, with arrays [problems]; NaN for those that have ended."""

    phase: str  # "stabilise" or "optimise"
    z: Float[np.ndarray, "problems n"]
    cost: Float[np.ndarray, " problems"]
    gradient_norm: Float[np.ndarray, " problems"]
    stable: Float[np.ndarray, " problems"]  # share of the members whose abscissa is below 0
    worst: Float[np.ndarray, " problems"]  # the member of the highest cost
    means: dict[str, Float[np.ndarray, " problems"]]  # over the members, of each quantity
    seconds: float  # since the start


Listener = Callable[[Evaluation], None]


class Progress:
    """Keeps every evaluation, and prints a line of it on a terminal."""

    def __init__(self, shown: bool | None, listener: Listener | None = None):
        self.history: list[Evaluation] = []
        self.begun = time.perf_counter()
        self.shown = sys.stderr.isatty() if shown is None else shown
        self.listener = listener

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self.begun

    def say(self, text: str) -> None:
        if self.shown:
            print(text, file=sys.stderr, flush=True)

    def add(self, result: CostResult, z: np.ndarray, on: np.ndarray, fly: bool) -> None:
        hide = lambda x: np.where(on, np.asarray(x), np.nan)
        abscissa, counted = np.asarray(result.numbers["abscissa"]), result.costs.shape[1]
        now = Evaluation(
            phase="optimise" if fly else "stabilise",
            z=np.array(z),
            cost=hide(result.value),
            gradient_norm=hide(np.linalg.norm(result.gradient, axis=1)),
            stable=hide(np.mean(abscissa < 0, axis=1)),
            worst=hide(np.argmax(result.costs if fly else abscissa, axis=1)),
            means={n: hide(np.mean(x[:, :counted], axis=1)) for n, x in result.numbers.items()},
            seconds=self.seconds,
        )
        self.history.append(now)
        self.say(describe_evaluation(len(self.history), now))
        if self.listener is not None:
            self.listener(now)


def describe_evaluation(count: int, now: Evaluation) -> str:
    """One line of text of an evaluation; of several problems, the best one's numbers."""
    running = np.isfinite(now.cost)
    best = int(np.argmin(np.where(running, now.cost, np.inf)))
    parts = [f"{now.phase} {count:3d}", f"cost {now.cost[best]:9.5f}"]
    if running.size > 1:
        parts.append(f"(best of {running.sum()} running)")
    if "itae" in now.means and now.phase == "optimise":
        parts.append(f"ITAE {np.degrees(now.means['itae'][best]):.4g} deg s^2")
    parts.append(f"stable {100 * now.stable[best]:.3g} %")
    parts.append(f"worst member {now.worst[best]:.0f}")
    parts.append(f"|gradient| {now.gradient_norm[best]:.2g}")
    return "  ".join([*parts, f"{now.seconds:.1f} s"])


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
    """Raise ValueError for what is no sum of squares."""
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
    coordinates: Coordinates,
    problem: Problem,
    objective: Objective,
    start: Float[np.ndarray, " n"],
    method: GaussNewton,
) -> tuple[Float[np.ndarray, " n"], int, bool]:
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
    numbers = squares.problem.linear.numbers(controller, linear, SMOOTHING)
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
