"""A design flown and analysed on every member."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad.control import flown, LADRC, PID, told
from jaxquad.ensembles import Members
from jaxquad.models import DecoupledAxes, Multirotor
from jaxquad.simulation import evaluate, Metrics, Scenario

from ._judged import Judged, LINEAR
from ._loop_numbers import loop_numbers, LoopNumbers, worst_of
from ._observer_alone import runaway
from ._parts import parts_of


_PER_MEMBER = ("b0", "kp", "ki", "kd", "feedforward")  # what an inertia told may change


def wide(law: Any, axes: int, members: int) -> Any:
    """The gains of a LADRC or PID in one shape, so that all of a kind share a compile."""
    if not isinstance(law, LADRC | PID):
        return law
    gains = {name: x for name, x in vars(law).items() if isinstance(x, Array)}
    full = {name: _shaped(x, name, axes, members) for name, x in gains.items()}
    return dataclasses.replace(law, **full)


def _shaped(gain: Array, name: str, axes: int, members: int) -> Array:
    shape = (axes, members) if name in _PER_MEMBER or gain.ndim > 1 else (axes,)
    given = np.asarray(gain)
    aligned = given.reshape(given.shape + (1,) * (len(shape) - given.ndim)) if given.ndim else given
    return jnp.asarray(np.broadcast_to(aligned, shape))


_INTEGRALS = ("itae", "iae", "ise")
_WHOLE = ("activity", "energy", "saturation_share", "peak", "rms", "disturbance_rmse")


class Span(NamedTuple):
    """What of a flight counts, in s; at `events` ITAE's clock and the overshoot start anew."""

    events: Sequence[float] = ()
    start: float = 0.0
    stop: float | None = None
    load_start: float | None = None

    @property
    def parts(self) -> list[tuple[float, float | None]]:
        return parts_of(self.events, self.start, self.stop)


def judge(
    controller: Any, members: Members, flight: Scenario, span: Span, devices: Any = None
) -> Judged:
    """`controller` on all `members`, in a `flight` that has their noise in it.

    The loop in time holds every limit, the encoder and dry friction; the linear one is exact, of a
    controller that has a `linear` form, scheduled or adaptive ones at the inertia they are told.
    """
    axes = flight.reference.shape[1]
    law = wide(flown(controller, members.inertia_told), axes, members.size)

    def over(start: float, stop: float | None, load_start: float | None = None) -> Metrics:
        return evaluate(
            members.plant, law, flight, start=start, stop=stop, load_start=load_start,
            dt=members.dt, drive=members.drive, encoder=members.encoder, delay=members.delay,
            devices=devices,
        )  # fmt: skip

    whole = over(span.start, span.stop, span.load_start)
    parts = [over(*part) for part in span.parts] if len(span.parts) > 1 else [whole]
    numbers = _joined(whole, parts)
    linear = _linear(controller, members, flight)
    if linear is not None:
        numbers |= {name: getattr(linear, name) for name in LINEAR}
    unstable = None if linear is None else ~np.all(linear.stable, axis=0)
    return Judged(numbers, unstable, np.asarray(whole.diverged), runaway(controller))


def axes_of(plant: Any) -> DecoupledAxes:
    """The plant near level flight, one axis at a time."""
    return plant.decoupled() if isinstance(plant, Multirotor) else plant


def _joined(whole: Metrics, parts: Sequence[Metrics]) -> dict[str, np.ndarray]:
    stack = lambda name: np.stack([np.asarray(getattr(one, name), float) for one in parts])
    numbers = {name: np.asarray(getattr(whole, name), float) for name in _WHOLE}
    numbers["activity_rate"] = numbers["activity"] / (whole.stop - whole.start)
    numbers["overshoot"] = _greatest(stack("overshoot"))
    return numbers | {name: stack(name).sum(axis=0) for name in _INTEGRALS}


def _greatest(values: Float[np.ndarray, "parts axes members"]) -> np.ndarray:
    """NaN where no part has a step."""
    known = ~np.isnan(values)
    greatest = np.max(np.where(known, values, -np.inf), axis=0)
    return np.where(known.any(axis=0), greatest, np.nan)


def _linear(controller: Any, members: Members, flight: Scenario) -> LoopNumbers | None:
    law, axes = told(controller, members.inertia_told), flight.reference.shape[1]
    if not hasattr(law, "linear"):
        return None
    law, late = wide(law, axes, members.size), members.delay
    plants = [axes_of(plant) for plant in _loaded(members.plant, flight)]
    loops = [
        loop_numbers(plant, law, late, longest=members.longest_delay, axes=axes) for plant in plants
    ]
    return worst_of(loops)


def _loaded(plant: Any, flight: Scenario) -> list[Any]:
    """The plant, and with the most and the least that the flight makes it carry."""
    if flight.payload is None:
        return [plant]
    extremes = [np.max(flight.payload, axis=0), np.min(flight.payload, axis=0)]
    return [plant, *(plant.with_added_inertia(x) for x in extremes if np.any(x != 0))]
