"""The numbers of one design on every member, their statistics, and how far they are from limits."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jaxquad._core import as_array

from ._objective import Limit, Risk, risk_text
from ._quantities import QUANTITIES


Numbers = Float[np.ndarray, " members"]


class DesignResult(eqx.Module):
    """One design on every member of an ensemble: the numbers that a certificate is made of.

    Of several axes, integrals are summed and other quantities are those of the worst axis. Numbers
    are in SI units, see `jq.simulation.Metrics` and `jq.loops.LoopAnalysis`. Those of the linear
    loop are NaN where it is unstable, except the abscissa; any is NaN where the scenario or the
    controller does not have it.
    """

    by_axis: dict[str, Float[np.ndarray, "axes members"]]
    unstable: Bool[np.ndarray, " members"] | None  # by the exact poles; None without a linear form
    diverged: Bool[np.ndarray, " members"]
    lost: Bool[np.ndarray, " members"]  # diverged, or carried off beyond the model's range
    observer_instability: str = ""  # why an observer of the controller is unstable by itself

    @property
    def members(self) -> int:
        """How many members there are."""
        return self.diverged.size

    @property
    def unstable_count(self) -> int | None:
        """How many members are linearly unstable; None without a linear form."""
        return None if self.unstable is None else int(np.sum(self.unstable))

    def of(self, quantity: str, *, worst_axis: bool = False) -> Numbers:
        """One number for each member.

        **Arguments:**

        - `quantity`: a name from `jq.tuning.QUANTITIES`.
        - `worst_axis`: take the worst axis of integrals, too, instead of their sum.

        **Raises:**

        - `ValueError`: the quantity was not computed.
        """
        if quantity not in self.by_axis:
            computed = ", ".join(self.by_axis)
            raise ValueError(f"{quantity!r} was not computed: choose one of {computed}")
        if QUANTITIES[quantity].summed and not worst_axis:
            return np.sum(self.by_axis[quantity], axis=0)
        sign, by_axis = QUANTITIES[quantity].sign, self.by_axis[quantity]
        some = ~np.isnan(by_axis)
        worst = sign * np.max(np.where(some, sign * by_axis, -np.inf), axis=0)
        worst = np.where(some.any(axis=0), worst, np.nan)
        needs_stability = QUANTITIES[quantity].linear and quantity != "abscissa"
        if self.unstable is not None and needs_stability:
            return np.where(self.unstable, np.nan, worst)
        return worst

    def worst_member(self, quantity: str) -> int | None:
        """The index of the member with the worst finite number; None without any."""
        values = QUANTITIES[quantity].sign * self.of(quantity)
        finite = np.isfinite(values)
        return int(np.argmax(np.where(finite, values, -np.inf))) if finite.any() else None

    def content(self) -> Mapping[str, object]:
        """Every member's numbers, for `jaxquad.report.write_json`."""
        flags = {"unstable": self.unstable, "diverged": self.diverged, "lost": self.lost}
        return flags | {name: self.of(name) for name in self.by_axis}


class LinearMembers(NamedTuple):
    """Further members of an ensemble, of which only the linear loops were analysed."""

    design: DesignResult  # numbers of the linear loop; none of these members has flown
    facts: dict[str, Float[np.ndarray, "axes members"]]  # as in `Certificate`

    def content(self) -> dict[str, object]:
        """How many there are, and how the linear loops of the design do on them."""
        design = self.design
        worst = {name: design.worst_member(name) for name in design.by_axis}
        values = {n: None if k is None else design.of(n)[k] for n, k in worst.items()}
        return {"members": design.members, "unstable": design.unstable_count, "worst": values}


def with_further(design: DesignResult, further: LinearMembers | None) -> DesignResult:
    """The linear loops of the members that flew, and of those that did not, in this order."""
    if further is None:
        return design
    join = lambda a, b: np.concatenate([a, b], axis=-1)
    mine, other = design, further.design
    names = [name for name in mine.by_axis if name in other.by_axis]
    assert mine.unstable is not None and other.unstable is not None
    return DesignResult(
        {name: join(mine.by_axis[name], other.by_axis[name]) for name in names},
        join(mine.unstable, other.unstable),
        join(mine.diverged, other.diverged),
        join(mine.lost, other.lost),
        mine.observer_instability,
    )


def upper_bound(count: int, draws: int, *, level: float = 0.95) -> float:
    """The exact one-sided confidence bound of a share, by Clopper and Pearson.

    None of 256 bounds the share by 1.2 %, none of 2304 by 0.13 %.
    Source: Clopper and Pearson, Biometrika 26 (1934).

    **Arguments:**

    - `count`: how many of the independent members showed the event.
    - `draws`: how many members there were.
    - `level`: the confidence.

    **Returns:**

    The share that the true one exceeds with a probability of at most 1 - `level`.

    **Raises:**

    - `ValueError`: there are fewer draws than counted, or the level is not between 0 and 1.
    """
    if not (0 <= count <= draws and draws >= 1):
        raise ValueError(f"{count} of {draws} members: give 1 draw or more, and a count among them")
    if not 0 < level < 1:
        raise ValueError(f"level is {level}: give a confidence between 0 and 1, such as 0.95")
    if count == draws:
        return 1.0
    from scipy.special import betaincinv

    return float(betaincinv(count + 1, draws - count, level))


def share_interval(count: int, draws: int, *, level: float = 0.95) -> tuple[float, float]:
    """The exact two-sided confidence interval of a share, by Clopper and Pearson.

    171 of 256 bound the share by 60.7 and 72.5 %, 1408 of 2000 by 68.3 and 72.4 %.
    Source: Clopper and Pearson, Biometrika 26 (1934).

    **Arguments:**

    - `count`: how many of the independent members showed the event.
    - `draws`: how many members there were.
    - `level`: the confidence.

    **Returns:**

    The lower and the upper end; outside of each the true share lies with (1 - `level`) / 2 at most.

    **Raises:**

    - `ValueError`: as `jq.tuning.upper_bound` does.
    """
    one_sided = 0.5 * (1 + level)
    low = 1 - upper_bound(draws - count, draws, level=one_sided)
    return low, upper_bound(count, draws, level=one_sided)


class Statistics(NamedTuple):
    """One quantity over the members that have it; NaN without any."""

    mean: float
    p95: float  # of margins, the value that 5 % of the members fall below
    worst: float
    members: int  # that have it: a linear quantity exists for stable loops only
    worst_member: int | None


class DesignSummary(NamedTuple):
    """One design of a certificate, over all members."""

    members: int
    unstable: int | None  # by the exact poles of the linear loop; None without a linear form
    unstable_at_most: float | None  # share, with 95 % confidence
    diverged: int
    lost: int  # diverged, or carried off beyond the model's range
    statistics: dict[str, Statistics]

    def content(self) -> Mapping[str, object]:
        """Everything, for `jaxquad.report.write_json`."""
        plain = {name: one._asdict() for name, one in self.statistics.items()}
        return self._asdict() | {"statistics": plain}


def summarise_design(design: DesignResult, *, independent: bool) -> DesignSummary:
    """Statistics of every computed quantity; the bound only for `independent` members."""
    count = design.unstable_count
    bound = None if count is None else upper_bound(count, design.members)
    return DesignSummary(
        members=design.members,
        unstable=count,
        unstable_at_most=bound if independent else None,
        diverged=int(np.sum(design.diverged)),
        lost=int(np.sum(design.lost)),
        statistics={name: _statistics(design, name) for name in design.by_axis},
    )


def _statistics(design: DesignResult, name: str) -> Statistics:
    values, sign = design.of(name), QUANTITIES[name].sign
    numbers, member = values[~np.isnan(values)], design.worst_member(name)
    partial = numbers.size < values.size and not QUANTITIES[name].linear
    if not numbers.size or partial:
        return Statistics(np.nan, np.nan, np.nan, numbers.size, member)
    ordered = np.sort(sign * numbers)
    if np.isfinite(ordered).all():
        p95 = float(np.quantile(ordered, 0.95))
    else:  # infinite as soon as it rests on an infinite value
        p95 = float(ordered[int(np.ceil(0.95 * (ordered.size - 1)))])
    worst = float(sign * ordered[-1])
    return Statistics(float(np.mean(numbers)), sign * p95, worst, numbers.size, member)


class Distance(NamedTuple):
    """How far a design is from one limit, in the SI unit of the limit."""

    quantity: str
    over: str  # the number over the members that is bounded, such as "worst"
    sense: str  # "at most" or "at least"
    bound: float
    reached: float  # NaN if it is not known, infinite with unstable members
    slack: float  # met by this much; below 0, missed
    percent: float  # slack over the bound
    beyond: int  # members that are beyond the bound themselves
    without: int  # members that are unstable and have no such number
    of_others: float  # what is found without those
    members: int
    member: int | None  # the worst one
    beyond_at_most: float | None = None  # share of all members, with 95 % confidence

    def content(self) -> Mapping[str, object]:
        """Everything, for `jaxquad.report.write_json`."""
        names = {"reached": "found"}  # as result files have it
        plain = {names.get(name, name): value for name, value in self._asdict().items()}
        return plain | {"met": self.met}

    @property
    def met(self) -> bool:
        """Whether the limit is met, by every member if it is one on the worst.

        An unknown number does not meet it.
        """
        return bool(self.slack >= 0)

    def __str__(self) -> str:
        shown = QUANTITIES[self.quantity]
        demand = f"{shown.title}, {self.over}, {self.sense} {shown.text(self.bound)}"
        if np.isnan(self.reached):
            return f"{demand}: not known, because the scenario or the controller does not have it"
        beyond = self._beyond
        if self.without:
            finite = np.isfinite(self.of_others)
            others = f"; of the others {shown.text(self.of_others)}" if finite else ""
            return f"{demand}: missed, {self.without} members are unstable{others}{beyond}"
        if not np.isfinite(self.reached):
            return (
                f"{demand}: {shown.text(self.reached)}, {'met' if self.met else 'missed'}{beyond}"
            )
        difference = abs(shown.number(self.reached) - shown.number(self.bound))
        by = f"{'met' if self.met else 'missed'} by {difference:.3g} {shown.unit}".rstrip()
        share = f" ({abs(self.percent):.2g} %)" if np.isfinite(self.percent) else ""
        return f"{demand}: {shown.text(self.reached)}, {by}{share}{beyond}"

    @property
    def _beyond(self) -> str:
        """How many members are beyond the limit, and what that proves of all."""
        if not covers(self):
            return ""
        count = f", {self.beyond} of {self.members} members beyond"
        if self.beyond_at_most is None:
            return count
        most = 100 * self.beyond_at_most
        return f"{count} (proven: at most {most:.2g} % of all, 95 % confidence)"


def covers(distance: Distance) -> bool:
    """Whether every single member has to keep the limit, and not a mean or a quantile."""
    return distance.over == "worst"


def beyond_limit(design: DesignResult, distance: Distance) -> Bool[np.ndarray, " members"]:
    """Which members are beyond the bound themselves; a number that is not known counts as so."""
    sign = 1.0 if distance.sense == "at most" else -1.0
    return ~(sign * _with_unstable(design, distance.quantity) <= sign * distance.bound)


def measure_distances(
    design: DesignResult,
    limits: Sequence[Limit],
    *,
    independent: bool,
    further: LinearMembers | None = None,
) -> tuple[Distance, ...]:
    """Of one design to each of the limits; bounds of shares only for `independent` members.

    Limits of the linear loop count `further` members, too. Raise ValueError for quantities that
    were not computed.
    """
    every = with_further(design, further)
    pick = lambda limit: every if QUANTITIES[limit.quantity].linear else design
    return tuple(_distance(pick(limit), limit, independent) for limit in limits)


def _distance(design: DesignResult, limit: Limit, independent: bool) -> Distance:
    bound, sign = float(limit.bound), limit.sign
    values = sign * _with_unstable(design, limit.quantity)  # larger is worse
    reached = sign * _risk(limit.over, values)
    slack = sign * (bound - reached)
    over, beyond = risk_text(limit.over), int(np.sum(~(values <= sign * bound)))
    proven = independent and over == "worst"
    return Distance(
        quantity=limit.quantity,
        over=over,
        sense="at least" if limit.at_most is None else "at most",
        bound=bound,
        reached=reached,
        slack=slack,
        percent=100 * slack / abs(bound) if bound else np.copysign(np.inf, slack),
        beyond=beyond,
        without=int(np.sum(np.isposinf(values))),
        of_others=sign * _risk(limit.over, values[~np.isposinf(values)]),
        members=values.size,
        member=None if np.isnan(values).any() else int(np.argmax(values)),
        beyond_at_most=upper_bound(beyond, values.size) if proven else None,
    )


def _with_unstable(design: DesignResult, quantity: str) -> Numbers:
    """The numbers of the members; an unstable one has the worst number possible."""
    values = design.of(quantity, worst_axis=True)
    if QUANTITIES[quantity].linear and design.unstable is not None:
        worst = QUANTITIES[quantity].sign * np.inf
        return np.where(design.unstable & np.isnan(values), worst, values)
    return values


def _risk(over: Risk, values: Numbers) -> float:
    if not values.size or np.isnan(values).any():
        return np.nan
    if np.isposinf(values).any():
        return np.inf  # whatever its weight: 0 times it would be nan
    return float(over(as_array(values)))


def front_point(design: DesignResult, over: str) -> tuple[float, float]:
    """Where a design stands beside a front: its effort and its mean ITAE.

    The effort is the mean of `over`, or the worst Ms, which is infinite with unstable members.
    """
    values = design.of(over)
    if over != "sensitivity_peak":
        return float(np.mean(values)), float(np.mean(design.of("itae")))
    unstable = design.unstable is None or bool(design.unstable.any())
    return np.inf if unstable else float(np.max(values)), float(np.mean(design.of("itae")))
