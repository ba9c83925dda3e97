import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ._loop_numbers import LoopNumbers


SMALLER_IS_WORSE = ("gain_margin", "phase_margin", "delay_margin")
# Over the axes; of other quantities the worst axis counts.
SUMMED = ("itae", "iae", "ise", "activity", "activity_rate", "energy")
LINEAR = LoopNumbers._fields[1:]


class Judged(eqx.Module):
    """One design on every member of an ensemble: the numbers that a certificate is made of.

    Of several axes, integrals are summed and other quantities are those of the worst one. They are
    in SI units, see `jq.simulation.Metrics` and `jq.loops.LoopAnalysis`; those of the linear loop are NaN where it
    is unstable, but for the abscissa, and any is where scenario or controller do not have it.
    """

    by_axis: dict[str, Float[np.ndarray, "axes members"]]
    unstable: Bool[np.ndarray, " members"] | None  # by the exact poles; None without a linear form
    diverged: Bool[np.ndarray, " members"]
    runaway: str = ""  # why an observer of the controller is unstable by itself, if one is

    @property
    def members(self) -> int:
        return self.diverged.size

    @property
    def unstable_count(self) -> int | None:
        return None if self.unstable is None else int(np.sum(self.unstable))

    def of(self, quantity: str, *, worst_axis: bool = False) -> Float[np.ndarray, " members"]:
        """One number per member, with `worst_axis` integrals of that axis alone, too.

        Raises ValueError for a quantity that was not judged.
        """
        if quantity not in self.by_axis:
            known = ", ".join(self.by_axis)
            raise ValueError(f"no {quantity!r} was judged: choose one of {known}")
        if quantity in SUMMED and not worst_axis:
            return np.sum(self.by_axis[quantity], axis=0)
        worst = _worst(self.by_axis[quantity], sign_of(quantity))
        if self.unstable is not None and quantity in LINEAR and quantity != "abscissa":
            return np.where(self.unstable, np.nan, worst)
        return worst

    def worst_member(self, quantity: str) -> int | None:
        """The index of the member with the worst finite number; None without any."""
        values = sign_of(quantity) * self.of(quantity)
        known = np.isfinite(values)
        return int(np.argmax(np.where(known, values, -np.inf))) if known.any() else None


def sign_of(quantity: str) -> float:
    """-1 where a smaller number is the worse one."""
    return -1.0 if quantity in SMALLER_IS_WORSE else 1.0


def _worst(values: Float[np.ndarray, "axes members"], sign: float) -> np.ndarray:
    known = ~np.isnan(values)
    worst = sign * np.max(np.where(known, sign * values, -np.inf), axis=0)
    return np.where(known.any(axis=0), worst, np.nan)
