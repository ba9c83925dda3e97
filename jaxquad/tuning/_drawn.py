"""Members that a controller is tuned on, and those that are searched for the worst."""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Key, PyTree

from jaxquad._core import on_host
from jaxquad.ensembles import Ensemble, Members
from jaxquad.loops import Loop
from jaxquad.simulation import Scenario

from ._cost import stack_copies
from ._evaluate_design import flying_loop
from ._flown import fly
from ._objective import Limit, Worst
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
    FlightSearch,
    GUARDS,
    is_kept_by_flights,
    is_kept_by_loops,
    Search,
    SLICE,
    take_members,
)


_WIDE = 256  # members more, whose linear loops have to keep limits
_FIRST = 2  # folded into the key of the first slice of loops that is searched
_FLOWN = 0xF17E  # and of the first slice of flights
_GUARDING = 0x6A2D  # of those that fly for limits alone
_MARGIN = 0.01  # of the reserve, what is left once the worst of a search are tuned on


class Job(NamedTuple):
    """What is tuned, and for what."""

    loop: Loop  # its controller is the start
    ensemble: Ensemble | Members
    scenario: Scenario
    limits: tuple[Limit, ...]
    span: TimeSpan
    devices: DeviceChoice
    key: Key[Array, ""]  # of all draws


def draw_or_take(
    loop: Loop, ensemble: Ensemble | Members, count: int, key: Key[Array, ""]
) -> Members:
    """`count` members of an ensemble, or the members that were given."""
    if isinstance(ensemble, Ensemble):
        return ensemble.draw(loop, count, key)
    require_same_rate(loop, ensemble)
    return ensemble


def pose_problem(job: Job, drawn: Members, search: Search | None) -> Problem:
    """The problem on the members `drawn`, and on those that guard limits."""
    if search is None or search.flights is None:
        controller, span = job.loop.controller, job.span
        problem = make_problem(controller, drawn, job.scenario, span=span, devices=job.devices)
    else:
        problem = search.flights.problem(search.flights.guards)
    limited = _draw_limited(job)
    if limited is None:
        return problem
    return dataclasses.replace(problem, limited=linear_loops(limited, job.devices))


def _draw_limited(job: Job) -> Members | None:
    """More members where there are limits of the linear loop, whose worst case is in a corner."""
    linear = any(QUANTITIES[limit.quantity].linear for limit in job.limits)
    if isinstance(job.ensemble, Members) or not linear:
        return None
    return job.ensemble.draw(job.loop, _WIDE, jax.random.fold_in(job.key, 1))


def make_search(
    job: Job, drawn: Members, *, reserve: float, starts: int, size: int
) -> Search | None:
    """Members to search for those beyond limits, and the limits that those found have to keep.

    `size` is that of a slice of flights.
    """
    loop, ensemble, limits = job.loop, job.ensemble, job.limits
    if isinstance(ensemble, Members) or not any(isinstance(x.over, Worst) for x in limits):
        return None
    fresh = lambda own, count: ensemble.fresh(loop, count, jax.random.fold_in(job.key, own))
    around = lambda controller, members: _fly_around(job, controller, members)
    problem = lambda guards: _guarded(job, drawn, guards)
    flights = FlightSearch(
        lambda k: fresh(_FLOWN + k, size), around, problem, fresh(_GUARDING, GUARDS), size
    )
    loops = lambda k: linear_loops(fresh(_FIRST + k, SLICE), job.devices)
    small = min(reserve, _MARGIN)
    aimed = [tighten(x, small if isinstance(x.over, Worst) else reserve) for x in limits]
    return Search(
        loops if any(map(is_kept_by_loops, limits)) else None,
        flights if any(map(is_kept_by_flights, limits)) else None,
        stack_copies(limits, starts),
        stack_copies(tuple(aimed), starts),
    )


def _fly_around(job: Job, controller: PyTree, members: Members) -> dict[str, np.ndarray]:
    around = flying_loop(controller, members)
    return fly(around, members.flight(job.scenario), job.span, job.devices).numbers


def _guarded(job: Job, drawn: Members, guards: Members) -> Problem:
    """The problem in which the guards fly, too, for limits alone."""
    places = [(k, i) for k, some in enumerate((drawn, guards)) for i in range(some.size)]
    flown = take_members([drawn, guards], places)
    assert flown is not None
    return make_problem(
        job.loop.controller, flown, job.scenario,
        span=job.span, devices=job.devices, counted=drawn.size,
    )  # fmt: skip


def tighten(limit: Limit, reserve: float) -> Limit:
    """The limit with a reserve; raise ValueError for one outside of 0 <= reserve < 1."""
    if not 0 <= reserve < 1:
        raise ValueError(
            f"reserve is {reserve}: give the share by which limits are tightened, as 0.03"
        )
    share = limit.sign * np.sign(np.asarray(limit.bound)) * reserve
    name = "at_least" if limit.at_most is None else "at_most"
    return Limit(limit.quantity, **{name: on_host(limit.bound) * (1 - share)}, over=limit.over)
