"""Gains tuned by gradient through the closed loops of an ensemble, with a certificate."""

import dataclasses
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from jaxquad._core import as_array
from jaxquad.ensembles import Ensemble, Members
from jaxquad.identify import Free
from jaxquad.loops import Loop
from jaxquad.simulation import find_steps, Scenario

from ._certificate import Certificate, lag_remark
from ._certify import certify
from ._cost import Listener, Progress, stack_copies
from ._evaluate_design import certified_members
from ._gauss_newton import GaussNewton, require_squares
from ._lbfgs import LBFGS
from ._objective import Limit, Objective
from ._parameters import build_design, Coordinates, find_bounds, select_coordinates
from ._phases import go_on, Solution, solve
from ._problem import DeviceChoice, Problem, TimeSpan
from ._tail import certified_beyond, draw_or_take, Job, make_search, pose_problem, Search, tighten
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
    key, watched = jax.random.key(0) if key is None else key, Progress(progress, listener)
    job = Job(loop, ensemble, scenario, tuple(limits), TimeSpan.of(objective), devices, key)
    coordinates = select_coordinates(loop.controller, free)
    drawn = draw_or_take(loop, ensemble, members, key)
    require_fresh(fresh, drawn, peers)
    size = fresh if isinstance(fresh, int) else _SIZE
    search = make_search(job, drawn, reserve=reserve, starts=starts, size=size)
    problem = pose_problem(job, drawn, search)
    require_steps(problem, objective.quantities | {limit.quantity for limit in limits})
    tightened = tuple(tighten(limit, reserve) for limit in limits)
    solution = solve(
        coordinates, problem, scatter_starts(coordinates.start, starts, scatter, seed=0),
        stack_copies(objective, starts), stack_copies(tightened, starts), method=method,
        rate=stabilising_rate(objective), progress=watched, search=search,
    )  # fmt: skip
    best, seconds = _best(solution), watched.seconds
    certified = _certify(job, coordinates, watched, fresh, peers, solution, best, search)
    return _tuned(job, coordinates, problem, certified, best, watched, seconds)


_SIZE = 256  # flights in a slice
_CERTIFICATES = 3  # at most
_AGAIN = 0xCE57  # folded into the key of certificates after the first


class _Certified(NamedTuple):
    """Where the descents ended, and what holds there on other members."""

    solution: Solution
    certificate: Certificate | None
    certificates: int  # how many were made
    seconds: float  # of descents between them


def _certify(
    job: Job,
    coordinates: Coordinates,
    watched: Progress,
    fresh: int | Members | None,
    peers: Mapping[str, PyTree] | None,
    solution: Solution,
    best: int,
    search: Search | None,
) -> _Certified:
    """A certificate; and where it has members beyond a limit, tune on these and certify again.

    Members that are given have one certificate. None where none is asked for, or where nothing is
    left to draw it from.
    """
    ensemble = fresh if isinstance(fresh, Members) else job.ensemble
    if fresh is None or isinstance(fresh, int) and isinstance(ensemble, Members):
        return _Certified(solution, None, 0, 0.0)
    count = 0 if isinstance(fresh, Members) else fresh

    def certificate(z: Float[np.ndarray, " n"], key: Key[Array, ""]) -> Certificate:
        watched.say("certificate on fresh members ...")
        design = job.loop.with_controller(build_design(coordinates, as_array(z)))
        return certify(
            design, ensemble, job.scenario, limits=job.limits, peers=peers, members=count,
            begun=job.loop.controller, key=key, devices=job.devices, **job.span._asdict(),
        )  # fmt: skip

    key, certificates, seconds = job.key, 1, 0.0
    latest = certificate(solution.z[best], key)
    while search is not None and isinstance(ensemble, Ensemble) and certificates < _CERTIFICATES:
        members = certified_members(job.loop, ensemble, key, flown=count)
        worst = certified_beyond(latest, members)
        if not worst.added:
            break
        began = time.perf_counter()
        solution = go_on(solution, worst, search, best)
        seconds += time.perf_counter() - began
        key = jax.random.fold_in(job.key, _AGAIN + certificates)
        latest, certificates = certificate(solution.z[best], key), certificates + 1
    return _Certified(solution, latest, certificates, seconds)


def _tuned(
    job: Job,
    coordinates: Coordinates,
    problem: Problem,
    certified: _Certified,
    best: int,
    watched: Progress,
    seconds: float,
) -> Tuned:
    solution, certificate = certified.solution, certified.certificate
    tuned = build_design(coordinates, as_array(solution.z[best]))
    limits = _limit_results(job.limits, solution, best)
    bounds = find_bounds(coordinates, solution.z[best], solution.gradient[best])
    convergence = judge_descent(solution, best, bounds, limits)
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
        limits=limits,
        minima=distinct_optima(solution, coordinates),
        evaluations=int(solution.evaluations[best]),
        stabilising=int(solution.stabilising[best]),
        tail=solution.tail._replace(certificates=certified.certificates),
        history=tuple(watched.history),
        seconds=seconds + certified.seconds,
        remarks=tuple(_remarks(tuned, problem, solution, best, limits)),
    )


def stabilising_rate(objective: Objective) -> float:
    """The abscissa in 1/s that every member is brought to before anything is flown."""
    knees = [float(p.knee) for p in objective.penalties if p.quantity == "abscissa"]
    return min([*knees, -0.1]) if knees else -0.5


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
        reached = float(limit.bound) + limit.sign * excess
        active = float(np.asarray(solution.multipliers.values[k])[index].sum()) > _ACTIVE
        results.append(LimitResult(limit, reached, excess <= 0, active))
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
        missed=[f"{x.limit} cannot be met: {x.reached:.4g} at best" for x in limits if not x.met],
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


def require_fresh(fresh: object, drawn: Members, peers: Mapping[str, PyTree] | None) -> None:
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
    if not np.any(np.asarray(steps.is_single & (steps.target != steps.before))):
        raise ValueError(
            "overshoot is wanted, but the reference makes no step from event to event: give a "
            "scenario with one, and its times as Objective(events=...)"
        )
