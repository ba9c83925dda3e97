"""Feed-forward of the sticks: how much of it makes the rate follow a quick stick best.

It acts on the speed of the set-point and is in no loop: gains are designed first. The response from
set-point to rate is T + f H, with T of the loop alone, H of a unit of feed-forward, and f its gain.
The error after a quick stick is quadratic in f, and the peak of the response is convex.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ._flight_channels import FlownAutopilot
from ._law import RateLoop
from ._parameters import find_parameter, names_by_field
from ._rate_loops import (
    cells_of,
    DesignSettings,
    OneGains,
    RateLoops,
    Response,
    Responses,
    unit_path,
)


_STICK_HZ, _LAGS = 15.0, 3  # of a quick stick: a step of the set-point behind so many lags
_STEEPEST = 0.27 * 2 * np.pi * _STICK_HZ  # 1/s, of it
_SIZE, _SHARE = np.radians(200.0), 0.5  # of it in rad/s, which may ask for this share of the limit
_LOWEST = 1.0  # rad/s, below which no stick is quick
_RESERVE = 0.985  # of the limit, because fresh plants reach further than those tuned on
_VALUES = 49  # that are tried
_WORTH = 0.97  # of the error with what flew, above which a change is not worth one

Values = Float[np.ndarray, " values"]


class StickFollowing(NamedTuple):
    """How the rate follows a quick stick with one gain of feed-forward."""

    value: float  # of the gain, as stored
    error: float  # rms of set-point less rate, over all plants, relative to the flown gain
    peak: float  # the greatest of the response from set-point to rate


@dataclasses.dataclass(frozen=True)
class FeedForwardVerdict:
    """What the search made of the feed-forward."""

    text: str
    parameter: str
    stages: tuple[StickFollowing, StickFollowing]  # with the flown gain of it, and the new one
    keeps: bool  # whether the response keeps the limit on its peak

    @property
    def flown(self) -> dict[str, float]:
        """Of the feed-forward, where it changes: what was off stays so."""
        old, new = self.stages[0].value, self.stages[-1].value
        return {self.parameter: old} if 0 < old != new else {}

    @property
    def new(self) -> dict[str, float]:
        return dict.fromkeys(self.flown, self.stages[-1].value)

    @property
    def reason(self) -> str:
        """Why it changes."""
        (old, _, _), (_, error, peak) = self.stages
        return f"error after a quick stick {error:.2f} of that with {old:.0f}, peak {peak:.2f}"

    def content(self) -> dict[str, object]:
        stages = [stage._asdict() for stage in self.stages]
        return {"text": self.text, "parameter": self.parameter, "stages": stages}


def design_feed_forward(
    flown: FlownAutopilot, loops: Sequence[RateLoops], fresh: Sequence[RateLoops], gains: OneGains,
    settings: DesignSettings,
) -> FeedForwardVerdict | None:  # fmt: skip
    """The gain with the least error after a quick stick whose response keeps the limit on its peak.

    Where the certificate shows a peak beyond the limit and above that with the flown gain, this
    stays. None for a law whose feed-forward is not of the sticks.

    **Arguments:**

    - `loops`: what the new P, I and D, `gains`, were tuned on, behind the new filters.
    - `fresh`: likewise, for the certificate.
    """
    law, axis = flown.law, flown.axis
    if not law.of_sticks:
        return None
    [field] = law.feed_forward
    name = names_by_field(law.firmware, axis)[field]
    row = find_parameter(law.firmware, name)
    before = float(np.broadcast_to(vars(law)[field], 3)[axis])
    sticks, others = (_QuickSticks(x, gains, law, axis) for x in (loops, fresh))
    least, most = before / settings.change, before * settings.change if before > 0 else row.high
    asked_for = _SHARE * float(np.broadcast_to(vars(law)["limit"], 3)[axis]) / sticks.command
    ends = np.clip((least, min(most, max(before, asked_for))), row.low, row.high)
    values = np.array([before, _best_value(sticks, before, ends, settings.resonance)])
    errors = others.errors(values)
    rows = zip(values, errors / errors[0], others.peaks(values), strict=True)
    old, new = (StickFollowing(*map(float, row)) for row in rows)
    limit = settings.resonance
    if new.peak > max(limit, old.peak):
        new = old
    text, keeps = _in_words(name, old, new, limit), new.peak <= limit
    return FeedForwardVerdict(text, name, (old, new), keeps)


def _best_value(sticks: "_QuickSticks", before: float, ends: Values, limit: float) -> float:
    """Of the least error that keeps the limit on the peak, or of the least peak where none does."""
    best = np.clip(sticks.best, *ends)
    values = np.unique(np.rint([before, *np.linspace(ends[0], best, _VALUES)]))
    peaks, errors = sticks.peaks(values), sticks.errors(values)
    score = np.where(peaks <= _RESERVE * limit, errors, 1e9 * peaks)
    [flown] = score[values == before]
    return before if _WORTH * flown <= score.min() else float(values[np.argmin(score)])


def _in_words(name: str, old: StickFollowing, new: StickFollowing, limit: float) -> str:
    bound = f"of at most {limit:g}" if new.peak <= limit else f"above {limit:g}"
    peak = f"the response to the set-point peaks at {new.peak:.2f}, {bound}"
    if new.value == old.value:
        return f"{name} = {new.value:.0f} stays: {peak}"
    share = f"{new.error:.2f} of the error after a quick stick"
    if old.value == 0:
        return f"off, and stays so; {name} = {new.value:.0f} would leave {share} ({peak})"
    return (
        f"{name} = {old.value:.0f} -> {new.value:.0f} leaves {share} with the new gains; {peak} "
        f"(with {old.value:.0f} at {old.peak:.2f})"
    )


class _QuickSticks:
    """How the rate follows them under some gains, by the value of the feed-forward."""

    def __init__(self, loops: Sequence[RateLoops], gains: OneGains, law: RateLoop, axis: int):
        quick = loops[0].omega >= _LOWEST
        omega = loops[0].omega[quick]
        unit = unit_path(law.deflected(), axis, law.feed_forward[0], loops[0].omega)[0]
        # The greatest that a unit of it asks for after a quick stick.
        self.command = float(np.abs(unit[0]) / loops[0].omega[0]) * _STEEPEST * _SIZE
        lag = 1 / (1 + 1j * omega / (2 * np.pi * _STICK_HZ))
        weight = np.abs(lag) ** (2 * _LAGS) / omega**2 * cells_of(omega)
        # While the sticks move, the integral may be held and D raised.
        follows = np.array([1.0, 0.0 if any(x.relaxed for x in loops) else 1.0, 1.0])
        raised = np.array([1.0, 1.0, max(x.ceiling for x in loops)])
        states = np.unique([follows, follows * raised, raised, np.ones(3)], axis=0)
        self.parts: list[tuple[Responses, Responses]] = []  # without it, and of a unit of it
        for state in states:
            both = [_responses(x, state * gains, unit) for x in loops]
            alone, ahead = (np.concatenate(x)[:, quick] for x in zip(*both, strict=True))
            self.parts.append((alone, ahead))
        following, ahead = self.parts[int(np.flatnonzero((states == follows).all(axis=1))[0])]
        missing = 1 - following
        mean = lambda x: float(np.mean(np.real(x) @ weight))
        self.square = mean(np.abs(missing) ** 2)
        self.product, self.unit = mean(np.conj(missing) * ahead), mean(np.abs(ahead) ** 2)

    @property
    def best(self) -> float:
        """Of the error alone."""
        return self.product / self.unit

    def errors(self, values: Values) -> Values:
        return np.sqrt(self.square - 2 * values * self.product + values**2 * self.unit)

    def peaks(self, values: Values) -> Values:
        return np.array(
            [max(np.abs(x + value * ahead).max() for x, ahead in self.parts) for value in values]
        )


def _responses(loops: RateLoops, gains: OneGains, unit: Response) -> tuple[Responses, Responses]:
    """From set-point to rate: of the loop alone, and of a unit of feed-forward."""
    back, ahead = loops.paths(gains[None])
    closed = loops.plants / (1 + back * loops.plants)
    return ahead * closed, unit * closed
