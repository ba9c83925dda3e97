"""What a descent lowers, for many designs at once, and the search for members beyond limits."""

import dataclasses
import functools as ft
import sys
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from jaxquad._compile import brief_options, Jit
from jaxquad._core import as_array, mark_members, on_host
from jaxquad.control import ObserverController
from jaxquad.ensembles import Members

from ._design_result import DesignResult, Numbers
from ._objective import Limit, Objective, QUANTITIES, soft, split_quantities, Worst
from ._problem import Coordinates, LinearLoops, Problem
from ._verdict import Distance


_BARRIER = 0.01  # weight of the barrier before observers that are slower than the feedback

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
    value: Float[Array, " problems"]
    gradient: Float[Array, "problems n"]
    cost: Float[Array, " problems"]  # the objective, without what limits add
    costs: Float[Array, "problems members"]
    numbers: dict[str, Float[Array, "problems members"]]  # of each member's worst axis
    limited: tuple[Float[Array, "problems members"], ...]  # quantity of each limit, by member
    beyond: tuple[Float[Array, "problems members"], ...]  # as levels: above 0, missed


@ft.partial(Jit, options=brief_options)
def evaluate_cost(
    z: Float[Array, "problems n"], on: Bool[Array, " problems"], coordinates: Coordinates,
    problem: Problem, subproblem: Subproblem,
) -> CostResult:  # fmt: skip
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
    numbers = problem.linear.numbers(controller, linear)
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
        wide = problem.limited.numbers(controller, names)
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


_ENOUGH = 16  # members beyond a limit
_NEAR = 0.1  # nepers within a limit: so near, they are tuned on with those beyond it
_LOST = 5.0  # nepers beyond a limit: the peak of a loop that is unstable, or as good as that


class Tail(NamedTuple):
    """What was searched, and what came of it."""

    searches: int = 0
    searched: int = 0  # linear loops, in all searches
    flown: int = 0  # flights, in all searches
    beyond: int = 0  # members of the last search beyond a limit
    added: int = 0  # to those that limits are kept on
    certificates: int = 0  # each on other members; all but the last found members to tune on


class Beyond(NamedTuple):
    """Members that are beyond a limit; the worst of them, to tune on."""

    loops: Members | None  # whose linear loops are
    flown: Members | None  # whose flights are
    count: int  # how many there are in all
    searched: int = 0  # linear loops
    flights: int = 0

    @property
    def added(self) -> int:
        """How many there are to tune on."""
        return sum(some.size for some in (self.loops, self.flown) if some is not None)

    def __str__(self) -> str:
        flights = f" and {self.flights} flights" * bool(self.flights)
        return f"tail: {self.count} of {self.searched} linear loops{flights} are beyond limits"


def search(
    draw: Callable[[int], Members], number: int, most: int,
    levels: Callable[[Members], Sequence[Float[ArrayLike, " members"]]], added: int,
) -> tuple[Members | None, int, int]:  # fmt: skip
    """The worst members, how many are beyond limits, and how many were searched.

    Searched are `most` slices that `draw` makes, unless there are enough members to go on before.
    """
    slices: list[Members] = []
    ranked: list[tuple[float, tuple[int, int]]] = []
    count = 0
    while len(slices) < most and count < _ENOUGH:
        s = len(slices)
        slices.append(draw(number * most + s))
        level = np.max([np.asarray(x) for x in levels(slices[s])], axis=0)
        ranked += [(float(level[k]), (s, int(k))) for k in np.flatnonzero(level > -_NEAR)]
        count += int(np.sum(level > 0))
    worst = [place for _, place in sorted(ranked, reverse=True)[:added]]
    return take_members(slices, worst), count, sum(x.size for x in slices)


@ft.partial(Jit, options=brief_options)
def loop_levels(
    z: Float[Array, " n"], coordinates: Coordinates, loops: LinearLoops, limits: tuple[Limit, ...]
) -> Float[Array, " members"]:
    """How far linear loops are beyond limits that every member has to keep, the greatest of all.

    An unstable loop has no number that a limit could pull at: it is left to the certificate.
    """
    kept = [limit for limit in limits if is_kept_by(limit, flights=False)]
    names = {limit.quantity for limit in kept}
    numbers = loops.numbers(coordinates.controller_at(z), names)
    values = {name: QUANTITIES[name].combine_axes(numbers[name], worst=True) for name in names}
    level = jnp.max(jnp.stack([limit.beyond(values[limit.quantity]) for limit in kept]), axis=0)
    return jnp.where(level < _LOST, level, -jnp.inf)


def flight_levels(
    numbers: dict[str, Float[np.ndarray, "axes members"]], limits: Sequence[Limit]
) -> Float[np.ndarray, " members"]:
    """As `loop_levels`, of the numbers of flights."""
    levels = []
    for limit in limits:
        if is_kept_by(limit, flights=True):
            sign = QUANTITIES[limit.quantity].sign
            worst = sign * np.max(sign * numbers[limit.quantity], axis=0)
            levels.append(_level(limit.quantity, worst, limit.bound))
    return np.max(levels, axis=0)


def _level(quantity: str, values: Numbers, bound: Float[ArrayLike, ""]) -> Numbers:
    """How far values are beyond a bound; minus infinity for those that are no number."""
    shown = QUANTITIES[quantity]
    level = np.asarray(shown.sign * (shown.level(values) - shown.level(on_host(bound))))
    return np.where(np.isfinite(level), level, -np.inf)


def is_kept_by(limit: Limit, *, flights: bool) -> bool:
    """Whether every member has to keep this limit, and in flight or by its linear loop."""
    return QUANTITIES[limit.quantity].linear != flights and isinstance(limit.over, Worst)


def rank_beyond(design: DesignResult, missed: Sequence[Distance]) -> list[int]:
    """The members that are beyond limits, the worst first; without those that have no number."""
    if not missed:
        return []
    values = [design.of(x.quantity, worst_axis=True) for x in missed]
    pairs = zip(missed, values, strict=True)
    level = np.max([_level(x.quantity, value, x.bound) for x, value in pairs], axis=0)
    return [int(k) for k in np.argsort(-level, kind="stable") if level[k] > 0]


def rank_places(
    result: CostResult, kept: Sequence[bool], on: np.ndarray, first: int = 0
) -> Int[np.ndarray, " members"]:
    """Members from the `first` on, those before that are furthest within the limits `kept`."""
    beyond = [x for x, mine in zip(result.beyond, kept, strict=True) if mine]
    levels = np.max([np.asarray(x)[on, first:] for x in beyond], axis=(0, 1))
    return np.argsort(np.where(np.isfinite(levels), levels, -np.inf), kind="stable")


def take_members(slices: Sequence[Members], places: Sequence[tuple[int, int]]) -> Members | None:
    """The members at these places, (slice, place in it); None without any. Compiles nothing."""
    if not places:
        return None
    of, index = np.array(places).T
    longest = max(slices[s].longest_delay for s in of)
    alike = [dataclasses.replace(x, longest_delay=longest) for x in slices]
    first = np.cumsum([0, *(x.size for x in slices)])[of]

    def pick(per_member: bool, *parts: Array) -> PyTree:
        if not per_member:
            return parts[0]
        keys = jnp.issubdtype(parts[0].dtype, jax.dtypes.prng_key)
        arrays = [np.asarray(jax.random.key_data(x)).T if keys else np.asarray(x) for x in parts]
        together = np.concatenate(arrays, axis=-1)[..., first + index]
        return jax.random.wrap_key_data(as_array(together.T)) if keys else as_array(together)

    marks = mark_members(alike[0], (alike[0].size,))
    return jax.tree.map(pick, marks, *alike)
