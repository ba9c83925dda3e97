"""What objectives and limits are made of: names, and how a number of each is compared."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float


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


class Quantity(NamedTuple):
    """How a number is compared: as its logarithm, or in steps of `scale`."""

    unit: str
    logarithmic: bool = True
    scale: float = 1.0
    least: float = 1e-9  # that a logarithm is taken of
    most: float = 1e9
    smaller_is_worse: bool = False
    summed: bool = False  # over the axes in an objective; else the worst axis counts


IN_TIME = {
    "itae": Quantity("rad s^2", summed=True),
    "iae": Quantity("rad s", summed=True),
    "ise": Quantity("rad^2 s", summed=True),
    "activity": Quantity("unit^2", summed=True),
    "activity_rate": Quantity("unit^2/s", summed=True),
    "energy": Quantity("unit^2 s", summed=True),
    "overshoot": Quantity("%", logarithmic=False, scale=10.0),
    "peak": Quantity("rad"),
    "rms": Quantity("rad"),
    "disturbance_rmse": Quantity("N m"),
    "saturation_share": Quantity("1", logarithmic=False, scale=0.1),
}
OF_THE_LOOP = {
    "abscissa": Quantity("1/s", logarithmic=False),
    "sensitivity_peak": Quantity("1"),
    "noise_gain": Quantity("unit/rad"),
    "gain_margin": Quantity("1", least=1.0, most=1e3, smaller_is_worse=True),
    "gain_reduction": Quantity("1", least=1e-3),
    "phase_margin": Quantity("rad", logarithmic=False, most=3.15, smaller_is_worse=True),
    "delay_margin": Quantity("s", least=1e-5, most=10.0, smaller_is_worse=True),
}
QUANTITIES = IN_TIME | OF_THE_LOOP


def require_quantity(name: str) -> None:
    """Raises ValueError for a quantity that does not exist."""
    if name not in QUANTITIES:
        raise ValueError(f"there is no quantity {name!r}: choose one of {', '.join(QUANTITIES)}")


def level(name: str, value: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
    """What weights and penalties act on: ln of the value, or the value over its scale."""
    quantity, value = QUANTITIES[name], jnp.asarray(value)
    bounded = jnp.minimum(value, quantity.most)
    if not quantity.logarithmic:
        return bounded / quantity.scale
    return jnp.log(jnp.maximum(bounded, quantity.least))


def per_member(
    name: str, value: Float[Array, "axes members"], *, worst: bool = False
) -> Float[Array, " members"]:
    """One number for each member: the sum over its axes, or that of its worst axis."""
    quantity = QUANTITIES[name]
    if quantity.summed and not worst:
        return jnp.sum(value, axis=0)
    return jnp.min(value, axis=0) if quantity.smaller_is_worse else jnp.max(value, axis=0)
