"""From the gain over the throttle to the parameters of Betaflight's proposed ADRC.

The observer's response is rational in exp(-j omega T) and b0 divides it, so that a design is a
search over wc, wo and b0 on responses, as `_rate_gains` searches P, I and D.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from jaxquad._core import announce, plain_content
from jaxquad.identify import B0Law, B0Schedule, GainOverThrottle, ScaledB0, UndeterminedError
from jaxquad.records import AXES

from .._parameters import store_parameters
from .._rate_loops import LoopQualities
from .._stages import Kind
from ._adrc import FlownADRC
from ._adrc_loops import (
    a_third,
    ADRCFrame,
    ADRCLoop,
    ADRCStage,
    ADRCTargets,
    beyond_targets,
    Design,
    Designs,
    draw_at,
    Flown,
    judge,
    make_adrc_loop,
    rows_of,
    stages_of,
)


_LAW: B0Law = "SQRT"  # of the firmware by default
_POINTS, _LEVELS, _ROUGH, _NARROWED = 5, 8, 5, 0.55  # the first levels on one plant each
_RESERVE = 0.97  # of the limits, because fresh plants reach further than those that were tuned on
_CERTIFICATES = 3
_SPREAD = 4.0  # factor on b0 to either side


@dataclasses.dataclass(frozen=True)
class ADRCProposal:
    """Parameters of Betaflight's proposed ADRC, certified; `str()` is a report.

    **Attributes:**

    - `kind`: "proposed"; "kept" where the ADRC that flew is as good; "not to be flown" where no
        parameters keep the targets.
    - `verdict`: the same in words.
    - `parameters`: of the firmware by name, empty where nothing is proposed.
    - `schedule`: adrc_b0_law, adrc_hover_throttle and the limits of b0's scale.
    - `throttle`: at which the loops were certified.
    - `stages`: by name, what parameters give on fresh plants: "what flew", "proposed" and
        "defaults"; "a third of the way" where the ADRC flew.
    - `scaled`: b0 of the log and how far each law is from it; None of a log with one level of
        throttle, which does not show it.
    """

    kind: Kind
    verdict: str
    parameters: Mapping[str, float]
    schedule: B0Schedule
    throttle: tuple[float, ...]
    stages: Mapping[str, ADRCStage]
    scaled: ScaledB0 | None = None

    @property
    def stage(self) -> ADRCStage:
        """Of the proposal."""
        return self.stages["proposed"]

    @property
    def defaults(self) -> ADRCStage:
        """Of the firmware's default wc, wo and b0."""
        return self.stages["defaults"]

    @property
    def law(self) -> B0Law:
        """adrc_b0_law."""
        return self.schedule.law

    def content(self) -> dict[str, object]:
        """All of it, for JSON."""
        return plain_content({
            "kind": self.kind,
            "verdict": self.verdict,
            "parameters": dict(self.parameters),
            "schedule": self.schedule._asdict(),
            "throttle": self.throttle,
            "stages": {name: stage._asdict() for name, stage in self.stages.items()},
            "b0_of_the_log": None if self.scaled is None else {
                "hover": self.scaled.hover,
                "b0": self.scaled.b0.value,
                "interval_95": self.scaled.b0.interval,
                "law": self.scaled.law,
                "deviations": dict(self.scaled.deviations),
                "extrapolated": self.scaled.extrapolated,
            },
        })  # fmt: skip

    def table(self) -> str:
        """The stages as text."""
        rows = [
            f"{'on fresh plants':<18} {'wc':>4} {'wo':>4} {'b0':>6}   stable   worst Ms   resonance"
            "   crossover   torque   noise"
        ]
        for name, x in self.stages.items():
            numbers = f"{x.wc:4.0f} {x.wo:4.0f} {x.b0:6.0f}"
            rows.append(
                f"{name:<18} {numbers.replace('nan', '  -')} {100 * x.stable:6.1f} % "
                f"{x.peak:10.2f} {x.resonance:11.2f} {x.crossover / (2 * np.pi):8.1f} Hz "
                f"{x.rejection:8.2f} {x.noise:7.2f}"
            )
        return "\n".join(rows)

    def __str__(self) -> str:
        sets = [f"set {name} = {value:g}" for name, value in self.parameters.items()]
        sets += [f"set adrc_b0_law = {self.law}"] if sets else []
        return "\n".join([self.table(), *sets, "", self.verdict])


def propose_adrc(
    plant: GainOverThrottle,
    flown: Flown,
    axis: str,
    *,
    hover: float | None = None,
    targets: ADRCTargets | None = None,
    bins: int = 5,
    members: int = 32,
    fresh: int = 256,
    seed: int = 0,
) -> ADRCProposal:
    """Tune wc, wo and b0 of Betaflight's proposed ADRC on the plants that a log leaves possible.

    Wanted is the least rate after a step of torque, with the targets kept on every plant at every
    throttle that was flown, behind the filters of the gyro that flew and adrc_gyro_lpf_hz. The
    whole numbers are certified on fresh plants; where that fails the worst of these join the
    search, three times at most. Loops are taken as linear.

    Where the PID flew, the law of b0 over the throttle is the one nearest to the measured gain, wo
    is at least wc, and b0 within a factor of 4 of the identified one. Where the ADRC flew, its law,
    hover throttle, low-passes and leak stay, and a third of the way keeps the limit on Ms, too, or
    that of what flew. A log with one level of throttle does not show b0 over the throttle: the law
    is then the firmware's default or what flew, and the certificate is of that throttle alone.
    Source: docs/autopilots.md.

    **Arguments:**

    - `found`: of `jq.identify.gain_over_throttle`, with the filters of the gyro divided out.
    - `flown`: the loop of the log's header, `betaflight_loop` or `betaflight_adrc_loop`: its
        filters stay, and it is what noise and torque are compared with.
    - `axis`: "roll", "pitch" or "yaw".
    - `hover`: adrc_hover_throttle, 0 to 1; by default that of the ADRC that flew, else the lowest
        level of throttle, because b0 is scaled up from there alone.
    - `targets`: an `ADRCTargets`.
    - `bins`: throttles, evenly from the lowest to the highest flown.
    - `members`, `fresh`: plants to tune on, and to certify on at each throttle.
    - `seed`: of the draws.

    **Returns:** an `ADRCProposal`.

    **Raises:**

    - `UndeterminedError`: the log does not tell the gain, the lag or the thrust curve; says what
        to fly.
    - `ValueError`: for another axis, a hover throttle beyond 0 to 1 or other than that of the ADRC
        that flew, or units that are not known.

    !!! example

        ```python
        flown = betaflight_loop(settings.values, settings.version)
        chains = [flown.law.gyro, FilterChain(flown.law.filters, 1 / flown.law.dt)]
        found = jq.identify.gain_over_throttle(record, throttle_range=(0, 1000), filters=chains)
        print(jq.autopilot.propose_adrc(found, flown, "roll", hover=0.3))
        ```
    """
    if axis not in AXES:
        raise ValueError(f"axis is {axis!r}: give one of {', '.join(AXES)}")
    targets, one = targets or ADRCTargets(), plant.throttle.size == 1
    grid = plant.throttle if one else np.linspace(plant.low.min(), plant.high.max(), bins)
    frame, scaled, middle = _frame(plant, flown, hover)
    make = lambda plants, seed: [
        make_adrc_loop(plant, flown, AXES.index(axis), float(x), frame, plants, seed) for x in grid
    ]
    _require_gains(plant, grid, fresh, seed)
    edge = np.inf if plant.fit.origin is None else plant.fit.origin.band[1]
    before, bounds = _flown_design(flown, axis), _bounds(flown, axis, middle, targets.change)
    loops = make(max(1, members // len(grid)), seed)
    attempt = 1
    while True:
        announce(f"searching wc, wo and b0 at {len(grid)} throttles")
        best = _search(loops, bounds, targets, edge, before)
        announce(f"certifying the whole numbers on {fresh} new plants")
        new = make(fresh, seed + attempt)
        stages = stages_of(new, axis, before, best)
        if attempt == _CERTIFICATES or not beyond_targets(stages, targets, edge):
            break
        loops = [old.joined(fresh_loop, best) for old, fresh_loop in zip(loops, new, strict=True)]
        attempt += 1
    kind, verdict = judge(stages, targets, edge, fresh, grid)
    values = _parameters(axis, best, frame) if kind == "proposed" else {}
    stored = store_parameters("betaflight", values)
    return ADRCProposal(
        kind, verdict, stored, frame.schedule, tuple(map(float, grid)), stages, scaled
    )


def _frame(
    plant: GainOverThrottle, flown: Flown, hover: float | None
) -> tuple[ADRCFrame, ScaledB0 | None, float]:
    """What is not tuned, b0 of the log where it shows it, and b0 at the hover throttle."""
    if hover is not None and not 0 < hover <= 1:
        raise ValueError(f"hover is {hover}: give the throttle at hover, above 0 and up to 1")
    if isinstance(flown, FlownADRC):
        schedule = flown.schedule
        if hover is not None and abs(hover - schedule.hover) > 0.005:
            raise ValueError(
                f"hover is {hover:g}, but the ADRC that flew has an adrc_hover_throttle of "
                f"{100 * schedule.hover:.0f} %, which stays: leave hover out"
            )
        law = flown.law
        frame = ADRCFrame(
            schedule, flown.lowpass_hz, float(law.setpoint_lowpass_hz), float(law.forgetting)
        )
    else:
        lowest = float(plant.throttle[0]) if hover is None else hover
        frame = ADRCFrame(B0Schedule(_LAW, max(0.05, round(lowest, 2))))
    at = frame.schedule.hover
    if plant.throttle.size == 1:
        degrees = 1.0 if plant.output_unit == "deg/s" else 180 / np.pi
        scale = float(frame.schedule.scale(plant.throttle[0]))
        return frame, None, degrees * plant.b0(0).value / scale
    scaled = plant.adrc_b0(at, largest=frame.schedule.high)
    if not isinstance(flown, FlownADRC):
        frame = frame._replace(schedule=frame.schedule._replace(law=scaled.law))
    return frame, scaled, scaled.b0.value


def _require_gains(plant: GainOverThrottle, grid: np.ndarray, plants: int, seed: int) -> None:
    """Raise UndeterminedError where the log leaves gains of 0 or below possible."""
    drawn = [draw_at(plant, float(x), plants, seed)[0] for x in grid]
    if min(float(gains.min()) for gains in drawn) <= 0:
        raise UndeterminedError(
            "the log does not tell the gain from the command to the rate: 0 is within what it "
            "leaves possible. Fly a chirp of the rate set-point, or stronger and quicker stick"
        )


def _flown_design(flown: Flown, axis: str) -> Design | None:
    """wc, wo and b0 that flew; None of a PID."""
    if not isinstance(flown, FlownADRC):
        return None
    law, k = flown.law, AXES.index(axis)
    return np.array([float(np.broadcast_to(x, (3,))[k]) for x in (law.wc, law.wo, law.b0)])


def _bounds(flown: Flown, axis: str, b0: float, change: float) -> tuple[Design, Design]:
    """Least and most of wc, wo and b0."""
    rows = rows_of(axis)
    low = np.array([row.low for row in rows], float)
    high = np.array([row.high for row in rows], float)
    before = _flown_design(flown, axis)
    if before is not None:
        return np.clip(before / change, low, high), np.clip(before * change, low, high)
    low[2], high[2] = np.clip([b0 / _SPREAD, b0 * _SPREAD], low[2], high[2])
    return low, high


def _parameters(axis: str, design: Design, frame: ADRCFrame) -> dict[str, float]:
    """What the firmware has to hold for the loops that were certified."""
    values = {row.name: float(x) for row, x in zip(rows_of(axis), design, strict=True)}
    return values | {
        "adrc_gyro_lpf_hz": frame.lowpass_hz,
        "adrc_td_hz": frame.setpoint_hz,
        "adrc_hover_throttle": 100 * frame.schedule.hover,
        "adrc_sigma_decay": 10 * frame.forgetting,
    }


def _search(
    loops: Sequence[ADRCLoop], bounds: tuple[Design, Design], targets: ADRCTargets, edge: float,
    before: Design | None,
) -> Design:  # fmt: skip
    """The whole numbers with the least effect of torque; where none keep the targets: nearest."""
    low, high = bounds
    score = _Score(loops, targets, edge, before)
    rough = _Score([loop.first() for loop in loops], targets, edge, before)
    middle, half = np.log(low * high) / 2, np.log(high / low) / 2
    for level in range(_LEVELS):
        axes = [
            np.clip(np.linspace(m - h, m + h, _POINTS), np.log(a), np.log(b))
            for m, h, a, b in zip(middle, half, low, high, strict=True)
        ]
        points = np.stack([x.ravel() for x in np.meshgrid(*axes, indexing="ij")], axis=1)
        used = rough if level < _ROUGH else score
        middle, half = points[np.argmin(used(np.exp(points)))], _NARROWED * half
    edges = zip(np.exp(middle), np.ceil(low), np.floor(high), strict=True)
    near = [np.unique(np.clip([np.floor(x), np.ceil(x)], a, b)) for x, a, b in edges]
    stored = np.array(list(itertools.product(*near)))
    return stored[np.argmin(score(stored))]


class _Score:
    """The effect of torque; designs beyond a target come after all that keep them."""

    def __init__(
        self, loops: Sequence[ADRCLoop], targets: ADRCTargets, edge: float, before: Design | None
    ):
        self.loops, self.targets, self.edge, self.before = loops, targets, edge, before
        self.flown = [loop.flown() for loop in loops]

    def __call__(self, designs: Designs) -> Float[np.ndarray, " designs"]:
        parts = np.array_split(designs, max(1, len(designs) // 64))
        return np.concatenate([self._of(part) for part in parts])

    def _of(self, designs: Designs) -> Float[np.ndarray, " designs"]:
        worst, rejected = designs[:, 0] / designs[:, 1], np.zeros(len(designs))  # wc at most wo
        targets = self.targets
        for loop, flown in zip(self.loops, self.flown, strict=True):
            qualities = loop.qualities(designs)
            beyond = np.stack([
                np.max(qualities.peak, axis=1) / (_RESERVE * targets.sensitivity),
                np.max(qualities.resonance, axis=1) / (_RESERVE * targets.resonance),
                np.mean(qualities.noise / flown.noise, axis=1) / (_RESERVE * targets.noise),
                np.max(qualities.crossover, axis=1) / self.edge,
            ]).max(axis=0)  # fmt: skip
            worst = np.maximum(
                worst, np.where(np.all(qualities.stable, axis=1), beyond, 1e6 * beyond)
            )
            worst = np.maximum(worst, self._on_the_way(loop, flown, designs))
            rejected += np.mean((qualities.rejection / flown.rejection) ** 2, axis=1)
        return np.where(worst <= 1, np.sqrt(rejected / len(self.loops)), 1e9 * worst)

    def _on_the_way(
        self, loop: ADRCLoop, flown: LoopQualities, designs: Designs
    ) -> Float[np.ndarray, " designs"]:
        """Ms a third of the way, over the greatest that is allowed there."""
        if self.before is None:
            return np.zeros(len(designs))
        qualities = loop.qualities(a_third(self.before, designs))
        allowed = max(_RESERVE * self.targets.sensitivity, float(np.max(flown.peak)))
        beyond = np.max(qualities.peak, axis=1) / allowed
        return np.where(np.all(qualities.stable, axis=1), beyond, 1e6 * beyond)
