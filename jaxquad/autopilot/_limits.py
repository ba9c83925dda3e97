"""Which limits a certified design does not keep, in words."""

from typing import Protocol, runtime_checkable

import numpy as np


@runtime_checkable
class Certified(Protocol):
    """What gains or parameters give on fresh plants, as `Stage` and `ADRCStage` say it."""

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


@runtime_checkable
class Limits(Protocol):
    """What is wanted of them, as `DesignSettings` and `ADRCTargets` say it."""

    @property
    def sensitivity(self) -> float: ...
    @property
    def resonance(self) -> float: ...
    @property
    def noise(self) -> float: ...


def beyond_limits(
    flown: Certified, third: Certified, whole: Certified, limits: Limits, edge: float, *,
    loud: float = 1.0,
) -> list[str]:  # fmt: skip
    """In words, what is beyond a limit: `edge` of the identified band in rad/s, `loud` of noise."""
    limit, hertz = limits.sensitivity, 2 * np.pi
    share, most = 100 * min(third.stable, whole.stable), max(limit, flown.peak)
    found = [
        (share < 100, f"only {share:.1f} % of the loops are stable"),
        (whole.peak > limit, f"the worst Ms is {whole.peak:.2f}, above {limit:g}"),
        (
            whole.resonance > limits.resonance,
            f"the worst peak from set-point to rate is {whole.resonance:.2f}, above "
            f"{limits.resonance:g}",
        ),
        (
            third.peak > most,
            f"a third of the way the worst Ms is {third.peak:.2f}, above {most:.3g}",
        ),
        (
            whole.noise > loud * limits.noise,
            f"the command's noise is {whole.noise:.2f} of what flew, above {limits.noise:g}",
        ),
        (
            whole.crossover > edge,
            f"the crossover of {whole.crossover / hertz:.1f} Hz is beyond the identified "
            f"{edge / hertz:.1f} Hz",
        ),
    ]
    return [words for is_beyond, words in found if is_beyond]


@runtime_checkable
class CertifiedAngle(Protocol):
    """What an angle loop gives on fresh plants, as `OuterStage` says it."""

    @property
    def parameter(self) -> str: ...
    @property
    def value(self) -> float: ...
    @property
    def stable(self) -> float: ...
    @property
    def peak(self) -> float: ...
    @property
    def resonance(self) -> float: ...


def beyond_angle(angle: CertifiedAngle, limits: Limits) -> list[str]:
    """In words, which limits an angle loop does not keep."""
    around = f"of the angle loop ({angle.parameter} {angle.value:.3g})"
    found = [
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
    return [words for is_beyond, words in found if is_beyond]


@runtime_checkable
class GainLimits(Protocol):
    """By which factors noise and gains may differ from what flew."""

    @property
    def noise(self) -> float: ...
    @property
    def change(self) -> float: ...


def limits_text(limits: GainLimits) -> str:
    """Of what the limits are relative to, and when to stop."""
    return (
        f"limits: noise {limits.noise:g} times and gains {limits.change:g} times those of this "
        "flight at most. They compound from log to log: stop where a log keeps what flew, or the "
        "motors get warm"
    )
