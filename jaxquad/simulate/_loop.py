import functools as ft
import math
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad.records import Record

from ._actuator import MotorDrive
from ._integrate import runge_kutta
from ._sensor import Encoder


AXES = ("roll", "pitch", "yaw")


@runtime_checkable
class Plant(Protocol):
    """What a loop is closed around: `jq.Multirotor`, or a user's own module."""

    def init(self, euler: Any = None, *, ensemble: tuple[int, ...] = ()) -> PyTree: ...
    def derivative(self, state: Any, inputs: Any, disturbance: Any) -> PyTree: ...
    def measure(self, state: Any) -> Float[Array, " axes *ensemble"]: ...


@runtime_checkable
class Controller(Protocol):
    """What closes a loop, one step a sample."""

    def init(self, like: Any) -> PyTree: ...
    def step(self, state: Any, reference: Any, measurement: Any) -> tuple[PyTree, Array]: ...


class Scenario(eqx.Module):
    """What happens to a loop, sample by sample; a trailing axis makes an ensemble."""

    reference: Float[Array, " samples axes *ensemble"]  # attitude set-point, rad
    injection: Float[Array, " samples axes *ensemble"]  # added to the command, V
    disturbance: Float[Array, " samples axes *ensemble"]  # torque, N m
    noise: Float[Array, " samples axes *ensemble"]  # on the measured angle, rad

    def __check_init__(self):
        parts = (self.reference, self.injection, self.disturbance, self.noise)
        if all(isinstance(part, jax.Array | np.ndarray) for part in parts):
            shapes = [part.shape for part in parts]
            if len(set(shapes)) != 1:
                raise ValueError(f"a scenario's arrays have different shapes: {shapes}")


class Simulation(eqx.Module):
    """What a simulated loop did."""

    time: Float[Array, " samples"]  # s
    angle: Float[Array, " samples axes *ensemble"]  # true, rad
    measurement: Float[Array, " samples axes *ensemble"]  # rad
    command: Float[Array, " samples axes *ensemble"]  # achieved, V
    injection: Float[Array, " samples axes *ensemble"]  # V

    def record(self, axis: str = "roll", *, member: int | None = None) -> Record:
        """The axis as it would be logged: achieved command, measured angle, injected sweep.

        `member` picks one of an ensemble. Raises `ValueError` for an axis that does not exist.
        """
        if axis not in AXES:
            raise ValueError(f"axis {axis!r}: choose one of {', '.join(AXES)}")
        if member is None and self.angle.ndim > 2:
            raise ValueError(
                f"an ensemble of shape {self.angle.shape[2:]} has many records: pick one, member=0"
            )
        k = AXES.index(axis)
        place = (slice(None), k) if member is None else (slice(None), k, member)
        command, angle, sweep = (
            np.asarray(x[place]) for x in (self.command, self.measurement, self.injection)
        )
        excited = np.ptp(sweep) > 0
        return Record(
            np.asarray(self.time), command, angle, sweep if excited else None,
            input_names=f"{axis}_command", output_names=f"{axis}_angle",
            reference_names="sweep" if excited else None,
            input_units="V", output_units="rad", reference_units="V" if excited else None,
            source="simulation",
        )  # fmt: skip


def simulate(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    *,
    dt: float = 0.002,
    drive: MotorDrive | None = None,
    encoder: Encoder | None = None,
) -> Simulation:
    """Run a sampled-data loop: measure, control, hold the inputs for `dt` seconds, repeat.

    Between samples the plant is integrated by a fourth-order Runge-Kutta step under constant
    inputs. The injected signal is added to the controller's command, so that a sweep can excite a
    plant that needs stabilising; `drive` makes motor inputs of the sum, as `jq.Multirotor` needs.
    One loop, or an ensemble along the last axis of the scenario, of the plant's parameters, or of
    both. Raises `ValueError` for a controller made for another `dt`.
    """
    if not dt > 0:
        raise ValueError(f"dt is {dt} s: give a positive sample interval")
    made_for = getattr(controller, "dt", dt)
    if not math.isclose(made_for, dt, rel_tol=1e-6):
        raise ValueError(f"the controller was made for samples of {made_for} s, not {dt} s")
    angle, measurement, command, injection = _scan(plant, controller, scenario, dt, drive, encoder)
    time = dt * jnp.arange(angle.shape[0], dtype=angle.dtype)
    return Simulation(time, angle, measurement, command, injection)


@eqx.filter_jit
def _scan(plant, controller, scenario, dt, drive, encoder):
    start = plant.init(ensemble=scenario.reference.shape[2:])
    ensemble = plant.measure(start).shape[1:]
    scenario = jax.tree.map(ft.partial(_widen, ensemble=ensemble), scenario)
    sample = ft.partial(_sample, plant, controller, dt, drive, encoder)
    carry = (start, controller.init(scenario.noise[0]))
    return *jax.lax.scan(jax.checkpoint(sample), carry, scenario)[1], scenario.injection


def _widen(
    signal: Float[Array, "samples axes ..."], ensemble: tuple[int, ...]
) -> Float[Array, "samples axes ..."]:
    """One scenario for all members of an ensemble of plants."""
    missing = len(ensemble) - (signal.ndim - 2)
    aligned = signal.reshape(signal.shape[:2] + (1,) * missing + signal.shape[2:])
    return jnp.broadcast_to(aligned, signal.shape[:2] + ensemble)


def _sample(plant, controller, dt, drive, encoder, carry, now):
    state, memory = carry
    angle = plant.measure(state)
    measurement = angle + now.noise
    measurement = measurement if encoder is None else encoder(measurement)
    memory, command = controller.step(memory, now.reference, measurement)
    inputs = command + now.injection
    achieved = inputs
    if drive is not None:
        inputs = drive.inputs(inputs)
        achieved = drive.achieved(inputs)
    held = ft.partial(plant.derivative, inputs=inputs, disturbance=now.disturbance)
    state = runge_kutta(held, state, dt)
    return (state, memory), (angle, measurement, achieved)
