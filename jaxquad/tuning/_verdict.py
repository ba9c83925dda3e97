"""What a design is judged against, limits and its own plants, and its three verdicts."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TYPE_CHECKING

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxquad._core import as_array, mark_members
from jaxquad.control import LADRC, PID
from jaxquad.ensembles import Members
from jaxquad.models import DecoupledAxes, Multirotor
from jaxquad.simulation import Authority, Encoder, Saturation, Scenario, window

from ._design_result import (
    DesignResult,
    fly_members,
    LinearMembers,
    Numbers,
    upper_bound,
    with_further,
)
from ._objective import Limit, QUANTITIES, Risk, risk_text
from ._problem import decouple, DeviceChoice, LinearisedPlant, TimeSpan


if TYPE_CHECKING:
    from ._certificate import Certificate


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
        beyond = f", {self.beyond} of {self.members} members beyond" if covers(self) else ""
        if beyond and self.beyond_at_most is not None:
            most = 100 * self.beyond_at_most
            beyond += f" (proven: at most {most:.2g} % of all, 95 % confidence)"
        if self.without:
            finite = np.isfinite(self.of_others)
            others = f"; of the others {shown.text(self.of_others)}" if finite else ""
            return f"{demand}: missed, {self.without} members are unstable{others}{beyond}"
        met = "met" if self.met else "missed"
        if not np.isfinite(self.reached):
            return f"{demand}: {shown.text(self.reached)}, {met}{beyond}"
        difference = abs(shown.number(self.reached) - shown.number(self.bound))
        by = f"{met} by {difference:.3g} {shown.unit}".rstrip()
        share = f" ({abs(self.percent):.2g} %)" if np.isfinite(self.percent) else ""
        return f"{demand}: {shown.text(self.reached)}, {by}{share}{beyond}"


def covers(distance: Distance) -> bool:
    """Whether every single member has to keep the limit, and not a mean or a quantile."""
    return distance.over == "worst"


def measure_distances(
    design: DesignResult, limits: Sequence[Limit], *, independent: bool,
    further: LinearMembers | None = None,
) -> tuple[Distance, ...]:  # fmt: skip
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
            quantity=limit.quantity, over=over,
            sense="at least" if limit.at_most is None else "at most", bound=bound, reached=reached,
            slack=slack, percent=100 * slack / abs(bound) if bound else np.copysign(np.inf, slack),
            beyond=beyond, without=values.size - stable.size, of_others=sign * risk(stable),
            members=values.size, member=None if np.isnan(values).any() else int(np.argmax(values)),
        )  # fmt: skip
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


SETTLED = 0.05  # of a manoeuvre: the band within which a step counts as settled
_POINTS = 200  # at least, of a part of the flight; what is held between them counts by its mean

Parts = Float[np.ndarray, "parts axes members"]


class Attainable(NamedTuple):
    """The bounds of a flight on the plants that flew it, from event to event.

    ITAE in rad s^2, angles in rad. `linear` and `linear_peak` are the flight of the same gains
    without limit, friction and encoder, through the same noise: all that margins speak of. `drive`
    is less than any command within the limit can reach for the reference, which moves from rest:
    what is left of the step after full torque, behind lag and delay, all the time (a step from rest
    to rest costs 17 % more). `carried` is the angle at which a disturbance holds the plant against
    full torque, from rest.
    """

    linear: Parts
    linear_peak: Parts
    drive: Parts
    nothing: Parts  # of the command 0, from rest on the reference
    carried: Parts
    settled: Float[np.ndarray, "parts 1 1"]  # ITAE of an error that stays at the `band`
    command: float  # its limit
    step: float  # of the encoder
    moved: float  # how far the reference goes
    varies: bool  # whether the members differ in more than noise

    @property
    def band(self) -> float:
        """An error in rad that is none: within it a step has settled, or the encoder shows 0."""
        return max(SETTLED * self.moved, 0.5 * self.step)


def evaluate_attainable(
    controller: PyTree, drawn: Members, flight: Scenario, span: TimeSpan,
    authority: Authority | None, devices: DeviceChoice,
) -> Attainable:  # fmt: skip
    """For a controller and the members that fly, whose noise is in the `flight`."""
    axes, plant = drawn.axes, decouple(drawn.plant)
    still = None if plant.coulomb is None else as_array(np.zeros(plant.coulomb.shape))
    free = lambda x: dataclasses.replace(x, limit=as_array(np.full(x.limit.shape, np.inf)))
    drive = free(drawn.drive) if isinstance(drawn.drive, Saturation) else None
    if isinstance(drawn.plant, DecoupledAxes | Multirotor):
        without_friction = dataclasses.replace(plant, coulomb=still)
    else:
        without_friction = LinearisedPlant(drawn.plant, axes)
    ideal = dataclasses.replace(drawn, plant=without_friction, drive=drive, encoder=None)
    is_limited = lambda x: isinstance(x, LADRC | PID)
    unlimited = jax.tree.map(
        lambda x: free(x) if is_limited(x) else x, controller, is_leaf=is_limited
    )
    linear = fly_members(unlimited, ideal, flight, span, devices)

    def wide(values: Array | None) -> Float[np.ndarray, "axes members"]:
        x = np.zeros(axes) if values is None else np.asarray(values, float)
        return np.broadcast_to(x if x.ndim > 1 else x[:, None], (axes, drawn.size))

    inertia, lag, gain = wide(plant.inertia), wide(plant.lag), wide(plant.torque_gain)
    damping, stiffness, friction = map(wide, (plant.damping, plant.stiffness, plant.coulomb))
    delay = np.asarray(drawn.delay, float)
    torque = np.full(inertia.shape, np.inf) if authority is None else wide(authority.torque)
    command = np.inf if authority is None else float(np.max(np.asarray(authority.command)))
    full = lambda x: np.asarray(x, float).reshape(np.shape(x) + (1,) * (3 - np.ndim(x)))
    reference, disturbance = full(flight.reference), full(flight.disturbance)
    payload = full(np.zeros((1, 1)) if flight.payload is None else flight.payload)
    light, heavy = (inertia + f(payload, axis=0, initial=0.0) for f in (np.min, np.max))
    moved = max(float(reference.max()), 0.0) - min(float(reference.min()), 0.0)
    step = 2 * np.pi / drawn.encoder.counts if isinstance(drawn.encoder, Encoder) else 0.0
    rows, seconds = [], []
    for start, stop in span.parts:
        a, b, *_ = window(len(reference), drawn.dt, start=start, stop=stop, load_start=None)
        stride = max(1, (b + 1 - a) // _POINTS)
        count, h = (b + 1 - a) // stride, stride * drawn.dt
        targets, torques = (
            x[a : a + count * stride].reshape(count, stride, *x.shape[1:]).mean(axis=1)
            for x in (reference, disturbance)
        )
        targets = targets - (reference[a - 1] if a else 0.0)
        pushes = np.sign(torques) * np.maximum(np.abs(torques) - friction, 0)
        # Of the plant alone from rest: under the disturbance, and after a unit of impulse.
        angle = rate = response = reach = least = nothing = carried = np.zeros_like(inertia)
        answer = 1 / heavy
        for t, target, push in zip(h * np.arange(1, count + 1), targets, pushes, strict=True):
            rate = rate + h / heavy * (push - damping * rate - stiffness * angle)
            answer = answer - h / heavy * (damping * answer + stiffness * response)
            angle, response = angle + h * rate, response + h * answer
            reach = reach + h * torque * np.abs(response)
            late = np.maximum(t - delay, 0)  # full torque, integrated twice behind lag and delay
            faded = lag * late + lag**2 * np.expm1(-late / np.where(lag > 0, lag, 1))
            reached = np.where(late > 0, torque / light * (0.5 * late**2 - faded), 0)
            least = least + h * t * np.maximum(np.abs(target) - reached, 0)
            nothing = nothing + h * t * np.abs(target - angle)
            carried = np.maximum(carried, np.abs(angle) - reach)
        rows.append((least, nothing, carried))
        seconds.append(count * h)
    theirs = jax.tree.leaves(eqx.filter(drawn.plant, mark_members(drawn.plant, (drawn.size,))))
    different = (inertia, gain, lag, damping, stiffness, friction, delay[None], payload,
                 np.asarray(drawn.assumed_inertia), *map(np.asarray, theirs))  # fmt: skip
    varies = any(np.any(np.ptp(x, axis=-1) > 0) for x in different)
    drive_bound, nothing, carried = (np.stack(x) for x in zip(*rows, strict=True))
    half_squares = 0.5 * np.reshape(seconds, (-1, 1, 1)) ** 2
    result = Attainable(
        linear.by_part, linear.peaks, drive_bound, nothing, carried, half_squares, command, step,
        moved, varies,
    )  # fmt: skip
    return result._replace(settled=result.band * half_squares)


WORTH, SATURATED = 0.5, 0.25  # most of doing nothing's error, and of the time at the limit
BUSIER, QUIET = 10.0, 0.2  # of the start's activity; of limit^2 per second, which any drive bears
FEWEST = 64  # members that speak of an ensemble


class Verdict(NamedTuple):
    """One verdict of a design: whether it holds, by which numbers, and what to do if it does not.

    `str()` is one line. `holds` is None for what was not asked, as the convergence of gains that
    were not tuned, and for what the members do not decide.
    """

    name: str
    holds: bool | None
    text: str  # one sentence, with the numbers
    remedy: str = ""  # what to do

    def __str__(self) -> str:
        sign = {True: "OK  ", False: "FAIL", None: "--  "}[self.holds]
        return f"{sign} {self.name}: {self.text}{'. ' * bool(self.remedy)}{self.remedy}"


def judge_stability(
    design: DesignResult, distances: Sequence[Distance], further: LinearMembers | None,
    independent: bool, place: Callable[[int], str],
) -> Verdict:  # fmt: skip
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
    kept, others = [x for x in distances if covers(x)], [x for x in distances if not covers(x)]
    unstable = np.zeros(every.members, bool) if every.unstable is None else every.unstable
    if further is None:
        text = _within(design, unstable | design.diverged, kept, "members are stable", proven)
    else:
        linear = [x for x in kept if QUANTITIES[x.quantity].linear]
        flown = [x for x in kept if x not in linear]
        text = _within(every, unstable, linear, "members are stable", proven)
        text += f"; {_within(design, design.diverged, flown, 'flights are bounded', proven)}"
    if failures:
        remedy = "Lower the bandwidth, tune with a tighter limit, or narrow the ensemble"
        return Verdict("STABILITY", False, "; ".join([*failures, text]), remedy)
    met = f"; the limit on {joined(_titles(others))} is met" if others else ""
    return Verdict("STABILITY", True, f"{text}{met}")


def _within(
    design: DesignResult, lost: Bool[np.ndarray, " members"], kept: Sequence[Distance], what: str,
    proven: bool,
) -> str:  # fmt: skip
    """How many members are neither lost nor beyond a limit that each has to keep, as a sentence."""
    for distance in kept:  # beyond it is a number that is not known, too
        sign = 1.0 if distance.sense == "at most" else -1.0
        lost = lost | ~(sign * _with_unstable(design, distance.quantity) <= sign * distance.bound)
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


def judge_performance(certificate: "Certificate") -> Verdict:
    """Whether a design is of use, and whether its flights are what its linear loops say.

    The rules are those of docs/tuning.md. Errors count from event to event, since beside a plant
    that was carried off once any error is small; within the band in which a step counts as settled
    they are none. A motor's losses grow with the square of the command's changes: ten times the
    start's activity is another load, if it is more than a reversal from limit to limit every 20 s.
    Of 59 members, none that fails shows that at most 5 % of all do (95 % confidence).
    """
    design, idle, error = certificate.design, certificate.idle, certificate.error
    limits, start, independent = certificate.attainable, certificate.start, certificate.independent
    mine, nothing = design.of(error), idle.of(error)
    if not np.any(nothing > 0):
        text = "not known, since the scenario moves nothing: doing nothing makes no error"
        return Verdict("PERFORMANCE", False, text, "Give it a reference or a disturbance")
    shown = QUANTITIES[error]
    compared = [f"doing nothing {_mean(idle, error)}"]
    compared += [f"the start {_mean(start, error)}"] if start is not None else []
    useless = ~(mine <= WORTH * nothing)
    faster = "Let the design be faster: relax limits and penalties, or start with more bandwidth"
    less = "Ask for less (smaller disturbance or step), or raise the limit of the command"
    checks = [
        (design.lost, "are lost (carried off beyond the range of the model)", less),
        (useless, "make more than half the error of doing nothing", faster),
        (
            design.of("saturation_share") > SATURATED,
            "have the command at its limit for more than a quarter of the time", less,
        ),
    ]  # fmt: skip
    remarks = list(certificate.unsupported)
    if limits is not None and design.by_part is not None:
        flown = design.by_part
        over = flown > np.maximum(WORTH * limits.nothing, limits.settled)
        useless |= np.any(over & (limits.nothing > 0), axis=(0, 1))
        if error == "itae":
            mean = lambda x: shown.text(float(np.mean(np.sum(x, axis=(0, 1)))))
            compared.append(f"the linear loop alone {mean(limits.linear)}")
            compared.append(f"the drive allows {mean(limits.drive)}")
        fastest = np.maximum(np.maximum(limits.linear, limits.drive) / WORTH, limits.settled)
        imperfect = np.any(np.sum(flown, axis=0) > np.sum(fastest, axis=0), axis=0)
        imperfect |= np.any((limits.drive > 0) & (flown > fastest), axis=(0, 1))
        what = "make more than twice the error of their linear loops, which know neither limit, "
        what += "nor friction, nor resolution"
        checks.append((imperfect, what, "Raise the limit, reduce friction, or measure finer"))
        degrees = np.degrees(np.max(limits.carried))
        what = f"are carried off by the disturbance, up to {degrees:.3g} deg against full torque"
        farther = limits.carried > np.maximum(WORTH * limits.linear_peak, limits.band)
        checks.append((np.any(farther, axis=(0, 1)), what, less))
        if limits.moved and limits.band > SETTLED * limits.moved:
            text = f"half a step of the encoder is {np.degrees(limits.step) / 2:.3g} deg, beyond "
            text += f"{SETTLED:.0%} of the manoeuvre of {np.degrees(limits.moved):.3g} deg"
            remarks.append((text, "Take a finer encoder, or fly a larger manoeuvre"))
    if start is not None:
        busy, before = (float(np.median(x.of("activity_rate"))) for x in (design, start))
        limit = 0.0 if limits is None or np.isinf(limits.command) else limits.command
        if before > 0 and busy > max(BUSIER * before, QUIET * limit**2):
            text = f"the command's activity is {busy / before:.3g} times that of the start"
            remarks.append((text, "Penalise activity with a knee near that of the start"))
    numbers = f"{shown.title} {shown.text(float(np.mean(mine)))} in the mean and "
    numbers += f"{shown.text(float(np.max(mine)))} at worst ({', '.join(compared)})"
    for quantity in ("overshoot", "saturation_share"):
        values: Numbers = design.of(quantity)
        if not np.isnan(values).any():
            title, text = QUANTITIES[quantity].title, QUANTITIES[quantity].text
            numbers += f"; {title} {text(float(np.mean(values)))}, worst {text(np.max(values))}"
    checks = [(f"{_count(x)} members {what}", remedy) for x, what, remedy in checks if x.any()]
    checks += remarks
    if checks:
        texts, remedies = zip(*checks, strict=True)
        text, remedy = f"{'; '.join(texts)}: {numbers}", ". ".join(dict.fromkeys(remedies))
        return Verdict("PERFORMANCE", False, text, remedy)
    none = np.zeros(design.members, bool)
    text = f"{_count(~none)} members make less than half the error of doing nothing"
    text += " and less than twice that of their linear loops" * (limits is not None)
    text += f"{_share(none, 'do not', independent)}: {numbers}"
    if limits is None or (limits.varies and design.members >= FEWEST):
        return Verdict("PERFORMANCE", True, text)
    few = f"{design.members} members are too few to speak of others"
    few = few if limits.varies else "all members are the same plant"
    remedy = f"Let the ensemble have a spread, and certify on {FEWEST} members or more"
    return Verdict("PERFORMANCE", None, f"not decided, since {few}; {text}", remedy)


def _mean(design: DesignResult, error: str) -> str:
    text = QUANTITIES[error].text(float(np.mean(design.of(error))))
    unstable, lost = design.unstable_count, int(design.lost.sum())
    if unstable:
        return f"{text} with {unstable} members unstable"
    return f"{text} with {lost} members lost" if lost else text
