"""The members of a tune in their flights: everything that does not change while it runs."""

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxquad._xla import asked_devices, Devices, devices_for
from jaxquad.control import schedule_for_analysis, schedule_for_flight
from jaxquad.ensembles import Members
from jaxquad.loops import Loop
from jaxquad.models import DecoupledAxes, Multirotor
from jaxquad.simulation import (
    Authority,
    check_run,
    divisor,
    find_authority,
    loop_over_devices,
    makes_step,
    over_devices,
    scan_loop,
    Scenario,
    wide,
    Window,
    window,
)

from ._linear_numbers import linear_numbers
from ._objective import Objective


DeviceChoice = int | Sequence[jax.Device] | None  # see `jq.evaluate`


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


_WHOLE = TimeSpan()


class Span(NamedTuple):
    """The samples that count, as `jaxquad.simulation.Window`, but static."""

    first: int
    last: int
    loaded: int
    until: int


class Steps(NamedTuple):
    """Of the parts of a flight between events: where the reference goes, for overshoot."""

    target: Float[Array, "parts axes ..."]  # rad, where the reference ends
    before: Float[Array, "parts axes ..."]  # rad, where it was before
    known: Bool[Array, "parts axes ..."]  # whether it is a step


class Accumulate(eqx.Module):
    """Adds up what `wanted` quantities need: to be given to a loop, with `begin`."""

    wanted: tuple[str, ...] = eqx.field(static=True)
    span: Span = eqx.field(static=True)
    dt: float = eqx.field(static=True)
    events: tuple[float, ...] = eqx.field(static=True)  # s, when the clock of ITAE starts again
    parts: tuple[tuple[int, int], ...] = eqx.field(static=True)  # samples from and to, of `steps`
    steps: Steps
    authority: Authority | None

    def begin(self, like: Float[Array, " axes *ensemble"]) -> dict[str, Array]:
        names = list(self.wanted) + ["command"] * ("activity" in self.wanted)
        return {name: jnp.zeros_like(like) for name in names}

    def update(self, sums: dict[str, Array], now: Any) -> tuple[dict[str, Array], None]:
        """One sample more; `now` is a `SampleResult`."""
        inside = (now.index >= self.span.first) & (now.index <= self.span.last)
        after = {name: getattr(self, f"_{name}")(sums, now) for name in sums}
        return jax.tree.map(lambda new, old: jnp.where(inside, new, old), after, sums), None

    def finished(self, sums: dict[str, Array]) -> dict[str, Array]:
        """The quantities of what was added up."""
        span = self.span
        counted, loaded = span.last - span.first + 1, span.last - span.loaded + 1
        shares = {"saturation_share": counted, "rms": loaded, "disturbance_rmse": loaded}
        found = {name: x / shares.get(name, 1) for name, x in sums.items() if name != "command"}
        for name in {"rms", "disturbance_rmse"} & found.keys():
            found[name] = jnp.sqrt(jnp.maximum(found[name], 1e-30))
        return found

    def _itae(self, sums, now):
        return sums["itae"] + self._weight(now) * self._elapsed(now) * jnp.abs(_error(now))

    def _iae(self, sums, now):
        return sums["iae"] + self._weight(now) * jnp.abs(_error(now))

    def _ise(self, sums, now):
        return sums["ise"] + self._weight(now) * _error(now) ** 2

    def _energy(self, sums, now):
        return sums["energy"] + self.dt * now.command**2

    def _activity(self, sums, now):
        change = jnp.where(now.index == self.span.first, 0, now.command - sums["command"])
        return sums["activity"] + change**2

    def _command(self, sums, now):
        return now.command

    def _overshoot(self, sums, now):
        target, before, known = (wide(x[0], now.angle) for x in self.steps)
        for k, (first, _) in enumerate(self.parts[1:], 1):
            later = (wide(x[k], now.angle) for x in self.steps)
            held = zip((target, before, known), later, strict=True)
            target, before, known = (jnp.where(now.index >= first, b, a) for a, b in held)
        beyond = 100 * ((now.angle - before) / divisor(target - before) - 1)
        counts = known & (now.index <= self.parts[-1][1])
        return jnp.where(counts, jnp.maximum(sums["overshoot"], beyond), sums["overshoot"])

    def _peak(self, sums, now):
        return jnp.maximum(sums["peak"], jnp.where(self._loaded(now), jnp.abs(_error(now)), 0))

    def _rms(self, sums, now):
        return sums["rms"] + jnp.where(self._loaded(now), _error(now) ** 2, 0)

    def _disturbance_rmse(self, sums, now):
        if self.authority is None or "disturbance" not in now.signals:
            return jnp.full_like(now.angle, jnp.nan)
        gain = wide(self.authority.torque_gain, now.angle)
        missed = gain * now.signals["disturbance"] - now.disturbance
        return sums["disturbance_rmse"] + jnp.where(self._loaded(now), missed**2, 0)

    def _saturation_share(self, sums, now):
        if self.authority is None:
            return sums["saturation_share"] + now.saturated.astype(now.angle.dtype)
        limit = wide(self.authority.command, now.angle)
        known = jnp.isfinite(limit)
        used = jnp.abs(now.command) / jnp.where(known, limit, 1)
        share = jax.nn.sigmoid((used - (1 - 2 * _SOFTNESS)) / (0.4 * _SOFTNESS))
        return sums["saturation_share"] + jnp.where(known, share, 0)

    def _loaded(self, now):
        return now.index >= self.span.loaded

    def _weight(self, now):
        # The trapezoidal rule, as `Meter`.
        at_end = (now.index == self.span.first) | (now.index == self.span.last)
        return jnp.where(at_end, 0.5 * self.dt, self.dt).astype(now.angle.dtype)

    def _elapsed(self, now):
        """s since the last event."""
        since = now.index - self.span.first
        for event in self.events:
            at = round(event / self.dt)
            since = jnp.where(now.index >= at, jnp.minimum(since, now.index - at), since)
        return since.astype(now.angle.dtype) * self.dt


def _error(now: Any) -> Array:
    return now.reference - now.angle


class LinearLoops(eqx.Module):
    """The linear loops of members."""

    axes: DecoupledAxes  # the plant near level flight
    delay: Float[Array, " members"]  # s
    inertia_told: Float[Array, "axes members"]  # kg m^2
    longest_delay: float = eqx.field(static=True)  # s
    devices: Devices = eqx.field(static=True, default=())

    @property
    def members(self) -> int:
        """How many there are."""
        return self.inertia_told.shape[-1]

    def numbers(
        self, controller: PyTree, wanted: Collection[str], smoothing: float
    ) -> dict[str, Float[Array, "axes members"]]:
        """The wanted quantities of the linear loop of each member, the abscissa with them."""

        def run(own: PyTree, controller: PyTree) -> dict[str, Array]:
            axes, delay, inertia = own
            return linear_numbers(
                axes, schedule_for_analysis(controller, inertia), delay,
                longest=self.longest_delay, wanted=wanted, smoothing=smoothing,
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

    loop: Loop  # of all members, around the controller that a tune starts from
    linear: LinearLoops
    limited: LinearLoops | None  # of more members, on which limits of the linear loop are kept
    flight: Scenario
    span: Span = eqx.field(static=True)
    events: tuple[float, ...] = eqx.field(static=True)  # s
    parts: tuple[tuple[int, int], ...] = eqx.field(static=True)  # samples from event to event

    @property
    def members(self) -> int:
        """How many are flown."""
        return self.linear.members

    def loop_around(self, controller: PyTree) -> Loop:
        """The loops of all members around another controller."""
        return self.loop.with_controller(schedule_for_flight(controller, self.linear.inertia_told))

    def in_time(
        self, controller: PyTree, wanted: Collection[str]
    ) -> dict[str, Float[Array, "axes members"]]:
        """The wanted quantities of a flight of each member."""
        run = (self.loop_around(controller), self.flight)
        names = tuple(sorted({"activity" if n == "activity_rate" else n for n in wanted}))
        summed = lambda run, _: self._summed(*run, names)
        numbers = loop_over_devices(summed, run, None, self.linear.devices)
        if "activity_rate" in wanted:
            duration = (self.span.last - self.span.first + 1) * self.loop.dt
            numbers["activity_rate"] = numbers["activity"] / duration
        return {name: numbers[name] for name in wanted}

    def _summed(
        self, loop: Loop, flight: Scenario, names: tuple[str, ...]
    ) -> dict[str, Float[Array, "axes members"]]:
        found = find_authority(loop.plant, loop.drive, loop.controller)
        steps = find_steps(flight.reference, self.parts)
        sums = Accumulate(names, self.span, loop.dt, self.events, self.parts, steps, found)
        return sums.finished(scan_loop(loop, flight, sums.update, sums.begin)[0])


def find_steps(
    reference: Float[Array, "samples axes ..."], parts: Sequence[tuple[int, int]]
) -> Steps:
    """Where the reference of each part goes, as `jq.evaluate` has it of a window of its own."""
    before = [reference[a - 1] if a else jnp.zeros_like(reference[0]) for a, _ in parts]
    target = [reference[b] for _, b in parts]
    known = [makes_step(reference, Window(a, b, a, b)) for a, b in parts]
    target, before, known = (jnp.stack(x) for x in (target, before, known))
    return Steps(target, before, known & (target != before))


def make_problem(
    controller: PyTree,
    members: Members,
    scenario: Scenario,
    limited: Members | None = None,
    *,
    span: TimeSpan = _WHOLE,
    devices: DeviceChoice = None,
) -> Problem:
    """Of `members`, and of the linear loops of the `limited` ones on which limits are kept.

    Raise ValueError for parts that do not fit together, as `jq.evaluate` does.
    """
    flight, loop = members.flight(scenario), members.loop(controller)
    check_run(loop, flight)
    samples, dt = len(flight.reference), loop.dt
    late = [t for t in span.events if t >= samples * dt - 0.5 * dt]
    if late:
        raise ValueError(f"events at {late} s lie beyond the scenario of {samples * dt:.6g} s")
    place = window(samples, dt, start=span.start, stop=span.stop, load_start=span.load_start)
    windows = [window(samples, dt, start=a, stop=b, load_start=None) for a, b in span.parts]
    parts = [(int(x[0]), int(x[1])) for x in windows]
    return Problem(
        loop=loop,
        linear=_linear_loops(members, devices),
        limited=None if limited is None else _linear_loops(limited, devices),
        flight=flight,
        span=Span(*(int(x) for x in place)),
        events=tuple(float(t) for t in span.events),
        parts=tuple(parts) if len(parts) > 1 else ((int(place[0]), int(place[3])),),
    )


def _linear_loops(members: Members, devices: DeviceChoice) -> LinearLoops:
    plant = members.plant
    axes = plant.decoupled() if isinstance(plant, Multirotor) else plant
    places = devices_for(members.size, asked_devices(devices))
    longest = float(members.longest_delay)
    return LinearLoops(axes, members.delay, members.inertia_told, longest, places)
