"""The members of a tune in their flights: everything that does not change while it runs."""

import dataclasses
from collections.abc import Collection, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from jaxquad._core import as_array, mark_members
from jaxquad.control import schedule_for_analysis, schedule_for_flight
from jaxquad.ensembles import Members
from jaxquad.loops import linear_numbers, Loop
from jaxquad.models import DecoupledAxes, Multirotor
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

from ._objective import Objective


DeviceChoice = int | Sequence[jax.Device] | None  # see `jq.evaluate`
Plant = DecoupledAxes | Multirotor


class TimeSpan(NamedTuple):
    """What of a flight counts, in s; ITAE's clock and overshoot start again at the `events`."""

    events: Sequence[float] = ()
    start: float = 0.0
    stop: float | None = None
    load_start: float | None = None

    @classmethod
    def of(cls, objective: Objective) -> "TimeSpan":
        """That of an objective."""
        return cls(objective.events, objective.start, objective.stop, objective.load_start)

    @property
    def parts(self) -> list[tuple[float, float | None]]:
        """From event to event, in s."""
        ends = np.inf if self.stop is None else self.stop
        inside = sorted({float(t) for t in self.events if self.start < t < ends})
        return list(zip([self.start, *inside], [*inside, self.stop], strict=True))


_SOFTNESS = 0.005  # of the limit, about which a command counts as saturated in part


_FULL_FLIGHT = TimeSpan()


class LinearLoops(eqx.Module):
    """The linear loops of members."""

    axes: DecoupledAxes  # the plant near level flight
    delay: Float[Array, " members"]  # s
    assumed_inertia: Float[Array, "axes members"]  # kg m^2
    longest_delay: float = eqx.field(static=True)  # s
    dt: float = eqx.field(static=True)  # s
    devices: Devices = eqx.field(static=True, default=())

    @property
    def members(self) -> int:
        """How many there are."""
        return self.assumed_inertia.shape[-1]

    def replaced(
        self,
        places: Int[np.ndarray, " some"],
        others: "LinearLoops",
        chosen: Int[np.ndarray, " some"],
    ) -> "LinearLoops":
        """The same with the members at `places` replaced by `chosen` ones of the `others`."""

        def put(mine: Array, other: Array, varies: bool) -> Array:
            if not varies:
                return mine
            values = np.array(mine)
            values[..., places] = np.asarray(other)[..., chosen]
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
        self, controller: PyTree, wanted: Collection[str], smoothing: float
    ) -> dict[str, Float[Array, "axes members"]]:
        """The wanted quantities of the linear loop of each member, the abscissa with them."""

        def run(loops: PyTree, controller: PyTree) -> dict[str, Array]:
            axes, delay, inertia = loops
            loop = Loop(
                axes,
                schedule_for_analysis(controller, inertia),
                delay=delay if self.longest_delay else 0.0,
                longest_delay=self.longest_delay or None,
                dt=self.dt,
            )
            places = range(len(inertia))
            numbers = linear_numbers(loop, places, wanted, smoothing=smoothing, smooth=True)
            wide = lambda x: jnp.broadcast_to(x.reshape(len(x), -1), inertia.shape)
            return {name: wide(x) for name, x in numbers.items()}

        if len(self.devices) < 2:
            return run((self.axes, self.delay, self.assumed_inertia), controller)
        full = lambda x: jnp.broadcast_to(
            x if x.ndim > 1 else x[:, None], (x.shape[0], self.members)
        )
        loops = (jax.tree.map(full, self.axes), self.delay, self.assumed_inertia)
        return over_devices(run, loops, controller, devices=self.devices)


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
        """How many are flown."""
        return self.linear.members

    def loop_around(self, controller: PyTree) -> Loop:
        """The loops of all members around another controller."""
        return self.loop.with_controller(
            schedule_for_flight(controller, self.linear.assumed_inertia)
        )

    def in_time(
        self, controller: PyTree, wanted: Collection[str]
    ) -> dict[str, Float[Array, "axes members"]]:
        """The wanted quantities of a flight of each member."""
        run = (self.loop_around(controller), self.flight)
        names = tuple(sorted({"activity" if n == "activity_rate" else n for n in wanted}))
        summed = lambda run, _: self._summed(run[0], run[1], names)
        numbers = loop_over_devices(summed, run, None, self.linear.devices)
        if "activity_rate" in wanted:
            duration = (self.window.last - self.window.first + 1) * self.loop.dt
            numbers["activity_rate"] = numbers["activity"] / duration
        return {name: numbers[name] for name in wanted}

    def _summed(
        self, loop: Loop, flight: Scenario, names: tuple[str, ...]
    ) -> dict[str, Float[Array, "axes members"]]:
        authority = find_authority(loop.plant, loop.drive, loop.controller)
        sums = FlightMetrics(
            wanted=names,
            window=self.window,
            dt=loop.dt,
            steps=find_steps(flight.reference, self.parts),
            torque_gain=None if authority is None else authority.torque_gain,
            limit=None if authority is None else authority.command,
            smooth=True,
        )
        return sums.finish(scan_loop(loop, flight, sums)[0])


def make_problem(
    controller: PyTree,
    members: Members,
    scenario: Scenario,
    limited: Members | None = None,
    *,
    span: TimeSpan = _FULL_FLIGHT,
    devices: DeviceChoice = None,
    counted: int | None = None,
) -> Problem:
    """Of `members`, and of the linear loops of the `limited` ones on which limits are kept.

    The first of the members are `counted` in the objective (all, by default).

    Raise ValueError for parts that do not fit together, as `jq.evaluate` does.
    """
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
    parts = [(int(x[0]), int(x[1])) for x in windows]
    if len(parts) == 1:
        parts = [(first, until)]
    return Problem(
        loop=loop,
        linear=linear_loops(members, devices),
        limited=None if limited is None else linear_loops(limited, devices),
        flight=flight,
        window=Window(first, last, loaded, parts[-1][1]),
        parts=tuple(parts),
        counted=members.size if counted is None else counted,
    )


def linear_loops(members: Members, devices: DeviceChoice) -> LinearLoops:
    axes = decouple(members.plant)
    places = devices_for(members.size, devices)
    longest = float(members.longest_delay)
    return LinearLoops(axes, members.delay, members.assumed_inertia, longest, members.dt, places)


def decouple(plant: object) -> DecoupledAxes:
    """The plant near level flight, one axis at a time."""
    axes = plant.decoupled() if isinstance(plant, Multirotor) else plant
    if not isinstance(axes, DecoupledAxes):
        raise ValueError(
            f"a {type(plant).__name__} cannot be tuned: its members are a jq.DecoupledAxes or a "
            "jq.Multirotor, whose linear loops a tune needs. Of a fitted model of your own "
            "jq.ensembles.Posterior(fit, plant=...) makes them; jq.simulate, jq.evaluate, their "
            "derivatives and jq.analyse take any plant"
        )
    return axes


def require_same_rate(loop: Loop, members: Members) -> None:
    """Raise ValueError for members that were drawn around a loop of another sample interval."""
    if not np.isclose(loop.dt, members.dt, rtol=1e-6):
        raise ValueError(
            f"the members were drawn around a loop with dt = {members.dt} s, but this one has "
            f"{loop.dt} s: draw them again, ensemble.draw(loop, n, key)"
        )
