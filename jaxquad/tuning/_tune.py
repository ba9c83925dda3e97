import dataclasses
import functools as ft
import time
from collections.abc import Callable, Iterator, Mapping, Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from jaxquad._core import as_array, on_host
from jaxquad.ensembles import Ensemble, Members
from jaxquad.identify import Free
from jaxquad.loops import Loop
from jaxquad.simulation import find_steps, Scenario

from ._beside import begin_evaluating, Beside, evaluate_beside
from ._certificate import Certificate, lag_remark
from ._certify import certify_beside
from ._cost import Listener, Progress, stack_copies
from ._evaluate_design import certified_members, flying_loop
from ._flown import fly
from ._gauss_newton import GaussNewton, require_squares
from ._lbfgs import LBFGS
from ._objective import Limit, Objective, Worst
from ._parameters import build_design, select_coordinates
from ._phases import find_bounds, go_on, Solution, solve
from ._problem import (
    DeviceChoice,
    linear_loops,
    make_problem,
    Problem,
    require_same_rate,
    TimeSpan,
)
from ._quantities import QUANTITIES
from ._tail import (
    certified_beyond,
    FlightSearch,
    GUARDS,
    is_kept_by_flights,
    is_kept_by_loops,
    prepare_search,
    Search,
    SLICE,
    take_members,
)
from ._tuned import distinct_optima, LimitResult, scatter_starts, Tuned
from ._verdict import Bound, judge_convergence, Verdict


Method = LBFGS | GaussNewton


def tune(
    loop: Loop,
    ensemble: Ensemble | Members,
    scenario: Scenario,
    *,
    objective: Objective | None = None,
    limits: Sequence[Limit] = (),
    reserve: float = 0.03,
    free: Free = None,
    members: int = 64,
    fresh: int | Members | None = 256,
    starts: int = 1,
    scatter: float = 0.4,
    method: Method | None = None,
    peers: Mapping[str, PyTree] | None = None,
    key: Key[Array, ""] | None = None,
    progress: bool | None = None,
    listener: Listener | None = None,
    devices: DeviceChoice = None,
) -> Tuned:
    """Tune a controller by gradient through the closed loops of all members of an ensemble at once.

    First the slowest pole of every member is moved to the left of the knee of the objective's
    penalty on the abscissa (-0.5 1/s without one), which needs no flights. Then the objective is
    minimised through their flights of the scenario. Limits are enforced by an augmented Lagrangian,
    those of the linear loop on 256 further members. Then others are searched for such as are beyond
    a limit that every member has to keep: 8192 linear loops, 2048 flights. The worst join those
    that the limit is kept on, and the descent goes on from where it ended, until a search of other
    members finds none, five times at most. Where the certificate still finds one, it is tuned on,
    too, and another certificate is made on members of its own: three at most. A design whose
    certificate fails is returned, too, and says so first.
    Source: docs/tuning.md.

    !!! example

        ```python
        loop = jq.Loop(plant, controller, drive=jq.simulation.Saturation(10.0), delay=0.004)
        ensemble = jq.Ensemble(
            inertia=jq.ensembles.LogUniform(0.5, 3.0), lag=jq.ensembles.Uniform(0.01, 0.04)
        )
        tuned = jq.tune(loop, ensemble, flight, limits=[jq.Limit("sensitivity_peak", at_most=3.6)])
        print(tuned)
        ```

    **Arguments:**

    - `loop`: what is nominal; `loop.controller` is the start. It has the method `linear`, as
        `jq.LADRC`, `jq.PID`, both of them scheduled, and the adaptive LADRC have.
    - `ensemble`: what varies, or members that were drawn from it.
    - `scenario`: what all members fly.
    - `objective`: what is minimised, see `jq.Objective`.
    - `limits`: bounds that the design has to keep.
    - `reserve`: by how much more limits are enforced than asked (0.03 is 3 %), because fresh
        members reach further than those that were tuned on. At most 1 % of it is left on limits
        that every member has to keep once the worst of a search are tuned on.
    - `free`: the numbers to tune, as in `jq.fit`; by default those that `controller.tunable()`
        names: wc, wo and b0 or the knots of its map, of a PID all gains that are not 0. Gains keep
        their sign; the knots of a `jq.control.InertiaMap` stay falling.
    - `members`: how many are drawn to tune on.
    - `fresh`: how many new members the certificate evaluates the design on, or those members; None
        makes no certificate.
    - `starts`, `scatter`: with several starts, others are scattered about the first (normal, by
        `scatter` nepers) and solved together; `Tuned.minima` lists where they ended, and the best
        is returned.
    - `method`: `jq.tuning.LBFGS` (by default) or `jq.tuning.GaussNewton`.
    - `peers`: controllers that stand beside the design in its certificate, by name.
    - `key`: of all draws; `jax.random.key(0)` by default.
    - `progress`: write a line per evaluation on stderr; by default if that is a terminal.
    - `listener`: is called with each `jq.tuning.Evaluation`.
    - `devices`: over which the members are split, see `jq.evaluate`.

    **Returns:**

    A `jq.tuning.Tuned` with `.controller` and `.certificate`.

    **Raises:**

    - `ValueError`: parts do not fit together, or the controller is in single precision.
    """
    objective = Objective() if objective is None else objective
    method = LBFGS() if method is None else method
    require_kinds(loop, ensemble, scenario, objective, limits, method)
    key = jax.random.key(0) if key is None else key
    span, watched = TimeSpan.of(objective), Progress(progress, listener)
    coordinates = select_coordinates(loop.controller, free)
    drawn = draw_or_take(loop, ensemble, members, key)
    _require_fresh(fresh, drawn, peers)
    search = _search(
        loop, ensemble, drawn, scenario, limits, reserve=reserve, starts=starts, key=key, span=span,
        size=fresh if isinstance(fresh, int) else _SIZE, devices=devices,
    )  # fmt: skip
    if search is None or search.flights is None:
        problem = make_problem(loop.controller, drawn, scenario, span=span, devices=devices)
    else:
        problem = search.flights.problem(search.flights.guards)
    limited = _draw_limited(loop, ensemble, limits, key)
    if limited is not None:
        problem = dataclasses.replace(problem, limited=linear_loops(limited, devices))
    require_steps(problem, objective.quantities | {limit.quantity for limit in limits})
    begun = scatter_starts(coordinates.start, starts, scatter, seed=0)
    tightened = tuple(tighten(limit, reserve) for limit in limits)
    certified = fresh is not None and not (isinstance(ensemble, Members) and isinstance(fresh, int))
    others, count = (fresh, 0) if isinstance(fresh, Members) else (ensemble, fresh or 0)
    beside = ft.partial(
        evaluate_beside, loop, others, scenario, peers=peers or {}, begun=loop.controller,
        members=count, span=span, devices=devices,
    )  # fmt: skip
    first: list[Callable[[], Beside]] = []

    def prepare() -> None:
        if search is not None:
            prepare_search(search, coordinates, coordinates.start)

    def traced() -> None:
        if certified:
            first.append(begin_evaluating(lambda: beside(key), devices, before=prepare))

    solution = solve(
        coordinates, problem, begun, stack_copies(objective, starts),
        stack_copies(tightened, starts), method=method, rate=stabilising_rate(objective),
        progress=watched, search=search, traced=traced,
    )  # fmt: skip
    best, seconds, certificate, certificates = _best(solution), watched.seconds, None, 0
    if certified:

        def judge(solution: Solution, key: Key[Array, ""], found: Beside) -> Certificate:
            watched.say("certificate on fresh members ...")
            design = build_design(coordinates, as_array(solution.z[best]))
            return certify_beside(
                loop.with_controller(design), others, scenario, found, limits=limits,
                linear_members=None, key=key, span=span, name="tuned", devices=devices,
            )  # fmt: skip

        certificate, certificates = judge(solution, key, first[0]()), 1
        if search is not None and isinstance(ensemble, Ensemble) and isinstance(fresh, int):
            redraw = ft.partial(certified_members, loop, ensemble, flown=fresh)
            again = lambda solution, key: judge(solution, key, beside(key))
            solution, certificate, certificates, more = _certify_until_kept(
                solution, certificate, again, redraw, search, best, key
            )
            seconds += more
    tuned = build_design(coordinates, as_array(solution.z[best]))
    found = _limit_results(limits, solution, best)
    bounds = find_bounds(coordinates, solution.z[best], solution.gradient[best])
    convergence = judge_descent(solution, best, bounds, found)
    if certificate is not None:
        certificate = dataclasses.replace(certificate, convergence=convergence)
    return Tuned(
        controller=tuned,
        certificate=certificate,
        bounds=bounds,
        convergence=convergence,
        stabilised=bool(solution.stabilised[best]),
        converged=bool(solution.converged[best]),
        cost=float(solution.cost[best]),
        values=coordinates.values(solution.z[best]),
        limits=found,
        minima=distinct_optima(solution, coordinates),
        evaluations=int(solution.evaluations[best]),
        stabilising=int(solution.stabilising[best]),
        tail=solution.tail._replace(certificates=certificates),
        history=tuple(watched.history),
        seconds=seconds,
        remarks=tuple(_remarks(tuned, problem, solution, best, found)),
    )


_WIDE = 256
_CERTIFICATES = 3  # at most
_AGAIN = 0xCE57  # folded into the key of certificates after the first


def _certify_until_kept(
    solution: Solution,
    certificate: Certificate,
    judge: Callable[[Solution, Key[Array, ""]], Certificate],
    redraw: Callable[[Key[Array, ""]], list[Members]],
    search: Search,
    best: int,
    key: Key[Array, ""],
) -> tuple[Solution, Certificate, int, float]:
    """Where certified members are beyond a limit, tune on these, too, and certify on others.

    Also returns how many certificates there are, and how long that tuning took, in s.
    """
    seconds, number, own = 0.0, 1, key
    for number in range(1, _CERTIFICATES + 1):
        if number == _CERTIFICATES:
            break
        worst = certified_beyond(certificate, redraw(own))
        if not worst.added:
            break
        began = time.perf_counter()
        solution = go_on(solution, worst, search, best)
        seconds += time.perf_counter() - began
        own = jax.random.fold_in(key, _AGAIN + number)
        certificate = judge(solution, own)
    return solution, certificate, number, seconds


def draw_or_take(
    loop: Loop, ensemble: Ensemble | Members, count: int, key: Key[Array, ""]
) -> Members:
    """`count` members of an ensemble, or the members that were given."""
    if isinstance(ensemble, Ensemble):
        return ensemble.draw(loop, count, key)
    require_same_rate(loop, ensemble)
    return ensemble


def _draw_limited(
    loop: Loop, ensemble: Ensemble | Members, limits: Sequence[Limit], key: Key[Array, ""]
) -> Members | None:
    """More members where there are limits of the linear loop, whose worst case is in a corner."""
    linear = any(QUANTITIES[limit.quantity].linear for limit in limits)
    if isinstance(ensemble, Members) or not linear:
        return None
    return ensemble.draw(loop, _WIDE, jax.random.fold_in(key, 1))


_FIRST = 2  # folded into the key of the first slice of loops that is searched
_FLOWN = 0xF17E  # and of the first slice of flights
_GUARDING = 0x6A2D  # of those that fly for limits alone
_SIZE = 256  # flights in a slice
_MARGIN = 0.01  # of the reserve, what is left once the worst of a search are tuned on


def _search(
    loop: Loop,
    ensemble: Ensemble | Members,
    drawn: Members,
    scenario: Scenario,
    limits: Sequence[Limit],
    *,
    reserve: float,
    starts: int,
    key: Key[Array, ""],
    span: TimeSpan,
    size: int,
    devices: DeviceChoice,
) -> Search | None:
    """Members to search for those beyond limits, and the limits that those found have to keep."""
    if isinstance(ensemble, Members) or not any(isinstance(x.over, Worst) for x in limits):
        return None
    fresh = lambda own, count: ensemble.fresh(loop, count, jax.random.fold_in(key, own))

    def fly_around(controller: PyTree, members: Members) -> dict[str, np.ndarray]:
        around = flying_loop(controller, members)
        return fly(around, members.flight(scenario), span, devices).numbers

    def problem(guards: Members) -> Problem:
        flown = take_members([drawn, guards], [
            *((0, k) for k in range(drawn.size)), *((1, k) for k in range(guards.size))
        ])  # fmt: skip
        assert flown is not None
        return make_problem(
            loop.controller, flown, scenario, span=span, devices=devices, counted=drawn.size
        )

    flights = FlightSearch(
        lambda k: fresh(_FLOWN + k, size), fly_around, problem, fresh(_GUARDING, GUARDS), size
    )
    loops = ft.cache(lambda k: linear_loops(fresh(_FIRST + k, SLICE), devices))
    aimed = [tighten(x, min(reserve, _MARGIN) if isinstance(x.over, Worst) else reserve)
             for x in limits]  # fmt: skip
    return Search(
        loops if any(map(is_kept_by_loops, limits)) else None,
        flights if any(map(is_kept_by_flights, limits)) else None,
        stack_copies(tuple(limits), starts),
        stack_copies(tuple(aimed), starts),
    )


def stabilising_rate(objective: Objective) -> float:
    """The abscissa in 1/s that every member is brought to before anything is flown."""
    knees = [float(p.knee) for p in objective.penalties if p.quantity == "abscissa"]
    return min([*knees, -0.1]) if knees else -0.5


def tighten(limit: Limit, reserve: float) -> Limit:
    """The limit with a reserve; raise ValueError for one outside of 0 <= reserve < 1."""
    if not 0 <= reserve < 1:
        raise ValueError(
            f"reserve is {reserve}: give the share by which limits are tightened, as 0.03"
        )
    share = limit.sign * np.sign(np.asarray(limit.bound)) * reserve
    name = "at_least" if limit.at_most is None else "at_most"
    return Limit(limit.quantity, **{name: on_host(limit.bound) * (1 - share)}, over=limit.over)


def _best(solution: Solution) -> int:
    """The lowest cost among the starts that are stable and miss limits least."""
    missed = np.maximum(solution.beyond, 0).sum(axis=1) if solution.beyond.size else 0.0
    missed = np.where(np.asarray(missed) > 5e-3, missed, 0.0)
    cost = np.where(np.isnan(solution.cost), np.inf, solution.cost)
    return int(np.lexsort((cost, np.broadcast_to(missed, cost.shape), np.isinf(cost)))[0])


_ACTIVE = 1e-3  # the multiplier's sum above which a limit costs something


@eqx.filter_jit  # as one program
def _excess(limit: Limit, values: Float[Array, " members"]) -> Float[Array, ""]:
    return limit.excess(values)


def _limit_results(
    limits: Sequence[Limit], solution: Solution, index: int
) -> tuple[LimitResult, ...]:
    """Each limit as it was given, on the members that were tuned on."""
    results = []
    for k, limit in enumerate(limits):
        values = as_array(solution.result.limited[k][index])
        excess = float(_excess(limit, values))
        found = float(limit.bound) + limit.sign * excess
        active = float(np.asarray(solution.multipliers.values[k])[index].sum()) > _ACTIVE
        results.append(LimitResult(limit, found, excess <= 0, active))
    return tuple(results)


def judge_descent(
    solution: Solution, index: int, bounds: tuple[Bound, ...], limits: Sequence[LimitResult] = ()
) -> Verdict:
    """The verdict on convergence, where all members could be stabilised."""
    if not solution.stable[index]:
        text = "nothing was optimised, because not every member could be stabilised"
        remedy = "Start with slower gains, or narrow the ensemble"
        return Verdict("CONVERGENCE", False, text, remedy)
    return judge_convergence(
        converged=bool(solution.converged[index]),
        reason=solution.reasons[index],
        refusal=solution.refusal,
        gradient=float(np.max(np.abs(solution.gradient[index]))),
        evaluations=int(solution.evaluations[index]),
        bounds=bounds,
        missed=[f"{x.limit} cannot be met: {x.found:.4g} at best" for x in limits if not x.met],
    )


def _remarks(
    controller: PyTree,
    problem: Problem,
    solution: Solution,
    index: int,
    limits: Sequence[LimitResult],
) -> Iterator[str]:
    slowest = np.asarray(solution.result.numbers["abscissa"][index])
    if not solution.stable[index]:
        count = int(np.sum(slowest >= 0))
        yield (
            f"{count} of the {slowest.size} members that were tuned on cannot be stabilised from "
            f"this start (slowest pole {slowest.max():+.3g} 1/s), so nothing was optimised: start "
            "with slower gains, or narrow the ensemble"
        )
    elif not solution.stabilised[index]:
        yield f"the slowest pole of a member decays at only {-slowest.max():.3g} 1/s"
    if not all(one.met for one in limits) or not solution.stable[index]:
        remark = lag_remark(controller, problem.linear.delay, problem.linear.axes.lag)
        if remark is not None:
            yield remark


def require_kinds(
    loop: object,
    ensemble: object,
    scenario: object,
    objective: object,
    limits: object,
    method: object,
) -> None:
    """Raise ValueError for an argument of another kind, and for limits on no sum of squares."""
    if not isinstance(loop, Loop):
        raise ValueError(
            f"loop is a {type(loop).__name__}: give jq.Loop(plant, controller, ...), whose "
            "controller is the start"
        )
    if not isinstance(ensemble, Ensemble | Members):
        raise ValueError(
            f"ensemble is a {type(ensemble).__name__}: give jq.Ensemble(inertia=...), or "
            "jq.ensembles.Members of it"
        )
    if not isinstance(scenario, Scenario):
        raise ValueError(
            f"scenario is a {type(scenario).__name__}: give jq.scenario(duration=..., ...)"
        )
    if not isinstance(objective, Objective):
        name = type(objective).__name__
        raise ValueError(f"objective is a {name}: give jq.Objective(terms={{'itae': 1.0}}, ...)")
    if not isinstance(limits, Sequence) or not all(isinstance(x, Limit) for x in limits):
        raise ValueError(f"limits are {limits}: give a list, as [jq.Limit('overshoot', at_most=5)]")
    if not isinstance(method, LBFGS | GaussNewton):
        raise ValueError(f"method is {method!r}: give jq.tuning.LBFGS() or jq.tuning.GaussNewton()")
    if isinstance(method, GaussNewton):
        require_squares(objective, limits)


def _require_fresh(fresh: object, drawn: Members, peers: Mapping[str, PyTree] | None) -> None:
    """Raise ValueError for members that are tuned on, and for a peer of the design's name."""
    if "tuned" in (peers or {}):
        raise ValueError("a peer has the name 'tuned' of the design itself: rename it")
    if isinstance(fresh, Members):
        data = [np.asarray(jax.random.key_data(x.keys)) for x in (fresh, drawn)]
        mine, theirs = ({tuple(row) for row in x} for x in data)
        if mine & theirs:
            raise ValueError(
                f"{len(mine & theirs)} of the fresh members are those that are tuned on: a "
                "certificate needs others, as ensemble.fresh(loop, 256, key) draws them"
            )


def require_steps(problem: Problem, wanted: frozenset[str]) -> None:
    """Raise ValueError for an overshoot where there is no step."""
    if "overshoot" not in wanted:
        return
    steps = find_steps(problem.flight.reference, problem.parts)
    if not np.any(np.asarray(steps.known & (steps.target != steps.before))):
        raise ValueError(
            "overshoot is wanted, but the reference makes no step from event to event: give a "
            "scenario with one, and its times as Objective(events=...)"
        )
