"""How far a design is from its limits, and its verdicts: stability, performance, convergence."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxquad._core import as_array

from ._design_result import DesignResult, LinearMembers, Numbers, upper_bound, with_further
from ._objective import Limit, QUANTITIES, Risk, risk_text


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
    every, distances = with_further(design, further), []
    for limit in limits:
        bound, sign = float(limit.bound), limit.sign
        of = every if QUANTITIES[limit.quantity].linear else design
        values = sign * _with_unstable(of, limit.quantity)  # larger is worse
        stable = values[~np.isposinf(values)]

        def risk(values: Numbers, over: Risk = limit.over) -> float:
            if not values.size or np.isnan(values).any():
                return np.nan
            # Infinite whatever its weight: 0 times it would be nan.
            return np.inf if np.isposinf(values).any() else float(over(as_array(values)))

        reached = sign * risk(values)
        slack = sign * (bound - reached)
        beyond, over = int(np.sum(~(values <= sign * bound))), risk_text(limit.over)
        distance = Distance(
            quantity=limit.quantity,
            over=over,
            sense="at least" if limit.at_most is None else "at most",
            bound=bound,
            reached=reached,
            slack=slack,
            percent=100 * slack / abs(bound) if bound else np.copysign(np.inf, slack),
            beyond=beyond,
            without=values.size - stable.size,
            of_others=sign * risk(stable),
            members=values.size,
            member=None if np.isnan(values).any() else int(np.argmax(values)),
        )
        if independent and covers(distance):
            distance = distance._replace(beyond_at_most=upper_bound(beyond, values.size))
        distances.append(distance)
    return tuple(distances)


def _with_unstable(design: DesignResult, quantity: str) -> Numbers:
    """The numbers of the members; an unstable one has the worst number possible."""
    values = design.of(quantity, worst_axis=True)
    if QUANTITIES[quantity].linear and design.unstable is not None:
        worst = QUANTITIES[quantity].sign * np.inf
        return np.where(design.unstable & np.isnan(values), worst, values)
    return values


WORTH, SATURATED = 0.5, 0.25  # most of doing nothing's error, and of the time at the limit


class Verdict(NamedTuple):
    """One verdict of a design: whether it holds, by which numbers, and what to do if it does not.

    `str()` is one line. `holds` is None for what was not asked, as the convergence of gains that
    were not tuned.
    """

    name: str
    holds: bool | None
    text: str  # one sentence, with the numbers
    remedy: str = ""  # what to do

    def __str__(self) -> str:
        sign = {True: "OK  ", False: "FAIL", None: "--  "}[self.holds]
        return f"{sign} {self.name}: {self.text}{'. ' * bool(self.remedy)}{self.remedy}"


NOT_TUNED = Verdict("CONVERGENCE", None, "the gains were given, not tuned here")


def judge_stability(
    design: DesignResult,
    distances: Sequence[Distance],
    further: LinearMembers | None,
    independent: bool,
    place: Callable[[int], str],
) -> Verdict:
    """Whether every member is stable and every limit is met; `place` puts a member in words.

    `further` members count for their linear loops and for limits on these, by a share of their own.
    """
    every, failures = with_further(design, further), []
    if every.unstable is None:
        failures.append("the controller has no method linear(), so its stability is not known")
    for of, which, what in (
        (every, every.unstable, "linearly unstable"),
        (design, design.diverged, "diverged in flight"),
    ):
        if which is not None and which.any():
            worst = of.worst_member("abscissa")  # None without a linear form
            shown = int(np.argmax(which)) if worst is None or not which[worst] else worst
            failures.append(f"{_count(which)} ({np.mean(which):.1%}) {what} ({place(shown)})")
    failures += [design.observer_instability] if design.observer_instability else []
    missed = [distance for distance in distances if not distance.met]
    missed.sort(key=lambda d: -np.inf if np.isnan(d.percent) else d.percent)
    failures += [f"{d}{'' if d.member is None else f' ({place(d.member)})'}" for d in missed]
    proven = independent and not failures
    kept, others = _split(distances, covers)
    unstable = np.zeros(every.members, bool) if every.unstable is None else every.unstable
    if further is None:
        text = _within(design, unstable | design.diverged, kept, "members are stable", proven)
    else:
        linear, flown = _split(kept, lambda x: QUANTITIES[x.quantity].linear)
        text = _within(every, unstable, linear, "members are stable", proven)
        text += f"; {_within(design, design.diverged, flown, 'flights are bounded', proven)}"
    if failures:
        remedy = "Lower the bandwidth, tune with a tighter limit, or narrow the ensemble"
        return Verdict("STABILITY", False, "; ".join([*failures, text]), remedy)
    met = f"; the limit on {joined(_titles(others))} is met" if others else ""
    return Verdict("STABILITY", True, f"{text}{met}")


def _split(
    distances: Sequence[Distance], chosen: Callable[[Distance], bool]
) -> tuple[list[Distance], list[Distance]]:
    return [x for x in distances if chosen(x)], [x for x in distances if not chosen(x)]


def _within(
    design: DesignResult,
    lost: Bool[np.ndarray, " members"],
    kept: Sequence[Distance],
    what: str,
    proven: bool,
) -> str:
    """How many members are neither lost nor beyond a limit that each has to keep, as a sentence."""
    for distance in kept:
        lost = lost | beyond_limit(design, distance)
    titles = _titles(kept)
    within = f" and within the limit{'s' * (len(titles) > 1)} on {joined(titles)}" if titles else ""
    return f"{_count(~lost)} {what}{within}{_share(lost, 'are not', proven)}"


def _titles(distances: Sequence[Distance]) -> list[str]:
    return [f"{'' if covers(x) else f'{x.over} '}{QUANTITIES[x.quantity].title}" for x in distances]


def joined(words: Sequence[str]) -> str:
    return words[0] if len(words) < 2 else f"{', '.join(words[:-1])} and {words[-1]}"


def _count(which: Bool[np.ndarray, " members"]) -> str:
    return f"{int(which.sum())} of {which.size}"


def _share(bad: Bool[np.ndarray, " members"], what: str, independent: bool) -> str:
    """What the count proves of all members, where they were drawn independently."""
    if not independent:
        return ""
    most = 100 * upper_bound(int(bad.sum()), bad.size)
    return f" (proven: at most {most:.2g} % of all {what}, 95 % confidence)"


def judge_performance(
    design: DesignResult,
    idle: DesignResult,
    start: DesignResult | None,
    error: str,
    independent: bool,
) -> Verdict:
    """Whether a design is of use: against the command 0 (`idle`), and beside the `start`.

    Every member has to stay in the range of the model, with at most half of the `error` of doing
    nothing, and with the command at its limit for at most a quarter of the time.
    """
    mine, nothing = design.of(error), idle.of(error)
    if not np.any(nothing > 0):
        text = "not known, since the scenario moves nothing: doing nothing makes no error"
        return Verdict("PERFORMANCE", False, text, "Give it a reference or a disturbance")
    useless = ~(mine <= WORTH * nothing)
    busy = design.of("saturation_share") > SATURATED
    bad = design.lost | useless | busy
    # Error, overshoot and time saturated, beside doing nothing and the start.
    shown = QUANTITIES[error]
    references = [f"doing nothing {_mean(idle, error)}"]
    references += [f"the start {_mean(start, error)}"] if start is not None else []
    mean, worst = shown.text(float(np.mean(mine))), shown.text(float(np.max(mine)))
    parts = [f"{shown.title} {mean} in the mean and {worst} at worst ({', '.join(references)})"]
    for quantity in ("overshoot", "saturation_share"):
        values: Numbers = design.of(quantity)
        if not np.isnan(values).any():
            title, text = QUANTITIES[quantity].title, QUANTITIES[quantity].text
            parts.append(f"{title} {text(float(np.mean(values)))}, worst {text(np.max(values))}")
    numbers = "; ".join(parts)
    if not bad.any():
        text = (
            f"{_count(~bad)} members make less than half the error of doing nothing"
            f"{_share(bad, 'do not', independent)}: {numbers}"
        )
        return Verdict("PERFORMANCE", True, text)
    reasons = [
        f"{_count(which)} members {what}"
        for which, what in (
            (design.lost, "are lost (carried off beyond the range of the model)"),
            (useless, "make more than half the error of doing nothing"),
            (busy, "have the command at its limit for more than a quarter of the time"),
        )
        if which.any()
    ]
    faster = "relax limits and penalties, or start with a higher bandwidth"
    remedy = f"Let the design be faster: {faster}"
    if busy.any():
        remedy = "Ask for less (smaller disturbance or step), or raise the limit of the command"
    elif design.lost.any():
        remedy = f"Ask for less (smaller disturbance or step), or let it be faster: {faster}"
    return Verdict("PERFORMANCE", False, f"{'; '.join(reasons)}: {numbers}", remedy)


def _mean(design: DesignResult, error: str) -> str:
    text = QUANTITIES[error].text(float(np.mean(design.of(error))))
    unstable = design.unstable_count
    lost = int(design.lost.sum())
    if unstable:
        return f"{text} with {unstable} members unstable"
    return f"{text} with {lost} members lost" if lost else text
