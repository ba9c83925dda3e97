"""The cost of many designs at once, with its gradient; the history of its evaluations."""

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

from ._objective import Limit, Objective, soft, Worst
from ._parameters import Coordinates
from ._problem import Problem
from ._quantities import QUANTITIES, split_quantities


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


class Multipliers(NamedTuple):
    """Of the augmented Lagrangian, with a constraint for each limit and member."""

    values: tuple[Float[Array, "problems members"], ...]  # of each limit
    stiffness: Float[Array, "problems limits"]


class Subproblem(NamedTuple):
    """What is minimised: the abscissa, down to `rate`, or the objective with its limits."""

    objective: Objective  # arrays [problems, ...]
    limits: tuple[Limit, ...]  # the same
    multipliers: Multipliers
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
    def total(z: Float[Array, " n"]) -> tuple[Array, PyTree]:
        controller = coordinates.controller_at(z)
        value, others = _cost(controller, problem, subproblem)
        if isinstance(controller, ObserverController):
            value = value + _BARRIER * controller.observer_barrier(coordinates.arrays)
        return value, others

    (value, others), gradient = jax.value_and_grad(total, has_aux=True)(z)
    return CostResult(value, gradient, *others)


def _cost(
    controller: PyTree, problem: Problem, subproblem: Subproblem
) -> tuple[Float[Array, ""], PyTree]:
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
        multiplier = subproblem.multipliers.values[k]
        stiffness = subproblem.multipliers.stiffness[k]
        forced = jnp.maximum(multiplier + stiffness * levels, 0)
        penalty = penalty + jnp.sum(forced**2 - multiplier**2) / (2 * stiffness)
    total = jnp.where(subproblem.fly, cost + penalty, settling)
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

    def add(self, evaluation: Evaluation) -> None:
        self.history.append(evaluation)
        self.say(describe_evaluation(len(self.history), evaluation))
        if self.listener is not None:
            self.listener(evaluation)


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
