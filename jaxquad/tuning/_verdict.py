"""The three verdicts of a design: stability, performance and convergence."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from ._design_result import (
    beyond_limit,
    covers,
    DesignResult,
    Distance,
    LinearMembers,
    Numbers,
    upper_bound,
    with_further,
)
from ._quantities import QUANTITIES


WORTH, SATURATED = 0.5, 0.25  # most of doing nothing's error, and of the time at the limit
Place = Callable[[int], str]  # a member in words


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
    *,
    further: LinearMembers | None = None,
    independent: bool,
    place: Place,
) -> Verdict:
    """Whether every member is stable and every limit is met; `place` says which member fails.

    `further` members count for their linear loops and for limits on these, by a share of their own.
    """
    every = with_further(design, further)
    failures = [*_instabilities(design, every, place), *_missed(distances, place)]
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
    met = f"; the limit on {_join(_titles(others))} is met" if others else ""
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
    within = f" and within the limit{'s' * (len(titles) > 1)} on {_join(titles)}" if titles else ""
    return f"{_count(~lost)} {what}{within}{_share(lost, 'are not', proven)}"


def _instabilities(design: DesignResult, every: DesignResult, place: Place) -> list[str]:
    failures = []
    if every.unstable is None:
        failures.append("the controller has no method linear(), so its stability is not known")
    elif every.unstable.any():
        failures.append(_where(every, every.unstable, "linearly unstable", place))
    if design.diverged.any():
        failures.append(_where(design, design.diverged, "diverged in flight", place))
    return failures + ([design.observer_instability] if design.observer_instability else [])


def _where(
    design: DesignResult, which: Bool[np.ndarray, " members"], what: str, place: Place
) -> str:
    worst = design.worst_member("abscissa")  # None without a linear form
    shown = int(np.argmax(which)) if worst is None or not which[worst] else worst
    return f"{_count(which)} ({np.mean(which):.1%}) {what} ({place(shown)})"


def _missed(distances: Sequence[Distance], place: Place) -> list[str]:
    missed = [distance for distance in distances if not distance.met]
    missed.sort(key=lambda d: -np.inf if np.isnan(d.percent) else d.percent)
    return [f"{d}{'' if d.member is None else f' ({place(d.member)})'}" for d in missed]


def _titles(distances: Sequence[Distance]) -> list[str]:
    return [f"{'' if covers(x) else f'{x.over} '}{QUANTITIES[x.quantity].title}" for x in distances]


def _join(words: Sequence[str]) -> str:
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
    *,
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
    numbers = _numbers(design, idle, start, error)
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


def _numbers(
    design: DesignResult, idle: DesignResult, start: DesignResult | None, error: str
) -> str:
    """Error, overshoot and time saturated, beside doing nothing and the start."""
    shown = QUANTITIES[error]
    references = [f"doing nothing {_mean(idle, error)}"]
    references += [f"the start {_mean(start, error)}"] if start is not None else []
    worst = shown.text(float(np.max(design.of(error))))
    mean = shown.text(float(np.mean(design.of(error))))
    parts = [f"{shown.title} {mean} in the mean and {worst} at worst"]
    parts[0] += f" ({', '.join(references)})"
    for quantity in ("overshoot", "saturation_share"):
        values: Numbers = design.of(quantity)
        if not np.isnan(values).any():
            title, text = QUANTITIES[quantity].title, QUANTITIES[quantity].text
            parts.append(f"{title} {text(float(np.mean(values)))}, worst {text(np.max(values))}")
    return "; ".join(parts)


def _mean(design: DesignResult, error: str) -> str:
    text = QUANTITIES[error].text(float(np.mean(design.of(error))))
    unstable = design.unstable_count
    lost = int(design.lost.sum())
    if unstable:
        return f"{text} with {unstable} members unstable"
    return f"{text} with {lost} members lost" if lost else text


class Bound(NamedTuple):
    """A tuned number that stands at the end of what the controller allows."""

    name: str
    value: float
    reason: str  # why it can go no further


def judge_convergence(
    *,
    converged: bool,
    reason: str,
    refusal: str,
    gradient: float,
    evaluations: int,
    bounds: Sequence[Bound],
    missed: Sequence[str],
) -> Verdict:
    """Whether the descent ended at a stationary point inside of all bounds, with limits met."""
    size = f"the greatest entry of the gradient is {gradient:.2g} per neper"
    faults = [] if converged else [f"the descent ended where the cost still falls: {reason}"]
    if refusal and not (converged or bounds):
        faults.append(f"the controller refused steps: {refusal}")
    faults += [
        f"{b.name} = {b.value:.4g} stands at its bound, a further step is refused "
        f"({b.reason.rstrip('.')})"
        for b in bounds
    ]
    faults += [f"the limit on {text}" for text in missed]
    ended = f"{evaluations} gradients"
    if not faults:
        why = f"{reason}, " if reason else ""
        text = f"the descent ended at a stationary point after {ended}: {why}{size}"
        return Verdict("CONVERGENCE", True, text)
    names = ", ".join(b.name for b in bounds)
    remedies = [f"Hold {names} below it, or penalise what drives it there (activity)"] * bool(
        bounds
    )
    remedies += ["Relax the limits, or narrow the ensemble"] * bool(missed)
    remedies += ["Tune on from here, with more evaluations"] * (not remedies)
    return Verdict(
        "CONVERGENCE", False, f"{'; '.join(faults)} ({ended}, {size})", ". ".join(remedies)
    )


def overall(verdicts: Sequence[Verdict], on: str) -> str:
    """The first line: whether the design may be flown, and which verdicts say no."""
    holding = [v.name for v in verdicts if v.holds is not None]
    failed = [v.name for v in verdicts if v.holds is False]
    if not failed:
        return f"CERTIFICATE HOLDS on {on}: {_join(holding)}"
    return f"CERTIFICATE FAILS on {on}, not to be flown: {_join(failed)}"
