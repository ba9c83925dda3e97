"""One design on every member of an ensemble: its flights, its linear loops, their statistics."""

import dataclasses
import functools as ft
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree

from jaxquad._compile import brief_options, Jit
from jaxquad._core import as_array, map_in_threads
from jaxquad.control import (
    LADRC,
    LinearisableController,
    ObserverController,
    PID,
    schedule_for_analysis,
)
from jaxquad.ensembles import Ensemble, Members
from jaxquad.loops import CarriesPayload, Loop, loop_numbers, LoopNumbers
from jaxquad.simulation import (
    check_run,
    Devices,
    find_authority,
    find_steps,
    FlightMetrics,
    loop_over_devices,
    over_cores,
    placed,
    SampleResult,
    scan_loop,
    Scenario,
    Window,
    window,
)

from ._objective import LINEAR, QUANTITIES, split_quantities
from ._problem import decouple, DeviceChoice, TimeSpan


Numbers = Float[np.ndarray, " members"]


class DesignResult(eqx.Module):
    """One design on every member of an ensemble: the numbers that a certificate is made of.

    Of several axes, integrals are summed and other quantities are those of the worst axis. Numbers
    are in SI units, see `jq.simulation.Metrics` and `jq.loops.LoopAnalysis`. Those of the linear
    loop are NaN where it is unstable, except the abscissa; any is NaN where the scenario or the
    controller does not have it.
    """

    by_axis: dict[str, Float[np.ndarray, "axes members"]]
    unstable: Bool[np.ndarray, " members"] | None  # by the exact poles; None without a linear form
    diverged: Bool[np.ndarray, " members"]
    lost: Bool[np.ndarray, " members"]  # diverged, or carried off beyond the model's range
    observer_instability: str = ""  # why an observer of the controller is unstable by itself
    # ITAE from event to event, rad s^2
    by_part: Float[np.ndarray, "parts axes members"] | None = None

    @property
    def members(self) -> int:
        """How many members there are."""
        return self.diverged.size

    @property
    def unstable_count(self) -> int | None:
        """How many members are linearly unstable; None without a linear form."""
        return None if self.unstable is None else int(np.sum(self.unstable))

    def of(self, quantity: str, *, worst_axis: bool = False) -> Numbers:
        """One number for each member, with `worst_axis` of its worst axis for integrals, too.

        Raise ValueError for a name that is not in `by_axis`.
        """
        if quantity not in self.by_axis:
            computed = ", ".join(self.by_axis)
            raise ValueError(f"{quantity!r} was not computed: choose one of {computed}")
        if QUANTITIES[quantity].summed and not worst_axis:
            return np.sum(self.by_axis[quantity], axis=0)
        sign, by_axis = QUANTITIES[quantity].sign, self.by_axis[quantity]
        some = ~np.isnan(by_axis)
        worst = sign * np.max(np.where(some, sign * by_axis, -np.inf), axis=0)
        worst = np.where(some.any(axis=0), worst, np.nan)
        needs_stability = QUANTITIES[quantity].linear and quantity != "abscissa"
        if self.unstable is not None and needs_stability:
            return np.where(self.unstable, np.nan, worst)
        return worst

    def worst_member(self, quantity: str) -> int | None:
        """The index of the member with the worst finite number; None without any."""
        values = QUANTITIES[quantity].sign * self.of(quantity)
        finite = np.isfinite(values)
        return int(np.argmax(np.where(finite, values, -np.inf))) if finite.any() else None

    def content(self) -> Mapping[str, object]:
        """Every member's numbers, for `jaxquad.report.write_json`."""
        flags = {"unstable": self.unstable, "diverged": self.diverged, "lost": self.lost}
        return flags | {name: self.of(name) for name in self.by_axis}


class LinearMembers(NamedTuple):
    """Further members of an ensemble, of which only the linear loops were analysed."""

    design: DesignResult  # numbers of the linear loop; none of these members has flown
    facts: dict[str, Float[np.ndarray, "axes members"]]  # as in `Certificate`

    def content(self) -> dict[str, object]:
        """How many there are, and how the linear loops of the design do on them."""
        design = self.design
        worst = {name: design.worst_member(name) for name in design.by_axis}
        values = {n: None if k is None else design.of(n)[k] for n, k in worst.items()}
        return {"members": design.members, "unstable": design.unstable_count, "worst": values}


def with_further(design: DesignResult, further: LinearMembers | None) -> DesignResult:
    """The linear loops of the members that flew, and of those that did not, in this order."""
    if further is None:
        return design
    join = lambda a, b: np.concatenate([a, b], axis=-1)
    mine, other = design, further.design
    names = [name for name in mine.by_axis if name in other.by_axis]
    assert mine.unstable is not None and other.unstable is not None
    return DesignResult(
        {name: join(mine.by_axis[name], other.by_axis[name]) for name in names},
        join(mine.unstable, other.unstable),
        join(mine.diverged, other.diverged),
        join(mine.lost, other.lost),
        mine.observer_instability,
    )


def upper_bound(count: int, draws: int) -> float:
    """The exact one-sided bound of a share: the true one exceeds it in at most 5 % of cases.

    `count` of `draws` independent members showed the event. None of 256 bounds the share by 1.2 %,
    none of 2304 by 0.13 %.
    Source: Clopper and Pearson, Biometrika 26 (1934).

    **Raises:** ValueError for fewer draws than counted.
    """
    if not (0 <= count <= draws and draws >= 1):
        raise ValueError(f"{count} of {draws} members: give 1 draw or more, and a count among them")
    if count == draws:
        return 1.0
    from scipy.special import betaincinv

    return float(betaincinv(count + 1, draws - count, 0.95))


class Statistics(NamedTuple):
    """One quantity over the members that have it; NaN without any."""

    mean: float
    p95: float  # of margins, the value that 5 % of the members fall below
    worst: float
    members: int  # that have it: a linear quantity exists for stable loops only
    worst_member: int | None


class DesignSummary(NamedTuple):
    """One design of a certificate, over all members."""

    members: int
    unstable: int | None  # by the exact poles of the linear loop; None without a linear form
    unstable_at_most: float | None  # share, with 95 % confidence
    diverged: int
    lost: int  # diverged, or carried off beyond the model's range
    statistics: dict[str, Statistics]

    def content(self) -> Mapping[str, object]:
        """Everything, for `jaxquad.report.write_json`."""
        plain = {name: one._asdict() for name, one in self.statistics.items()}
        return self._asdict() | {"statistics": plain}


def summarise_design(design: DesignResult, *, independent: bool) -> DesignSummary:
    """Statistics of every computed quantity; the bound only for `independent` members."""
    count = design.unstable_count
    bound = None if count is None else upper_bound(count, design.members)
    return DesignSummary(
        members=design.members, unstable=count, unstable_at_most=bound if independent else None,
        diverged=int(np.sum(design.diverged)), lost=int(np.sum(design.lost)),
        statistics={name: _statistics(design, name) for name in design.by_axis},
    )  # fmt: skip


def _statistics(design: DesignResult, name: str) -> Statistics:
    values, sign = design.of(name), QUANTITIES[name].sign
    numbers, member = values[~np.isnan(values)], design.worst_member(name)
    partial = numbers.size < values.size and not QUANTITIES[name].linear
    if not numbers.size or partial:
        return Statistics(np.nan, np.nan, np.nan, numbers.size, member)
    ordered = np.sort(sign * numbers)
    # Infinite as soon as it rests on an infinite value.
    method = "linear" if np.isfinite(ordered).all() else "higher"
    p95 = float(np.quantile(ordered, 0.95, method=method))
    worst = float(sign * ordered[-1])
    return Statistics(float(np.mean(numbers)), sign * p95, worst, numbers.size, member)


def evaluate_design(
    controller: PyTree, members: Members, flight: Scenario, span: TimeSpan, devices: DeviceChoice
) -> DesignResult:
    """`controller` on all `members`, in a `flight` that has their noise in it."""
    flown = fly_members(controller, members, flight, span, devices)
    numbers = flown.numbers
    linear = _linear(controller, members, flight)
    if linear is not None:
        numbers |= {name: linear._asdict()[name] for name in LINEAR}
    unstable = None if linear is None else ~np.all(linear.stable, axis=0)
    observed = isinstance(controller, ObserverController)
    why = controller.observer_instability() if observed else ""
    # Carried off: the error exceeds all that the reference moves by more than a quarter turn.
    reference = np.asarray(flight.reference)
    moved = max(float(np.max(reference)), 0.0) - min(float(np.min(reference)), 0.0)
    lost = flown.diverged | ~(flown.greatest <= _TILTED + moved)
    return DesignResult(numbers, unstable, flown.diverged, lost, why, flown.by_part)


def fly_members(
    controller: PyTree, members: Members, flight: Scenario, span: TimeSpan, devices: DeviceChoice
) -> "Flown":
    """All members around a controller, its gains as wide as all of its kind have."""
    loop = members.loop(controller)
    loop = loop.with_controller(_widen(loop.controller, members.axes, members.size))
    flown = _fly(loop, flight, span, devices)
    if flown.diverged.ndim:
        return flown
    wide = lambda x: np.broadcast_to(x[..., None], (*x.shape, members.size))
    return jax.tree.map(wide, flown)  # of members that do not differ, one flew


_MULTIPLE, _MOST = 8, 2048  # of members that fly, and at most


def analyse_further(
    loop: Loop, ensemble: Ensemble, scenario: Scenario, key: Key[Array, ""], *, flown: int,
    count: int | None,
) -> LinearMembers | None:  # fmt: skip
    """Of at least `count` further members, in slices of as many as have `flown`."""

    def analyse(drawn: Members) -> tuple[LoopNumbers | None, dict[str, np.ndarray]]:
        still = dataclasses.replace(drawn, noise=None, gust=None)
        return _linear(loop.controller, drawn, still.flight(scenario)), member_facts(drawn)

    parts = map_in_threads(analyse, _draw_further(loop, ensemble, key, flown, count))
    loops = [linear for linear, _ in parts if linear is not None]
    if not loops:
        return None
    facts = [some for _, some in parts]
    join = lambda parts: np.concatenate(parts, axis=-1)
    numbers = {name: join([x._asdict()[name] for x in loops]) for name in LINEAR}
    unstable = ~np.all(join([x.stable for x in loops]), axis=0)
    none = np.zeros_like(unstable)
    joined = {name: join([x[name] for x in facts]) for name in facts[0]}
    return LinearMembers(DesignResult(numbers, unstable, none, none), joined)


_FURTHER = 0xF0C5  # folded into the key of members that do not fly


def _draw_further(
    loop: Loop, ensemble: Ensemble, key: Key[Array, ""], flown: int, count: int | None
) -> Iterator[Members]:
    count = min(_MULTIPLE * flown, _MOST) if count is None else count
    keys = jax.random.split(jax.random.fold_in(key, _FURTHER), -(-count // flown))
    for data in np.asarray(jax.random.key_data(keys)):  # in NumPy: to index keys compiles
        slice_key = jax.random.wrap_key_data(as_array(data), impl=jax.random.key_impl(keys))
        yield ensemble.fresh(loop, flown, slice_key)


def certified_members(
    loop: Loop, ensemble: Ensemble, key: Key[Array, ""], *, flown: int
) -> list[Members]:
    """The members of a certificate with that key: those that flew, and the further ones."""
    further = _draw_further(loop, ensemble, key, flown, None)
    return [ensemble.fresh(loop, flown, key), *further]


def member_facts(drawn: Members) -> dict[str, Float[np.ndarray, "axes members"]]:
    """Inertia, torque gain, lag and delay in SI units; assumed_inertia over the true one."""
    plant = decouple(drawn.plant)
    parameters = {"inertia": plant.inertia, "torque_gain": plant.torque_gain, "lag": plant.lag}
    shape = (plant.shape[0], drawn.size)
    wide = lambda x: np.broadcast_to(np.asarray(x) if x.ndim > 1 else x[:, None], shape)
    facts = {n: np.array(wide(x)) for n, x in parameters.items() if x is not None}
    facts["delay"] = np.array(np.broadcast_to(np.asarray(drawn.delay), shape))
    return facts | {"assumed_inertia": np.asarray(drawn.assumed_inertia) / facts["inertia"]}


_TILTED = np.pi / 2  # rad: a vehicle that is turned further pushes downwards
_PER_MEMBER = ("b0", "kp", "ki", "kd", "feedforward")  # what scheduling may change


def _widen(controller: PyTree, axes: int, members: int) -> PyTree:
    """The gains of a LADRC or PID in one shape, so that all of a kind share a compile."""
    if not isinstance(controller, LADRC | PID):
        return controller

    def full(gain: Array, name: str) -> Array:
        shape = (axes, members) if name in _PER_MEMBER or gain.ndim > 1 else (axes,)
        values = np.asarray(gain)
        if values.ndim:
            values = values.reshape(values.shape + (1,) * (len(shape) - values.ndim))
        return as_array(np.broadcast_to(values, shape))

    gains = {name: x for name, x in vars(controller).items() if isinstance(x, Array)}
    return dataclasses.replace(controller, **{name: full(x, name) for name, x in gains.items()})


def _linear(controller: PyTree, members: Members, flight: Scenario) -> LoopNumbers | None:
    scheduled = schedule_for_analysis(controller, members.assumed_inertia)
    if not isinstance(scheduled, LinearisableController):
        return None
    axes = flight.reference.shape[1]
    loop = members.loop(controller).with_controller(_widen(scheduled, axes, members.size))
    plants = [members.plant]
    if flight.payload is not None and isinstance(members.plant, CarriesPayload):
        # With the most and the least that the flight makes it carry.
        extremes = [np.max(flight.payload, axis=0), np.min(flight.payload, axis=0)]
        plants += [members.plant.with_added_inertia(x) for x in extremes if np.any(x != 0)]
    # Of the same members as different plants: stable where all are, else NaN as one of them.
    wide = lambda x: np.broadcast_to(x.reshape(len(x), -1), (len(x), members.size))
    loops = [LoopNumbers(*map(wide, loop_numbers(loop.with_plant(x), range(axes)))) for x in plants]
    stable = np.all([loop.stable for loop in loops], axis=0)
    worst = {"abscissa": np.max([loop.abscissa for loop in loops], axis=0)}
    for name in LoopNumbers._fields[2:]:
        find = np.min if QUANTITIES[name].smaller_is_worse else np.max
        extreme = find([loop._asdict()[name] for loop in loops], axis=0)
        worst[name] = np.where(stable, extreme, np.nan)
    return LoopNumbers(stable, **worst)


_INTEGRALS = ("itae", "iae", "ise")
_OF_PARTS = (*_INTEGRALS, "overshoot", "peak")
_OF_ALL = tuple(
    name for name in split_quantities(QUANTITIES)[0]
    if name not in (*_INTEGRALS, "overshoot", "activity_rate")
)  # fmt: skip


class Flown(NamedTuple):
    numbers: dict[str, Float[np.ndarray, "axes members"]]
    diverged: Bool[np.ndarray, " members"]
    greatest: Float[np.ndarray, " members"]  # rad, the error at any time and of any axis
    by_part: Float[np.ndarray, "parts axes members"]  # ITAE from event to event, rad s^2
    peaks: Float[np.ndarray, "parts axes members"]  # rad, the greatest error from event to event


def _fly(loop: Loop, flight: Scenario, span: TimeSpan, devices: DeviceChoice) -> Flown:
    """From event to event the integrals' clock starts again, and the greatest overshoot counts."""
    check_run(loop, flight)
    samples, dt = len(flight.reference), loop.dt
    span_of_all = window(samples, dt, start=span.start, stop=span.stop, load_start=span.load_start)
    parts = [window(samples, dt, start=a, stop=b, load_start=None) for a, b in span.parts]
    windows = tuple(Window(*map(as_array, x)) for x in (span_of_all, *parts))
    run, places = placed(loop, flight, devices)
    *metrics, diverged = over_cores(_run, run, (windows,), places)
    numbers, by_part = jax.tree.map(lambda x: np.asarray(x, float), tuple(metrics))
    stack = lambda name: np.stack([part[name] for part in by_part])
    overshoot = stack("overshoot")
    some = ~np.isnan(overshoot)  # no part with a step: none
    greatest = np.max(np.where(some, overshoot, -np.inf), axis=0)
    numbers |= {name: stack(name).sum(axis=0) for name in _INTEGRALS}
    numbers["overshoot"] = np.where(some.any(axis=0), greatest, np.nan)
    numbers["activity_rate"] = numbers["activity"] / ((span_of_all[1] + 1 - span_of_all[0]) * dt)
    peaks = stack("peak")
    greatest = np.max(peaks, axis=(0, 1))
    return Flown(numbers, np.asarray(diverged), greatest, stack("itae"), peaks)


_Finished = tuple[dict[str, Array], list[dict[str, Array]], Bool[Array, "*ensemble"]]


@ft.partial(Jit, options=brief_options)
def _run(
    loop: Loop, scenario: Scenario, windows: tuple[Window, ...], devices: Devices | None = None
) -> _Finished:
    return loop_over_devices(_measure, (loop, scenario), windows, devices)


def _measure(run: tuple[Loop, Scenario], windows: tuple[Window, ...]) -> _Finished:
    loop, scenario = run
    authority = find_authority(loop.plant, loop.drive, loop.controller)
    sums = _Parts(
        tuple(
            FlightMetrics(
                wanted=_OF_PARTS if k else _OF_ALL,
                window=span,
                dt=loop.dt,
                steps=find_steps(scenario.reference, [(span.first, span.until)]),
                from_first=jnp.asarray(span.first == 0) if k else None,
                torque_gain=None if authority is None else authority.torque_gain,
                limit=None if authority is None else authority.command,
            )
            for k, span in enumerate(windows)
        )
    )
    total, _, running = scan_loop(loop, scenario, sums)
    numbers, *by_part = [one.finish(x) for one, x in zip(sums.parts, total, strict=True)]
    return numbers, by_part, ~running


class _Parts(eqx.Module):
    """Adds up the numbers of several windows of one flight."""

    parts: tuple[FlightMetrics, ...]

    def begin(self, like: Float[Array, " axes *ensemble"]) -> tuple[PyTree, ...]:
        return tuple(part.begin(like) for part in self.parts)

    def update(self, total: tuple[PyTree, ...], now: SampleResult) -> tuple[tuple, None]:
        pairs = zip(self.parts, total, strict=True)
        return tuple(part.update(sums, now)[0] for part, sums in pairs), None
