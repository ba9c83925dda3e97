"""The tail of an ensemble: thousands of members are searched, and limits kept on the worst."""

import dataclasses
import functools as ft
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from jaxquad._compile import brief_options, Jit
from jaxquad._core import as_array, mark_members, on_host
from jaxquad.ensembles import Members

from ._cost import CostResult, SMOOTHING
from ._design_result import DesignResult, Numbers
from ._objective import Limit, QUANTITIES, Worst
from ._problem import Coordinates, LinearLoops
from ._verdict import Distance


SEARCHES = 5  # at most, until one finds none
SLICE = 2048  # linear loops that are evaluated at once
GUARDS = 16  # members that fly for limits alone
LOOPS, FLIGHTS = 8192, 2048  # of a search, unless it has enough members to go on with before
ADDED = 64  # linear loops at most, after a search
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
    draw: Callable[[int], Members],
    number: int,
    most: int,
    levels: Callable[[Members], Sequence[Float[ArrayLike, " members"]]],
    added: int,
) -> tuple[Members | None, int, int]:
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
    numbers = loops.numbers(coordinates.controller_at(z), names, SMOOTHING)
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
