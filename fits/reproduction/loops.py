"""The paper's rig and controllers, under every reading of its command u."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

import jaxquad as jq


jq.enable_x64()  # before the first array of any script that imports this

DT = 0.002  # s
SHEET = jq.models.QUANSER_HOVER
INERTIA = SHEET.inertia[0]
LEVER = SHEET.arm * SHEET.thrust_coefficient  # N m per volt of V4 - V2
WC, WO = 10.0, 30.0  # rad/s
START, END = 3.0, 1.6  # b0 before and after the paper's adaptation
# What u may be, and N m per unit of it: a difference of two motors' voltages, a voltage that goes
# to both with opposite signs, the torque itself, or whatever makes the last b0 the right one.
DIFFERENCE, VOLTAGE, TORQUE, FITTED = "u = V4 - V2", "u = +-V", "u in N m", "b = 1.6"
TORQUE_GAINS = {DIFFERENCE: LEVER, VOLTAGE: 2 * LEVER, TORQUE: 1.0, FITTED: END * INERTIA}


class Response(NamedTuple):
    """What a loop made of a step of the set-point, in units of the step."""

    overshoot: float  # %; infinite for a loop that diverged
    settling: float  # s, to 2 %; nan if never
    itae: float  # s^2; infinite for a loop that diverged
    angle: np.ndarray  # [samples]

    @property
    def numbers(self) -> dict[str, float]:
        return {"overshoot, %": self.overshoot, "settling, s": self.settling, "ITAE": self.itae}


def rig(torque_gain: ArrayLike, **friction: Any) -> jq.DecoupledAxes:
    """A roll axis for each `torque_gain`, along the ensemble."""
    gain = np.atleast_1d(np.asarray(torque_gain, float))[None]
    return jq.DecoupledAxes(gain, np.full(gain.shape, INERTIA), **friction)


def ladrc(b0: ArrayLike, **options: Any) -> jq.LADRC:
    """The paper's bandwidths with a `b0` for each member."""
    return jq.LADRC(WC, WO, np.atleast_1d(np.asarray(b0, float))[None], dt=DT, **options)


def run_step(
    plant: Any, controller: Any, size: ArrayLike, **options: Any
) -> jq.simulation.Simulation:
    """10 s after a step of `size` rad, one or one for each member."""
    sizes = np.atleast_1d(np.asarray(size, float))
    happening = jq.scenario(duration=10.0, dt=DT, axes=1, reference=jq.Step(sizes))
    return jq.simulate(jq.Loop(plant, controller, dt=DT, **options), happening)


def responses(done: jq.simulation.Simulation) -> list[Response]:
    """Every member's response to its step."""
    metrics = jq.simulation.metrics(done).normalised()
    size = np.asarray(done.reference)[-1, 0]
    angle = np.asarray(done.angle)[:, 0] / size
    lost = np.asarray(done.diverged)
    overshoot, itae = (
        np.where(lost, np.inf, np.asarray(x)[0]) for x in (metrics.overshoot, metrics.itae)
    )
    settling = np.where(lost, np.nan, np.asarray(metrics.settling_time)[0])
    columns = zip(overshoot, settling, itae, angle.T, strict=True)
    return [Response(float(o), float(s), float(i), member) for o, s, i, member in columns]


def step(plant: Any, controller: Any, size: ArrayLike, **options: Any) -> list[Response]:
    return responses(run_step(plant, controller, size, **options))
