"""What a tune is about, with everything that does not change while it runs."""

from collections.abc import Collection
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad.control import flown, told
from jaxquad.models import DecoupledAxes, Multirotor
from jaxquad.simulate import Scenario
from jaxquad.simulate._authority import find_authority
from jaxquad.simulate._check_loop import check_loop
from jaxquad.simulate._devices import asked_devices, devices_for
from jaxquad.simulate._loop import scan_loop
from jaxquad.simulate._over_devices import loop_over_devices, over_devices
from jaxquad.simulate._settings import loop_settings, Settings
from jaxquad.simulate._window import makes_step, Window, window

from ._accumulate import Accumulate, Span, Steps
from ._linear_numbers import linear_numbers
from ._members import Members
from ._parts import parts_of
from ._quantities import IN_TIME


class Loops(eqx.Module):
    """The linear loops of members."""

    axes: DecoupledAxes  # the plant near level flight
    delay: Float[Array, " members"]  # s
    inertia_told: Float[Array, "axes members"]  # kg m^2
    longest_delay: float = eqx.field(static=True)  # s
    devices: tuple[Any, ...] = eqx.field(static=True, default=())

    @property
    def members(self) -> int:
        return self.inertia_told.shape[-1]

    def numbers(
        self, controller: Any, wanted: Collection[str], smoothing: float
    ) -> dict[str, Float[Array, "axes members"]]:
        """The wanted quantities of the linear loop of each member, the abscissa with them."""

        def run(own: Any, controller: Any) -> dict[str, Array]:
            axes, delay, inertia = own
            return linear_numbers(
                axes, told(controller, inertia), delay, longest=self.longest_delay, wanted=wanted,
                smoothing=smoothing,
            )  # fmt: skip

        if len(self.devices) < 2:
            return run((self.axes, self.delay, self.inertia_told), controller)
        full = lambda x: jnp.broadcast_to(
            x if x.ndim > 1 else x[:, None], (x.shape[0], self.members)
        )
        own = (jax.tree.map(full, self.axes), self.delay, self.inertia_told)
        return over_devices(run, own, controller, devices=self.devices)


class Problem(eqx.Module):
    """Members in their flights: all of it is data, so that it compiles once for a shape."""

    plant: Any
    loops: Loops
    wide: Loops | None  # of more members, on which limits of the loop are kept
    flight: Scenario
    settings: Settings
    span: Span = eqx.field(static=True)
    events: tuple[float, ...] = eqx.field(static=True)
    parts: tuple[tuple[int, int], ...] = eqx.field(static=True)  # samples from event to event

    @property
    def members(self) -> int:
        return self.loops.members

    def in_time(
        self, controller: Any, wanted: Collection[str]
    ) -> dict[str, Float[Array, "axes members"]]:
        """The wanted quantities of a flight of each member."""
        law, span = flown(controller, self.loops.inertia_told), self.span
        loop = (self.plant, law, self.flight, self.settings)
        names = {"activity" if name == "activity_rate" else name for name in wanted}
        run = lambda loop, _: self._summed(loop, tuple(sorted(names)))
        numbers = loop_over_devices(run, loop, None, self.loops.devices)
        if "activity_rate" in wanted:
            duration = (span.last - span.first + 1) * self.settings.dt
            numbers["activity_rate"] = numbers["activity"] / duration
        return {name: numbers[name] for name in wanted}

    def _summed(
        self, loop: tuple[Any, Any, Scenario, Settings], names: tuple[str, ...]
    ) -> dict[str, Float[Array, "axes members"]]:
        plant, law, flight, settings = loop
        found = find_authority(plant, settings.drive, law)
        steps = steps_of(flight.reference, self.parts)
        sums = Accumulate(names, self.span, settings.dt, self.events, self.parts, steps, found)
        return sums.finished(scan_loop(*loop, sums.update, sums.begin)[0])


def steps_of(reference: Float[Array, "samples axes ..."], parts: Any) -> Steps:
    """Where the reference of each part goes, as `jq.evaluate` has it of a window of its own."""
    before = [reference[a - 1] if a else jnp.zeros_like(reference[0]) for a, _ in parts]
    target = [reference[b] for _, b in parts]
    known = [makes_step(reference, Window(a, b, a, b)) for a, b in parts]
    stacks = (jnp.stack(x) for x in (target, before, known))
    target, before, known = stacks
    return Steps(target, before, known & (target != before))


def problem_of(
    controller: Any,
    members: Members,
    scenario: Scenario,
    wide: Members | None = None,
    *,
    events: tuple[float, ...] = (),
    start: float = 0.0,
    stop: float | None = None,
    load_start: float | None = None,
    devices: Any = None,
) -> Problem:
    """Of `members`, and of the linear loops of `wide` ones where limits are to be kept.

    Raises ValueError for parts that do not fit together, as `jq.evaluate` does.
    """
    flight, dt = members.flight(scenario), members.dt
    settings = loop_settings(
        dt=dt, drive=members.drive, encoder=members.encoder, delay=np.asarray(members.delay)
    )
    check_loop(members.plant, flown(controller, members.inertia_told), flight, settings)
    samples = len(flight.reference)
    late = [t for t in events if t >= samples * dt - 0.5 * dt]
    if late:
        raise ValueError(f"events at {late} s lie beyond the scenario of {samples * dt:.6g} s")
    place = window(samples, dt, start=start, stop=stop, load_start=load_start)
    windows = [
        window(samples, dt, start=a, stop=b, load_start=None)
        for a, b in parts_of(events, start, stop)
    ]
    parts = [(int(x[0]), int(x[1])) for x in windows]
    return Problem(
        plant=members.plant,
        loops=_loops(members, devices),
        wide=None if wide is None else _loops(wide, devices),
        flight=flight,
        settings=settings,
        span=Span(*(int(x) for x in place)),
        events=tuple(float(t) for t in events),
        parts=tuple(parts) if len(parts) > 1 else ((int(place[0]), int(place[3])),),
    )


def _loops(members: Members, devices: Any) -> Loops:
    plant = members.plant
    axes = plant.decoupled() if isinstance(plant, Multirotor) else plant
    places = devices_for(members.size, asked_devices(devices))
    longest = float(members.longest_delay)
    return Loops(axes, members.delay, members.inertia_told, longest, places)


def split(wanted: Collection[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What is of a flight and what is of the linear loop."""
    names = sorted(wanted)
    return tuple(n for n in names if n in IN_TIME), tuple(n for n in names if n not in IN_TIME)
