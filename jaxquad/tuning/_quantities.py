"""The quantities that are tuned, limited and certified: one entry each in `QUANTITIES`."""

from collections.abc import Collection
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float


Value = TypeVar("Value", bound=ArrayLike)  # NumPy's stay so: nothing is compiled for them
_DEGREE = float(np.degrees(1.0))


class Quantity(NamedTuple):
    """A number of a loop: how it is computed, how two of it compare, and how it is printed."""

    title: str  # in tables and figures
    unit: str  # as printed
    factor: float = 1.0  # from SI units to the printed one
    decibels: bool = False  # printed as 20 log10
    linear: bool = False  # of the linear loop, see `jq.loops.LoopAnalysis`; else of a flight
    si_unit: str = "1"
    logarithmic: bool = True  # it is compared by its logarithm; else in steps of `scale`
    scale: float = 1.0
    least: float = 1e-9  # value of which a logarithm is taken
    most: float = 1e9
    smaller_is_worse: bool = False
    summed: bool = False  # over the axes in an objective; else the worst axis counts

    @property
    def sign(self) -> float:
        """-1 where a smaller number is the worse one, else 1."""
        return -1.0 if self.smaller_is_worse else 1.0

    def level(self, value: Value) -> Value:
        """What weights and penalties act on: ln of the value, or the value over its `scale`."""
        xp: Any = jnp if isinstance(value, jax.Array) else np
        bounded = xp.minimum(value, self.most)
        if not self.logarithmic:
            return bounded / self.scale
        return xp.log(xp.maximum(bounded, self.least))

    def combine_axes(
        self, value: Float[Array, "axes members"], *, worst: bool = False
    ) -> Float[Array, " members"]:
        """One number for each member: the sum over its axes, or that of its worst axis."""
        if self.summed and not worst:
            return jnp.sum(value, axis=0)
        return jnp.min(value, axis=0) if self.smaller_is_worse else jnp.max(value, axis=0)

    def number(self, value: float) -> float:
        """The value in the printed unit."""
        if self.decibels:
            with np.errstate(divide="ignore", invalid="ignore"):
                return float(20 * np.log10(value))
        return float(value) * self.factor

    def text(self, value: float, *, unit: bool = True) -> str:
        """The value as printed; an infinite margin is "any"."""
        number = self.number(value)
        if np.isnan(number):
            return "n/a"
        if np.isinf(number):
            return "any" if "margin" in self.title else f"{'-' if number < 0 else ''}inf"
        return f"{number:.4g}{' ' + self.unit if unit and self.unit else ''}"


# To add one: an entry here, and a number of that name from what computes it, which is
# `jaxquad.simulation.FlightMetrics` for a flight, `jaxquad.loops.LoopNumbers` for a linear loop.
QUANTITIES = {
    "itae": Quantity("ITAE", "deg s^2", _DEGREE, si_unit="rad s^2", summed=True),
    "iae": Quantity("IAE", "deg s", _DEGREE, si_unit="rad s", summed=True),
    "ise": Quantity("ISE", "deg^2 s", _DEGREE**2, si_unit="rad^2 s", summed=True),
    "activity": Quantity("activity", "u^2", si_unit="unit^2", summed=True),
    "activity_rate": Quantity("activity", "u^2/s", si_unit="unit^2/s", summed=True),
    "energy": Quantity("energy", "u^2 s", si_unit="unit^2 s", summed=True),
    "overshoot": Quantity("overshoot", "%", si_unit="%", logarithmic=False, scale=10.0),
    "peak": Quantity("peak error", "deg", _DEGREE, si_unit="rad"),
    "rms": Quantity("rms error", "deg", _DEGREE, si_unit="rad"),
    "disturbance_rmse": Quantity("disturbance error", "N m", si_unit="N m"),
    "saturation_share": Quantity("saturated", "%", 100.0, logarithmic=False, scale=0.1),
    "abscissa": Quantity("slowest pole", "1/s", linear=True, si_unit="1/s", logarithmic=False),
    "sensitivity_peak": Quantity("Ms", "", linear=True),
    "gain_margin": Quantity(
        "gain margin up", "dB", decibels=True, linear=True, least=1.0, most=1e3,
        smaller_is_worse=True,
    ),
    "gain_reduction": Quantity("gain margin down", "dB", decibels=True, linear=True, least=1e-3),
    "phase_margin": Quantity(
        "phase margin", "deg", _DEGREE, linear=True, si_unit="rad", logarithmic=False, most=3.15,
        smaller_is_worse=True,
    ),
    "delay_margin": Quantity(
        "delay margin", "ms", 1e3, linear=True, si_unit="s", least=1e-5, most=10.0,
        smaller_is_worse=True,
    ),
    "noise_gain": Quantity("noise gain", "u/rad", linear=True, si_unit="unit/rad"),
}  # fmt: skip
LINEAR = tuple(name for name, quantity in QUANTITIES.items() if quantity.linear)


def split_quantities(wanted: Collection[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The names of flight quantities, and those of the linear loop."""
    names = sorted(wanted)
    flight = tuple(name for name in names if not QUANTITIES[name].linear)
    return flight, tuple(name for name in names if QUANTITIES[name].linear)


def require_quantity(name: str) -> None:
    """Raise ValueError for a quantity that does not exist."""
    if name not in QUANTITIES:
        raise ValueError(f"there is no quantity {name!r}: choose one of {', '.join(QUANTITIES)}")
