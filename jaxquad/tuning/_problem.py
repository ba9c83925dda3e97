"""What a tune works on: the coordinates of a controller, and the members in their flights."""

import dataclasses
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from jaxquad._core import (
    align,
    as_array,
    ensemble_shape,
    mark_members,
    multiply_gains,
    require_signature,
)
from jaxquad.control import (
    find_transform,
    ObserverController,
    schedule_for_analysis,
    schedule_for_flight,
    Transform,
    Tunable,
)
from jaxquad.ensembles import Ensemble, Members
from jaxquad.identify import Free, name_places, Parameters, Place, select_parameters, with_values
from jaxquad.loops import linear_numbers, LinearisablePlant, Loop, Plant
from jaxquad.models import DecoupledAxes, LinearAxis, Multirotor
from jaxquad.simulation import (
    check_run,
    Devices,
    devices_for,
    find_authority,
    find_steps,
    FlightMetrics,
    loop_over_devices,
    over_devices,
    scan_loop,
    Scenario,
    Window,
    window,
)


class Block(eqx.Module):
    """An array that is tuned as a whole, in the coordinates of its `transform`."""

    places: tuple[Place, ...] = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)
    transform: Transform
    start: Float[Array, " numbers"]


class Coordinates(eqx.Module):
    """Tuned numbers as one vector z: logarithms of gains first, then the arrays in `blocks`."""

    controller: PyTree
    parameters: Parameters | None
    blocks: tuple[Block, ...]

    @property
    def start(self) -> Float[np.ndarray, " n"]:
        """z of the controller as it was given."""
        gains = self.parameters
        some = [] if gains is None else [np.asarray(gains.start)[: gains.count]]
        return np.concatenate([*some, *(np.asarray(block.start) for block in self.blocks)])

    @property
    def names(self) -> tuple[str, ...]:
        names = () if self.parameters is None else self.parameters.names
        return names + tuple(place.name for block in self.blocks for place in block.places)

    @property
    def arrays(self) -> frozenset[str]:
        """The names of the arrays that the tuned numbers are in."""
        return frozenset(name.partition("[")[0] for name in self.names)

    def controller_at(self, z: Float[Array, " n"]) -> PyTree:
        controller, first = self.controller, 0
        if self.parameters is not None:
            first = self.parameters.count
            controller = self.parameters.insert(controller, z[:first])
        for block in self.blocks:
            part = z[first : first + len(block.places)].reshape(block.shape)
            values = block.transform.forward(part).reshape(-1)
            controller = with_values(controller, block.places, values)
            first += len(block.places)
        return controller

    def values(self, z: Float[np.ndarray, " n"]) -> dict[str, float]:
        tuned = eqx.filter(build_design(self, as_array(z)), eqx.is_inexact_array)
        leaves = [np.asarray(x).reshape(-1) for x in jax.tree.leaves(tuned)]
        places = {place.name: place for place in name_places(self.controller)}
        at = lambda place: float(leaves[place.leaf][place.index])
        return {name: at(places[name]) for name in self.names}


@eqx.filter_jit
def build_design(coordinates: Coordinates, z: Float[Array, " n"]) -> PyTree:
    """`coordinates.controller_at(z)`, compiled as one."""
    return coordinates.controller_at(z)


def select_coordinates(controller: PyTree, free: Free = None) -> Coordinates:
    """Those in which a controller is tuned: an array with a transform that is named as a whole,
    such as the knots of a `jq.control.InertiaMap`, in the coordinates of that.
    """
    if ensemble := ensemble_shape(controller):
        raise ValueError(
            f"the controller is an ensemble of {ensemble}: give one controller; "
            "a tune makes its own copies for members and starts"
        )
    if free is None and not isinstance(controller, Tunable):
        raise ValueError(
            f"a {type(controller).__name__} does not say which of its numbers are tuned: name "
            'them, free=["kp", "kd"], or give it a method tunable()'
        )
    require_signature(controller, Tunable, "tunable", 0)
    free = list(controller.tunable()) if free is None else free
    places = name_places(controller)
    blocks: list[Block] = []
    chosen, items = (
        (free, []) if callable(free) else ([], [free] if isinstance(free, str) else free)
    )
    for item in items:
        transform = find_transform(controller, item) if isinstance(item, str) else None
        if transform is None:
            chosen.append(item)
            continue
        mine = tuple(p for p in places if p.name == item or p.name.startswith(f"{item}["))
        leaves = jax.tree.leaves(eqx.filter(controller, eqx.is_inexact_array))
        values = np.asarray(leaves[mine[0].leaf])
        start = as_array(np.asarray(transform.inverse(values)).reshape(-1))
        blocks.append(Block(mine, values.shape, transform, start))
    parameters = select_parameters(controller, chosen) if callable(chosen) or chosen else None
    if parameters is None and not blocks:
        raise ValueError('free is empty: name the numbers to tune, as ["wc", "wo"]')
    return Coordinates(controller, parameters, tuple(blocks))


_NEAR, _FLAT = 0.02, 1e-3  # nepers to a bound, and the slope per neper that pushes against it


def find_refusal(controller: PyTree) -> str:
    """Why a controller, unchecked so far, cannot be built or must not be flown; empty if it can."""
    for part in _iter_modules(controller):
        try:
            for kind in type(part).__mro__:  # as when it is made
                if "__check_init__" in vars(kind):
                    vars(kind)["__check_init__"](part)
        except ValueError as error:
            return str(error)
    if not isinstance(controller, ObserverController):
        return ""
    return controller.observer_instability() or controller.observer_slowness()


class Bound(NamedTuple):
    """A tuned number that stands at the end of what the controller allows."""

    name: str
    value: float
    reason: str  # why it can go no further


def find_bounds(
    coordinates: Coordinates, z: Float[np.ndarray, " n"], gradient: Float[np.ndarray, " n"]
) -> tuple[Bound, ...]:
    """The numbers that could lower the cost if the controller allowed them a small step more."""
    bounds, values = [], coordinates.values(z)
    for k, name in enumerate(values):
        step = np.zeros_like(z)
        step[k] = -_NEAR * np.sign(gradient[k])
        if abs(gradient[k]) <= _FLAT:
            continue
        if why := find_refusal(build_design(coordinates, as_array(z + step))):
            bounds.append(Bound(name, values[name], why))
    return tuple(bounds)


def _iter_modules(tree: PyTree) -> Iterator[eqx.Module]:
    """`tree` and the modules in it."""
    if isinstance(tree, eqx.Module):
        yield tree
        for part in vars(tree).values():
            yield from _iter_modules(part)


DeviceChoice = int | Sequence[jax.Device] | None  # see `jq.evaluate`


class TimeSpan(NamedTuple):
    """What of a flight counts, in s; ITAE's clock and overshoot start again at the `events`."""

    events: Sequence[float] = ()
    start: float = 0.0
    stop: float | None = None
    load_start: float | None = None

    @property
    def parts(self) -> list[tuple[float, float | None]]:
        """From event to event, in s."""
        ends = np.inf if self.stop is None else self.stop
        inside = sorted({float(t) for t in self.events if self.start < t < ends})
        return list(zip([self.start, *inside], [*inside, self.stop], strict=True))


_FULL_FLIGHT = TimeSpan()
_SMOOTHING = 1e-6  # 1/s, of the abscissa: its derivative is off by as much, relative to 1 1/s


class LinearLoops(eqx.Module):
    axes: Plant  # near level flight, with a linear form
    delay: Float[Array, " members"]  # s
    assumed_inertia: Float[Array, "axes members"]  # kg m^2
    longest_delay: float = eqx.field(static=True)  # s
    dt: float = eqx.field(static=True)  # s
    devices: Devices = eqx.field(static=True, default=())

    @property
    def members(self) -> int:
        return self.assumed_inertia.shape[-1]

    def replaced(self, places: Int[np.ndarray, " some"], others: "LinearLoops") -> "LinearLoops":
        """The same with the `others` in the places of some members."""

        def put(mine: Array, other: Array, varies: bool) -> Array:
            if not varies:
                return mine
            values = np.array(mine)
            values[..., places] = np.asarray(other)
            return as_array(values)

        marks = mark_members(self.axes, (self.members,))
        return dataclasses.replace(
            self,
            axes=jax.tree.map(put, self.axes, others.axes, marks),
            delay=put(self.delay, others.delay, True),
            assumed_inertia=put(self.assumed_inertia, others.assumed_inertia, True),
            longest_delay=max(self.longest_delay, others.longest_delay),
        )

    def numbers(
        self, controller: PyTree, wanted: Collection[str]
    ) -> dict[str, Float[Array, "axes members"]]:
        """The wanted quantities of the linear loop of each member, the abscissa with them."""

        def run(loops: PyTree, controller: PyTree) -> dict[str, Array]:
            axes, delay, inertia = loops
            delays = (delay, self.longest_delay) if self.longest_delay else (0.0, None)
            controller = schedule_for_analysis(controller, inertia)
            loop = Loop(axes, controller, delay=delays[0], longest_delay=delays[1], dt=self.dt)
            places = range(len(inertia))
            numbers = linear_numbers(loop, places, wanted, smoothing=_SMOOTHING)
            wide = lambda x: jnp.broadcast_to(x.reshape(len(x), -1), inertia.shape)
            return {name: wide(x) for name, x in numbers.items()}

        if len(self.devices) < 2:
            return run((self.axes, self.delay, self.assumed_inertia), controller)
        varies = mark_members(self.axes, (self.members,))
        theirs, common = eqx.partition(self.axes, varies)
        split = lambda loops, shared: run((eqx.combine(loops[0], shared[0]), *loops[1:]), shared[1])
        loops = (theirs, self.delay, self.assumed_inertia)
        return over_devices(split, loops, (common, controller), devices=self.devices)


class Problem(eqx.Module):
    """Members in their flights: all of it is data, so that it compiles once for a shape."""

    loop: Loop  # of all members, around the controller that a tune starts from
    linear: LinearLoops
    limited: LinearLoops | None  # of more members, on which limits of the linear loop are kept
    flight: Scenario
    window: Window = eqx.field(static=True)
    parts: tuple[tuple[int, int], ...] = eqx.field(static=True)  # samples from event to event
    counted: int = eqx.field(static=True)  # members of the objective: others are for limits alone

    @property
    def members(self) -> int:
        return self.linear.members

    def loop_around(self, controller: PyTree) -> Loop:
        """The loops of all members around another controller."""
        inertia = self.linear.assumed_inertia
        return self.loop.with_controller(schedule_for_flight(controller, inertia))

    def in_time(
        self, controller: PyTree, wanted: Collection[str]
    ) -> dict[str, Float[Array, "axes members"]]:
        """The wanted quantities of a flight of each member."""
        names = tuple(sorted({"activity" if n == "activity_rate" else n for n in wanted}))

        def summed(run: tuple[Loop, Scenario], _: None) -> dict[str, Array]:
            loop, flight = run
            authority = find_authority(loop.plant, loop.drive, loop.controller)
            sums = FlightMetrics(
                wanted=names, window=self.window, dt=loop.dt,
                steps=find_steps(flight.reference, self.parts),
                torque_gain=None if authority is None else authority.torque_gain,
                limit=None if authority is None else authority.command,
                smooth=True,
            )  # fmt: skip
            return sums.finish(scan_loop(loop, flight, sums)[0])

        run = (self.loop_around(controller), self.flight)
        numbers = loop_over_devices(summed, run, None, self.linear.devices)
        if "activity_rate" in wanted:
            duration = (self.window.last - self.window.first + 1) * self.loop.dt
            numbers["activity_rate"] = numbers["activity"] / duration
        return {name: numbers[name] for name in wanted}


def make_problem(
    controller: PyTree, members: Members, scenario: Scenario, *, span: TimeSpan = _FULL_FLIGHT,
    devices: DeviceChoice = None, counted: int | None = None,
) -> Problem:  # fmt: skip
    """Of `members`, of whom the first are `counted` in the objective (all, by default)."""
    flight, loop = members.flight(scenario), members.loop(controller)
    check_run(loop, flight)
    samples, dt = len(flight.reference), loop.dt
    late = [t for t in span.events if t >= samples * dt - 0.5 * dt]
    if late:
        raise ValueError(f"events at {late} s lie beyond the scenario of {samples * dt:.6g} s")
    first, last, loaded, until = window(
        samples, dt, start=span.start, stop=span.stop, load_start=span.load_start
    )
    windows = [window(samples, dt, start=a, stop=b, load_start=None) for a, b in span.parts]
    parts = [(int(x[0]), int(x[1])) for x in windows] if len(windows) > 1 else [(first, until)]
    return Problem(
        loop=loop, linear=linear_loops(members, devices), limited=None, flight=flight,
        window=Window(first, last, loaded, parts[-1][1]), parts=tuple(parts),
        counted=members.size if counted is None else counted,
    )  # fmt: skip


def linear_loops(members: Members, devices: DeviceChoice) -> LinearLoops:
    axes = decouple(members.plant)  # refuses a plant that has no linear form
    if not isinstance(members.plant, Multirotor):
        axes = members.plant
    places = devices_for(members.size, devices)
    longest = float(members.longest_delay)
    return LinearLoops(axes, members.delay, members.assumed_inertia, longest, members.dt, places)


def decouple(plant: object) -> DecoupledAxes:
    """The plant near level flight, one axis at a time.

    Of a class of the user's own it is what the linear forms tell; motors of more than one state
    count as motors without a lag.
    """
    if isinstance(plant, DecoupledAxes | Multirotor):
        return plant.decoupled() if isinstance(plant, Multirotor) else plant
    if not isinstance(plant, LinearisablePlant):
        raise ValueError(
            f"a {type(plant).__name__} has no method linearise(axis) that returns a "
            "jq.models.LinearAxis, which jq.tune and jq.certify need of a plant: add it, see "
            "jq.loops.LinearisablePlant"
        )
    require_signature(plant, LinearisablePlant, "linearise", 1)
    forms = _linear_forms(plant)
    row = lambda pick: np.stack([np.asarray(pick(x)) for x in forms])
    inertia = 1 / row(lambda x: x.torque[1])
    times_inertia = lambda pick: multiply_gains(inertia, row(pick))
    friction = getattr(plant, "coulomb", None)
    return DecoupledAxes(
        times_inertia(lambda x: x.gain), inertia,
        lag=-1 / row(lambda x: x.A[2, 2]) if len(forms[0].A) == 3 else None,
        damping=times_inertia(lambda x: -x.A[1, 1]), stiffness=times_inertia(lambda x: -x.A[1, 0]),
        coulomb=None if friction is None else np.asarray(friction),
    )  # fmt: skip


@eqx.filter_jit
def _linear_forms(plant: PyTree) -> list[LinearAxis]:
    return [plant.linearise(axis) for axis in range(len(plant.measure(plant.init())))]


class LinearisedPlant(eqx.Module):
    """A plant of the user's own that moves as its linear forms say; states are [states, axes]."""

    plant: PyTree
    axes: int = eqx.field(static=True)

    def init(
        self, euler: ArrayLike | None = None, *, ensemble: tuple[int, ...] = ()
    ) -> Float[Array, " states axes *ensemble"]:
        form = self.plant.linearise(0)
        angle = jnp.zeros(self.axes, form.A.dtype) if euler is None else jnp.asarray(euler)
        wide = jnp.broadcast_shapes(ensemble_shape(self.plant), ensemble, angle.shape[1:])
        state = jnp.zeros((len(form.A), self.axes, *wide), form.A.dtype)
        return state.at[0].set(align(angle, state[0]))

    def derivative(
        self,
        state: Float[Array, " states axes *ensemble"],
        inputs: Float[Array, " axes *ensemble"],
        disturbance: Float[Array, " axes *ensemble"],
    ) -> Float[Array, " states axes *ensemble"]:
        def of_axis(axis: int) -> Array:
            form, x = self.plant.linearise(axis), state[:, axis]
            pushes = align(form.command, x) * inputs[axis][None]
            pushes += align(form.torque, x) * disturbance[axis][None]
            return jnp.sum(align(form.A, state) * x[None], axis=1) + pushes

        return jnp.stack([of_axis(axis) for axis in range(self.axes)], axis=1)

    def measure(self, state: Float[Array, " states axes *ensemble"]) -> Array:
        return state[0]

    def with_added_inertia(self, inertia: ArrayLike) -> "LinearisedPlant":
        return LinearisedPlant(self.plant.with_added_inertia(inertia), self.axes)


def require_ensemble(ensemble: object) -> None:
    if not isinstance(ensemble, Ensemble | Members):
        raise ValueError(
            f"ensemble is a {type(ensemble).__name__}: give jq.Ensemble(inertia=...), or "
            "jq.ensembles.Members of it"
        )


def require_same_rate(loop: Loop, members: Members) -> None:
    if not np.isclose(loop.dt, members.dt, rtol=1e-6):
        raise ValueError(
            f"the members were drawn around a loop with dt = {members.dt} s, but this one has "
            f"{loop.dt} s: draw them again, ensemble.draw(loop, n, key)"
        )
