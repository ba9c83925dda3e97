"""The tail of an ensemble: thousands of members are searched, and limits kept on the worst."""

import dataclasses
import functools as ft
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Key, PyTree

from jaxquad._compile import brief_options, Jit
from jaxquad._core import as_array, mark_members, on_host
from jaxquad.ensembles import Ensemble, Members
from jaxquad.loops import Loop
from jaxquad.simulation import Scenario

from ._certificate import Certificate
from ._cost import CostResult, Multipliers, SMOOTHING, stack_copies, take_problem
from ._design_result import covers, DesignResult, Distance, Numbers, with_further
from ._evaluate_design import fly, flying_loop
from ._objective import Limit, Worst
from ._parameters import build_design, Coordinates
from ._problem import (
    DeviceChoice,
    linear_loops,
    LinearLoops,
    make_problem,
    Problem,
    require_same_rate,
    TimeSpan,
)
from ._quantities import QUANTITIES


SEARCHES = 5  # at most, until one finds none
SLICE = 2048  # linear loops that are evaluated at once
GUARDS = 16  # members that fly for limits alone
_LOOPS, _FLIGHTS = 8192, 2048  # of a search, unless it has enough members to go on with before
_ENOUGH = 16  # members beyond a limit
_NEAR = 0.1  # nepers within a limit: so near, they are tuned on with those beyond it
_ADDED = 64  # linear loops at most, after a search


class FlightSearch(NamedTuple):
    """What is searched of flights."""

    draw: Callable[[int], Members]  # the slice of that number: members that no tuner has seen
    fly: Callable[[PyTree, Members], dict[str, Float[np.ndarray, "axes members"]]]  # a controller
    problem: Callable[[Members], Problem]  # in which these fly for limits alone
    guards: Members  # who does so before anything is known
    size: int  # of a slice


class Search(NamedTuple):
    """What is searched; limits have arrays [problems, ...]."""

    linear: Callable[[int], LinearLoops] | None  # a slice, as of `FlightSearch`
    flights: FlightSearch | None
    limits: tuple[Limit, ...]  # that those members have to keep
    aimed: tuple[Limit, ...]  # what is enforced once members of the tail are known


class Tail(NamedTuple):
    """What was searched, and what came of it."""

    searches: int = 0
    searched: int = 0  # linear loops, in all searches
    flown: int = 0  # flights, in all searches
    beyond: int = 0  # members of the last search beyond a limit
    added: int = 0  # to those that limits are kept on
    certificates: int = 0  # each on other members; all but the last found members to tune on

    def with_search(self, beyond: "Beyond") -> "Tail":
        """After one more search."""
        return self._replace(
            searches=self.searches + 1,
            searched=self.searched + beyond.searched,
            flown=self.flown + beyond.flights,
            beyond=beyond.count,
        )


class WorstLoops(NamedTuple):
    """Linear loops to keep limits on: where they lie in their slices, the worst first."""

    slices: list[LinearLoops]
    places: list[tuple[int, int]]  # slice, and place in it

    def put_into(self, limited: LinearLoops, places: Int[np.ndarray, " some"]) -> LinearLoops:
        """They take the `places` of others."""
        slices, chosen = np.array(self.places).T
        for k in np.unique(slices):
            mine = slices == k
            limited = limited.replaced(places[mine], self.slices[k], chosen[mine])
        return limited


class Beyond(NamedTuple):
    """Members that are beyond a limit; the worst of them, to tune on."""

    loops: WorstLoops | None
    members: Members | None  # who fly
    count: int  # how many there are in all
    searched: int = 0  # linear loops
    flights: int = 0

    @property
    def added(self) -> int:
        """How many there are to tune on."""
        loops = 0 if self.loops is None else len(self.loops.places)
        return loops + (0 if self.members is None else self.members.size)

    def __str__(self) -> str:
        flights = f" and {self.flights} flights" * bool(self.flights)
        return f"tail: {self.count} of {self.searched} linear loops{flights} are beyond limits"


def search_tail(
    search: Search,
    number: int,
    coordinates: Coordinates,
    z: Float[np.ndarray, "problems n"],
    able: Bool[np.ndarray, " problems"],
) -> Beyond:
    """Search for members that are beyond a limit in one of the problems.

    An unstable loop has no number that a limit could pull at: it is left to the certificate.
    """
    designs = [(as_array(z[k]), take_problem(search.limits, int(k))) for k in able.nonzero()[0]]
    beyond = Beyond(None, None, 0)
    if search.linear is not None:
        levels = lambda loops: [_levels(x, coordinates, loops, limits) for x, limits in designs]
        slices, ranked, count = _search(search.linear, number, _LOOPS // SLICE, levels)
        loops = WorstLoops(slices, [place for _, place in ranked[:_ADDED]])
        beyond = Beyond(loops, None, count, len(slices) * SLICE)
    if search.flights is not None:
        fly, most = search.flights.fly, max(1, _FLIGHTS // search.flights.size)
        controllers = [(build_design(coordinates, x), limits) for x, limits in designs]
        levels = lambda flown: [flight_levels(fly(x, flown), limits) for x, limits in controllers]
        slices, ranked, count = _search(search.flights.draw, number, most, levels)
        members = take_members(slices, [place for _, place in ranked[:GUARDS]])
        flights = len(slices) * search.flights.size
        count += beyond.count
        beyond = beyond._replace(members=members, count=count, flights=flights)
    return beyond


Slice = TypeVar("Slice")
Ranked = list[tuple[float, tuple[int, int]]]  # levels, the worst first: slice, and place in it


def _search(
    draw: Callable[[int], Slice],
    number: int,
    most: int,
    levels: Callable[[Slice], Sequence[Float[ArrayLike, " members"]]],
) -> tuple[list[Slice], Ranked, int]:
    """Slices, `most` of them unless there are members enough to go on, and who is near a limit.

    Also returns how many of these are beyond it.
    """
    slices: list[Slice] = []
    ranked: Ranked = []
    count = 0
    for s in range(most):
        slices.append(draw(number * most + s))
        level = np.max([np.asarray(x) for x in levels(slices[s])], axis=0)
        ranked += [(float(level[k]), (s, int(k))) for k in np.flatnonzero(level > -_NEAR)]
        count += int(np.sum(level > 0))
        if count >= _ENOUGH:
            break
    return slices, sorted(ranked, reverse=True), count


_LOST = 5.0  # nepers beyond a limit: the peak of a loop that is unstable, or as good as that


@ft.partial(Jit, options=brief_options)
def _levels(
    z: Float[Array, " n"],
    coordinates: Coordinates,
    loops: LinearLoops,
    limits: tuple[Limit, ...],
) -> Float[Array, " members"]:
    """How far linear loops are beyond limits that every member has to keep, the greatest of all."""
    kept = [limit for limit in limits if is_kept_by_loops(limit)]
    names = {limit.quantity for limit in kept}
    numbers = loops.numbers(coordinates.controller_at(z), names, SMOOTHING)
    values = {name: QUANTITIES[name].combine_axes(numbers[name], worst=True) for name in names}
    level = jnp.max(jnp.stack([limit.beyond(values[limit.quantity]) for limit in kept]), axis=0)
    return jnp.where(level < _LOST, level, -jnp.inf)


def flight_levels(
    numbers: Mapping[str, Float[np.ndarray, "axes members"]], limits: Sequence[Limit]
) -> Float[np.ndarray, " members"]:
    """How far flights are beyond limits that every member has to keep, the greatest of all."""
    levels = []
    for limit in filter(is_kept_by_flights, limits):
        values, sign = numbers[limit.quantity], QUANTITIES[limit.quantity].sign
        worst = sign * np.max(sign * values, axis=0)
        levels.append(_level(limit.quantity, worst, limit.bound))
    return np.max(levels, axis=0)


def _level(quantity: str, values: Numbers, bound: Float[ArrayLike, ""]) -> Numbers:
    """How far values are beyond a bound; minus infinity for those that are no number."""
    shown = QUANTITIES[quantity]
    level = np.asarray(shown.sign * (shown.level(values) - shown.level(on_host(bound))))
    return np.where(np.isfinite(level), level, -np.inf)


def is_kept_by_loops(limit: Limit) -> bool:
    """Whether it is a limit of the linear loop that every member has to keep."""
    return QUANTITIES[limit.quantity].linear and isinstance(limit.over, Worst)


def is_kept_by_flights(limit: Limit) -> bool:
    """Whether it is a limit of the flight that every member has to keep."""
    return not QUANTITIES[limit.quantity].linear and isinstance(limit.over, Worst)


def certified_beyond(certificate: Certificate, drawn: Sequence[Members]) -> Beyond:
    """The members of a certificate that are beyond a limit.

    `drawn` are those that flew, and the further ones.
    """
    missed = [x for x in certificate.distances if x.beyond and covers(x)]
    linear = [x for x in missed if QUANTITIES[x.quantity].linear]
    every = with_further(certificate.design, certificate.further)
    loops = [divmod(k, drawn[0].size) for k in _rank(every, linear)]
    flown = [(0, k) for k in _rank(certificate.design, [x for x in missed if x not in linear])]
    slices = [linear_loops(x, None) for x in drawn] if loops else []
    return Beyond(
        WorstLoops(slices, loops[:_ADDED]),
        take_members(drawn, flown[:GUARDS]),
        len(loops) + len(flown),
    )


def _rank(design: DesignResult, missed: Sequence[Distance]) -> list[int]:
    """The members that are beyond limits, the worst first; without those that have no number."""
    if not missed:
        return []
    values = [design.of(x.quantity, worst_axis=True) for x in missed]
    pairs = zip(missed, values, strict=True)
    level = np.max([_level(x.quantity, value, x.bound) for x, value in pairs], axis=0)
    return [int(k) for k in np.argsort(-level, kind="stable") if level[k] > 0]


def half_of_reserve(
    limits: Sequence[Limit], allowed: Sequence[Limit]
) -> Float[np.ndarray, "problems limits"]:
    """Half of the level from what is aimed at to what is allowed: near enough to search again."""
    level = lambda limit: np.asarray(QUANTITIES[limit.quantity].level(on_host(limit.bound)))
    pairs = zip(limits, allowed, strict=True)
    return np.stack([0.5 * np.abs(level(a) - level(b)) for a, b in pairs], axis=1)


def _rank_places(
    result: CostResult,
    kept: Sequence[bool],
    able: Bool[np.ndarray, " problems"],
    first: int = 0,
) -> Int[np.ndarray, " members"]:
    """Members from the `first` on, those before that are furthest within the limits `kept`."""
    levels = np.max(
        [np.asarray(x)[able, first:] for x, mine in zip(result.beyond, kept, strict=True) if mine],
        axis=(0, 1),
    )
    return np.argsort(np.where(np.isfinite(levels), levels, -np.inf), kind="stable")


def put_loops(
    worst: WorstLoops,
    problem: Problem,
    multipliers: Multipliers,
    result: CostResult,
    limits: Sequence[Limit],
    able: Bool[np.ndarray, " problems"],
) -> tuple[Problem, Multipliers]:
    """Limits are kept on the worst in place of the least critical; their multipliers begin at 0."""
    assert problem.limited is not None
    kept = [is_kept_by_loops(limit) for limit in limits]
    places = _rank_places(result, kept, able)[: len(worst.places)]
    values = [np.array(x) for x in multipliers.values]
    for value in (x for x, mine in zip(values, kept, strict=True) if mine):
        value[:, places] = 0.0
    limited = worst.put_into(problem.limited, places)
    return dataclasses.replace(problem, limited=limited), _with_values(multipliers, values)


def put_flights(
    worst: Members,
    search: FlightSearch,
    guards: Members,
    problem: Problem,
    multipliers: Multipliers,
    result: CostResult,
    limits: Sequence[Limit],
    able: Bool[np.ndarray, " problems"],
) -> tuple[Members, Problem, Multipliers]:
    """The worst fly in place of the least critical guards; their multipliers begin at 0."""
    kept, first = [is_kept_by_flights(limit) for limit in limits], problem.counted
    stay = np.sort(_rank_places(result, kept, able, first)[worst.size :])
    places = [(0, int(k)) for k in stay] + [(1, k) for k in range(worst.size)]
    guards = take_members([guards, worst], places) or guards
    values = [np.array(x) for x in multipliers.values]
    for k in np.flatnonzero(kept):
        moved = [values[k][:, :first], values[k][:, first + stay]]
        values[k] = np.concatenate([*moved, np.zeros((len(values[k]), worst.size))], axis=1)
    flown = dataclasses.replace(search.problem(guards), limited=problem.limited)
    return guards, flown, _with_values(multipliers, values)


def _with_values(multipliers: Multipliers, values: Sequence[np.ndarray]) -> Multipliers:
    return multipliers._replace(values=tuple(map(as_array, values)))


def take_members(slices: Sequence[Members], places: Sequence[tuple[int, int]]) -> Members | None:
    """The members at these places, (slice, place in it); None without any. Compiles nothing."""
    if not places:
        return None
    chosen = [[k for s, k in places if s == slice] for slice in range(len(slices))]
    order = np.argsort([p for s in range(len(slices)) for p, at in enumerate(places) if at[0] == s])
    used = [(x, np.array(k, int)) for x, k in zip(slices, chosen, strict=True)]
    longest = max(x.longest_delay for x in slices)
    alike = [dataclasses.replace(x, longest_delay=longest) for x in slices]

    def pick(per_member: bool, *parts: Array) -> Array:
        if not per_member:
            return parts[0]
        keys = jnp.issubdtype(parts[0].dtype, jax.dtypes.prng_key)
        arrays = [np.asarray(jax.random.key_data(x)).T if keys else np.asarray(x) for x in parts]
        taken = [x[..., k] for x, (_, k) in zip(arrays, used, strict=True)]
        together = np.concatenate(taken, axis=-1)[..., order]
        return jax.random.wrap_key_data(as_array(together.T)) if keys else as_array(together)

    marks = mark_members(alike[0], (alike[0].size,))
    return jax.tree.map(pick, marks, *alike)


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
    linear = any(QUANTITIES[limit.quantity].linear for limit in job.limits)
    if isinstance(job.ensemble, Members) or not linear:
        return problem
    # More members where there are limits of the linear loop, whose worst case is in a corner.
    limited = job.ensemble.draw(job.loop, _WIDE, jax.random.fold_in(job.key, 1))
    return dataclasses.replace(problem, limited=linear_loops(limited, job.devices))


def make_search(
    job: Job, drawn: Members, *, reserve: float, starts: int, size: int
) -> Search | None:
    """Members to search for those beyond limits, and the limits that those found have to keep.

    `size` is that of a slice of flights.
    """
    loop, ensemble, limits = job.loop, job.ensemble, job.limits
    if isinstance(ensemble, Members) or not any(isinstance(x.over, Worst) for x in limits):
        return None
    fresh = lambda salt, count: ensemble.fresh(loop, count, jax.random.fold_in(job.key, salt))

    def fly_members(controller: PyTree, members: Members) -> dict[str, np.ndarray]:
        loop = flying_loop(controller, members)
        return fly(loop, members.flight(job.scenario), job.span, job.devices).numbers

    def problem(guards: Members) -> Problem:
        """In which the guards fly, too, for limits alone."""
        places = [(k, i) for k, some in enumerate((drawn, guards)) for i in range(some.size)]
        flown = take_members([drawn, guards], places)
        assert flown is not None
        return make_problem(
            job.loop.controller, flown, job.scenario,
            span=job.span, devices=job.devices, counted=drawn.size,
        )  # fmt: skip

    flights = FlightSearch(
        lambda k: fresh(_FLOWN + k, size), fly_members, problem, fresh(_GUARDING, GUARDS), size
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


def tighten(limit: Limit, reserve: float) -> Limit:
    """The limit with a reserve; raise ValueError for one outside of 0 <= reserve < 1."""
    if not 0 <= reserve < 1:
        raise ValueError(
            f"reserve is {reserve}: give the share by which limits are tightened, as 0.03"
        )
    share = limit.sign * np.sign(np.asarray(limit.bound)) * reserve
    name = "at_least" if limit.at_most is None else "at_most"
    return Limit(limit.quantity, **{name: on_host(limit.bound) * (1 - share)}, over=limit.over)
