"""The angle loop that a firmware closes around its rate loop: what it makes of its margins.

The rate's set-point is P times the error of the angle, so with T the response from set-point to
the true rate the open loop is P F(s) e^(-late s) T(s) / s. Source: docs/autopilots.md.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from jaxquad.records import AXES

from ._filters import FilterChain, PT3
from ._parameters import Firmware


_SHORT = ("RLL", "PIT", "YAW")
_PX4_ESTIMATE = 0.004  # s, from one attitude estimate to the next
_SMOOTH_HZ = 50.0  # of Betaflight's set-point in ANGLE mode

Frequencies = Float[np.ndarray, " frequencies"]
Open = Complex[np.ndarray, "plants frequencies"]


@dataclasses.dataclass(frozen=True)
class AngleLoop:
    """The gain of an axis' angle loop, and how late it acts.

    **Attributes:**

    - `name`: of the parameter; `value`: as the firmware stores it; `unit`: of it, in 1/s.
    - `late`: s from the angle to the rate's set-point.
    - `closed`: whether it was closed in the flight.
    - `smooth`: filters of the rate's set-point.
    """

    name: str
    value: float
    unit: float
    late: float
    closed: bool
    smooth: FilterChain = FilterChain()

    def path(self, omega: Frequencies) -> Complex[np.ndarray, " frequencies"]:
        """From the rate to minus the set-point, per 1/s of gain."""
        smooth = np.asarray(self.smooth.response(omega / (2 * np.pi)))
        return smooth * np.exp(-1j * omega * self.late) / (1j * omega)

    def gain(self, value: float) -> float:
        """In 1/s."""
        return self.unit * value


def angle_loop_of(
    firmware: Firmware, values: Mapping[str, str], axis: int, dt: float, *, levelled: bool
) -> AngleLoop | None:
    """The angle loop that a log's parameters describe; None where the firmware has none.

    `dt` is the rate loop's interval in s; `levelled` says whether Betaflight flew in ANGLE mode.
    """
    if firmware == "ardupilot":
        return _named(values, f"ATC_ANG_{_SHORT[axis]}_P", 1.0, dt, closed=True)
    if firmware == "px4":
        name = f"MC_{AXES[axis].upper()}_P"
        return _named(values, name, 1.0, 0.5 * _PX4_ESTIMATE + dt, closed=True)
    level = values.get("levelPID", "").split(",")[0]
    if axis == 2 or not level:
        return None
    smooth = FilterChain((PT3(_SMOOTH_HZ),), 1 / dt)
    named = _named({"angle_p_gain": level}, "angle_p_gain", 0.1, 0.0, closed=levelled)
    return None if named is None else dataclasses.replace(named, smooth=smooth)


def _named(
    values: Mapping[str, str], name: str, unit: float, late: float, *, closed: bool
) -> AngleLoop | None:
    value = float(values.get(name, 0.0))
    return AngleLoop(name, value, unit, late, closed) if value > 0 else None


class OuterQualities(NamedTuple):
    """What an angle loop gives, for each plant.

    **Attributes:**

    - `stable`; `peak`: Ms; `resonance`: of the response from set-point to angle.
    """

    stable: Bool[np.ndarray, " plants"]
    peak: Float[np.ndarray, " plants"]
    resonance: Float[np.ndarray, " plants"]


def delay_margin(loop: Open, omega: Frequencies) -> Float[np.ndarray, " plants"]:
    """The delay in s that brings each open loop to -1, at the worst of its crossings of 1."""
    size, angle = np.log(np.abs(loop)), np.angle(loop)
    falls = np.diff(np.sign(size), axis=1) != 0
    span = size[:, :-1] - size[:, 1:]
    part = np.where(falls, size[:, :-1] / np.where(span == 0, 1.0, span), 0.0)
    turned = np.angle(loop[:, 1:] / loop[:, :-1])
    phase = np.mod(angle[:, :-1] + part * turned + np.pi, 2 * np.pi)  # beyond -180 deg
    at = omega[:-1] * (omega[1:] / omega[:-1]) ** part
    return np.where(falls, phase / at, np.inf).min(axis=1)
