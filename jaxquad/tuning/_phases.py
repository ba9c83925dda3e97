"""Stabilise, then optimise: all problems in lockstep, limits by an augmented Lagrangian."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ._copies import one_of
from ._cost import Aim, evaluate, Pull, Told
from ._gauss_newton import GaussNewton, least_squares
from ._lbfgs import Descent, LBFGS, minimise
from ._objective import Limit, Objective
from ._observer_alone import refusal
from ._parameters import Coordinates
from ._problem import Problem
from ._progress import Evaluation, Progress
from ._quantities import OF_THE_LOOP


MET = 2e-3  # beyond a limit, as a level: 0.2 %
_STIFFNESS, _STIFFER = 4.0, 4.0
_STALLED = 0.9  # of what a limit was missed by before: it falls no further
_AS_GOOD = 1.05  # of the least miss: of rounds that miss limits so nearly alike, the cost decides


def no_pull(problem: Problem, limits: Sequence[Limit], problems: int) -> Pull:
    """Before anything is known of the limits."""
    sizes = [_constraints(problem, limit) for limit in limits]
    multipliers = tuple(jnp.asarray(np.zeros((problems, size))) for size in sizes)
    return Pull(multipliers, jnp.asarray(np.full((problems, len(sizes)), _STIFFNESS)))


def pulled(
    told: Told,
    pull: Pull,
    before: Float[np.ndarray, "problems limits"],
    on: Bool[np.ndarray, " problems"],
) -> tuple[Pull, Float[np.ndarray, "problems limits"]]:
    """The next multipliers for problems that are `on`, and how far each limit is missed.

    Where a limit is missed by more than a quarter of what it was `before`, it becomes stiffer.
    """
    keep, multipliers, most = np.asarray(on)[:, None], [], []
    stiffness = np.asarray(pull.stiffness)
    for k, beyond in enumerate(map(np.asarray, told.beyond)):
        old = np.asarray(pull.multipliers[k])
        raised = np.maximum(old + stiffness[:, k : k + 1] * beyond, 0)
        multipliers.append(jnp.asarray(np.where(keep, raised, old)))
        most.append(beyond.max(axis=1))
    missed = np.stack(most, axis=1)
    slow = missed > np.maximum(0.25 * before, MET)
    stiffer = np.where(slow & keep, _STIFFER, 1.0) * stiffness
    return Pull(tuple(multipliers), jnp.asarray(stiffer)), missed


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
        """Which problems have twice come no nearer to limits that they miss by more than 2 %."""
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


def _constraints(problem: Problem, limit: Limit) -> int:
    """One for each member that a limit is kept on."""
    wide = problem.wide if limit.quantity in OF_THE_LOOP else None
    return problem.members if wide is None else wide.members


_ROUNDS = 8  # of multipliers
_TIMES = 3  # what a descent may take, of evaluations, is what all rounds may
_BEYOND_KNEE = 0.25  # 1/s, what the first phase aims at below the abscissa that is enough


class Solution(NamedTuple):
    """Where each of the problems ended; arrays [problems, ...]."""

    z: Float[np.ndarray, "problems n"]
    cost: Float[np.ndarray, " problems"]  # the objective without what limits added
    gradient: Float[np.ndarray, "problems n"]
    able: Bool[np.ndarray, " problems"]  # no member is unstable
    stabilised: Bool[np.ndarray, " problems"]  # nor slower than the abscissa that is enough
    converged: Bool[np.ndarray, " problems"]
    reasons: tuple[str, ...]
    refusal: str  # of the last step that a controller refused, empty if none did
    evaluations: Int[np.ndarray, " problems"]  # of the second phase: flights and linear loops
    stabilising: Int[np.ndarray, " problems"]  # of the first phase: linear loops only
    beyond: Float[np.ndarray, "problems limits"]  # greatest, as levels: above 0, violated
    pull: Pull
    told: Told


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
) -> Solution:
    """Both phases of all problems: `objectives` and `limits` hold arrays [problems, ...].

    A problem whose members cannot all be made to decay at `rate` (1/s, negative) stays with the
    first phase's best if one of them is unstable. Otherwise no step is taken to where one is, and
    where limits cannot be met the end is the round that missed them least.
    """
    runner = _Runner(coordinates, problem, objectives, tuple(limits), method, rate, progress)
    first = runner.stabilise(np.asarray(start, float))
    slowest = runner.slowest(first.z)
    able = slowest < 0
    second, pull, told, beyond, count = runner.optimise(first.z, able)
    return Solution(
        z=second.z, cost=np.where(able, np.asarray(told.cost), np.nan), gradient=second.gradient,
        able=able, stabilised=slowest < rate, converged=second.converged & able,
        reasons=second.reasons, refusal=runner.refusal, evaluations=count,
        stabilising=first.evaluations,
        beyond=beyond, pull=pull, told=told,
    )  # fmt: skip


class _Runner:
    def __init__(self, coordinates, problem, objectives, limits, method, rate, progress):
        self.coordinates, self.problem, self.method = coordinates, problem, method
        self.objectives, self.limits, self.rate = objectives, limits, rate
        self.progress = progress
        self.last: Any = None
        self.refusal = ""
        self.first = method if isinstance(method, LBFGS) else LBFGS()

    def told(self, z: Any, on: Any, fly: Any, pull: Pull) -> Told:
        """One evaluation of the problems that are on."""
        count = len(z)
        rate = jnp.full(count, self.rate - _BEYOND_KNEE)
        flies = jnp.broadcast_to(jnp.asarray(fly), (count,))
        aim = Aim(self.objectives, self.limits, pull, flies, rate)
        given = (jnp.asarray(z), jnp.asarray(on))
        told = evaluate(*given, self.coordinates, self.problem, aim)
        return jax.tree.map(np.asarray, told)  # NumPy compiles nothing for what follows

    def both(self, fly: bool, pull: Pull) -> Any:
        def both(z, on):
            told = self.told(z, on, fly, pull)
            if fly:  # limits must not buy themselves members that are unstable
                lost = np.max(told.numbers["abscissa"], axis=1) >= 0
                told = told._replace(value=np.where(lost, np.inf, told.value))
            refused = [bool(go) and bool(self.refused(x)) for x, go in zip(z, on, strict=True)]
            told = told._replace(value=np.where(refused, np.inf, told.value))
            self.last = told
            self.progress.add(_evaluation(told, z, on, fly, self.progress.seconds))
            return np.asarray(told.value), np.asarray(told.gradient)

        return both

    def refused(self, z: np.ndarray) -> str:
        """Why no step goes to `z`; the last such reason is kept."""
        why = refusal(self.coordinates, z)
        self.refusal = why or self.refusal
        return why

    def stabilise(self, z: np.ndarray) -> Descent:
        pull = no_pull(self.problem, self.limits, len(z))
        enough = lambda k, value: float(self.last.numbers["abscissa"][k].max()) < self.rate
        return minimise(self.both(False, pull), z, self.first, enough=enough)

    def slowest(self, z: np.ndarray) -> np.ndarray:
        everyone = np.ones(len(z), bool)
        told = self.told(z, everyone, False, no_pull(self.problem, self.limits, len(z)))
        return np.asarray(told.numbers["abscissa"]).max(axis=1)

    def descended(self, z: np.ndarray, on: np.ndarray, pull: Pull, left: int) -> Descent:
        if not isinstance(self.method, GaussNewton):
            method = eqx.tree_at(lambda m: m.evaluations, self.method, left)
            return minimise(self.both(True, pull), z, method, on=on)
        ends = [
            least_squares(
                self.coordinates, self.problem, one_of(self.objectives, k), x, self.method
            )
            if on[k]
            else (x, 0, False)
            for k, x in enumerate(z)
        ]
        points, steps, done = zip(*ends, strict=True)
        value, gradient = self.both(True, pull)(np.stack(points), on)
        reasons = tuple(
            "" if d else f"stopped after {s} steps" for s, d in zip(steps, done, strict=True)
        )
        return Descent(np.stack(points), value, gradient, np.array(steps), np.array(done), reasons)

    def optimise(self, z: np.ndarray, able: np.ndarray) -> Any:
        pull, on = no_pull(self.problem, self.limits, len(z)), able.copy()
        counts, beyond = np.zeros(len(z), int), np.full((len(z), len(self.limits)), np.inf)
        told = self.told(z, np.ones_like(able), able, pull)
        _require_finite(told, able)
        descent: Any = None
        everyone, rounds = np.ones_like(able), Rounds()
        most = getattr(self.method, "evaluations", 0)
        for _ in range(_ROUNDS if self.limits else 1):
            found = self.descended(z, on, pull, min(most, int(_TIMES * most - counts.max())))
            descent = found if descent is None else _merged(descent, found, on)
            z, counts = descent.z, counts + found.evaluations
            told = self.told(z, everyone, able, pull)
            if not self.limits:
                return descent, pull, told, beyond, counts
            pull, beyond = pulled(told, pull, beyond, on)
            rounds.add(z, np.asarray(told.cost), beyond)
            on = on & (beyond.max(axis=1) > MET) & ~rounds.stalled
            if not on.any() or counts.max() >= _TIMES * most:
                break
        if np.any(rounds.best() != z):
            z = rounds.best()
            told = self.told(z, everyone, able, pull)
            beyond = np.stack([np.max(x, axis=1) for x in told.beyond], axis=1)
            descent = descent._replace(z=z, gradient=np.asarray(told.gradient))
        return descent, pull, told, beyond, counts


def _require_finite(told: Told, able: np.ndarray) -> None:
    """A cost that is no number would end the descent where it starts."""
    value = np.asarray(told.value)
    if not able.any() or np.isfinite(value[able]).any():
        return
    bad = [n for n, x in told.numbers.items() if not np.isfinite(np.asarray(x)[able]).all()]
    raise ValueError(
        f"the cost is {value[able][0]} at the start, though every member is stable, because of "
        f"{', '.join(bad) or 'the limits'}: the scenario or the controller do not have it (only a "
        "controller with an observer estimates a disturbance), or members diverge in flight"
    )


def _merged(old: Descent, new: Descent, on: np.ndarray) -> Descent:
    pick = lambda a, b: np.where(on.reshape((-1,) + (1,) * (a.ndim - 1)), b, a)
    reasons = tuple(b if o else a for a, b, o in zip(old.reasons, new.reasons, on, strict=True))
    fields = Descent._fields[:-1]
    arrays = {name: pick(getattr(old, name), getattr(new, name)) for name in fields}
    return Descent(**arrays, reasons=reasons)


def _evaluation(told: Told, z: np.ndarray, on: np.ndarray, fly: bool, seconds: float) -> Evaluation:
    hide = lambda x: np.where(on, np.asarray(x), np.nan)
    abscissa = np.asarray(told.numbers["abscissa"])
    worst = told.costs if fly else told.numbers["abscissa"]
    return Evaluation(
        phase="optimise" if fly else "stabilise",
        z=np.array(z),
        cost=hide(told.value),
        gradient_norm=hide(np.linalg.norm(told.gradient, axis=1)),
        stable=hide(np.mean(abscissa < 0, axis=1)),
        worst=hide(np.argmax(worst, axis=1)),
        means={name: hide(np.mean(x, axis=1)) for name, x in told.numbers.items()},
        seconds=seconds,
    )
