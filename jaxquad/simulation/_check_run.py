import numpy as np

from jaxquad._core import is_concrete
from jaxquad.control import PD
from jaxquad.loops import CarriesPayload, Controller, Loop, Plant

from ._scenario import Scenario


def check_run(loop: Loop, scenario: Scenario) -> None:
    """Raises ValueError for a loop that cannot run, and for a scenario that does not fit it."""
    if not isinstance(loop.controller, Controller):
        raise ValueError(
            f"a {type(loop.controller).__name__} cannot be run: a controller needs init(like) and "
            "step(state, reference, measurement)"
        )
    feeds = scenario.rate is not None or scenario.acceleration is not None
    if feeds and isinstance(loop.controller, PD):
        raise ValueError(
            "a PD feeds nothing forward, but the scenario gives the reference's rate or "
            "acceleration: take a jq.LADRC or jq.PID, or leave them None"
        )
    _check_payload(loop.plant, scenario)
    _check_numbers(scenario)


def _check_payload(plant: Plant, scenario: Scenario) -> None:
    if scenario.payload is None:
        return
    if not isinstance(plant, CarriesPayload):
        raise ValueError(
            f"the scenario has a payload, but {type(plant).__name__} has no "
            "with_added_inertia(inertia) to carry it: add that method, or leave the payload None"
        )
    if is_concrete(scenario.payload):
        plant.with_added_inertia(
            np.min(np.asarray(scenario.payload), axis=0)
        )  # it refuses one that is too low


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
