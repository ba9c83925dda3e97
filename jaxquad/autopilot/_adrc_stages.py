"""What parameters of the ADRC give on fresh plants, what is wanted of them, and the verdict."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ._adrc_loops import ADRCLoop, Designs
from ._firmware import Parameter
from ._limits import beyond_limits
from ._parameters import find_parameter
from ._rate_design import Kind
from ._rate_gains import LoopQualities


Design = Float[np.ndarray, "3"]  # wc, wo, b0
_WORTH = 0.95  # of the flown effect of torque, above which other numbers are not worth a change
_THIRD = 1 / 3


@dataclasses.dataclass(frozen=True, kw_only=True)
class ADRCTargets:
    """What tuned ADRC parameters keep on every plant and at every throttle.

    **Arguments:**

    - `sensitivity`: greatest |S| at most.
    - `resonance`: peak of the response from set-point to rate at most.
    - `noise`: of the command, relative to what flew, of white noise before the gyro's filters.
    - `change`: factor within which wc, wo and b0 stay of those that flew, where the ADRC flew.
    """

    sensitivity: float = 1.8
    resonance: float = 1.4
    noise: float = 1.5
    change: float = 3.0

    def __post_init__(self):
        if not (self.sensitivity > 1 and self.resonance > 1 and self.noise > 0 and self.change > 1):
            raise ValueError(
                f"sensitivity {self.sensitivity:g}, resonance {self.resonance:g}, change "
                f"{self.change:g} and noise {self.noise:g}: the first three must be above 1, the "
                "last above 0"
            )


class ADRCStage(NamedTuple):
    """What parameters give on fresh plants, over all throttles.

    **Attributes:**

    - `wc`, `wo`, `b0`: as the firmware stores them; nan of a PID that flew.
    - `stable`: share of the loops; `peak`, `resonance`: the greatest of them.
    - `crossover`: their median in rad/s.
    - `rejection`, `noise`: relative to what flew, root mean square.
    """

    wc: float
    wo: float
    b0: float
    stable: float
    peak: float
    resonance: float
    crossover: float
    rejection: float
    noise: float


def rows_of(axis: str) -> list[Parameter]:
    """Of wc, wo and b0."""
    return [find_parameter("betaflight", f"adrc_{name}_{axis}") for name in ("wc", "wo", "b0")]


def a_third(before: Design, designs: Designs) -> Designs:
    """A third of the way."""
    return before + _THIRD * (designs - before)


def stages_of(
    loops: Sequence[ADRCLoop], axis: str, before: Design | None, best: Design
) -> dict[str, ADRCStage]:
    """What flew, a third of the way where that has a meaning, the proposal, and the defaults."""
    flown = [each.flown() for each in loops]
    of = lambda design: _stage(design, [x.qualities(design[None]) for x in loops], flown)
    none = np.full(3, np.nan)
    stages = {"what flew": _stage(none if before is None else before, flown, flown)}
    if before is not None:
        stages["a third of the way"] = of(np.rint(a_third(before, best[None])[0]))
    default = np.array([row.default for row in rows_of(axis)], float)
    return stages | {"proposed": of(best), "defaults": of(default)}


def _stage(
    design: Design, found: Sequence[LoopQualities], flown: Sequence[LoopQualities]
) -> ADRCStage:
    joined, before = _together(found), _together(flown)
    relative = lambda new, old: float(np.sqrt(np.mean((new / old) ** 2)))
    wc, wo, b0 = map(float, design)
    return ADRCStage(
        wc,
        wo,
        b0,
        float(np.mean(joined.stable)),
        float(np.max(joined.peak)),
        float(np.max(joined.resonance)),
        float(np.median(joined.crossover)),
        relative(joined.rejection, before.rejection),
        relative(joined.noise, before.noise),
    )


def _together(found: Sequence[LoopQualities]) -> LoopQualities:
    """Of one design, the plants of all throttles one after the other."""
    columns = zip(*found, strict=True)
    return LoopQualities(*(np.concatenate([each[0] for each in column]) for column in columns))


def judge(
    stages: Mapping[str, ADRCStage], targets: ADRCTargets, edge: float, fresh: int, grid: np.ndarray
) -> tuple[Kind, str]:
    """The verdict, in words too."""
    if beyond := beyond_targets(stages, targets, edge):
        return "not to be flown", (
            f"no parameters are proposed: {'; '.join(beyond)}. Allow more (`sensitivity`, "
            "`resonance`, `noise`), or fly more excitation"
        )
    flown, best = stages["what flew"], stages["proposed"]
    better = f"{best.rejection:.2f} of the effect of torque with what flew"
    within = flown.peak <= targets.sensitivity and flown.resonance <= targets.resonance
    if not np.isnan(flown.wc) and flown.stable == 1 and within and best.rejection > _WORTH:
        return "kept", (
            f"what flew is kept: within the limits the best parameters leave {better}. Its worst "
            f"Ms on {fresh} fresh plants is {flown.peak:.2f}"
        )
    where = f"from {grid[0]:.2f} to {grid[-1]:.2f}" if len(grid) > 1 else f"at {grid[0]:.2f}"
    return "proposed", (
        f"proposed: stable on all {fresh} fresh plants {where} throttle, worst Ms {best.peak:.2f} "
        f"of at most {targets.sensitivity:g}, {better}"
    )


def beyond_targets(stages: Mapping[str, ADRCStage], targets: ADRCTargets, edge: float) -> list[str]:
    """In words, which of the targets are not kept."""
    flown, whole = stages["what flew"], stages["proposed"]
    return beyond_limits(flown, stages.get("a third of the way", whole), whole, targets, edge)
