"""Stabilise, then optimise: all problems in lockstep, limits by an augmented Lagrangian."""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Key

from jaxquad._core import as_array, on_host
from jaxquad.ensembles import Ensemble, Members
from jaxquad.identify import Free
from jaxquad.loops import Loop
from jaxquad.simulation import find_steps, Scenario

from ._cost import (
    Beyond,
    CostResult,
    count_members,
    evaluate_cost,
    flight_levels,
    is_kept_by,
    Listener,
    loop_levels,
    Progress,
    rank_places,
    search,
    stack_copies,
    Subproblem,
    Tail,
    take_members,
    take_problem,
)
from ._descent import (
    Descent,
    Evaluate,
    GaussNewton,
    LBFGS,
    minimise,
    minimise_squares,
    Pairs,
    require_squares,
)
from ._design_result import fly_members
from ._objective import Limit, Objective, QUANTITIES, Worst
from ._problem import (
    Bound,
    build_design,
    DeviceChoice,
    find_bounds,
    find_refusal,
    linear_loops,
    make_problem,
    Problem,
    require_ensemble,
    require_same_rate,
    select_coordinates,
    TimeSpan,
)
from ._verdict import Verdict


Method = LBFGS | GaussNewton


MET = 2e-3  # beyond a limit, as a level: 0.2 %
_STIFFNESS, _STIFFER = 4.0, 4.0
_STALLED = 0.9  # of what a limit was missed by before: it falls no further
_AS_GOOD = 1.05  # of the least miss: of rounds that miss limits so nearly alike, the cost decides
_ROUNDS = 8  # of multipliers
_TIMES = 3  # evaluations of all rounds together, in those of one descent
_BEYOND_KNEE = 0.25  # 1/s, below the abscissa that is enough: where the first phase aims
_WIDE = 256  # members more, whose linear loops have to keep limits
GUARDS = 16  # members that fly for limits alone
ADDED = 64  # linear loops at most, after a search
_SEARCHES = 5  # at most, until one finds none
_SLICE = 2048  # linear loops that are evaluated at once
_LOOPS, _FLIGHTS = 8192, 2048  # of a search, unless it has enough members to go on with before
_FIRST = 2  # folded into the key of the first slice of loops that is searched
_FLOWN = 0xF17E  # and of the first slice of flights
_GUARDING = 0x6A2D  # of those that fly for limits alone
_MARGIN = 0.01  # of the reserve, what is left once the worst of a search are tuned on


class Tuner:
    """What is tuned and for what; after `solve`, where each of the problems is, in arrays of them.

    A problem whose members cannot all be made to decay at `rate` stays with the first phase's best
    if one of them is unstable. Otherwise no step is taken to where one is, and where limits cannot
    be met the end is the round that missed them least.
    """

    descent: Descent | None = None
    stable: Bool[np.ndarray, " problems"]  # all members
    stabilised: Bool[np.ndarray, " problems"]  # all members decay as fast as was asked
    stabilising: np.ndarray  # evaluations of the first phase: linear loops only
    evaluations: np.ndarray  # of the second phase: flights and linear loops
    beyond: Float[np.ndarray, "problems limits"]  # greatest, as levels: above 0, violated
    result: CostResult
    _slowest: Float[np.ndarray, " problems"]  # 1/s, of the last evaluation
    refusal = ""  # why the controller refused the last of the steps that it refused, if any
    tail = Tail()

    def __init__(
        self, loop: Loop, ensemble: Ensemble | Members, scenario: Scenario,
        objective: Objective | None, limits: Sequence[Limit], *, reserve: float, free: Free,
        members: int, method: Method | None, key: Key[Array, ""] | None, progress: bool | None,
        listener: Listener | None, devices: DeviceChoice,
    ):  # fmt: skip
        objective = Objective() if objective is None else objective
        method = LBFGS() if method is None else method
        require_kinds(loop, ensemble, scenario, objective, limits, method)
        self.loop, self.ensemble, self.scenario, self.devices = loop, ensemble, scenario, devices
        self.objective, self.limits, self.method = objective, tuple(limits), method
        self.key = jax.random.key(0) if key is None else key
        self.progress = Progress(progress, listener)
        self.span = TimeSpan(
            objective.events, objective.start, objective.stop, objective.load_start
        )
        self.coordinates = select_coordinates(loop.controller, free)
        if isinstance(ensemble, Ensemble):
            self.drawn = ensemble.draw(loop, members, self.key)
        else:
            require_same_rate(loop, ensemble)
            self.drawn = ensemble
        knees = [float(p.knee) for p in objective.penalties if p.quantity == "abscissa"]
        # 1/s, that every member is brought to before anything is flown.
        self.rate = min([*knees, -0.1]) if knees else -0.5
        self.aims = tuple(tighten(limit, reserve) for limit in limits)
        small = min(reserve, _MARGIN)
        self.aims_on_tail = tuple(
            tighten(x, small if isinstance(x.over, Worst) else reserve) for x in limits
        )

    def solve(
        self, start: Float[np.ndarray, "problems n"], objectives: Objective, size: int | None = None
    ) -> None:
        """Both phases of all problems, whose `objectives` hold arrays [problems, ...].

        Then members beyond limits are searched for, and the problems descend again with these;
        `size` is that of a slice of flights, and there is no search without it.
        """
        searched = size is not None and isinstance(self.ensemble, Ensemble)
        self.kept_by = [[is_kept_by(x, flights=f) for x in self.limits] for f in (False, True)]
        self.searches = [searched and any(kept) for kept in self.kept_by]
        self.size = 1 if size is None else size
        self.guards = self._fresh(_GUARDING, GUARDS) if self.searches[1] else None
        self.problem = self._pose()
        if searched and any(QUANTITIES[limit.quantity].linear for limit in self.limits):
            # More members where limits are of the linear loop, whose worst case is in a corner.
            assert isinstance(self.ensemble, Ensemble)
            wide = self.ensemble.draw(self.loop, _WIDE, jax.random.fold_in(self.key, 1))
            limited = linear_loops(wide, self.devices)
            self.problem = dataclasses.replace(self.problem, limited=limited)
        wanted = self.objective.quantities | {limit.quantity for limit in self.limits}
        if "overshoot" in wanted:
            steps = find_steps(self.problem.flight.reference, self.problem.parts)
            if not np.any(np.asarray(steps.is_single & (steps.target != steps.before))):
                raise ValueError(
                    "overshoot is wanted, but the reference makes no step from event to event: "
                    "give a scenario with one, and its times as Objective(events=...)"
                )
        count, everyone = len(start), np.ones(len(start), bool)
        self.objectives, self.stacked = objectives, stack_copies(self.aims, count)
        sizes = [count_members(self.problem, limit) for limit in self.limits]
        self.multipliers = tuple(as_array(np.zeros((count, size))) for size in sizes)
        self.stiffness = as_array(np.full((count, len(sizes)), _STIFFNESS))
        method = self.method if isinstance(self.method, LBFGS) else LBFGS()
        enough = lambda k, value: float(self._slowest[k]) < self.rate
        first = minimise(self._evaluator(False), np.asarray(start, float), method, enough=enough)
        self.z, self.stabilising = first.z, first.evaluations
        slowest = np.max(np.asarray(self._evaluate(everyone, False).numbers["abscissa"]), axis=1)
        self.stable, self.stabilised = slowest < 0, slowest < self.rate
        self.evaluations = np.zeros(count, int)
        self._optimise(self.stable, MET)
        self._search(self.stable)

    @property
    def cost(self) -> Float[np.ndarray, " problems"]:
        """The objective without what limits added; NaN where members are not stable."""
        return np.where(self.stable, np.asarray(self.result.cost), np.nan)

    @property
    def converged(self) -> Bool[np.ndarray, " problems"]:
        """Whether the descent ended at a stationary point."""
        assert self.descent is not None
        return self.descent.converged & self.stable

    def judge(self, index: int, missed: Sequence[str] = ()) -> tuple[tuple[Bound, ...], Verdict]:
        """The bounds that stop the descent of a problem, and the verdict on its convergence.

        It holds for a stationary point inside of all bounds, without `missed` limits.
        """
        assert self.descent is not None
        gradient, reason = self.descent.gradient[index], self.descent.reasons[index]
        bounds = find_bounds(self.coordinates, self.z[index], gradient)
        if not self.stable[index]:
            text = "nothing was optimised, because not every member could be stabilised"
            remedy = "Start with slower gains, or narrow the ensemble"
            return bounds, Verdict("CONVERGENCE", False, text, remedy)
        size = f"the greatest entry of the gradient is {np.max(np.abs(gradient)):.2g} per neper"
        done, ended = self.converged[index], f"{self.evaluations[index]} gradients"
        faults = [] if done else [f"the descent ended where the cost still falls: {reason}"]
        if self.refusal and not (done or bounds):
            faults.append(f"the controller refused steps: {self.refusal}")
        faults += [
            f"{b.name} = {b.value:.4g} stands at its bound, a further step is refused "
            f"({b.reason.rstrip('.')})"
            for b in bounds
        ]
        faults += [f"the limit on {text}" for text in missed]
        if not faults:
            text = f"the descent ended at a stationary point after {ended}: "
            text += f"{reason}, {size}" if reason else size
            return bounds, Verdict("CONVERGENCE", True, text)
        names = ", ".join(b.name for b in bounds)
        hold = f"Hold {names} below it, or penalise what drives it there (activity)"
        remedies = [hold] * bool(bounds)
        remedies += ["Relax the limits, or narrow the ensemble"] * bool(missed)
        remedies += ["Tune on from here, with more evaluations"] * (not remedies)
        text = f"{'; '.join(faults)} ({ended}, {size})"
        return bounds, Verdict("CONVERGENCE", False, text, ". ".join(remedies))

    def go_on(self, worst: Beyond, index: int) -> None:
        """The problem of that index descends again with members that its certificate found."""
        on = np.arange(len(self.z)) == index
        self._tune_on(worst, on)
        self._search(on)

    def _fresh(self, salt: int, count: int) -> Members:
        assert isinstance(self.ensemble, Ensemble)
        return self.ensemble.fresh(self.loop, count, jax.random.fold_in(self.key, salt))

    def _pose(self) -> Problem:
        """The members that were drawn in their flights, and guards that fly for limits alone."""
        flown = self.drawn
        if self.guards is not None:
            some = (self.drawn, self.guards)
            places = [(k, i) for k, one in enumerate(some) for i in range(one.size)]
            flown = take_members(some, places) or flown
        return make_problem(
            self.loop.controller, flown, self.scenario,
            span=self.span, devices=self.devices, counted=self.drawn.size,
        )  # fmt: skip

    def _arguments(self, z: np.ndarray, on: np.ndarray, fly: ArrayLike) -> tuple:
        rate = as_array(np.full(len(z), self.rate - _BEYOND_KNEE))
        flies = as_array(np.broadcast_to(np.asarray(fly), (len(z),)))
        subproblem = Subproblem(
            self.objectives, self.stacked, self.multipliers, self.stiffness, flies, rate
        )
        return as_array(z), as_array(on), self.coordinates, self.problem, subproblem

    def _evaluate(self, on: np.ndarray, fly: ArrayLike) -> CostResult:
        """In NumPy's arrays, which compile nothing for what follows."""
        return jax.tree.map(np.asarray, evaluate_cost(*self._arguments(self.z, on, fly)))

    def _evaluator(self, fly: bool) -> Evaluate:
        """What a descent calls: infinite where a step must not go."""

        def evaluate(z: np.ndarray, on: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            # Before the costs, and looked at while they run: JAX runs one program after the other.
            designs = [build_design(self.coordinates, as_array(x)) for x in z[on]]
            running = evaluate_cost(*self._arguments(z, on, fly))
            refused = np.zeros(len(z), bool)
            for k, design in zip(np.flatnonzero(on), designs, strict=True):
                why = find_refusal(design)
                self.refusal, refused[k] = why or self.refusal, bool(why)
            result = jax.tree.map(np.asarray, running)
            self._slowest = np.max(result.numbers["abscissa"], axis=1)
            if fly:  # limits must not buy themselves members that are unstable
                refused |= self._slowest >= 0
            result = result._replace(value=np.where(refused, np.inf, result.value))
            self.progress.add(result, z, on, fly)
            return np.asarray(result.value), np.asarray(result.gradient)

        return evaluate

    def _descend(self, on: np.ndarray, left: int, pairs: Sequence[Pairs] | None) -> Descent:
        """One round of the second phase, of at most `left` evaluations."""
        if isinstance(self.method, LBFGS):
            method = dataclasses.replace(self.method, evaluations=left)
            return minimise(self._evaluator(True), self.z, method, on=on, pairs=pairs)
        ends = []
        for k, x in enumerate(self.z):
            objective = take_problem(self.objectives, k)
            args = self.coordinates, self.problem, objective, x, self.method
            ends.append(minimise_squares(*args) if on[k] else (x, 0, False))
        points, steps, done = zip(*ends, strict=True)
        value, gradient = self._evaluator(True)(np.stack(points), on)
        reasons = [
            "" if d else f"stopped after {s} steps" for s, d in zip(steps, done, strict=True)
        ]
        none = tuple(Pairs() for _ in ends)
        return Descent(
            np.stack(points), value, gradient, np.array(steps), np.array(done), tuple(reasons), none
        )

    def _optimise(self, on: Bool[np.ndarray, " problems"], met: ArrayLike) -> None:
        """The second phase: rounds of multipliers until limits are `met`, to these levels.

        Each round begins with the curvature that those before it found.
        """
        before, chosen, everyone = self.descent, on, np.ones_like(on)
        descent, pairs = None, None if before is None else before.pairs
        counts, beyond = np.zeros(len(on), int), np.full((len(on), len(self.limits)), np.inf)
        points, costs, misses = [], [], []
        self.result = self._evaluate(everyone, self.stable)
        _require_finite(self.result, self.stable)
        most = self.method.evaluations if isinstance(self.method, LBFGS) else 0
        for _ in range(_ROUNDS if self.limits else 1):
            left = min(most, int(_TIMES * most - counts.max()))
            latest = self._descend(on, left, pairs)
            descent = _merge(descent, latest, on)
            self.z, pairs, counts = descent.z, descent.pairs, counts + latest.evaluations
            self.result = self._evaluate(everyone, self.stable)
            if not self.limits:
                break
            beyond = self._update_multipliers(beyond, on)
            points.append(np.array(self.z))
            costs.append(np.asarray(self.result.cost))
            misses.append(np.maximum(beyond, 0).sum(axis=1))
            on = on & np.any(beyond > met, axis=1)
            if len(misses) > 2:  # by more than 2 %, and no nearer in two rounds: another is futile
                now, least = misses[-1], _STALLED * np.min(misses[:-2], axis=0)
                on = on & ~((now > 10 * MET) & (np.minimum(misses[-2], now) > least))
            if not on.any() or counts.max() >= _TIMES * most:
                break
        assert descent is not None
        if self.limits:  # the last round's end where it meets them, else of the least miss
            missed = np.stack(misses)
            near = missed <= _AS_GOOD * missed.min(axis=0)
            best = np.argmin(np.where(near, np.stack(costs), np.inf), axis=0)
            best = np.where(missed[-1] <= 2 * MET, len(missed) - 1, best)
            z = np.stack([points[r][k] for k, r in enumerate(best)])
            if np.any(z != self.z):
                self.z = z
                self.result = self._evaluate(everyone, self.stable)
                beyond = np.stack([np.max(x, axis=1) for x in self.result.beyond], axis=1)
                descent = descent._replace(z=z, gradient=np.asarray(self.result.gradient))
        self.descent = _merge(before, descent, chosen)
        self.z, self.beyond, self.evaluations = self.descent.z, beyond, self.evaluations + counts

    def _update_multipliers(self, before: np.ndarray, on: np.ndarray) -> np.ndarray:
        """Of problems that are `on`; returns how far each limit is missed.

        A limit becomes stiffer where it is missed by more than a quarter of what it was `before`.
        """
        stiffness, values = np.asarray(self.stiffness), []
        for k, beyond in enumerate(self.result.beyond):
            old = np.asarray(self.multipliers[k])
            raised = np.maximum(old + stiffness[:, k : k + 1] * beyond, 0)
            values.append(as_array(np.where(on[:, None], raised, old)))
        missed = np.stack([beyond.max(axis=1) for beyond in self.result.beyond], axis=1)
        slow = missed > np.maximum(0.25 * before, MET)
        self.multipliers = tuple(values)
        self.stiffness = as_array(np.where(slow & on[:, None], _STIFFER, 1.0) * stiffness)
        return missed

    def _half_of_reserve(self) -> Float[np.ndarray, " limits"]:
        """Half of the level from what is aimed at to what is allowed: near enough to search."""
        level = lambda x: np.asarray(QUANTITIES[x.quantity].level(on_host(x.bound)))
        pairs = zip(self.aims_on_tail, self.limits, strict=True)
        return np.array([0.5 * np.abs(level(a) - level(b)) for a, b in pairs])

    def _search(self, chosen: Bool[np.ndarray, " problems"]) -> None:
        """Search for members that are beyond limits, and descend again with the worst of them.

        Searched for are those of the problems `chosen` that keep limits on the members so far.
        """
        if not any(self.searches):
            return
        for _ in range(_SEARCHES):
            on = chosen & np.all(self.beyond <= np.maximum(self._half_of_reserve(), MET), axis=1)
            if not on.any():
                break
            worst, tail = self._search_once(on), self.tail
            self.progress.say(str(worst))
            self.tail = tail._replace(
                searches=tail.searches + 1, searched=tail.searched + worst.searched,
                flown=tail.flown + worst.flights, beyond=worst.count,
            )  # fmt: skip
            if not worst.count:
                break
            self._tune_on(worst, on)

    def _search_once(self, on: np.ndarray) -> Beyond:
        number, points = self.tail.searches, [as_array(x) for x in self.z[on]]
        beyond = Beyond(None, None, 0)
        if self.searches[0]:

            def levels(drawn: Members) -> list[Array]:
                loops = linear_loops(drawn, self.devices)
                return [loop_levels(z, self.coordinates, loops, self.limits) for z in points]

            draw = lambda k: self._fresh(_FIRST + k, _SLICE)
            loops, count, searched = search(draw, number, _LOOPS // _SLICE, levels, ADDED)
            beyond = Beyond(loops, None, count, searched)
        if self.searches[1]:
            designs = [build_design(self.coordinates, z) for z in points]

            def levels_of_flights(drawn: Members) -> list[np.ndarray]:
                flight = drawn.flight(self.scenario)
                run = lambda x: fly_members(x, drawn, flight, self.span, self.devices)
                return [flight_levels(run(x).numbers, self.limits) for x in designs]

            draw = lambda k: self._fresh(_FLOWN + k, self.size)
            most = max(1, _FLIGHTS // self.size)
            flown, count, flights = search(draw, number, most, levels_of_flights, GUARDS)
            beyond = beyond._replace(flown=flown, count=beyond.count + count, flights=flights)
        return beyond

    def _tune_on(self, worst: Beyond, on: Bool[np.ndarray, " problems"]) -> None:
        """The problems that are `on` descend again, with the worst among the members of limits.

        These take the places of the least critical ones, and their multipliers begin at 0.
        """
        values, problem, guards = [np.array(x) for x in self.multipliers], self.problem, self.guards
        if worst.loops is not None:
            assert problem.limited is not None
            places = rank_places(self.result, self.kept_by[0], on)[: worst.loops.size]
            for k in np.flatnonzero(self.kept_by[0]):
                values[k][:, places] = 0.0
            limited = problem.limited.replaced(places, linear_loops(worst.loops, None))
            problem = self.problem = dataclasses.replace(problem, limited=limited)
        if worst.flown is not None and guards is not None:
            first, count = problem.counted, worst.flown.size
            stay = np.sort(rank_places(self.result, self.kept_by[1], on, first)[count:])
            places = [(0, int(k)) for k in stay] + [(1, k) for k in range(count)]
            self.guards = take_members([guards, worst.flown], places)
            for k in np.flatnonzero(self.kept_by[1]):
                old = values[k]
                moved = [old[:, :first], old[:, first + stay], np.zeros((len(old), count))]
                values[k] = np.concatenate(moved, axis=1)
            self.problem = dataclasses.replace(self._pose(), limited=problem.limited)
        self.multipliers = tuple(map(as_array, values))
        self.stacked = stack_copies(self.aims_on_tail, len(on))
        self._optimise(on, self._half_of_reserve())
        self.tail = self.tail._replace(added=self.tail.added + worst.added)


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


def _merge(old: Descent | None, new: Descent, on: np.ndarray) -> Descent:
    """The new one of problems that were `on`, the old one of the others."""
    if old is None:
        return new
    pick = lambda a, b: np.where(on.reshape((-1,) + (1,) * (a.ndim - 1)), b, a)
    choose = lambda a, b: tuple(y if o else x for x, y, o in zip(a, b, on, strict=True))
    both = zip(Descent._fields, old, new, strict=True)
    merge = lambda a, b: choose(a, b) if isinstance(a, tuple) else pick(a, b)
    return new._replace(**{name: merge(a, b) for name, a, b in both})


def tighten(limit: Limit, reserve: float) -> Limit:
    """The limit with a reserve; raise ValueError for one outside of 0 <= reserve < 1."""
    if not 0 <= reserve < 1:
        raise ValueError(
            f"reserve is {reserve}: give the share by which limits are tightened, as 0.03"
        )
    share = limit.sign * np.sign(np.asarray(limit.bound)) * reserve
    name = "at_least" if limit.at_most is None else "at_most"
    return Limit(limit.quantity, **{name: on_host(limit.bound) * (1 - share)}, over=limit.over)


def require_kinds(
    loop: object, ensemble: object, scenario: object, objective: object, limits: object,
    method: object,
) -> None:  # fmt: skip
    """Raise ValueError for an argument of another kind, and for limits on no sum of squares."""
    require_ensemble(ensemble)
    for name, value, kind, remedy in (
        ("loop", loop, Loop, "jq.Loop(plant, controller, ...), whose controller is the start"),
        ("scenario", scenario, Scenario, "jq.scenario(duration=..., ...)"),
        ("objective", objective, Objective, "jq.Objective(terms={'itae': 1.0}, ...)"),
    ):
        if not isinstance(value, kind):
            raise ValueError(f"{name} is a {type(value).__name__}: give {remedy}")
    if not isinstance(limits, Sequence) or not all(isinstance(x, Limit) for x in limits):
        raise ValueError(f"limits are {limits}: give a list, as [jq.Limit('overshoot', at_most=5)]")
    if not isinstance(method, LBFGS | GaussNewton):
        raise ValueError(f"method is {method!r}: give jq.tuning.LBFGS() or jq.tuning.GaussNewton()")
    if isinstance(method, GaussNewton) and isinstance(objective, Objective):
        require_squares(objective, limits)
