"""Betaflight's proposed ADRC (pull request 15400) of a log, its loops, and what designs give there.

The observer's response is rational in exp(-j omega T), and b0 divides it.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxquad._core import as_messages, plain_content
from jaxquad.identify import (
    B0Law,
    B0Schedule,
    draw_models,
    filter_response,
    GainOverThrottle,
    ScaledB0,
)
from jaxquad.records import AXES

from .._filters import FilterChain, PT2
from .._law import DEGREES, FlownLoop, linear_responses
from .._parameters import list_parameters
from .._rate_loops import (
    cells_of,
    Frequencies,
    hold_plants,
    Kind,
    Limits,
    LoopQualities,
    Paths,
    RateLoops,
    together,
)
from ._betaflight import betaflight_loop, flies_adrc, FlownBetaflight
from ._betaflight_law import BetaflightADRC


_NUMBERED: tuple[B0Law, ...] = ("QUADRATIC", "SQRT", "LINEAR", "FIXED")  # as the header counts them
_LARGEST_WITHOUT_LAW = 9.0  # adrc_b0_scale_max of a build without adrc_b0_law
Design = Float[np.ndarray, "3"]  # wc, wo, b0
Designs = Float[np.ndarray, "designs 3"]


class ADRCFrame(NamedTuple):
    """What of the ADRC is not tuned: b0 over the throttle, filters, and the observer's leak."""

    schedule: B0Schedule
    lowpass_hz: float = 150.0  # 0 is off
    setpoint_hz: float = 0.0
    forgetting: float = 0.3  # 1/s

    def parameters(self) -> dict[str, float]:
        return {
            "adrc_gyro_lpf_hz": self.lowpass_hz, "adrc_td_hz": self.setpoint_hz,
            "adrc_hover_throttle": 100 * self.schedule.hover,
            "adrc_sigma_decay": 10 * self.forgetting,
        }  # fmt: skip


class FlownADRC(FlownLoop[BetaflightADRC]):
    """Betaflight's proposed ADRC of a log, with its dynamic cutoffs and b0 over the throttle.

    **Arguments:** (those of `FlownLoop`, and)

    - `pid`: the PID of the same header, which did not fly, for the gyro's filters.
    - `schedule`: of b0.
    """

    pid: FlownBetaflight = eqx.field(kw_only=True)
    schedule: B0Schedule = eqx.field(static=True, kw_only=True)

    @property
    def frame(self) -> ADRCFrame:
        """What a search leaves as it flew."""
        law = self.law
        cutoffs = [float(x.cutoff_hz) for x in law.lowpass or () if isinstance(x, PT2)]
        leak, setpoint_hz = float(law.forgetting), float(law.setpoint_lowpass_hz)
        return ADRCFrame(self.schedule, (*cutoffs, 0.0)[0], setpoint_hz, leak)

    def parameters(self) -> dict[str, float]:
        """The values that flew, by the names of `PARAMETERS`."""
        return list_parameters(self.law) | self.frame.parameters()

    def at(self, throttle: float) -> BetaflightADRC:
        """The law at a throttle of 0 to 1: dynamic cutoffs and the scale of b0."""
        scale = float(self.schedule.scale(throttle))
        return dataclasses.replace(self.law, filters=self.pid.at(throttle).filters, b0_scale=scale)


Flown = FlownBetaflight | FlownADRC


def adrc_parameters(values: Mapping[str, str]) -> dict[str, float]:
    """The parameters of the proposed ADRC that a Betaflight header holds, flown or not.

    `values` are as for `betaflight_loop`. Empty for a firmware without the ADRC.
    """
    lines = {"adrc_wc": "adrcWC", "adrc_wo": "adrcWO", "adrc_b0": "adrcB0"}
    parameters = {
        f"{name}_{axis}": value
        for name, line in lines.items() if line in values
        for axis, value in zip(AXES, _three(values, line), strict=True)
    }  # fmt: skip
    of_all = ("adrc_gyro_lpf_hz", "adrc_td_hz", "adrc_hover_throttle", "adrc_sigma_decay")
    return parameters | {name: float(values[name]) for name in of_all if name in values}


def betaflight_adrc_loop(
    values: Mapping[str, str], version: Sequence[int], *, throttle: float = 0.3
) -> FlownADRC:
    """The rate loop of a Betaflight header that was flown with the proposed ADRC.

    Arguments are as for `betaflight_loop`. A header without adrc_b0_law is of a build in which b0
    follows the square of the throttle. Source: docs/autopilots.md.

    **Raises:** `ValueError`: the PID flew, or the header lacks a number.
    """
    if not flies_adrc(values):
        raise ValueError(
            "the header has no pid_type of 1, so the PID flew: read it with betaflight_loop."
        )
    number = lambda name, default: float(values.get(name, default))
    pid, b0_of = betaflight_loop(values, version, throttle=throttle), b0_law(values)
    lowpass = number("adrc_gyro_lpf_hz", 150.0)
    law = BetaflightADRC(
        wc=_three(values, "adrcWC"), wo=_three(values, "adrcWO"), b0=_three(values, "adrcB0"),
        f=pid.law.f * pid.law.f_share, gyro=pid.law.gyro, filters=pid.law.filters,
        lowpass=(PT2(lowpass),) if lowpass > 0 else (),
        setpoint_lowpass_hz=number("adrc_td_hz", 0.0),
        forgetting=number("adrc_sigma_decay", 3.0) / 10, limit=pid.law.limit, dt=pid.law.dt,
    )  # fmt: skip
    schedule = B0Schedule(
        b0_of or "QUADRATIC", number("adrc_hover_throttle", 35.0) / 100,
        number("adrc_b0_scale_min", 100.0) / 100,
        number("adrc_b0_scale_max", 3.0 if b0_of else _LARGEST_WITHOUT_LAW),
    )  # fmt: skip
    # What concerns P, I and D did not fly.
    left_out: list[str] = [x for x in pid.unmodelled if x.kind in ("notch", "feedforward")]
    left_out.append("the gate before liftoff, and wc on the ground")
    if number("adrc_sat_z3_inhibit", 0.0) > 0:
        left_out += ["adrc_sat_z3_inhibit: the observer's integrator rests at the mixer's limits"]
    if any(float(x) != 100 for k in values if "adrc_zeta" in k for x in values[k].split(",")):
        left_out.append("adrc_zeta: the damping ratio is taken as 1")
    flown = FlownADRC(law, as_messages(left_out), pid=pid, schedule=schedule)
    return dataclasses.replace(flown, law=flown.at(throttle))


def b0_law(values: Mapping[str, str]) -> B0Law | None:
    """adrc_b0_law of a Betaflight header, as for `betaflight_loop`; None where it has none.

    **Raises:** `ValueError`: the header's number stands for no law.
    """
    if "adrc_b0_law" not in values:
        return None
    number = int(values["adrc_b0_law"])
    if not 0 <= number < len(_NUMBERED):
        raise ValueError(f"adrc_b0_law is {number} in the header: 0 to {len(_NUMBERED) - 1} exist.")
    return _NUMBERED[number]


def _three(values: Mapping[str, str], name: str) -> list[float]:
    if name not in values:
        raise ValueError(
            f"the header has no line {name}: the log's build of the ADRC is not that of pull "
            "request 15400."
        )
    return [float(x) for x in values[name].split(",")]


_LOWEST, _FREQUENCIES = 0.05, 300  # rad/s


@dataclasses.dataclass(frozen=True, kw_only=True)
class ADRCLoops(RateLoops):
    """The loops of all plants at one throttle, of which a design is a row of wc, wo and b0.

    Its `feedback` and `ahead` are those of the law that flew, and `passed` is of all filters of the
    rate; `scale` is that of b0.
    """

    dt: float
    scale: float
    frame: ADRCFrame

    def flown(self) -> LoopQualities:
        return self._qualities(self.feedback, self.ahead)

    def closed(self, design: Design | None) -> Paths:
        """From set-point to rate, of each plant; None is what flew."""
        flown = self.feedback, self.ahead
        [back], [ahead] = flown if design is None else self.paths(design[None])
        return ahead * self.plants / (1 + back * self.plants)

    def paths(self, gains: Designs, filters: None = None) -> tuple[Paths, Paths]:
        """From the rate to minus the command, and from the set-point to it.

        With q = exp(-j omega T) the observer of `BetaflightADRC` is (1 - q M) z = N y + q T b u,
        and b u = wc^2 r - (wc^2, 2 wc, 1) z: solved by elimination.
        """
        dt, frame = self.dt, self.frame
        wc, wo, b0 = (column[:, None] for column in gains.T)
        wo = np.minimum(wo, 0.5 / dt)
        q = np.exp(-1j * self.omega * dt)[None]
        updates = dt * np.stack([3 * wo, 3 * wo**2, wo**3])
        leak, one = 1 - q * (1 - frame.forgetting * dt), 1 - q

        def weighed(inputs: Sequence[np.ndarray | float] | np.ndarray) -> np.ndarray:
            """z for what enters each of its rows: z2 and z3 by z1 from the last up, then z1."""
            third = inputs[2] / leak, -q * updates[2] / leak
            second = (
                (inputs[1] + q * dt * third[0]) / one,
                (-q * updates[1] + q * dt * third[1]) / one,
            )
            first = inputs[0] + q * dt * second[0]
            first = first / (1 - q * (1 - updates[0]) - q * dt * second[1])
            return (
                wc**2 * first + 2 * wc * (second[0] + second[1] * first)
                + (third[0] + third[1] * first)
            )  # fmt: skip

        by_rate, by_drive = weighed(updates), weighed((0.0, q * dt, 0.0))
        back = by_rate / (b0 * (1 + by_drive)) * self.passed / self.scale
        ahead = wc**2 / (b0 * (1 + by_drive)) / self.scale
        if frame.setpoint_hz > 0:  # adrc_td_hz, a pt1
            w = 2 * np.pi * frame.setpoint_hz * dt
            ahead = ahead * (w / (w + 1) / (1 - np.exp(-1j * self.omega * dt) / (w + 1)))
        return DEGREES * back, DEGREES * ahead


def adrc_loops(
    plant: GainOverThrottle, flown: Flown, axis: int, throttle: float, frame: ADRCFrame,
    plants: int, seed: int, omega: Frequencies | None = None,
) -> ADRCLoops:  # fmt: skip
    """The loops of plants drawn at a throttle, behind the filters of what flew."""
    law, scale = flown.at(throttle), float(frame.schedule.scale(throttle))
    if omega is None:
        omega = np.geomspace(_LOWEST, 0.999 * np.pi / law.dt, _FREQUENCIES)
    gain, lag, delay = (x[:, None] for x in draw_at(plant, throttle, plants, seed))
    per_radian = 1.0 if plant.output_unit == "rad/s" else 1 / DEGREES
    responses = hold_plants(per_radian * gain, lag, delay, omega, law.dt)
    ahead, back = linear_responses(law.linear(axis), omega)
    observer = FilterChain((PT2(frame.lowpass_hz),) if frame.lowpass_hz > 0 else (), 1 / law.dt)
    chains = [x for x in law.gyro_chains() if x.filters]
    passed = filter_response([*chains, observer], omega)
    return ADRCLoops(
        omega, -back[None], ahead[None], responses, cells_of(omega), passed, dt=law.dt,
        scale=scale, frame=frame,
    )  # fmt: skip


def draw_at(
    plant: GainOverThrottle, throttle: float, plants: int, seed: int
) -> Sequence[Float[np.ndarray, " plants"]]:
    """Gain, lag and delay of drawn plants; of a record with one level, at that level's throttle."""
    if plant.throttle.size > 1:
        drawn = plant.draw(np.array([throttle]), plants, seed=seed)
        return drawn.gain[0], drawn.lag, drawn.delay
    plant.b0(0)  # says what to fly where the lag is not determined
    scores = np.random.default_rng(seed).standard_normal((len(plant.fit.names), plants))
    models = draw_models(plant.fit, jnp.asarray(scores))
    wide = lambda x: np.broadcast_to(np.asarray(x, float), (plants,))
    return wide(np.asarray(models.gain)[0]), wide(models.lag), wide(models.delay)


_LAW: B0Law = "SQRT"  # of the firmware by default
_WORTH = 0.95  # of the flown effect of torque, above which other numbers are not worth a change
_RESERVE = 0.97  # of the limits, because fresh plants reach further than those that were tuned on


@dataclasses.dataclass(frozen=True, kw_only=True)
class ADRCTargets:
    """What tuned ADRC parameters keep on every plant and at every throttle."""

    sensitivity: float = 1.8  # greatest |S|
    resonance: float = 1.4  # peak of the response from set-point to rate
    noise: float = 1.5  # of the command by white noise before the gyro's filters, over what flew
    change: float = 3.0  # factor from wc, wo and b0 that flew, where the ADRC flew

    def __post_init__(self):
        if not (self.sensitivity > 1 and self.resonance > 1 and self.noise > 0 and self.change > 1):
            raise ValueError(
                f"sensitivity {self.sensitivity:g}, resonance {self.resonance:g}, change "
                f"{self.change:g} and noise {self.noise:g}: the first three must be above 1, the "
                "last above 0"
            )


class ADRCStage(NamedTuple):
    """What parameters give on fresh plants, over all throttles."""

    wc: float  # as the firmware stores them; nan of a PID that flew
    wo: float
    b0: float
    stable: float  # share of the loops
    peak: float  # the greatest
    resonance: float  # the greatest
    crossover: float  # the median in rad/s
    rejection: float  # relative to what flew, root mean square
    noise: float  # likewise

    def cells(self) -> list[str]:
        """The numbers as both tables print them, the crossover in Hz."""
        tuned = ["-" if np.isnan(x) else f"{x:.0f}" for x in self[:3]]
        peaks, ends = ([f"{x:.2f}" for x in part] for part in (self[4:6], self[7:]))
        hertz = self.crossover / (2 * np.pi)
        return [*tuned, f"{100 * self.stable:.1f}", *peaks, f"{hertz:.1f}", *ends]


@dataclasses.dataclass(frozen=True)
class ADRCProposal:
    """Parameters of Betaflight's proposed ADRC, certified; `str()` is a report."""

    # "kept": the ADRC that flew is as good. "not to be flown": no parameters keep the targets.
    kind: Kind
    verdict: str  # the same in words
    parameters: Mapping[str, float]  # of the firmware by name, empty where nothing is proposed
    frame: ADRCFrame  # what was not tuned
    throttle: tuple[float, ...]  # at which the loops were certified
    # On fresh plants: "what flew", "proposed", "defaults", and "a third of the way" of an ADRC.
    stages: Mapping[str, ADRCStage]
    # b0 of the log and how far each law is from it; a log with one level of throttle has none.
    scaled: ScaledB0 | None = None

    @property
    def stage(self) -> ADRCStage:
        """Of the proposal."""
        return self.stages["proposed"]

    @property
    def law(self) -> B0Law:
        """adrc_b0_law."""
        return self.frame.schedule.law

    def content(self) -> dict[str, object]:
        """All of it, for JSON."""
        return plain_content({
            "kind": self.kind, "verdict": self.verdict, "parameters": dict(self.parameters),
            "schedule": self.frame.schedule._asdict(),
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


def third_of_the_way(before: Design, designs: Float[np.ndarray, "*designs 3"]) -> np.ndarray:
    return before + 1 / 3 * (designs - before)


def stages_of(
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
        stages["a third of the way"] = of(np.rint(third_of_the_way(before, best)))
    return stages | {"proposed": of(best), "defaults": of(usual)}


def score_of(
    loops: Sequence[ADRCLoops], targets: Limits, edge: float, before: Design | None
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
                third = loop.qualities(third_of_the_way(before, designs))
                allowed = max(limit, float(np.max(flew.peak)))
                worst = np.maximum(worst, last(third, np.max(third.peak, axis=1) / allowed))
            rejected += np.mean((x.rejection / flew.rejection) ** 2, axis=1)
        return np.where(worst <= 1, np.sqrt(rejected / len(loops)), 1e9 * worst)

    parts = lambda designs: np.array_split(designs, max(1, len(designs) // 64))
    return lambda designs: np.concatenate([score(part) for part in parts(designs)])


def frame_of(
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
        degrees = 1.0 if plant.output_unit == "deg/s" else DEGREES
        scale = float(schedule.scale(plant.throttle[0]))
        return frame, None, degrees * plant.b0(0).value / scale
    scaled = plant.adrc_b0(schedule.hover, largest=schedule.high)
    if not isinstance(flown, FlownADRC):
        frame = frame._replace(schedule=schedule._replace(law=scaled.law))
    return frame, scaled, scaled.b0.value


def judge_adrc(
    stages: Mapping[str, ADRCStage], beyond: Sequence[str], targets: Limits, fresh: int,
    grid: np.ndarray,
) -> tuple[Kind, str]:  # fmt: skip
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
