"""The thrust curve t = f x^2 + (1 - f) x, and the firmwares' parameters that go by it."""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from .uncertainty._verdict import Combination, reach_of_interval


CurveFirmware = Literal["px4", "ardupilot", "betaflight", "betaflight 2025.12"]
_PARAMETERS: Mapping[str, tuple[str, float, float, float]] = {  # name, factor on f, least, most
    "px4": ("THR_MDL_FAC", 1.0, 0.0, 1.0),
    "ardupilot": ("MOT_THST_EXPO", 1.0, -1.0, 1.0),
    "betaflight": ("thrust_linear", 100.0, 0.0, 150.0),
    "betaflight 2025.12": ("thrust_linear", 100.0, 0.0, 150.0),
}


def actuator(throttle: Float[ArrayLike, "..."], curve: float) -> Float[np.ndarray, "..."]:
    """The motor's command x, 0 to 1, of a firmware that inverts t = curve x^2 + (1 - curve) x."""
    t = np.asarray(throttle, float)
    if curve == 0:
        return t
    half = (1 - curve) / (2 * curve)
    return np.asarray(-half + np.sign(curve) * np.sqrt(half**2 + t / curve))


def relative_slope(
    throttle: Float[ArrayLike, "..."], curve: float, flown: float
) -> Float[np.ndarray, "..."]:
    """The gain over the throttle, relative to that of the `flown` curve being right."""
    x = actuator(throttle, flown)
    return np.asarray((1 - curve + 2 * curve * x) / (1 - flown + 2 * flown * x))


class FirmwareValue(NamedTuple):
    """A parameter of a firmware that straightens the thrust curve, with its 95 % interval."""

    name: str
    value: float  # within the documented range
    standard_error: float
    interval: tuple[float, float]  # not cut to the range

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.name} {self.value:.3g} (95 %: {low:.3g} .. {high:.3g})"

    def content(self) -> dict[str, object]:
        """All of it, for JSON."""
        content: dict[str, object] = dict(self._asdict())
        content["interval_95"] = content.pop("interval")
        return content


def curve_parameter(firmware: CurveFirmware) -> str:
    """The name of the parameter; ValueError for another firmware."""
    if firmware not in _PARAMETERS:
        raise ValueError(f"firmware is {firmware!r}: use one of {', '.join(_PARAMETERS)}")
    return _PARAMETERS[firmware][0]


def parameter_of_curve(firmware: CurveFirmware, curve: Combination) -> FirmwareValue:
    """The parameter that inverts this f, with the error of f."""
    name, factor, least, most = _PARAMETERS[firmware]
    convert = _cubic if firmware == "betaflight 2025.12" else float
    slope = (convert(curve.value + 1e-4) - convert(curve.value - 1e-4)) / 2e-4
    value, error = factor * convert(curve.value), factor * abs(slope) * curve.standard_error
    reach = reach_of_interval(curve.degrees_of_freedom) * error
    interval = (value - reach, value + reach)
    return FirmwareValue(name, float(np.clip(value, least, most)), error, interval)


def _cubic(curve: float) -> float:
    """e of t (1 + e (1 - t)^2) nearest to the inverse of the thrust curve."""
    t = (np.arange(1000) + 0.5) / 1000
    shape = t * (1 - t) ** 2
    return float(shape @ (actuator(t, curve) - t) / (shape @ shape))


def curve_of_parameter(firmware: CurveFirmware, value: float | int) -> float:
    """f of the thrust curve that a firmware inverts with this value of its parameter.

    It is the inverse of `GainOverThrottle.firmware_value`.

    **Arguments:**

    - `firmware`: as there.
    - `value`: of THR_MDL_FAC, MOT_THST_EXPO or thrust_linear.

    **Returns:** -1 to 1; for thrust_linear beyond what a curve of this family can be, the nearest.

    **Raises:**

    - `ValueError`: for another firmware.
    """
    curve_parameter(firmware)
    share = float(value) / _PARAMETERS[firmware][1]
    if firmware == "betaflight 2025.12":
        curves = np.linspace(0.0, 1.0, 201)
        return float(np.interp(share, [_cubic(float(curve)) for curve in curves], curves))
    return float(np.clip(share, -1.0, 1.0))


B0Law = Literal["FIXED", "SQRT", "LINEAR", "QUADRATIC"]
B0_POWERS: Mapping[B0Law, float] = {"FIXED": 0.0, "SQRT": 0.5, "LINEAR": 1.0, "QUADRATIC": 2.0}


class B0Schedule(NamedTuple):
    """How Betaflight's proposed ADRC scales b0 over the throttle.

    **Arguments:**

    - `law`: adrc_b0_law.
    - `hover`: adrc_hover_throttle, 0 to 1, where the scale is 1.
    - `low`, `high`: adrc_b0_scale_min and adrc_b0_scale_max, as factors.
    """

    law: B0Law
    hover: float
    low: float = 1.0
    high: float = 3.0

    def scale(self, throttle: Float[ArrayLike, "..."]) -> Float[np.ndarray, "..."]:
        """The factor on b0 at a throttle of 0 to 1."""
        scale = (np.asarray(throttle) / self.hover) ** B0_POWERS[self.law]
        return np.asarray(np.clip(scale, self.low, self.high))
