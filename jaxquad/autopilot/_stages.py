"""What gains give on fresh plants, which limits that keeps, and the verdict on it."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np

from ._firmware import OuterLoop
from ._rate_loops import delay_margin, is_stable, OneGains, RateLoops, together


Kind = Literal["proposed", "kept", "cannot tell", "not to be flown"]
WAYS = ("what flew", "a third of the way", "all of it")


@runtime_checkable
class Limits(Protocol):
    """What is kept: `DesignSettings`, or the `ADRCTargets`."""

    @property
    def sensitivity(self) -> float: ...
    @property
    def resonance(self) -> float: ...
    @property
    def noise(self) -> float: ...
    @property
    def change(self) -> float: ...


@runtime_checkable
class DesignSettings(Limits, Protocol):
    """What is kept, and how many plants: `jq.workflows.AutopilotSettings`."""

    @property
    def keep_filters(self) -> bool: ...
    @property
    def members(self) -> int: ...
    @property
    def fresh(self) -> int: ...
    @property
    def seed(self) -> int: ...
    def content(self) -> dict[str, Any]: ...
    def words(self) -> list[str]: ...


class OuterStage(NamedTuple):
    """What the angle loop around a rate loop gives on fresh plants."""

    parameter: str  # of its gain
    value: float
    closed: bool  # whether it was closed in the flight
    stable: float  # share of the plants
    peak: float  # the greatest Ms
    resonance: float  # the greatest peak from set-point to angle
    delay_margin: float  # the least, in s


class Stage(NamedTuple):
    """What gains give on fresh plants."""

    gains: tuple[float, ...]  # P, I and D
    stable: float  # share of the plants
    peak: float  # the greatest
    resonance: float  # the greatest
    crossover: float  # the median, in rad/s
    rejection: float  # relative to what flew
    noise: float  # relative to what flew
    peaks: tuple[float, ...] = ()  # the greatest Ms at each throttle
    relaxed: float | None = None  # the greatest Ms with the integral held; None where it never is
    delay_margin: float = float("inf")  # the least, in s
    angle: OuterStage | None = None  # of the angle loop around it

    @property
    def margin_text(self) -> str:
        """The least delay margin in ms; none of a loop that is not stable."""
        return f"{1e3 * self.delay_margin:.1f}" if self.stable == 1 else "none"

    def content(self) -> dict[str, object]:
        """All of it, for JSON."""
        return {**self._asdict(), "angle": None if self.angle is None else self.angle._asdict()}


def certify_angle(loops: RateLoops, gains: OneGains, angle: OuterLoop, value: float) -> OuterStage:
    """The angle loop with a value of its parameter around the rate loop with these gains."""
    around = loops.outer_loops(gains, angle.unit * value)
    distance = 1 + around
    stable = is_stable(np.real(distance)[None], np.imag(distance)[None])
    peak = np.max(1 / np.abs(distance).min(axis=1))
    resonance = np.max(np.abs(around / distance).max(axis=1))
    margin = np.min(delay_margin(around, loops.omega))
    numbers = map(float, (np.mean(stable), peak, resonance, margin))
    return OuterStage(angle.name, value, angle.closed, *numbers)


def certify_gains(loops: Sequence[RateLoops], designs: Sequence[OneGains]) -> list[Stage]:
    """What each of the designs gives under its own law, the first of which is what flew."""
    rms, stages, flown = lambda x: float(np.sqrt(np.mean(x**2))), [], None
    for loop, gains in zip(loops, designs, strict=True):
        parts = [group.qualities(gains[None]) for group in loop.groups]
        qualities = together(parts)
        flown = flown or qualities
        relaxed = any(group.relaxed for group in loop.groups)
        still = loop.relaxed_qualities(gains[None]) if relaxed else None
        stable = qualities.stable if still is None else qualities.stable & still.stable
        stages.append(
            Stage(
                tuple(map(float, gains)), float(np.mean(stable)), float(np.max(qualities.peak)),
                float(np.max(qualities.resonance)), float(np.median(qualities.crossover)),
                rms(qualities.rejection) / rms(flown.rejection),
                rms(qualities.noise) / rms(flown.noise),
                tuple(float(np.max(part.peak)) for part in parts),
                None if still is None else float(np.max(still.peak)),
                float(np.min(delay_margin(loop.open_loops(gains), loop.omega))),
            )
        )  # fmt: skip
    return stages


class SharedChange(NamedTuple):
    """What changed filters do to the axes that were not tuned."""

    delay_ms: tuple[float, float]  # of the gyro's filters, and with the D term's, over what flew
    noise: float  # the greatest growth of a command's noise


@dataclasses.dataclass(frozen=True)
class FilterVerdict:
    """What the search made of the filters."""

    text: str  # which freedom brought what, or why the filters stay
    flown: Mapping[str, float] = dataclasses.field(default_factory=dict)  # of those that change
    reason: str = ""  # why they change
    at_once: tuple[str, ...] = ()  # of a notch that is switched on, which has no third of the way
    gains_alone: Stage | None = None  # the best gains with the filters that flew
    shared: SharedChange | None = None

    def content(self) -> dict[str, object]:
        """All of it, for JSON."""
        return {
            "text": self.text,
            "flown": dict(self.flown),
            "gains_alone": None if self.gains_alone is None else self.gains_alone._asdict(),
            "shared": None if self.shared is None else self.shared._asdict(),
        }


def beyond_limits(
    flown: Any, third: Any, proposed: Any, limits: Limits, edge: float, *, loud: float = 1.0
) -> list[str]:
    """In words, what of a `Stage` or `ADRCStage` is beyond a limit, or `edge`, in rad/s."""
    share, hertz, limit = 100 * min(third.stable, proposed.stable), 2 * np.pi, limits.sensitivity
    most, loudest = max(limit, flown.peak), loud * limits.noise
    above = lambda text, value, highest: [text] if value > highest else []
    peak, resonance, noise = proposed.peak, proposed.resonance, proposed.noise
    return [
        *above(f"only {share:.1f} % of the loops are stable", 100, share),
        *above(f"the worst Ms is {peak:.2f}, above {limit:g}", peak, limit),
        *above(
            f"the worst peak from set-point to rate is {resonance:.2f}, above "
            f"{limits.resonance:g}",
            resonance, limits.resonance,
        ),
        *above(
            f"a third of the way the worst Ms is {third.peak:.2f}, above {most:.3g}",
            third.peak, most,
        ),
        *above(
            f"the command's noise is {noise:.2f} of what flew, above {limits.noise:g}",
            noise, loudest,
        ),
        *above(
            f"the crossover of {proposed.crossover / hertz:.1f} Hz is beyond the identified "
            f"{edge / hertz:.1f} Hz",
            proposed.crossover, edge,
        ),
    ]  # fmt: skip


def beyond_angle(angle: OuterStage, limits: Limits) -> list[str]:
    """In words, which limits an angle loop does not keep."""
    around = f"of the angle loop ({angle.parameter} {angle.value:.3g})"
    above = lambda what, value, most: (
        [f"the worst {what} {around} is {value:.2f}, above {most:g}"] if value > most else []
    )
    unstable = [f"only {100 * angle.stable:.1f} % {around} are stable"] if angle.stable < 1 else []
    peaks = above("Ms", angle.peak, limits.sensitivity)
    return unstable + peaks + above("peak", angle.resonance, limits.resonance)


def limits_text(limits: DesignSettings) -> str:
    """Of what the limits are relative to, and when to stop."""
    return (
        f"limits: noise {limits.noise:g} times and gains {limits.change:g} times those of this "
        "flight at most. They compound from log to log: stop where a log keeps what flew, or the "
        "motors get warm"
    )


_WORTH = 0.95  # of the flown effect of torque, above which gains are not worth a change
_ALLOWED = 1.03  # of a limit that the search kept on the ratio of filters, for the law itself
_NEARLY = 1.05  # of the limit of the resonance, which a third of the way may reach without a word
SWINGING = 0.1  # of a flight with a motor at its limit, from which the motors bound a swing
BELIEVED = 0.5  # share of plants on which the loop that flew has to be stable


def judge(
    stages: Sequence[Stage], settings: DesignSettings, edge: float, shared: SharedChange | None,
    throttles: Sequence[float], swings: float = 0.0,
) -> tuple[Kind, str]:  # fmt: skip
    """The verdict; `swings` is the share of the flight with a motor at its limit."""
    flown, third, new = stages
    bounded = flown.stable < BELIEVED and swings > SWINGING  # by the motors alone
    third = new if bounded else third
    beyond = beyond_limits(flown, third, new, settings, edge, loud=_ALLOWED)
    if shared is not None and shared.noise > _ALLOWED * settings.noise:
        beyond.append(
            f"the command's noise on another axis is {shared.noise:.2f} of what flew, above "
            f"{settings.noise:g}"
        )
    if new.angle is not None and new.angle.closed:
        beyond += beyond_angle(new.angle, settings)
    if beyond and flown.stable < BELIEVED and not bounded:
        return "cannot tell", (
            "this log cannot tell: the loop flew, but with the gains that flew it is stable on "
            f"{100 * flown.stable:.1f} % only of the plants within the error bars, so most of "
            "these are not the vehicle. Fly more excitation on this axis (a chirp of the rate "
            "set-point, or strong and quick stick)"
        )
    if beyond:
        return "not to be flown", (
            f"no gains are proposed: {'; '.join(beyond)}. Allow more (`sensitivity`, `resonance`, "
            "`noise`, `change`), or fly more excitation"
        )
    limit, plants = settings.sensitivity, f"{settings.fresh} fresh plants"
    if throttles:
        at = ", ".join(f"{level:.2f}" for level in throttles)
        plants += f" at each of the throttles {at}"
    better = f"{new.rejection:.2f} of the flown effect of a step of torque"
    within = flown.peak <= limit and flown.resonance <= settings.resonance
    if flown.angle is not None and flown.angle.closed:
        within = within and not beyond_angle(flown.angle, settings)
    if flown.stable == 1 and within and new.rejection > _WORTH:
        return "kept", (
            f"what flew is kept: within the limits the best gains leave {better}. Its worst Ms on "
            f"{plants} is {flown.peak:.2f}"
        )
    around, before, after = "", flown.angle, new.angle
    if before is not None and after is not None and after.closed:
        moved = f"{after.parameter} {before.value:.3g}"
        moved += f" -> {after.value:.3g}" if after.value != before.value else " as it flew"
        around = f"; with the angle loop around it ({moved}) worst Ms {after.peak:.2f}"
    proposed = f"proposed: stable on all {plants}, worst Ms {new.peak:.2f} of at most {limit:g}"
    if bounded:
        return "proposed", (
            f"{proposed}{around}. What flew is stable on {100 * flown.stable:.0f} % of them: "
            f"it swung between the motors' limits ({100 * swings:.0f} % of the flight). A third of "
            "the way would swing, too, so both files hold all of it, and gains may be further from "
            f"what flew than {settings.change:g} times (`change`): hover low with it first"
        )
    # A third of the way from a bad loop may be beyond the limits, too.
    first = "Load the file for a third of the way first"
    if not (third.peak <= limit and third.resonance <= _NEARLY * settings.resonance):
        first = (
            f"The file for a third of the way is beyond the limits (worst Ms {third.peak:.2f}, "
            f"peak from set-point to rate {third.resonance:.2f}), but better than what flew "
            f"({flown.peak:.2f}, {flown.resonance:.2f}): hover with it alone, then load all of it"
        )
    return "proposed", f"{proposed}, {better}{around}. {first}"
