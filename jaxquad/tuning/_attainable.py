"""What the linear loop and the drive allow on the same plants, against which a flight is judged."""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad._core import as_array
from jaxquad.control import LADRC, PID
from jaxquad.ensembles import Members
from jaxquad.simulation import Authority, Encoder, Saturation, Scenario, window

from ._design_result import fly, flying_loop
from ._problem import decouple, DeviceChoice, TimeSpan


SETTLED = 0.05  # of a manoeuvre: the band within which a step counts as settled
_POINTS = 200  # at least, of a part of the flight; what is held between them counts by its mean

Parts = Float[np.ndarray, "parts axes members"]


class Attainable(NamedTuple):
    """The bounds of a flight on the plants that flew it, from event to event.

    ITAE in rad s^2, angles in rad. `linear` and `linear_peak` are the flight of the same gains
    without limit, friction and encoder, through the same noise: all that margins speak of. `drive`
    is less than any command within the limit can reach for the reference, which moves from rest:
    what is left of the step after full torque, behind lag and delay, all the time (a step from rest
    to rest costs 17 % more). `carried` is the angle at which a disturbance holds the plant against
    full torque, from rest.
    """

    linear: Parts
    linear_peak: Parts
    drive: Parts
    nothing: Parts  # of the command 0, from rest on the reference
    carried: Parts
    settled: Float[np.ndarray, "parts 1 1"]  # ITAE of an error that stays at the `band`
    step: float  # of the encoder
    moved: float  # how far the reference goes
    varies: bool  # whether the members differ in more than noise

    @property
    def band(self) -> float:
        """An error in rad that is none: within it a step has settled, or the encoder shows 0."""
        return max(SETTLED * self.moved, 0.5 * self.step)


def evaluate_attainable(
    controller: PyTree,
    drawn: Members,
    flight: Scenario,
    span: TimeSpan,
    authority: Authority | None,
    devices: DeviceChoice,
) -> Attainable:
    """For a controller and the members that fly, whose noise is in the `flight`."""
    axes, plant = drawn.axes, decouple(drawn.plant)
    still = None if plant.coulomb is None else as_array(np.zeros(plant.coulomb.shape))
    free = lambda x: dataclasses.replace(x, limit=as_array(np.full(x.limit.shape, np.inf)))
    drive = free(drawn.drive) if isinstance(drawn.drive, Saturation) else None
    ideal = dataclasses.replace(
        drawn, plant=dataclasses.replace(plant, coulomb=still), drive=drive, encoder=None
    )
    is_limited = lambda x: isinstance(x, LADRC | PID)
    unlimited = jax.tree.map(
        lambda x: free(x) if is_limited(x) else x, controller, is_leaf=is_limited
    )
    linear = fly(flying_loop(unlimited, ideal), flight, span, devices)

    def wide(values: Array | None) -> Float[np.ndarray, "axes members"]:
        x = np.zeros(axes) if values is None else np.asarray(values, float)
        return np.broadcast_to(x if x.ndim > 1 else x[:, None], (axes, drawn.size))

    inertia, lag, gain = wide(plant.inertia), wide(plant.lag), wide(plant.torque_gain)
    damping, stiffness, friction = map(wide, (plant.damping, plant.stiffness, plant.coulomb))
    delay = np.asarray(drawn.delay, float)
    torque = np.full(inertia.shape, np.inf) if authority is None else wide(authority.torque)
    full = lambda x: np.asarray(x, float).reshape(np.shape(x) + (1,) * (3 - np.ndim(x)))
    reference, disturbance = full(flight.reference), full(flight.disturbance)
    payload = full(np.zeros((1, 1)) if flight.payload is None else flight.payload)
    light, heavy = (inertia + f(payload, axis=0, initial=0.0) for f in (np.min, np.max))
    moved = max(float(reference.max()), 0.0) - min(float(reference.min()), 0.0)
    step = 2 * np.pi / drawn.encoder.counts if isinstance(drawn.encoder, Encoder) else 0.0
    rows, seconds = [], []
    for start, stop in span.parts:
        a, b, *_ = window(len(reference), drawn.dt, start=start, stop=stop, load_start=None)
        stride = max(1, (b + 1 - a) // _POINTS)
        count, h = (b + 1 - a) // stride, stride * drawn.dt
        targets, torques = (
            x[a : a + count * stride].reshape(count, stride, *x.shape[1:]).mean(axis=1)
            for x in (reference, disturbance)
        )
        targets = targets - (reference[a - 1] if a else 0.0)
        pushes = np.sign(torques) * np.maximum(np.abs(torques) - friction, 0)
        # Of the plant alone from rest: under the disturbance, and after a unit of impulse.
        angle = rate = response = held = least = nothing = carried = np.zeros_like(inertia)
        answer = 1 / heavy
        for t, target, push in zip(h * np.arange(1, count + 1), targets, pushes, strict=True):
            rate = rate + h / heavy * (push - damping * rate - stiffness * angle)
            answer = answer - h / heavy * (damping * answer + stiffness * response)
            angle, response = angle + h * rate, response + h * answer
            held = held + h * torque * np.abs(response)
            late = np.maximum(t - delay, 0)  # full torque, integrated twice behind lag and delay
            faded = lag * late + lag**2 * np.expm1(-late / np.where(lag > 0, lag, 1))
            reached = np.where(late > 0, torque / light * (0.5 * late**2 - faded), 0)
            least = least + h * t * np.maximum(np.abs(target) - reached, 0)
            nothing = nothing + h * t * np.abs(target - angle)
            carried = np.maximum(carried, np.abs(angle) - held)
        rows.append((least, nothing, carried))
        seconds.append(count * h)
    different = (inertia, gain, lag, damping, stiffness, friction, delay[None], payload[0],
                 np.asarray(drawn.assumed_inertia))  # fmt: skip
    varies = any(np.any(np.ptp(x, axis=-1) > 0) for x in different)
    bounds = (np.stack(x) for x in zip(*rows, strict=True))
    half_squares = 0.5 * np.reshape(seconds, (-1, 1, 1)) ** 2
    result = Attainable(linear.by_part, linear.peaks, *bounds, half_squares, step, moved, varies)
    return result._replace(settled=result.band * half_squares)
