"""Plants of the suite with their drives, encoders and delays, as wide as an ensemble."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad.models import DecoupledAxes, Multirotor, quanser_hover
from jaxquad.simulation import Encoder, MotorDrive, Saturation

from .linear import Late


LONGEST_DELAY = 0.01  # s, one for all cases: they then share what is compiled
_AS_IT_IS = {"limit", "encoder", "lag", "delay", "coulomb"}
_FACTORS = {"torque_factor": "torque_gain", "inertia_factor": "inertia"}


class MixedEncoder(Encoder):
    """An encoder with its own `steps` in rad for each member."""

    steps: Float[Array, " members"] = eqx.field(converter=jnp.asarray, default=0.001)

    def __call__(self, angle: Float[Array, "..."]) -> Float[Array, "..."]:
        step = self.steps[None]
        return angle + jnp.round(angle / step) * step - angle


class Rig(NamedTuple):
    """A plant with its devices, and what the nominal one of its axes is like."""

    plant: DecoupledAxes | Multirotor
    options: dict[str, Any]  # of jq.simulate
    torque_gain: np.ndarray  # [axes, members] nominal, N m per unit of command
    inertia: np.ndarray  # [axes, members] nominal
    limit: np.ndarray  # [axes, members] of the command
    volts: np.ndarray  # [axes] units of command per volt of u


def rig(level: dict[str, Any], width: int, changes: dict[str, np.ndarray] | None = None) -> Rig:
    """The plant of this `level` for `width` members, with `changes` by member."""
    changes = changes or {}
    unknown = set(changes) - _AS_IT_IS - set(_FACTORS)
    if unknown:
        raise ValueError(f"{sorted(unknown)} cannot be changed by member")
    if "vehicle" in level:
        if changes:
            raise ValueError(f"the three-axis rig takes no {sorted(changes)} by member")
        return _three_axes(level, width)
    value = {name: np.full((1, width), x) for name, x in level.items()}
    value |= {name: x[None] for name, x in changes.items() if name in _AS_IT_IS}
    limit = value.get("limit", np.full((1, width), np.inf))
    options: dict[str, Any] = {}
    if "limit" in level:
        options["drive"] = Saturation(limit)
    options |= _sensing(level, value)
    return Rig(
        _axis(level, width, changes), options, value["torque_gain"], value["inertia"], limit,
        np.ones(1),
    )  # fmt: skip


def linear_axis(level: dict[str, Any], width: int, changes: dict[str, np.ndarray]) -> DecoupledAxes:
    """The first axis of the plant, `changes` by member."""
    if "vehicle" not in level:
        return _axis(level, width, changes)
    near = _vehicle(level).decoupled()
    first = {
        name: np.full((1, width), np.asarray(getattr(near, name))[0])
        for name in ("torque_gain", "inertia", "damping", "stiffness")
    }
    lag = changes.get("lag", np.full(width, level["lag"]))
    return DecoupledAxes(**first, lag=lag[None])


def lateness(level: dict[str, Any], width: int) -> Late:
    """The delay of a plant, for each member."""
    if "delay" not in level:
        return Late()
    return Late(np.full(width, level["delay"]), LONGEST_DELAY)


def _axis(level: dict[str, Any], width: int, changes: dict[str, np.ndarray]) -> DecoupledAxes:
    def wide(name: str, x: float) -> np.ndarray:
        return np.full((1, width), changes.get(name, x), float)

    given = {name: wide(name, level[name]) for name in ("torque_gain", "inertia")}
    for factor, name in _FACTORS.items():
        given[name] = given[name] * wide(factor, 1.0)
    given |= {name: wide(name, level[name]) for name in ("lag", "coulomb") if name in level}
    zero = np.zeros((1, width))
    return DecoupledAxes(**given, damping=zero, stiffness=zero)


def _sensing(level: dict[str, Any], value: dict[str, np.ndarray]) -> dict[str, Any]:
    options = {}
    if "encoder" in level:
        options["encoder"] = MixedEncoder(steps=2 * np.pi / value["encoder"][0])
    if "delay" in level:
        options |= {"delay": value["delay"][0], "longest_delay": LONGEST_DELAY}
    return options


def _vehicle(level: dict[str, Any]) -> Multirotor:
    names = ("lag", "damping", "stiffness", "coulomb")
    return quanser_hover(**{name: level[name] for name in names})


def _three_axes(level: dict[str, Any], width: int) -> Rig:
    plant = _vehicle(level)
    near, volts = plant.decoupled(), np.array(level["volts"])
    wide = lambda x: np.array(np.broadcast_to(np.asarray(x)[:, None], (3, width)), float)
    # A motor serves yaw and one other axis: each may have half of what its bias leaves.
    limit = wide(volts * 0.5 * (level["motor_limit"] - level["bias"]))
    value = {name: np.full((1, width), level[name]) for name in ("encoder", "delay")}
    drive = MotorDrive(plant.allocation, bias=level["bias"], limit=level["motor_limit"])
    options = {"drive": drive, **_sensing(level, value)}
    return Rig(plant, options, wide(near.torque_gain), wide(near.inertia), limit, volts)
