"""What gains give on fresh plants: the rate loop as set and relaxed, the angle loop around it."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from ._firmware import OuterLoop
from ._identified import DesignSettings
from ._rate_loops import delay_margin, RateLoops, together


class OuterStage(NamedTuple):
    """What the angle loop around a rate loop gives on fresh plants.

    **Attributes:**

    - `parameter`, `value`: of its gain; `closed`: whether it was closed in the flight.
    - `stable`: share of the plants; `peak`: the greatest Ms; `resonance`: the greatest peak from
        set-point to angle; `delay_margin`: the least, in s.
    """

    parameter: str
    value: float
    closed: bool
    stable: float
    peak: float
    resonance: float
    delay_margin: float


class Stage(NamedTuple):
    """What gains give on fresh plants.

    **Attributes:**

    - `gains`: P, I and D.
    - `stable`: share of the plants; `peak`, `resonance`: the greatest of them.
    - `crossover`: their median in rad/s.
    - `rejection`, `noise`: relative to what flew.
    - `peaks`: the greatest Ms at each throttle.
    - `relaxed`: the greatest Ms with the integral held; None where it never is.
    - `delay_margin`: the least of the plants, in s.
    - `angle`: likewise of the angle loop around it; None without one.
    """

    gains: tuple[float, ...]
    stable: float
    peak: float
    resonance: float
    crossover: float
    rejection: float
    noise: float
    peaks: tuple[float, ...] = ()
    relaxed: float | None = None
    delay_margin: float = float("inf")
    angle: OuterStage | None = None

    @property
    def margin_text(self) -> str:
        """The least delay margin in ms; none of a loop that is not stable."""
        return f"{1e3 * self.delay_margin:.1f}" if self.stable == 1 else "none"

    def content(self) -> dict[str, object]:
        """All of it, for JSON."""
        return {**self._asdict(), "angle": None if self.angle is None else self.angle._asdict()}


def certify_angle(
    loops: RateLoops, gains: Float[np.ndarray, " gains"], angle: OuterLoop, value: float
) -> OuterStage:
    """The angle loop with a value of its parameter around the rate loop with these gains."""
    around = loops.outer_qualities(gains, angle.gain(value))
    margin = delay_margin(loops.outer_loops(gains, angle.gain(value)), loops.omega)
    return OuterStage(
        angle.name, value, angle.closed, float(np.mean(around.stable)),
        float(np.max(around.peak)), float(np.max(around.resonance)), float(np.min(margin)),
    )  # fmt: skip


def certify_gains(
    loops: Sequence[RateLoops], designs: Sequence[Float[np.ndarray, " gains"]]
) -> list[Stage]:
    """What each of the designs gives under its own law, the first of which is what flew."""
    rms, stages = lambda x: float(np.sqrt(np.mean(x**2))), []
    flown = None
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


@runtime_checkable
class Limits(Protocol):
    """What is kept: `DesignSettings`, or the `ADRCTargets`."""

    @property
    def sensitivity(self) -> float: ...
    @property
    def resonance(self) -> float: ...
    @property
    def noise(self) -> float: ...


@runtime_checkable
class Certified(Protocol):
    """What gains or parameters give on fresh plants: a `Stage`, or an `ADRCStage`."""

    @property
    def stable(self) -> float: ...
    @property
    def peak(self) -> float: ...
    @property
    def resonance(self) -> float: ...
    @property
    def crossover(self) -> float: ...
    @property
    def noise(self) -> float: ...


def beyond_limits(
    flown: Certified, third: Certified, proposed: Certified, limits: Limits, edge: float, *,
    loud: float = 1.0,
) -> list[str]:  # fmt: skip
    """In words, what is beyond a limit: `edge` of the identified band in rad/s, `loud` of noise."""
    limit, hertz = limits.sensitivity, 2 * np.pi
    share, most = 100 * min(third.stable, proposed.stable), max(limit, flown.peak)
    said = [
        (share < 100, f"only {share:.1f} % of the loops are stable"),
        (proposed.peak > limit, f"the worst Ms is {proposed.peak:.2f}, above {limit:g}"),
        (
            proposed.resonance > limits.resonance,
            f"the worst peak from set-point to rate is {proposed.resonance:.2f}, above "
            f"{limits.resonance:g}",
        ),
        (
            third.peak > most,
            f"a third of the way the worst Ms is {third.peak:.2f}, above {most:.3g}",
        ),
        (
            proposed.noise > loud * limits.noise,
            f"the command's noise is {proposed.noise:.2f} of what flew, above {limits.noise:g}",
        ),
        (
            proposed.crossover > edge,
            f"the crossover of {proposed.crossover / hertz:.1f} Hz is beyond the identified "
            f"{edge / hertz:.1f} Hz",
        ),
    ]
    return [words for is_beyond, words in said if is_beyond]


def beyond_angle(angle: OuterStage, limits: Limits) -> list[str]:
    """In words, which limits an angle loop does not keep."""
    around = f"of the angle loop ({angle.parameter} {angle.value:.3g})"
    said = [
        (angle.stable < 1, f"only {100 * angle.stable:.1f} % {around} are stable"),
        (
            angle.peak > limits.sensitivity,
            f"the worst Ms {around} is {angle.peak:.2f}, above {limits.sensitivity:g}",
        ),
        (
            angle.resonance > limits.resonance,
            f"the worst peak {around} is {angle.resonance:.2f}, above {limits.resonance:g}",
        ),
    ]
    return [words for is_beyond, words in said if is_beyond]


def limits_text(limits: DesignSettings) -> str:
    """Of what the limits are relative to, and when to stop."""
    return (
        f"limits: noise {limits.noise:g} times and gains {limits.change:g} times those of this "
        "flight at most. They compound from log to log: stop where a log keeps what flew, or the "
        "motors get warm"
    )
