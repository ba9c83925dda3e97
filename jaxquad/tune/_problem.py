"""What a tune is about, with everything that does not change while it runs."""

from collections.abc import Collection
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad.control import flown, told
from jaxquad.models import DecoupledAxes, Multirotor
from jaxquad.simulate import Scenario
from jaxquad.simulate._authority import find_authority
from jaxquad.simulate._check_loop import check_loop
from jaxquad.simulate._loop import scan_loop
from jaxquad.simulate._settings import loop_settings, Settings
from jaxquad.simulate._window import window

from ._accumulate import Accumulate, Span
from ._linear_numbers import linear_numbers
from ._members import Members
from ._quantities import IN_TIME


class Loops(eqx.Module):
    """The linear loops of members."""

    axes: DecoupledAxes  # the plant near level flight
    delay: Float[Array, " members"]  # s
    inertia_told: Float[Array, "axes members"]  # kg m^2
    longest_delay: float = eqx.field(static=True)  # s

    @property
    def members(self) -> int:
        return self.inertia_told.shape[-1]

    def numbers(
        self, controller: Any, wanted: Collection[str], smoothing: float
    ) -> dict[str, Float[Array, "axes members"]]:
        """The wanted quantities of the linear loop of each member, the abscissa with them."""
        law = told(controller, self.inertia_told)
        return linear_numbers(
            self.axes, law, self.delay, longest=self.longest_delay, wanted=wanted,
            smoothing=smoothing,
        )  # fmt: skip


class Problem(eqx.Module):
    """Members in their flights: all of it is data, so that it compiles once for a shape."""

    plant: Any
    loops: Loops
    wide: Loops | None  # of more members, on which limits of the loop are kept
    flight: Scenario
    settings: Settings
    span: Span = eqx.field(static=True)
    events: tuple[float, ...] = eqx.field(static=True)

    @property
    def members(self) -> int:
        return self.loops.members

    def in_time(
        self, controller: Any, wanted: Collection[str]
    ) -> dict[str, Float[Array, "axes members"]]:
        """The wanted quantities of a flight of each member."""
        law = flown(controller, self.loops.inertia_told)
        reference, span = self.flight.reference, self.span
        found = find_authority(self.plant, self.settings.drive, law)
        before = jnp.zeros_like(reference[0]) if span.first == 0 else reference[span.first - 1]
        names = {"activity" if name == "activity_rate" else name for name in wanted}
        sums = Accumulate(
            tuple(sorted(names)), span, self.settings.dt, self.events, reference[span.until],
            before, found,
        )  # fmt: skip
        total = scan_loop(self.plant, law, self.flight, self.settings, sums.update, sums.begin)[0]
        numbers = sums.finished(total)
        if "activity_rate" in wanted:
            duration = (span.last - span.first + 1) * self.settings.dt
            numbers["activity_rate"] = numbers["activity"] / duration
        return {name: numbers[name] for name in wanted}


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
) -> Problem:
    """Of `members`, and of the linear loops of `wide` ones where limits are to be kept.

    Raises ValueError for parts that do not fit together, as `jq.evaluate` does.
    """
    flight, dt = members.flight(scenario), getattr(controller, "dt", members.dt)
    settings = loop_settings(
        dt=dt, drive=members.drive, encoder=members.encoder, delay=np.asarray(members.delay)
    )
    check_loop(members.plant, flown(controller, members.inertia_told), flight, settings)
    place = window(len(flight.reference), dt, start=start, stop=stop, load_start=load_start)
    return Problem(
        plant=members.plant,
        loops=_loops(members),
        wide=None if wide is None else _loops(wide),
        flight=flight,
        settings=settings,
        span=Span(*(int(x) for x in place)),
        events=tuple(float(t) for t in events),
    )


def _loops(members: Members) -> Loops:
    plant = members.plant
    axes = plant.decoupled() if isinstance(plant, Multirotor) else plant
    return Loops(axes, members.delay, members.inertia_told, float(members.longest_delay))


def split(wanted: Collection[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What is of a flight and what is of the linear loop."""
    names = sorted(wanted)
    return tuple(n for n in names if n in IN_TIME), tuple(n for n in names if n not in IN_TIME)
