"""The plant's gain over the collective: one thrust curve out of gains that were found in bins."""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxquad._core import Number, require_positive

from ._law import DEGREES


Points = Float[np.ndarray, " points"]
_WIDEST = 0.3  # 95 % half-width of the curve's factor up to which it is called known


class ThrustCurve(eqx.Module):
    """K(x) = level + slope x over a motor's command x of 0 to 1: thrust (1 - f) x + f x^2.

    f = slope / (2 level + slope) is PX4's THR_MDL_FAC and ArduPilot's MOT_THST_EXPO.

    **Arguments:**

    - `level`, `slope`: in the unit of the gain.
    - `covariance`: of the two, scaled by the misfit where that is above 1.
    - `span`: lowest and highest command of the bins.
    - `misfit`: chi^2 per degree of freedom of the bins; NaN for two of them.
    """

    level: float
    slope: float
    covariance: Float[np.ndarray, "2 2"]
    span: tuple[float, float]
    misfit: float

    @property
    def factor(self) -> float:
        """f, 0 for thrust linear in the command, 1 for the square."""
        return self.slope / (2 * self.level + self.slope)

    @property
    def factor_error(self) -> float:
        """One standard error of `factor`."""
        slopes = np.array([-2 * self.slope, 2 * self.level]) / (2 * self.level + self.slope) ** 2
        return float(np.sqrt(slopes @ self.covariance @ slopes))

    def gain(self, command: Points) -> tuple[Points, Points]:
        """K and its standard error at these commands of 0 to 1."""
        rows = np.stack([np.ones_like(command), command], axis=1)
        value = rows @ np.array([self.level, self.slope])
        return value, np.sqrt(np.einsum("pi,ij,pj->p", rows, self.covariance, rows))

    @property
    def verdict(self) -> str:
        """What the log cannot tell, and what to fly; empty where f is known to 0.3 (95 %)."""
        width = 1.96 * self.factor_error
        if width <= _WIDEST:
            return ""
        low, high = self.span
        return (
            f"This log cannot tell the thrust curve: its factor is {self.factor:.2f} +- "
            f"{width:.2f} (95 %) from commands of {low:.2f} to {high:.2f}. Excite the axis in "
            "climbs and descents too, so that the collective changes by half of its range."
        )


def pool_gains(
    command: Points,
    gain: Points,
    error: Points,
    *,
    flown_factor: Number = 0.0,
) -> ThrustCurve:
    """One thrust curve for all bins of the collective, by weighted least squares.

    **Arguments:**

    - `command`: the collective of each bin, 0 to 1, two bins at least.
    - `gain`: the plant's gain found in it, from the firmware's output to the acceleration.
    - `error`: its standard error; those of the bins are taken as independent.
    - `flown_factor`: the THR_MDL_FAC or MOT_THST_EXPO that flew, 0 for none (Betaflight's
        thrust_linear must have been 0). `command` is then the relative thrust that was asked for.

    **Raises:**

    - `ValueError`: fewer than two different commands, one beyond 0 to 1, or an error not above 0.
    """
    require_positive("error", error, "give standard errors")
    if len(np.unique(command)) < 2 or not np.all((command >= 0) & (command <= 1)):
        raise ValueError(
            f"the commands are {command}: give those of two bins at least, between 0 and 1."
        )
    motor = motor_command(command, flown_factor)
    steeper = 1 - flown_factor + 2 * flown_factor * motor  # thrust per command, which was undone
    value, deviation = gain * steeper, error * steeper
    rows = np.stack([np.ones_like(motor), motor], axis=1) / deviation[:, None]
    covariance = np.linalg.inv(rows.T @ rows)
    level, slope = covariance @ rows.T @ (value / deviation)
    left = value / deviation - rows @ np.array([level, slope])
    freedom = len(value) - 2
    misfit = float(left @ left / freedom) if freedom else float("nan")
    widened = covariance * max(1.0, misfit) if freedom else covariance
    span = float(motor.min()), float(motor.max())
    return ThrustCurve(float(level), float(slope), widened, span, misfit)


def motor_command(thrust: Points, factor: Number) -> Points:
    """The motor's command of 0 to 1 that a firmware gives for a relative thrust."""
    if factor == 0:
        return thrust
    half = (1 - factor) / (2 * factor)
    return -half + np.sign(factor) * np.sqrt(half**2 + thrust / factor)


def thrust_linear(
    curve: ThrustCurve, *, version: tuple[int, ...] = (2025, 12)
) -> tuple[float, float]:
    """Betaflight's thrust_linear in percent that makes thrust most linear, and its error.

    **Arguments:**

    - `version`: of Betaflight; the formula changed in 2026.6.

    **Returns:** the value, 0 to 150, and its standard error.
    """
    h = 0.02
    best = [_most_linear(curve.factor + step, version) for step in (-h, 0.0, h)]
    return best[1], abs(best[2] - best[0]) / (2 * h) * curve.factor_error


def _most_linear(factor: float, version: tuple[int, ...]) -> float:
    t, e = np.linspace(0, 1, 101), np.linspace(0, 1.5, 301)[:, None]
    if version >= (2026, 6):
        motor = t * (1 + e * (1 - t) * (1 + e * (1 - 2 * t)))
    else:
        motor = t * (1 + e * (1 - t) ** 2)
    off = factor * motor**2 + (1 - factor) * motor - t
    return float(100 * e[np.argmin(np.mean(off**2, axis=1)), 0])


class B0Law(NamedTuple):
    """How the proposed ADRC's b0 is to follow the throttle.

    **Arguments:**

    - `law`: FIXED, SQRT, LINEAR or QUADRATIC.
    - `b0`: at the hover throttle, in deg/s^3 per pidsum; `error`: by the gain alone.
    - `deviation`: the greatest of |law/K - 1| over the throttles that were flown above hover.
    """

    law: str
    b0: float
    error: float
    deviation: float


_POWERS = {"FIXED": 0.0, "SQRT": 0.5, "LINEAR": 1.0, "QUADRATIC": 2.0}


def adrc_b0_law(curve: ThrustCurve, *, hover: Number, lag: Number) -> B0Law:
    """The law of b0 over the throttle that is nearest to a thrust curve.

    b0 is that of the hover throttle times (throttle/hover)^(0, 1/2, 1 or 2), within 1 to 3.

    **Arguments:**

    - `curve`: of the gain per unit of pidsum/1000.
    - `hover`: throttle of 0 to 1.
    - `lag`: of the motors in s.

    **Raises:**

    - `ValueError`: `hover` or `lag` is not above 0.
    """
    require_positive("hover", hover, "give a throttle of 0 to 1")
    require_positive("lag", lag, "give the motors' lag in s")
    throttle = np.linspace(hover, max(curve.span[1], hover), 50)
    gain, error = curve.gain(throttle)
    worst = {
        law: float(np.max(np.abs(np.clip((throttle / hover) ** power, 1, 3) * gain[0] / gain - 1)))
        for law, power in _POWERS.items()
    }
    law = min(worst, key=lambda name: worst[name])
    scale = DEGREES / (1000 * lag)
    return B0Law(law, float(scale * gain[0]), float(scale * error[0]), worst[law])
