"""How far a quantity is open."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ._law import Law, Shares, Values
from ._law_values import (
    as_numbers,
    as_numbers_or_none,
    check_above_zero,
    check_axes,
    check_ends,
    check_finite,
    from_end_to_end,
    number,
    Numbers,
    row,
)


REACH = 4.0  # standard deviations at which normal laws end
_TAIL = 3.167124183311998e-05  # of the normal distribution beyond the reach
_DEVIATION = "it is a standard deviation; for what does not vary give a plain number"


class Uniform(Law):
    """Every value from `low` to `high` alike. Raises ValueError unless low < high."""

    low: Numbers = eqx.field(converter=as_numbers)
    high: Numbers = eqx.field(converter=as_numbers)

    def __check_init__(self):
        check_ends(self.low, self.high)

    def quantile(self, u: Shares) -> Values:
        low, high = row(self.low), row(self.high)
        return np.clip(low + (high - low) * u, low, high)

    @property
    def support(self) -> tuple[Numbers, Numbers]:
        return self.low, self.high

    def levels(self, count: int) -> Float[np.ndarray, " count"]:
        return from_end_to_end(count)

    @property
    def text(self) -> str:
        return f"uniform {number(self.low)} .. {number(self.high)}"


class LogUniform(Law):
    """Every ratio alike, from `low` to `high`. Raises ValueError unless 0 < low < high."""

    low: Numbers = eqx.field(converter=as_numbers)
    high: Numbers = eqx.field(converter=as_numbers)

    def __check_init__(self):
        check_ends(self.low, self.high)
        check_above_zero("a ratio needs it; use jq.Uniform for a range with 0", low=self.low)

    def quantile(self, u: Shares) -> Values:
        low, high = row(self.low), row(self.high)
        return np.clip(low * (high / low) ** u, low, high)

    @property
    def support(self) -> tuple[Numbers, Numbers]:
        return self.low, self.high

    def levels(self, count: int) -> Float[np.ndarray, " count"]:
        return from_end_to_end(count)

    @property
    def text(self) -> str:
        return f"log-uniform {number(self.low)} .. {number(self.high)}"


class Normal(Law):
    """Normal with a standard `deviation`, cut off at 4 of them.

    Without a `mean`, the deviation is relative to the quantity's own value: `Normal(0.05)` is 5 %
    of it. Raises ValueError for a deviation that is not above 0.
    """

    deviation: Numbers = eqx.field(converter=as_numbers)
    mean: Numbers | None = eqx.field(converter=as_numbers_or_none, default=None)

    def __check_init__(self):
        check_axes(deviation=self.deviation, mean=self._mean)
        check_above_zero(_DEVIATION, deviation=self.deviation)
        check_finite(mean=self._mean)

    @property
    def _mean(self) -> Numbers:
        return np.asarray(1.0) if self.mean is None else self.mean

    def quantile(self, u: Shares) -> Values:
        return row(self._mean) + row(self.deviation) * scores(u)

    @property
    def support(self) -> tuple[Numbers, Numbers]:
        reach = REACH * self.deviation
        return np.asarray(self._mean - reach), np.asarray(self._mean + reach)

    def about(self, value: Numbers | None, name: str) -> Law:
        if self.mean is not None:
            return self
        if value is None:
            raise ValueError(
                f"{name} is Normal({number(self.deviation)}), relative to a value that is not known"
                " here: say the mean, jq.Normal(deviation, mean=...), both in its unit"
            )
        return Normal(self.deviation * np.abs(value), value)

    @property
    def text(self) -> str:
        return f"normal {number(self._mean)} +- {number(self.deviation)}"


class LogNormal(Law):
    """Values around `median` whose logarithm is normal with `deviation`, cut off at 4 of them.

    For spreads too wide for `jq.Normal`, whose values would reach 0. Raises ValueError for a
    deviation or median that is not above 0.
    """

    deviation: Numbers = eqx.field(converter=as_numbers)
    median: Numbers = eqx.field(converter=as_numbers, default=1.0)

    def __check_init__(self):
        check_axes(deviation=self.deviation, median=self.median)
        check_above_zero(_DEVIATION, deviation=self.deviation)
        check_above_zero("logarithms need it", median=self.median)

    def quantile(self, u: Shares) -> Values:
        return row(self.median) * np.exp(row(self.deviation) * scores(u))

    @property
    def support(self) -> tuple[Numbers, Numbers]:
        factor = np.exp(REACH * self.deviation)
        return np.asarray(self.median / factor), np.asarray(self.median * factor)

    @property
    def text(self) -> str:
        return f"log-normal {number(self.median)} */ exp({number(self.deviation)})"


def scores(u: Shares) -> Shares:
    """Standard normal values of shares of the probability, within 4 on both sides."""
    from scipy.special import ndtri

    return ndtri(_TAIL + (1 - 2 * _TAIL) * u)
