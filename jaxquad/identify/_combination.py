"""Combinations of parameters that a record determines, in the user's own names."""

from fractions import Fraction
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ._accuracy import Matrix


KINDS = ("product", "sum")


class Combination(NamedTuple):
    """A product of powers, or a weighted sum, of parameters, with its standard error."""

    name: str
    value: float
    standard_error: float

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval."""
        reach = 1.96 * self.standard_error
        return self.value - reach, self.value + reach

    def __str__(self) -> str:
        low, high = self.interval
        return (
            f"{self.name} = {self.value:.5g} +- {self.standard_error:.2g}  "
            f"(95 %: {low:.5g} .. {high:.5g})"
        )


def echelon(rows: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """Reduced row echelon form with full pivoting: the same space, with many zeros."""
    rows, pivots = rows.copy(), []
    for k in range(len(rows)):
        rest = np.abs(rows[k:])
        rest[:, pivots] = 0
        i, j = np.unravel_index(np.argmax(rest), rest.shape)
        rows[[k, k + i]] = rows[[k + i, k]]
        rows[k] /= rows[k, j]
        others = [m for m in range(len(rows)) if m != k]
        rows[others] -= np.outer(rows[others, j], rows[k])
        pivots.append(j)
    return rows


class Named(NamedTuple):
    """What a combination is made of; `relative` is the covariance of changes over `units`."""

    names: tuple[str, ...]
    values: Float[np.ndarray, " parameters"]
    units: Float[np.ndarray, " parameters"]  # the value itself where its logarithm is fitted
    relative: Matrix


def combine(
    weights: Float[np.ndarray, " parameters"],
    named: Named,
    kinds: tuple[str, ...] = KINDS,
) -> Combination:
    """The simplest product or sum that is as sharp as `weights` times the relative changes.

    Whole exponents or coefficients are taken if they cost no more than a quarter in standard error;
    where nothing simple is as sharp, the weights are printed as they are.
    """
    logarithmic = bool(np.all(named.units == named.values))
    products = logarithmic and "product" in kinds
    powers = _simple(weights) if products else None
    sums = _simple(weights / named.units) if "sum" in kinds else None
    if powers is not None and not _as_sharp(powers, weights, named):
        powers = None
    if sums is not None and not _as_sharp(sums * named.units, weights, named):
        sums = None
    if sums is not None and (powers is None or _simpler(sums, powers)):
        return _sum(sums, named)
    if powers is not None:
        return _product(powers, named)
    if products:
        return _product(np.round(weights, 3), named)
    scaled = weights / named.units
    return _sum(np.round(scaled / np.max(np.abs(scaled)), 3), named)


def _simpler(sums: np.ndarray, powers: np.ndarray) -> bool:
    """Whether to take the sum of the two; times that only lower the response add up."""
    return bool(np.abs(sums).max() < np.abs(powers).max() or np.all(powers <= 0))


def is_vague(weights: Float[np.ndarray, " parameters"], named: Named, limit: float) -> bool:
    """Whether the error of a combination is beyond `limit` times what it is made of.

    Where all parts have one sign that is their sum, else the largest: of 0.02 + 0.02 an error of
    0.01 is a quarter. One that ran to zero adds nothing, whatever its unit.
    """
    parts = weights * named.values / named.units
    alike = np.all(parts >= 0) or np.all(parts <= 0)
    size = np.sum(np.abs(parts)) if alike else np.max(np.abs(parts))
    return _spread(weights, named) > limit * float(size)


def _as_sharp(simple: np.ndarray, weights: np.ndarray, named: Named) -> bool:
    limit = 1.25 * _spread(weights, named)
    return _spread(simple, named) <= limit * _length(simple, weights)


def _spread(weights: np.ndarray, named: Named) -> float:
    return float(np.sqrt(max(weights @ named.relative @ weights, 0.0)))


def _length(weights: np.ndarray, like: np.ndarray) -> float:
    """Size of one combination beside another, along the latter's direction."""
    return abs(float(weights @ like)) / float(like @ like)


def _simple(weights: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " parameters"] | None:
    """The nearest vector of small whole numbers, or None if there is none near."""
    unit = weights / np.max(np.abs(weights))
    parts = [Fraction(float(w)).limit_denominator(4) for w in unit]
    exact = np.array([float(part) for part in parts])
    whole = exact * np.lcm.reduce([part.denominator for part in parts])
    near = np.max(np.abs(exact - unit)) < 0.25
    return whole * np.sign(weights @ whole) if near and np.max(np.abs(whole)) <= 4 else None


def _product(powers: Float[np.ndarray, " parameters"], named: Named) -> Combination:
    value = float(np.prod(np.abs(named.values) ** powers))
    above = [_power(n, p) for n, p in zip(named.names, powers, strict=True) if p > 0]
    below = [_power(n, -p) for n, p in zip(named.names, powers, strict=True) if p < 0]
    name = " ".join(above) or "1"
    if below:
        name += " / " + (below[0] if len(below) == 1 else f"({' '.join(below)})")
    return Combination(name, value, value * _spread(powers, named))


def _power(name: str, power: float) -> str:
    return name if power == 1 else f"{name}^{power:g}"


def _sum(weights: Float[np.ndarray, " parameters"], named: Named) -> Combination:
    weights = weights * np.sign(weights[np.argmax(np.abs(weights * named.units))])
    value = float(np.sum(weights * named.values))
    name = ""
    for w, n in zip(weights, named.names, strict=True):
        if w:
            sign = ("- " if w < 0 else "") if not name else (" - " if w < 0 else " + ")
            name += sign + (n if abs(w) == 1 else f"{abs(w):g} {n}")
    return Combination(name, value, _spread(weights * named.units, named))
