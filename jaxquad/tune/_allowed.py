"""What a controller refuses of its own gains, which a traced one cannot."""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np

from ._observer_alone import modules, runaway, sluggish
from ._parameters import Coordinates


def refusal(coordinates: Coordinates, z: np.ndarray) -> str:
    """Why the controller at `z` cannot be built or must not be flown; empty if it can."""
    controller = _built(coordinates, z)
    for part in modules(controller):
        try:
            dataclasses.replace(part)
        except ValueError as error:
            return str(error)
    return runaway(controller) or sluggish(controller)


@eqx.filter_jit
def _built(coordinates: Coordinates, z: Any) -> Any:
    return coordinates.controller_at(z)
