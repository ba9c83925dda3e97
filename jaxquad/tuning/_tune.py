from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from jaxquad.ensembles import Ensemble, Members
from jaxquad.identify import Free
from jaxquad.simulation import Scenario

from ._certificate import lag_remark
from ._certify import certify
from ._checks import require_judges, require_kinds, require_steps
from ._copies import copies
from ._gauss_newton import GaussNewton
from ._lbfgs import LBFGS
from ._objective import Limit, Objective
from ._parameters import Coordinates, coordinates, design_at
from ._phases import Solution, solve
from ._problem import Problem, problem_of
from ._progress import Listener, Progress
from ._quantities import OF_THE_LOOP
from ._tuned import Kept, optima, scattered, Tuned


_ACTIVE = 1e-3  # the multiplier's sum above which a limit costs something


def kept_limits(limits: Sequence[Limit], solution: Solution, index: int) -> tuple[Kept, ...]:
    """Each limit as it was given, on the members that were tuned on."""
    kept = []
    for k, limit in enumerate(limits):
        values = jnp.asarray(solution.told.bounded[k][index])
        excess = float(limit.excess(values))
        found = float(limit.bound) + limit.sign * excess
        acts = float(solution.pull.multipliers[k][index].sum()) > _ACTIVE
        kept.append(Kept(limit, found, excess <= 0, acts))
    return tuple(kept)


def remarks_of(
    controller: Any, problem: Problem, solution: Solution, index: int, kept: Sequence[Kept]
) -> Iterator[str]:
    slowest = np.asarray(solution.told.numbers["abscissa"][index])
    if not solution.able[index]:
        count = int(np.sum(slowest >= 0))
        yield (
            f"{count} of the {slowest.size} members that were tuned on cannot be stabilised from "
            f"here (slowest pole {slowest.max():+.3g} 1/s), so nothing was optimised: start "
            "slower, or narrow the ensemble"
        )
    elif not solution.stabilised[index]:
        yield f"the slowest pole of a member decays at {-slowest.max():.3g} 1/s only"
    missed = [one for one in kept if not one.met]
    for one in missed:
        yield f"the limit on {one.limit} cannot be met: {one.found:.4g} at best"
    if missed or not solution.able[index]:
        remark = lag_remark(controller, problem.loops.delay, problem.loops.axes.lag)
        if remark is not None:
            yield remark
    if solution.refusal and not solution.converged[index]:
        yield f"steps were taken back where the controller refuses its gains: {solution.refusal}"
    if not solution.converged[index] and solution.able[index]:
        yield f"the descent has not converged: {solution.reasons[index]}"


_WIDE = 512


def tune(
    controller: Any,
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
    method: LBFGS | GaussNewton | None = None,
    peers: Mapping[str, Any] | None = None,
    key: Key[Array, ""] | None = None,
    progress: bool | None = None,
    listener: Listener | None = None,
    devices: int | Sequence[Any] | None = None,
) -> Tuned:
    """Tune a controller by gradient through the closed loop, for all of an ensemble at once.

    First the slowest pole of every one of the `members` is moved to the left of the knee of the
    objective's penalty on the abscissa (-0.5 1/s without one), which needs no flights; then the
    `objective` is minimised through their flights of the `scenario`, see `jq.Objective`. `limits`
    are kept by an augmented Lagrangian, those of the linear loop on 512 further members, and by
    `reserve` (0.03 is 3 %) more than they ask, because fresh members reach further than those that
    were tuned on. A design whose certificate fails is
    returned too, and says so first.

    `controller` is the start: a `jq.LADRC`, `jq.PID`, one of them scheduled, an adaptive LADRC, or
    a module of one's own with `linear`, then with `free` naming the numbers to tune, as in
    `jq.fit`. None frees wc, wo and b0 or the map's knots, of a PID all gains that are not 0. Gains
    keep their sign; knots of an `jq.control.InertiaMap` fall. With several `starts`, others are scattered
    about the first (normal, by `scatter` nepers) and solved in lockstep; `Tuned.minima` lists where
    they led, and the best is returned. `method` is `jq.tuning.LBFGS` or `jq.tuning.GaussNewton`. `fresh` says on
    how many new members the certificate judges the design beside its `peers`, or on which; None
    does without. `progress` writes a line per evaluation on stderr, by default if that is a
    terminal; `listener` is called with each. The members' loops are split over `devices`, see
    `jq.evaluate`.
    Needs float64. Raises ValueError for parts that do not fit together.
    Source: EQUATIONS.md, section 3.
    """
    objective = Objective() if objective is None else objective
    method = LBFGS() if method is None else method
    require_kinds(ensemble, objective, limits, method)
    key = jax.random.key(0) if key is None else key
    span = {name: getattr(objective, name) for name in ("events", "start", "stop", "load_start")}
    free_ones, watched = coordinates(controller, free), Progress(progress, listener)
    drawn = ensemble if isinstance(ensemble, Members) else ensemble.draw(members, key)
    require_judges(fresh, drawn, peers)
    wide = _wide(ensemble, limits, key)
    problem = problem_of(controller, drawn, scenario, wide, **span, devices=devices)
    require_steps(problem, objective.quantities | {limit.quantity for limit in limits})
    solution = _solved(
        free_ones, problem, scattered(free_ones.start, starts, scatter, seed=0),
        objective, [_tightened(limit, reserve) for limit in limits],
        method, watched,
    )  # fmt: skip
    seconds, best = watched.seconds, _best(solution)
    tuned = design_at(free_ones, jnp.asarray(solution.z[best]))
    judged = None
    if fresh is not None and not (isinstance(ensemble, Members) and isinstance(fresh, int)):
        watched.say("certificate on fresh members ...")
        others, count = (fresh, 0) if isinstance(fresh, Members) else (ensemble, fresh)
        judged = certify(
            tuned,
            others,
            scenario,
            limits=limits,
            peers=peers,
            members=count,
            key=key,
            **span,
            devices=devices,
        )
    kept = kept_limits(limits, solution, best)
    return Tuned(
        controller=tuned,
        certificate=judged,
        stabilised=bool(solution.stabilised[best]),
        converged=bool(solution.converged[best]),
        cost=float(solution.cost[best]),
        values=free_ones.values(solution.z[best]),
        limits=kept,
        minima=optima(solution.cost, solution.z, solution.converged, free_ones.values),
        evaluations=int(solution.evaluations[best]),
        stabilising=int(solution.stabilising[best]),
        history=tuple(watched.history),
        seconds=seconds,
        remarks=tuple(remarks_of(tuned, problem, solution, best, kept)),
    )


def _wide(
    ensemble: Ensemble | Members, limits: Sequence[Limit], key: Key[Array, ""]
) -> Members | None:
    """More members where there are limits of the linear loop, whose worst case is in a corner."""
    if isinstance(ensemble, Members) or not any(x.quantity in OF_THE_LOOP for x in limits):
        return None
    return ensemble.draw(_WIDE, jax.random.fold_in(key, 1))


def stabilising_rate(objective: Objective) -> float:
    """The abscissa in 1/s that every member is brought to before anything is flown."""
    knees = [float(p.knee) for p in objective.penalties if p.quantity == "abscissa"]
    return min([*knees, -0.1]) if knees else -0.5


def _solved(
    free_ones: Coordinates,
    problem: Problem,
    start: np.ndarray,
    objective: Objective,
    limits: Sequence[Limit],
    method: Any,
    watched: Progress,
) -> Solution:
    count = len(start)
    return solve(
        free_ones, problem, start, copies(objective, count), copies(tuple(limits), count),
        method=method, rate=stabilising_rate(objective), progress=watched,
    )  # fmt: skip


def _tightened(limit: Limit, reserve: float) -> Limit:
    if not 0 <= reserve < 1:
        raise ValueError(f"reserve is {reserve}: give the share by which limits are kept, as 0.03")
    share = limit.sign * np.sign(np.asarray(limit.bound)) * reserve
    name = "at_least" if limit.at_most is None else "at_most"
    return Limit(limit.quantity, **{name: limit.bound * (1 - share)}, over=limit.over)


def _best(solution: Solution) -> int:
    """The lowest cost among the starts that are stable and miss limits least."""
    missed = np.maximum(solution.beyond, 0).sum(axis=1) if solution.beyond.size else 0.0
    missed = np.where(np.asarray(missed) > 5e-3, missed, 0.0)
    cost = np.where(np.isnan(solution.cost), np.inf, solution.cost)
    return int(np.lexsort((cost, np.broadcast_to(missed, cost.shape), np.isinf(cost)))[0])
