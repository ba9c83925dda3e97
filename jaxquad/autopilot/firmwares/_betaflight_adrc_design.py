"""From the gain over the throttle to the parameters of Betaflight's proposed ADRC.

A design is a search over wc, wo and b0 on responses, as that of a PID is one over P, I and D.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad._core import announce, plain_content
from jaxquad.identify import B0Law, B0Schedule, GainOverThrottle, ScaledB0, UndeterminedError
from jaxquad.records import AXES

from .._parameters import find_parameter, store_parameters
from .._rate_design import best_on_grid, stored_near
from .._rate_loops import LoopQualities, together
from .._stages import beyond_limits, Kind
from ._betaflight_adrc import (
    adrc_loops,
    ADRCFrame,
    ADRCLoops,
    Design,
    Designs,
    draw_at,
    Flown,
    FlownADRC,
)


_LAW: B0Law = "SQRT"  # of the firmware by default
_POINTS, _LEVELS, _ROUGH, _NARROWED = 5, 8, 5, 0.55  # the first levels on one plant each
_RESERVE = 0.97  # of the limits, because fresh plants reach further than those that were tuned on
_CERTIFICATES, _WORST = 3, 8
_SPREAD = 4.0  # factor on b0 to either side
_WORTH = 0.95  # of the flown effect of torque, above which other numbers are not worth a change


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

    def cells(self) -> list[str]:
        """The numbers as both tables print them, the crossover in Hz."""
        tuned = ["-" if np.isnan(x) else f"{x:.0f}" for x in self[:3]]
        peaks, ends = ([f"{x:.2f}" for x in part] for part in (self[4:6], self[7:]))
        hertz = self.crossover / (2 * np.pi)
        return [*tuned, f"{100 * self.stable:.1f}", *peaks, f"{hertz:.1f}", *ends]


@dataclasses.dataclass(frozen=True)
class ADRCProposal:
    """Parameters of Betaflight's proposed ADRC, certified; `str()` is a report.

    **Attributes:**

    - `kind`: "proposed"; "kept" where the ADRC that flew is as good; "not to be flown" where no
        parameters keep the targets.
    - `verdict`: the same in words.
    - `parameters`: of the firmware by name, empty where nothing is proposed.
    - `frame`: what was not tuned.
    - `throttle`: at which the loops were certified.
    - `stages`: by name, what parameters give on fresh plants: "what flew", "proposed" and
        "defaults"; "a third of the way" where the ADRC flew.
    - `scaled`: b0 of the log and how far each law is from it; None of a log with one level of
        throttle, which does not show it.
    """

    kind: Kind
    verdict: str
    parameters: Mapping[str, float]
    frame: ADRCFrame
    throttle: tuple[float, ...]
    stages: Mapping[str, ADRCStage]
    scaled: ScaledB0 | None = None

    @property
    def stage(self) -> ADRCStage:
        """Of the proposal."""
        return self.stages["proposed"]

    @property
    def schedule(self) -> B0Schedule:
        """adrc_b0_law, adrc_hover_throttle and the limits of b0's scale."""
        return self.frame.schedule

    @property
    def law(self) -> B0Law:
        """adrc_b0_law."""
        return self.schedule.law

    def content(self) -> dict[str, object]:
        """All of it, for JSON."""
        return plain_content({
            "kind": self.kind, "verdict": self.verdict, "parameters": dict(self.parameters),
            "schedule": self.schedule._asdict(),
            "throttle": self.throttle,
            "stages": {name: stage._asdict() for name, stage in self.stages.items()},
            "b0_of_the_log": None if (x := self.scaled) is None else {
                "hover": x.hover, "b0": x.b0.value, "interval_95": x.b0.interval, "law": x.law,
                "deviations": dict(x.deviations), "extrapolated": x.extrapolated,
            },
        })  # fmt: skip

    def table(self) -> str:
        """The stages as text."""
        rows = [
            f"{'on fresh plants':<18} {'wc':>4} {'wo':>4} {'b0':>6}   stable   worst Ms   resonance"
            "   crossover   torque   noise"
        ]
        form = "{:<18} {:>4} {:>4} {:>6} {:>6} % {:>10} {:>11} {:>8} Hz {:>8} {:>7}"
        rows += [form.format(name, *stage.cells()) for name, stage in self.stages.items()]
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

    - `plant`: of `jq.identify.gain_over_throttle`, with the filters of the gyro divided out.
    - `flown`: of `betaflight_loop` or `betaflight_adrc_loop`: its filters stay, and it is what
        noise and torque are compared with.
    - `axis`: "roll", "pitch" or "yaw".
    - `hover`: adrc_hover_throttle, 0 to 1; by default that of the ADRC that flew, else the lowest
        level of throttle, because b0 is scaled up from there alone.
    - `bins`: throttles, evenly from the lowest to the highest flown.
    - `members`, `fresh`: plants to tune on, and to certify on at each throttle.

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
    targets, one, place = targets or ADRCTargets(), plant.throttle.size == 1, AXES.index(axis)
    grid = plant.throttle if one else np.linspace(plant.low.min(), plant.high.max(), bins)
    frame, scaled, b0 = _frame(plant, flown, hover)
    draw = lambda plants, seed: [
        adrc_loops(plant, flown, place, float(x), frame, plants, seed) for x in grid
    ]
    if min(float(draw_at(plant, float(x), fresh, seed)[0].min()) for x in grid) <= 0:
        raise UndeterminedError(
            "the log does not tell the gain from the command to the rate: 0 is within what it "
            "leaves possible. Fly a chirp of the rate set-point, or stronger and quicker stick"
        )
    edge = np.inf if plant.fit.origin is None else plant.fit.origin.band[1]
    rows = [find_parameter("betaflight", f"adrc_{name}_{axis}") for name in ("wc", "wo", "b0")]
    low, high, usual = (
        np.array([getattr(row, name) for row in rows], float) for name in ("low", "high", "default")
    )
    before = flown.design(place) if isinstance(flown, FlownADRC) else None
    if before is not None:
        ways = before / targets.change, before * targets.change
        low, high = (np.clip(x, low, high) for x in ways)
    else:
        low[2], high[2] = np.clip([b0 / _SPREAD, b0 * _SPREAD], low[2], high[2])
    loops = draw(max(1, members // len(grid)), seed)
    for attempt in range(1, _CERTIFICATES + 1):
        announce(f"searching wc, wo and b0 at {len(grid)} throttles")
        score = _score(loops, targets, edge, before)
        first = [dataclasses.replace(loop, plants=loop.plants[:1]) for loop in loops]
        rough, ends = _score(first, targets, edge, before), (np.log(low), np.log(high))
        middle, half = np.log(low * high) / 2, np.log(high / low) / 2
        for level in range(_LEVELS):
            used = rough if level < _ROUGH else score
            middle, half = best_on_grid(used, middle, half, ends, _POINTS), _NARROWED * half
        near = stored_near(np.exp(middle), rows, (low, high))
        best = near[np.argmin(score(near))]  # where none keep the targets: the nearest
        announce(f"certifying the whole numbers on {fresh} new plants")
        certified = draw(fresh, seed + attempt)
        stages = _stages(certified, before, best, usual)
        third = stages.get("a third of the way", stages["proposed"])
        beyond = beyond_limits(stages["what flew"], third, stages["proposed"], targets, edge)
        if not beyond:
            break
        worst = [x.worst(best[None], _WORST).plants for x in certified]
        loops = [
            dataclasses.replace(x, plants=np.concatenate([x.plants, more]))
            for x, more in zip(loops, worst, strict=True)
        ]
    kind, verdict = _judge(stages, beyond, targets, fresh, grid)
    values = {row.name: float(x) for row, x in zip(rows, best, strict=True)} | frame.parameters()
    stored = store_parameters("betaflight", values if kind == "proposed" else {})
    return ADRCProposal(kind, verdict, stored, frame, tuple(map(float, grid)), stages, scaled)


def _frame(
    plant: GainOverThrottle, flown: Flown, hover: float | None
) -> tuple[ADRCFrame, ScaledB0 | None, float]:
    """What is not tuned, b0 of the log where it shows it, and b0 at the hover throttle."""
    if hover is not None and not 0 < hover <= 1:
        raise ValueError(f"hover is {hover}: give the throttle at hover, above 0 and up to 1")
    if isinstance(flown, FlownADRC):
        frame, flew = flown.frame, flown.schedule.hover
        if hover is not None and abs(hover - flew) > 0.005:
            raise ValueError(
                f"hover is {hover:g}, but the ADRC that flew has an adrc_hover_throttle of "
                f"{100 * flew:.0f} %, which stays: leave hover out"
            )
    else:
        lowest = float(plant.throttle[0]) if hover is None else hover
        frame = ADRCFrame(B0Schedule(_LAW, max(0.05, round(lowest, 2))))
    schedule = frame.schedule
    if plant.throttle.size == 1:
        degrees = 1.0 if plant.output_unit == "deg/s" else 180 / np.pi
        scale = float(schedule.scale(plant.throttle[0]))
        return frame, None, degrees * plant.b0(0).value / scale
    scaled = plant.adrc_b0(schedule.hover, largest=schedule.high)
    if not isinstance(flown, FlownADRC):
        frame = frame._replace(schedule=schedule._replace(law=scaled.law))
    return frame, scaled, scaled.b0.value


def _third(before: Design, designs: Float[np.ndarray, "*designs 3"]) -> np.ndarray:
    return before + 1 / 3 * (designs - before)


def _stages(
    loops: Sequence[ADRCLoops], before: Design | None, best: Design, usual: Design
) -> dict[str, ADRCStage]:
    """What flew, a third of the way where that has a meaning, the proposal, and the defaults."""
    flown = together([loop.flown() for loop in loops])
    rms = lambda ratio: float(np.sqrt(np.mean(ratio**2)))

    def stage(design: Design, x: LoopQualities) -> ADRCStage:
        wc, wo, b0 = map(float, design)
        return ADRCStage(
            wc, wo, b0, float(np.mean(x.stable)), float(np.max(x.peak)),
            float(np.max(x.resonance)), float(np.median(x.crossover)),
            rms(x.rejection / flown.rejection), rms(x.noise / flown.noise),
        )  # fmt: skip

    of = lambda design: stage(design, together([loop.qualities(design[None]) for loop in loops]))
    stages = {"what flew": stage(np.full(3, np.nan) if before is None else before, flown)}
    if before is not None:
        stages["a third of the way"] = of(np.rint(_third(before, best)))
    return stages | {"proposed": of(best), "defaults": of(usual)}


def _judge(
    stages: Mapping[str, ADRCStage], beyond: Sequence[str], targets: ADRCTargets, fresh: int,
    grid: np.ndarray,
) -> tuple[Kind, str]:  # fmt: skip
    """The verdict, in words too."""
    if beyond:
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


def _score(
    loops: Sequence[ADRCLoops], targets: ADRCTargets, edge: float, before: Design | None
) -> Callable[[Designs], Float[np.ndarray, " designs"]]:
    """The effect of torque; designs beyond a target come after all that keep them."""
    limit, flown = _RESERVE * targets.sensitivity, [loop.flown() for loop in loops]
    last = lambda x, beyond: np.where(np.all(x.stable, axis=1), beyond, 1e6 * beyond)

    def score(designs: Designs) -> Float[np.ndarray, " designs"]:
        worst, rejected = designs[:, 0] / designs[:, 1], np.zeros(len(designs))  # wc at most wo
        for loop, flew in zip(loops, flown, strict=True):
            x = loop.qualities(designs)
            beyond = np.stack([
                np.max(x.peak, axis=1) / limit,
                np.max(x.resonance, axis=1) / (_RESERVE * targets.resonance),
                np.mean(x.noise / flew.noise, axis=1) / (_RESERVE * targets.noise),
                np.max(x.crossover, axis=1) / edge,
            ])  # fmt: skip
            worst = np.maximum(worst, last(x, beyond.max(axis=0)))
            if before is not None:  # Ms a third of the way, or that of what flew
                third = loop.qualities(_third(before, designs))
                allowed = max(limit, float(np.max(flew.peak)))
                worst = np.maximum(worst, last(third, np.max(third.peak, axis=1) / allowed))
            rejected += np.mean((x.rejection / flew.rejection) ** 2, axis=1)
        return np.where(worst <= 1, np.sqrt(rejected / len(loops)), 1e9 * worst)

    parts = lambda designs: np.array_split(designs, max(1, len(designs) // 64))
    return lambda designs: np.concatenate([score(part) for part in parts(designs)])
