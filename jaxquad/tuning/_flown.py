"""The flight of a design with all of its members, once, and its numbers by parts of the flight."""

import functools as ft
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxquad._compile import brief_options, Jit
from jaxquad._core import as_array
from jaxquad.loops import Loop
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

from ._problem import DeviceChoice, TimeSpan


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
    whole = window(samples, dt, start=span.start, stop=span.stop, load_start=span.load_start)
    parts = [window(samples, dt, start=a, stop=b, load_start=None) for a, b in span.parts]
    windows = tuple(Window(*map(as_array, x)) for x in (whole, *parts))
    run, places = placed(loop, flight, devices)
    numbers, each, diverged = over_cores(_run, run, (windows,), places)
    found = jax.tree.map(lambda x: np.asarray(x, float), (numbers, each))
    known, duration = _join(*found), (whole[1] + 1 - whole[0]) * dt
    known["activity_rate"] = known["activity"] / duration
    greatest = np.max([part["peak"] for part in found[1]], axis=(0, 1))
    return Flown(known, np.asarray(diverged), greatest)


def _join(
    numbers: dict[str, np.ndarray], parts: list[dict[str, np.ndarray]]
) -> dict[str, np.ndarray]:
    stack = lambda name: np.stack([part[name] for part in parts])
    sums = {name: stack(name).sum(axis=0) for name in _INTEGRALS}
    return dict(numbers) | sums | {"overshoot": _greatest(stack("overshoot"))}


def _greatest(values: Float[np.ndarray, "parts axes members"]) -> np.ndarray:
    """NaN where no part has a step."""
    known = ~np.isnan(values)
    greatest = np.max(np.where(known, values, -np.inf), axis=0)
    return np.where(known.any(axis=0), greatest, np.nan)


Finished = tuple[dict[str, Array], list[dict[str, Array]], Bool[Array, "*ensemble"]]


@ft.partial(Jit, options=brief_options)
def _run(
    loop: Loop, scenario: Scenario, windows: tuple[Window, ...], devices: Devices | None = None
) -> Finished:
    return loop_over_devices(_measure, (loop, scenario), windows, devices)


def _measure(run: tuple[Loop, Scenario], windows: tuple[Window, ...]) -> Finished:
    loop, scenario = run
    found = find_authority(loop.plant, loop.drive, loop.controller)

    def metrics(span: Window, wanted: tuple[str, ...]) -> FlightMetrics:
        return FlightMetrics(
            wanted=wanted,
            window=span,
            dt=loop.dt,
            steps=find_steps(scenario.reference, [(span.first, span.until)]),
            from_first=jnp.asarray(span.first == 0) if wanted is _OF_PARTS else None,
            torque_gain=None if found is None else found.torque_gain,
            limit=None if found is None else found.command,
        )

    whole, *parts = windows
    sums = _Parts((metrics(whole, _OF_ALL), *(metrics(part, _OF_PARTS) for part in parts)))
    total, _, running = scan_loop(loop, scenario, sums)
    numbers, *each = [one.finish(x) for one, x in zip(sums.parts, total, strict=True)]
    return numbers, each, ~running


class _Parts(eqx.Module):
    """Adds up the numbers of several windows of one flight."""

    parts: tuple[FlightMetrics, ...]

    def begin(self, like: Float[Array, " axes *ensemble"]) -> tuple[PyTree, ...]:
        return tuple(part.begin(like) for part in self.parts)

    def update(self, total: tuple[PyTree, ...], now: SampleResult) -> tuple[tuple, None]:
        pairs = zip(self.parts, total, strict=True)
        return tuple(part.update(sums, now)[0] for part, sums in pairs), None
