import math

import numpy as np

from jaxquad._core import is_concrete
from jaxquad.control import PD
from jaxquad.models import Multirotor

from ._delay import Settings
from ._protocols import Controller, Plant
from ._scenario import Scenario


def check_loop(
    plant: Plant, controller: Controller, scenario: Scenario, settings: Settings
) -> None:
    """Raises ValueError for parts that do not go together."""
    made_for, dt = getattr(controller, "dt", settings.dt), settings.dt
    if not math.isclose(made_for, dt, rel_tol=1e-6):
        raise ValueError(f"the controller was made for samples of {made_for} s, not {dt} s")
    if isinstance(plant, Multirotor) and settings.drive is None:
        raise ValueError(
            "drive is None, but a Multirotor turns by four motor inputs: give "
            "drive=jq.simulation.MotorDrive(plant.allocation)"
        )
    feeds = scenario.rate is not None or scenario.acceleration is not None
    if feeds and isinstance(controller, PD):
        raise ValueError(
            "a PD feeds nothing forward, but the scenario gives the reference's rate or "
            "acceleration: take a jq.LADRC or jq.PID, or leave them None"
        )
    _check_payload(plant, scenario)
    _check_numbers(scenario)


def _check_payload(plant: Plant, scenario: Scenario) -> None:
    if scenario.payload is None:
        return
    carry = getattr(plant, "with_added_inertia", None)
    if carry is None:
        raise ValueError(
            f"the scenario has a payload, but {type(plant).__name__} has no "
            "with_added_inertia(inertia) to carry it: add that method, or leave the payload None"
        )
    if is_concrete(scenario.payload):
        carry(np.min(np.asarray(scenario.payload), axis=0))  # it refuses one that is too low


def _check_numbers(scenario: Scenario) -> None:
    for name, part in vars(scenario).items():
        if part is not None and is_concrete(part):
            finite = np.isfinite(np.asarray(part))
            bad = np.flatnonzero(~finite.all(axis=tuple(range(1, part.ndim))))
            if bad.size:
                raise ValueError(
                    f"the scenario's {name} is not finite at sample {bad[0]}: look for the nan or "
                    "inf in it"
                )
