"""What figures of an autopilot's loop show."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


Frequencies = Float[np.ndarray, " frequencies"]


class Spectrum(NamedTuple):
    """A power spectral density, one-sided, per Hz."""

    hertz: Frequencies
    power: Frequencies


class StepBand(NamedTuple):
    """Step responses of many plants: their median, and between which 95 % of them lie."""

    time: Float[np.ndarray, " samples"]
    middle: Float[np.ndarray, " samples"]
    low: Float[np.ndarray, " samples"]
    high: Float[np.ndarray, " samples"]


class ThrottleCurve(NamedTuple):
    """A quantity over the throttle of 0 to 1, as a firmware takes it."""

    throttle: Float[np.ndarray, " points"]
    value: Float[np.ndarray, " points"]


class FlownAgain(NamedTuple):
    """A part of a flight as it was logged, and as law and plant fly it again: s and rad/s."""

    time: Float[np.ndarray, " samples"]
    setpoint: Float[np.ndarray, " samples"]
    rate: Float[np.ndarray, " samples"]
    again: Float[np.ndarray, " samples"]
