"""What gains give on fresh plants: the rate loop as set and relaxed, the angle loop around it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ._firmware import OuterLoop
from ._rate_gains import delay_margin, RateLoops, together


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
    angle: "OuterStage | None" = None

    def content(self) -> dict[str, object]:
        """All of it, for JSON."""
        return {**self._asdict(), "angle": None if self.angle is None else self.angle._asdict()}


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
    parts = [
        [group.qualities(gains[None]) for group in one.groups]
        for one, gains in zip(loops, designs, strict=True)
    ]
    found = [together(each) for each in parts]
    rms = lambda x: float(np.sqrt(np.mean(x**2)))
    first = found[0]
    held = [
        one.relaxed_qualities(gains[None]) if any(group.relaxed for group in one.groups) else None
        for one, gains in zip(loops, designs, strict=True)
    ]
    margins = [
        float(np.min(delay_margin(one.open_loops(gains), one.omega)))
        for one, gains in zip(loops, designs, strict=True)
    ]
    return [
        Stage(
            tuple(map(float, gains)),
            float(np.mean(each.stable if still is None else each.stable & still.stable)),
            float(np.max(each.peak)),
            float(np.max(each.resonance)),
            float(np.median(each.crossover)),
            rms(each.rejection) / rms(first.rejection),
            rms(each.noise) / rms(first.noise),
            tuple(float(np.max(group.peak)) for group in groups),
            None if still is None else float(np.max(still.peak)),
            margin,
        )
        for each, groups, gains, still, margin in zip(
            found, parts, designs, held, margins, strict=True
        )
    ]


def margin_text(stage: Stage) -> str:
    """The least delay margin in ms; none of a loop that is not stable."""
    return f"{1e3 * stage.delay_margin:.1f}" if stage.stable == 1 else "none"
