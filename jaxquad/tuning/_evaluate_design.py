"""One design on many members: their flights, and their linear loops."""

import dataclasses
import functools as ft
from collections.abc import Iterator, Sequence
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
from jaxquad.loops import Loop, loop_numbers, LoopNumbers
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

from ._design_result import DesignResult, LinearMembers
from ._problem import decouple, DeviceChoice, TimeSpan
from ._quantities import LINEAR


def evaluate_design(
    controller: PyTree,
    members: Members,
    flight: Scenario,
    span: TimeSpan,
    devices: DeviceChoice = None,
) -> DesignResult:
    """`controller` on all `members`, in a `flight` that has their noise in it.

    The loop in time holds every limit, the encoder and dry friction. The linear one is exact, and
    is that of a controller with a method `linear`, a scheduled or adaptive one at the inertia that
    it is given.
    """
    flown = fly(flying_loop(controller, members), flight, span, devices)
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
    return DesignResult(numbers, unstable, flown.diverged, lost, why)


def flying_loop(controller: PyTree, members: Members) -> Loop:
    """The loops of all members around a controller, its gains as wide as all of its kind have."""
    loop = members.loop(controller)
    return loop.with_controller(_widen(loop.controller, members.axes, members.size))


_MULTIPLE, _MOST = 8, 2048  # of members that fly, and at most


def analyse_further(
    loop: Loop,
    ensemble: Ensemble,
    scenario: Scenario,
    key: Key[Array, ""],
    *,
    flown: int,
    count: int | None,
) -> LinearMembers | None:
    """The linear loops of at least `count` further members; None without such loops.

    They come in slices of as many members as have `flown`, which compile nothing anew.
    """

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
    if flight.payload is not None:  # with the most and the least that the flight makes it carry
        extremes = [np.max(flight.payload, axis=0), np.min(flight.payload, axis=0)]
        plants += [members.plant.with_added_inertia(x) for x in extremes if np.any(x != 0)]
    return _worst([loop_numbers(loop.with_plant(x), range(axes)) for x in plants], members.size)


def _worst(loops: Sequence[LoopNumbers], members: int) -> LoopNumbers:
    """Of the same members as different plants: stable where all are, else NaN as one of them."""
    wide = lambda x: np.broadcast_to(x.reshape(len(x), -1), (len(x), members))
    loops = [LoopNumbers(*map(wide, loop)) for loop in loops]
    stable = np.all([loop.stable for loop in loops], axis=0)
    worst = {"abscissa": np.max([loop.abscissa for loop in loops], axis=0)}
    for name in LoopNumbers._fields[2:]:
        find = np.min if name.endswith("margin") else np.max
        extreme = find([loop._asdict()[name] for loop in loops], axis=0)
        worst[name] = np.where(stable, extreme, np.nan)
    return LoopNumbers(stable, **worst)


_OF_ALL = ("activity", "energy", "saturation_share", "peak", "rms", "disturbance_rmse")
_INTEGRALS = ("itae", "iae", "ise")
_OF_PARTS = (*_INTEGRALS, "overshoot", "peak")


class Flown(NamedTuple):
    """What a flight was, by members."""

    numbers: dict[str, Float[np.ndarray, "axes members"]]
    diverged: Bool[np.ndarray, " members"]
    greatest: Float[np.ndarray, " members"]  # rad, the error at any time and of any axis


def fly(loop: Loop, flight: Scenario, span: TimeSpan, devices: DeviceChoice = None) -> Flown:
    """Fly the loops of members; `flight` has their noise in it.

    From event to event the clock of the integrals starts again, and the greatest overshoot counts.
    """
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
    return Flown(numbers, np.asarray(diverged), np.max(stack("peak"), axis=(0, 1)))


Finished = tuple[dict[str, Array], list[dict[str, Array]], Bool[Array, "*ensemble"]]


@ft.partial(Jit, options=brief_options)
def _run(
    loop: Loop, scenario: Scenario, windows: tuple[Window, ...], devices: Devices | None = None
) -> Finished:
    return loop_over_devices(_measure, (loop, scenario), windows, devices)


def _measure(run: tuple[Loop, Scenario], windows: tuple[Window, ...]) -> Finished:
    loop, scenario = run
    authority = find_authority(loop.plant, loop.drive, loop.controller)

    def metrics(span: Window, wanted: tuple[str, ...]) -> FlightMetrics:
        return FlightMetrics(
            wanted=wanted,
            window=span,
            dt=loop.dt,
            steps=find_steps(scenario.reference, [(span.first, span.until)]),
            from_first=jnp.asarray(span.first == 0) if wanted is _OF_PARTS else None,
            torque_gain=None if authority is None else authority.torque_gain,
            limit=None if authority is None else authority.command,
        )

    span_of_all, *parts = windows
    sums = _Parts((metrics(span_of_all, _OF_ALL), *(metrics(part, _OF_PARTS) for part in parts)))
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
