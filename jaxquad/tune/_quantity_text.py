"""Quantities as they are printed: angles in degrees, margins in dB, deg and ms."""

from typing import NamedTuple

import numpy as np


_DEGREE = float(np.degrees(1.0))


class Shown(NamedTuple):
    """How a quantity in SI units is printed."""

    title: str
    unit: str
    scale: float = 1.0
    decibels: bool = False

    def number(self, value: float) -> float:
        if self.decibels:
            with np.errstate(divide="ignore", invalid="ignore"):
                return float(20 * np.log10(value))
        return float(value) * self.scale

    def text(self, value: float, *, unit: bool = True) -> str:
        number = self.number(value)
        if np.isnan(number):
            return "n/a"
        if np.isinf(number):
            return "any" if "margin" in self.title else f"{'-' if number < 0 else ''}inf"
        return f"{number:.4g}{' ' + self.unit if unit and self.unit else ''}"


SHOWN = {
    "itae": Shown("ITAE", "deg s^2", _DEGREE),
    "iae": Shown("IAE", "deg s", _DEGREE),
    "ise": Shown("ISE", "deg^2 s", _DEGREE**2),
    "overshoot": Shown("overshoot", "%"),
    "peak": Shown("peak error", "deg", _DEGREE),
    "rms": Shown("rms error", "deg", _DEGREE),
    "disturbance_rmse": Shown("disturbance error", "N m"),
    "activity": Shown("activity", "u^2"),
    "activity_rate": Shown("activity", "u^2/s"),
    "energy": Shown("energy", "u^2 s"),
    "saturation_share": Shown("saturated", "%", 100.0),
    "abscissa": Shown("slowest pole", "1/s"),
    "sensitivity_peak": Shown("Ms", ""),
    "gain_margin": Shown("gain margin up", "dB", decibels=True),
    "gain_reduction": Shown("gain margin down", "dB", decibels=True),
    "phase_margin": Shown("phase margin", "deg", _DEGREE),
    "delay_margin": Shown("delay margin", "ms", 1e3),
    "noise_gain": Shown("noise gain", "u/rad"),
}
