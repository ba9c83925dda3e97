"""Plants with drawn values in place of their nominal ones."""

from collections.abc import Mapping

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxquad._core import as_float
from jaxquad.models import Allocation, Attitude, DecoupledAxes, MotorLag, Multirotor


# Factors of nominal values; the other quantities replace these.
FACTORS = ("inertia", "torque_gain", "assumed_inertia")
QUANTITIES = (*FACTORS, "lag", "delay", "damping", "stiffness", "coulomb", "noise", "gust")
VariablePlant = DecoupledAxes | Multirotor
Numbers = Float[np.ndarray, "..."]
Drawn = Mapping[str, Numbers]  # [axes] or [axes, members] of each quantity


def nominal_value(plant: VariablePlant, name: str) -> Numbers | None:
    """The value of a quantity in a plant without members; None if the plant does not have it."""
    if name == "lag" and isinstance(plant, Multirotor):
        return None if plant.motor is None else np.asarray(plant.motor.time_constant)
    value = vars(plant.attitude if isinstance(plant, Multirotor) else plant).get(name)
    return None if value is None else np.asarray(value)


def vary_plant(plant: VariablePlant, drawn: Drawn) -> VariablePlant:
    """The plant with drawn factors of inertia and torque gain, and the other quantities replaced.

    Quantities that were not drawn keep the plant's value.
    """
    names = ("damping", "stiffness", "coulomb")
    values = {name: drawn.get(name, nominal_value(plant, name)) for name in names}
    own = {name: value for name, value in values.items() if value is not None}
    inertia = multiply(plant_inertia(plant), drawn["inertia"])
    if isinstance(plant, DecoupledAxes):
        gain = multiply(np.asarray(plant.torque_gain), drawn["torque_gain"])
        return DecoupledAxes(gain, inertia, lag=drawn.get("lag", plant.lag), **own)
    attitude = Attitude(inertia, rotor_inertia=plant.attitude.rotor_inertia, **own)
    motor = MotorLag(drawn["lag"][0]) if "lag" in drawn else plant.motor
    return Multirotor(attitude, _scale_torques(plant.allocation, drawn["torque_gain"][0]), motor)


def _scale_torques(rotors: Allocation, factor: Numbers) -> Allocation:
    """All three torques times a factor; the arm is as wide, since it tells the ensemble's shape."""
    where = lambda r: (r.arm, r.thrust_coefficient, r.torque_coefficient)
    factors = (np.ones_like(factor), factor, factor)
    scaled = [as_float(np.asarray(x) * y) for x, y in zip(where(rotors), factors, strict=True)]
    return eqx.tree_at(where, rotors, scaled)


def plant_inertia(plant: VariablePlant) -> Numbers:
    """[axes] or [axes, members], kg m^2."""
    return np.asarray(plant.attitude.inertia if isinstance(plant, Multirotor) else plant.inertia)


def count_axes(plant: VariablePlant) -> int:
    """How many angles a plant turns by."""
    return 3 if isinstance(plant, Multirotor) else plant.shape[0]


def multiply(a: Numbers, b: Numbers) -> Numbers:
    """The product; the one with fewer trailing axes holds for all members."""
    rank = max(a.ndim, b.ndim)
    a, b = (x.reshape(x.shape + (1,) * (rank - x.ndim)) for x in (a, b))
    return a * b
