"""Stabilise, then optimise: all problems in lockstep, limits by an augmented Lagrangian."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from jaxquad._core import as_array
from jaxquad.ensembles import Members

from ._cost import (
    CostResult,
    evaluate_cost,
    Evaluation,
    initial_multipliers,
    MET,
    Multipliers,
    Progress,
    Rounds,
    Subproblem,
    take_problem,
    update_multipliers,
)
from ._gauss_newton import GaussNewton, minimise_squares
from ._lbfgs import Descent, Evaluate, LBFGS, minimise, Pairs
from ._objective import Limit, Objective
from ._parameters import build_design, Coordinates, refusal_of
from ._problem import Problem
from ._tail import (
    Beyond,
    half_of_reserve,
    put_flights,
    put_loops,
    Search,
    search_tail,
    SEARCHES,
    Tail,
)


_ROUNDS = 8  # of multipliers
_TIMES = 3  # evaluations of all rounds together, in those of one descent
_BEYOND_KNEE = 0.25  # 1/s, below the abscissa that is enough: where the first phase aims


class Solution(NamedTuple):
    """Where each of the problems ended; arrays [problems, ...]."""

    z: Float[np.ndarray, "problems n"]
    cost: Float[np.ndarray, " problems"]  # the objective without what limits added
    gradient: Float[np.ndarray, "problems n"]
    stable: Bool[np.ndarray, " problems"]  # all members
    stabilised: Bool[np.ndarray, " problems"]  # all members decay as fast as was asked
    converged: Bool[np.ndarray, " problems"]
    reasons: tuple[str, ...]
    refusal: str  # why the controller refused the last of the steps that it refused, if any
    evaluations: Int[np.ndarray, " problems"]  # of the second phase: flights and linear loops
    stabilising: Int[np.ndarray, " problems"]  # of the first phase: linear loops only
    beyond: Float[np.ndarray, "problems limits"]  # greatest, as levels: above 0, violated
    multipliers: Multipliers
    result: CostResult
    tail: Tail
    state: "_State"  # to go on from


def solve(
    coordinates: Coordinates,
    problem: Problem,
    start: Float[np.ndarray, "problems n"],
    objectives: Objective,
    limits: Sequence[Limit] = (),
    *,
    method: LBFGS | GaussNewton,
    rate: float,
    progress: Progress,
    search: Search | None = None,
) -> Solution:
    """Both phases of all problems: `objectives` and `limits` hold arrays [problems, ...].

    A `search` finds members that are beyond limits, and the problems descend again with these.

    A problem whose members cannot all be made to decay at `rate` (1/s, negative) stays with the
    first phase's best if one of them is unstable. Otherwise no step is taken to where one is, and
    where limits cannot be met the end is the round that missed them least.
    """
    memory = _Memory()
    runner = _Runner(
        coordinates, problem, objectives, tuple(limits), method, rate, progress, memory
    )
    first = runner.stabilise(np.asarray(start, float))
    slowest = runner.slowest(first.z)
    stable = slowest < 0
    multipliers = initial_multipliers(problem, limits, len(first.z))
    end = runner.optimise(first.z, stable, stable, multipliers)
    guards = None if search is None or search.flights is None else search.flights.guards
    state = _State(runner, end, first.evaluations, stable, slowest < rate, Tail(), guards)
    if search is not None:
        state = _keep_on_tail(state, search)
    return _solution(state)


def go_on(solution: Solution, worst: Beyond, search: Search, index: int) -> Solution:
    """The problem of that index descends again with members that its certificate found."""
    state = solution.state
    on = np.arange(len(solution.z)) == index
    return _solution(_keep_on_tail(_with_worst(state, worst, search, on), search, on))


class _State(NamedTuple):
    """Where all problems are, and what they descend on."""

    runner: "_Runner"
    end: "_Optimised"
    stabilising: Int[np.ndarray, " problems"]  # evaluations of the first phase
    stable: Bool[np.ndarray, " problems"]
    stabilised: Bool[np.ndarray, " problems"]
    tail: Tail
    guards: Members | None  # who fly for limits alone


def _solution(state: _State) -> Solution:
    second, multipliers, result, beyond, counts = state.end
    return Solution(
        z=second.z, cost=np.where(state.stable, np.asarray(result.cost), np.nan),
        gradient=second.gradient, stable=state.stable, stabilised=state.stabilised,
        converged=second.converged & state.stable, reasons=second.reasons,
        refusal=state.runner.memory.refusal, evaluations=counts, stabilising=state.stabilising,
        beyond=beyond, multipliers=multipliers, result=result, tail=state.tail, state=state,
    )  # fmt: skip


def _keep_on_tail(
    state: _State, search: Search, chosen: Bool[np.ndarray, " problems"] | None = None
) -> _State:
    """Search for members that are beyond limits, and descend again with the worst of them.

    Searched for are those of the problems `chosen` (all, by default) and keep the limits on
    the members known so far.
    """
    met = np.maximum(half_of_reserve(search.aimed, search.limits), MET)
    chosen = state.stable if chosen is None else chosen
    for _ in range(SEARCHES):
        on = chosen & np.all(state.end.beyond <= met, axis=1)
        if not on.any():
            break
        runner, tail = state.runner, state.tail
        worst = search_tail(search, tail.searches, runner.coordinates, state.end.descent.z, on)
        runner.progress.say(str(worst))
        state = state._replace(tail=tail.with_search(worst))
        if not worst.count:
            break
        state = _with_worst(state, worst, search, on)
    return state


def _with_worst(
    state: _State, worst: Beyond, search: Search, on: Bool[np.ndarray, " problems"]
) -> _State:
    """The problems that are `on` descend again, with the worst among the members of limits."""
    runner, end = state.runner, state.end
    problem, multipliers, guards = runner.problem, end.multipliers, state.guards
    critical = end.result, runner.limits, on
    if worst.loops is not None and worst.loops.places:
        problem, multipliers = put_loops(worst.loops, problem, multipliers, *critical)
    if worst.members is not None and search.flights is not None and guards is not None:
        guards, problem, multipliers = put_flights(
            worst.members, search.flights, guards, problem, multipliers, *critical
        )
    runner = dataclasses.replace(runner, problem=problem, limits=search.aimed)
    met = half_of_reserve(search.aimed, search.limits)
    before = end.descent
    again = runner.optimise(before.z, state.stable, on, multipliers, met, before.pairs)
    end = again._replace(
        descent=_merge(before, again.descent, on), counts=end.counts + again.counts
    )
    tail = state.tail._replace(added=state.tail.added + worst.added)
    return state._replace(runner=runner, end=end, tail=tail, guards=guards)


class _Memory:
    """What a run remembers of its evaluations."""

    def __init__(self) -> None:
        self.slowest: Float[np.ndarray, " problems"] = np.zeros(0)  # 1/s, of the last one
        self.refusal = ""


class _Runner(eqx.Module):
    coordinates: Coordinates
    problem: Problem
    objectives: Objective
    limits: tuple[Limit, ...]
    method: LBFGS | GaussNewton
    rate: float  # 1/s
    progress: Progress
    memory: _Memory

    def evaluate(
        self, z: np.ndarray, on: np.ndarray, fly: ArrayLike, multipliers: Multipliers
    ) -> CostResult:
        """One evaluation of the problems that are on."""
        return _on_host(evaluate_cost(*self._arguments(z, on, fly, multipliers)))

    def _arguments(
        self, z: np.ndarray, on: np.ndarray, fly: ArrayLike, multipliers: Multipliers
    ) -> tuple[Array, Array, Coordinates, Problem, Subproblem]:
        count = len(z)
        rate = as_array(np.full(count, self.rate - _BEYOND_KNEE))
        flies = as_array(np.broadcast_to(np.asarray(fly), (count,)))
        subproblem = Subproblem(self.objectives, self.limits, multipliers, flies, rate)
        return as_array(z), as_array(on), self.coordinates, self.problem, subproblem

    def evaluator(self, fly: bool, multipliers: Multipliers) -> Evaluate:
        """What a descent calls: infinite where a step must not go."""

        def evaluate(z: np.ndarray, on: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            # Before the costs, and looked at while they run: JAX runs one program after the other.
            designs = [self._design(x) for x, go in zip(z, on, strict=True) if go]
            running = evaluate_cost(*self._arguments(z, on, fly, multipliers))
            refused = np.zeros(len(z), bool)
            refused[np.flatnonzero(on)] = [bool(self.refusal(design)) for design in designs]
            result = _on_host(running)
            if fly:  # limits must not buy themselves members that are unstable
                lost = np.max(result.numbers["abscissa"], axis=1) >= 0
                result = result._replace(value=np.where(lost, np.inf, result.value))
            result = result._replace(value=np.where(refused, np.inf, result.value))
            self.memory.slowest = np.max(result.numbers["abscissa"], axis=1)
            self.progress.add(_evaluation(result, z, on, fly, self.progress.seconds))
            return np.asarray(result.value), np.asarray(result.gradient)

        return evaluate

    def _design(self, z: np.ndarray) -> PyTree:
        return build_design(self.coordinates, as_array(z))

    def refusal(self, design: PyTree) -> str:
        """Why no step goes to this controller; the last such reason is kept."""
        why = refusal_of(design)
        self.memory.refusal = why or self.memory.refusal
        return why

    def stabilise(self, z: np.ndarray) -> Descent:
        """The first phase: linear loops alone."""
        multipliers = initial_multipliers(self.problem, self.limits, len(z))
        method = self.method if isinstance(self.method, LBFGS) else LBFGS()
        enough = lambda k, value: float(self.memory.slowest[k]) < self.rate
        return minimise(self.evaluator(False, multipliers), z, method, enough=enough)

    def slowest(self, z: np.ndarray) -> np.ndarray:
        """The abscissa of each problem's slowest member, 1/s."""
        multipliers = initial_multipliers(self.problem, self.limits, len(z))
        result = self.evaluate(z, np.ones(len(z), bool), False, multipliers)
        return np.asarray(result.numbers["abscissa"]).max(axis=1)

    def descend(
        self,
        z: np.ndarray,
        on: np.ndarray,
        multipliers: Multipliers,
        left: int,
        pairs: Sequence[Pairs] | None,
    ) -> Descent:
        """One round of the second phase, of at most `left` evaluations."""
        if isinstance(self.method, LBFGS):
            method = dataclasses.replace(self.method, evaluations=left)
            return minimise(self.evaluator(True, multipliers), z, method, on=on, pairs=pairs)
        ends = [self._squares(k, x) if on[k] else (x, 0, False) for k, x in enumerate(z)]
        points, steps, done = zip(*ends, strict=True)
        value, gradient = self.evaluator(True, multipliers)(np.stack(points), on)
        reasons = tuple(
            "" if d else f"stopped after {s} steps" for s, d in zip(steps, done, strict=True)
        )
        none = tuple(Pairs() for _ in z)
        return Descent(
            np.stack(points), value, gradient, np.array(steps), np.array(done), reasons, none
        )

    def _squares(self, k: int, z: np.ndarray) -> tuple[np.ndarray, int, bool]:
        assert isinstance(self.method, GaussNewton)
        objective = take_problem(self.objectives, k)
        return minimise_squares(self.coordinates, self.problem, objective, z, self.method)

    def optimise(
        self,
        z: np.ndarray,
        able: np.ndarray,
        on: np.ndarray,
        multipliers: Multipliers,
        met: ArrayLike = MET,
        pairs: Sequence[Pairs] | None = None,
    ) -> "_Optimised":
        """The second phase: rounds of multipliers until limits are `met`, to these levels.

        Problems that are `able` fly, even those that are not `on`. Each round begins with the
        curvature that those before it found, the first one with `pairs`.
        """
        on, everyone, rounds = on.copy(), np.ones_like(able), Rounds()
        counts, beyond = np.zeros(len(z), int), np.full((len(z), len(self.limits)), np.inf)
        result = self.evaluate(z, everyone, able, multipliers)
        _require_finite(result, able)
        descent: Descent | None = None
        most = self.method.evaluations if isinstance(self.method, LBFGS) else 0
        for _ in range(_ROUNDS if self.limits else 1):
            left = min(most, int(_TIMES * most - counts.max()))
            latest = self.descend(z, on, multipliers, left, pairs)
            descent = latest if descent is None else _merge(descent, latest, on)
            z, counts, pairs = descent.z, counts + latest.evaluations, descent.pairs
            result = self.evaluate(z, everyone, able, multipliers)
            if not self.limits:
                return _Optimised(descent, multipliers, result, beyond, counts)
            multipliers, beyond = update_multipliers(result, multipliers, beyond, on)
            rounds.add(z, np.asarray(result.cost), beyond)
            on = on & np.any(beyond > met, axis=1) & ~rounds.stalled
            if not on.any() or counts.max() >= _TIMES * most:
                break
        assert descent is not None
        if np.any(rounds.best() != z):
            z = rounds.best()
            result = self.evaluate(z, everyone, able, multipliers)
            beyond = np.stack([np.max(x, axis=1) for x in result.beyond], axis=1)
            descent = descent._replace(z=z, gradient=np.asarray(result.gradient))
        return _Optimised(descent, multipliers, result, beyond, counts)


def _on_host(result: CostResult) -> CostResult:
    """Wait for it, in NumPy's arrays, which compile nothing for what follows."""
    return jax.tree.map(np.asarray, result)


class _Optimised(NamedTuple):
    descent: Descent
    multipliers: Multipliers
    result: CostResult
    beyond: Float[np.ndarray, "problems limits"]
    counts: Int[np.ndarray, " problems"]


def _require_finite(result: CostResult, able: np.ndarray) -> None:
    """A cost that is no number would end the descent where it starts."""
    value = np.asarray(result.value)
    if not able.any() or np.isfinite(value[able]).any():
        return
    bad = [n for n, x in result.numbers.items() if not np.isfinite(np.asarray(x)[able]).all()]
    raise ValueError(
        f"the cost is {value[able][0]} at the start, though every member is stable, because of "
        f"{', '.join(bad) or 'the limits'}: the scenario or the controller does not have it (only "
        "a controller with an observer estimates a disturbance), or members diverge in flight"
    )


def _merge(old: Descent, new: Descent, on: np.ndarray) -> Descent:
    pick = lambda a, b: np.where(on.reshape((-1,) + (1,) * (a.ndim - 1)), b, a)
    choose = lambda a, b: tuple(y if o else x for x, y, o in zip(a, b, on, strict=True))
    fields = Descent._fields[:-2]
    both = old._asdict(), new._asdict()
    arrays = {name: pick(*(x[name] for x in both)) for name in fields}
    reasons, pairs = choose(old.reasons, new.reasons), choose(old.pairs, new.pairs)
    return Descent(**arrays, reasons=reasons, pairs=pairs)


def _evaluation(
    result: CostResult, z: np.ndarray, on: np.ndarray, fly: bool, seconds: float
) -> Evaluation:
    hide = lambda x: np.where(on, np.asarray(x), np.nan)
    abscissa = np.asarray(result.numbers["abscissa"])
    worst = result.costs if fly else result.numbers["abscissa"]
    return Evaluation(
        phase="optimise" if fly else "stabilise",
        z=np.array(z),
        cost=hide(result.value),
        gradient_norm=hide(np.linalg.norm(result.gradient, axis=1)),
        stable=hide(np.mean(abscissa < 0, axis=1)),
        worst=hide(np.argmax(worst, axis=1)),
        means={
            name: hide(np.mean(x[:, : result.costs.shape[1]], axis=1))
            for name, x in result.numbers.items()
        },
        seconds=seconds,
    )
