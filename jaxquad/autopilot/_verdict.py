"""The verdict on gains that were searched: what of them keeps the limits, and what to fly first."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ._filter_bank import SharedChange
from ._rate_loops import DesignSettings, Kind, Limits, OuterStage, Stage


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


_WORTH = 0.95  # of the flown effect of torque, above which gains are not worth a change
_ALLOWED = 1.03  # of a limit that the search kept on the ratio of filters, for the law itself
_NEARLY = 1.05  # of the limit of the resonance, which a third of the way may reach without a word
SWINGING = 0.1  # of a flight with a motor at its limit, from which the motors bound a swing
BELIEVED = 0.5  # share of plants on which the loop that flew has to be stable


def is_bounded(flown: Stage, swings: float) -> bool:
    """Whether the motors' limits alone bounded the swings of what flew."""
    return flown.stable < BELIEVED and swings > SWINGING


def judge(
    stages: Sequence[Stage], settings: DesignSettings, edge: float, shared: SharedChange | None,
    throttles: Sequence[float], swings: float = 0.0,
) -> tuple[Kind, str]:  # fmt: skip
    """The verdict; `swings` is the share of the flight with a motor at its limit."""
    flown, third, new = stages
    bounded = is_bounded(flown, swings)
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
            f"({flown.peak:.2f}, {flown.resonance:.2f}): only hover with it, then load all of it"
        )
    return "proposed", f"{proposed}, {better}{around}. {first}"
