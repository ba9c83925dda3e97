from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ._judged import Judged, LINEAR, sign_of


def upper_bound(count: int, draws: int, *, level: float = 0.95) -> float:
    """The share that is exceeded by no more than this, at the confidence `level`.

    Of `draws` independent members `count` showed the event; the bound is one-sided and exact, not
    an approximation by a normal distribution: none of 256 bounds the share by 1.2 %, none of 3000
    by 0.1 %. Source: Clopper & Pearson, Biometrika 26 (1934). Raises ValueError for a count beyond
    the draws and for a level outside 0 .. 1.
    """
    if not (0 <= count <= draws and draws >= 1):
        raise ValueError(f"{count} of {draws} members: give 1 draw or more, and a count among them")
    if not 0 < level < 1:
        raise ValueError(f"level is {level}: give a confidence between 0 and 1, such as 0.95")
    if count == draws:
        return 1.0
    from scipy.special import betaincinv

    return float(betaincinv(count + 1, draws - count, level))


class Statistics(NamedTuple):
    """One quantity over the members that have it; NaN without any."""

    mean: float
    p95: float  # of margins, the value that 5 % of the members fall below
    worst: float
    members: int  # that have it: a linear quantity exists for stable loops only
    worst_member: int | None


class Row(NamedTuple):
    """One design of a certificate, over all members."""

    members: int
    unstable: int | None  # by the exact poles of the linear loop; None without a linear form
    unstable_at_most: float | None  # share, with 95 % confidence
    diverged: int
    statistics: dict[str, Statistics]

    def content(self) -> dict[str, Any]:
        plain = {name: one._asdict() for name, one in self.statistics.items()}
        return self._asdict() | {"statistics": plain}


def row_of(design: Judged, *, independent: bool) -> Row:
    """The statistics of every quantity that was judged; a bound for `independent` members only."""
    count = design.unstable_count
    known = None if count is None else upper_bound(count, design.members)
    return Row(
        members=design.members,
        unstable=count,
        unstable_at_most=known if independent else None,
        diverged=int(np.sum(design.diverged)),
        statistics={name: _statistics(design, name) for name in design.by_axis},
    )


def _statistics(design: Judged, name: str) -> Statistics:
    values, sign = design.of(name), sign_of(name)
    known = values[~np.isnan(values)]
    partial = known.size < values.size and name not in LINEAR
    if not known.size or partial:
        return Statistics(np.nan, np.nan, np.nan, known.size, design.worst_member(name))
    worst = sign * np.max(sign * known)
    return Statistics(
        _mean(known), sign * _p95(sign * known), float(worst), known.size,
        design.worst_member(name),
    )  # fmt: skip


def _mean(values: Float[np.ndarray, " members"]) -> float:
    return float(np.mean(values))


def _p95(values: Float[np.ndarray, " members"]) -> float:
    """inf as soon as it rests on one."""
    ordered = np.sort(values)
    if not np.isfinite(ordered).all():
        return float(ordered[int(np.ceil(0.95 * (ordered.size - 1)))])
    return float(np.quantile(ordered, 0.95))
