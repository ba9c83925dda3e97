"""Rate loops with Betaflight's proposed ADRC, on plants drawn over the throttle."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from jaxquad.identify import B0Schedule, draw_models, GainOverThrottle

from .._filters import FilterChain, PT2
from .._firmware import Parameter
from .._law import law_responses
from .._parameters import find_parameter
from .._rate_loops import cells_of, hold_plants, LoopQualities, RateLoops
from .._stages import beyond_limits, Kind
from ._adrc import FlownADRC
from ._header import FlownBetaflight


Designs = Float[np.ndarray, "designs 3"]  # wc, wo, b0
Paths = Complex[np.ndarray, "designs frequencies"]
Frequencies = Float[np.ndarray, " frequencies"]
Flown = FlownBetaflight | FlownADRC
_DEGREES = 180 / np.pi
_LOWEST, _FREQUENCIES = 0.05, 300  # rad/s
_WORST = 8


class ADRCFrame(NamedTuple):
    """What of the ADRC is not tuned: b0 over the throttle, filters, and the observer's leak."""

    schedule: B0Schedule
    lowpass_hz: float = 150.0  # 0 is off
    setpoint_hz: float = 0.0
    forgetting: float = 0.3  # 1/s


@dataclasses.dataclass(frozen=True)
class ADRCLoop:
    """The loops of all plants at one throttle.

    **Attributes:**

    - `loops`: with the law that flew as its only design.
    - `passed`: response of all filters of the rate.
    - `scale`: of b0.
    """

    dt: float
    loops: RateLoops
    passed: Complex[np.ndarray, " frequencies"]
    scale: float
    frame: ADRCFrame

    def qualities(self, designs: Designs) -> LoopQualities:
        """What each row of wc, wo and b0 gives."""
        return self._with(designs).qualities(np.eye(len(designs)))

    def flown(self) -> LoopQualities:
        """What flew gives."""
        return self.loops.qualities(np.eye(1))

    def first(self) -> "ADRCLoop":
        """With one plant alone."""
        one = dataclasses.replace(self.loops, plants=self.loops.plants[:1])
        return dataclasses.replace(self, loops=one)

    def joined(self, others: "ADRCLoop", design: Float[np.ndarray, "3"]) -> "ADRCLoop":
        """With the worst plants of the others."""
        worst = others._with(design[None]).worst(np.eye(1), _WORST)
        return dataclasses.replace(self, loops=self.loops.joined(worst))

    def closed(self, design: Float[np.ndarray, "3"] | None) -> Paths:
        """From set-point to rate, of each plant; None is what flew."""
        loops = self.loops if design is None else self._with(design[None])
        [back], [ahead] = loops.feedback, loops.ahead
        return ahead * loops.plants / (1 + back * loops.plants)

    def _with(self, designs: Designs) -> RateLoops:
        omega, frame = self.loops.omega, self.frame
        back, ahead = observer_responses(designs, omega, self.dt, frame.forgetting)
        back, ahead = back * self.passed / self.scale, ahead / self.scale
        ahead = ahead * _setpoint_response(frame.setpoint_hz, omega, self.dt)
        return dataclasses.replace(self.loops, feedback=_DEGREES * back, ahead=_DEGREES * ahead)


def observer_responses(
    designs: Designs, omega: Frequencies, dt: float, forgetting: float = 0.3
) -> tuple[Paths, Paths]:
    """From the rate behind its low-pass to minus the command, and from the set-point to it.

    Per deg/s. With q = exp(-j omega T) the observer of `BetaflightADRC` is
    (1 - q M) z = N y + q T b u, and b u = wc^2 r - (wc^2, 2 wc, 1) z: solved by elimination.
    """
    wc, wo, b0 = (column[:, None] for column in designs.T)
    wo = np.minimum(wo, 0.5 / dt)
    q = np.exp(-1j * omega * dt)[None]
    gains = dt * np.stack([3 * wo, 3 * wo**2, wo**3])
    leak, one = 1 - q * (1 - forgetting * dt), 1 - q

    def observed(inputs: tuple[np.ndarray | float, ...]):
        """z for what enters each of its three rows."""
        # z2 and z3 by z1, from the last row up; then the first row alone.
        third = (inputs[2] / leak, -q * gains[2] / leak)
        second = [
            (inputs[1] + q * dt * third[0]) / one,
            (-q * gains[1] + q * dt * third[1]) / one,
        ]
        first = (inputs[0] + q * dt * second[0]) / (1 - q * (1 - gains[0]) - q * dt * second[1])
        return first, second[0] + second[1] * first, third[0] + third[1] * first

    weigh = lambda z: wc**2 * z[0] + 2 * wc * z[1] + z[2]
    by_rate, by_drive = weigh(observed(tuple(gains))), weigh(observed((0.0, q * dt, 0.0)))
    return by_rate / (b0 * (1 + by_drive)), wc**2 / (b0 * (1 + by_drive))


def _setpoint_response(
    cutoff_hz: float, omega: Frequencies, dt: float
) -> Complex[np.ndarray, " frequencies"]:
    """Of adrc_td_hz, a pt1."""
    if cutoff_hz == 0:
        return np.ones(omega.size, complex)
    w = 2 * np.pi * cutoff_hz * dt
    return w / (w + 1) / (1 - np.exp(-1j * omega * dt) / (w + 1))


def make_adrc_loop(
    plant: GainOverThrottle, flown: Flown, axis: int, throttle: float, frame: ADRCFrame,
    plants: int, seed: int, omega: Frequencies | None = None,
) -> ADRCLoop:  # fmt: skip
    """The loops of plants drawn at a throttle, behind the filters of what flew."""
    law, scale = flown.at(throttle), float(frame.schedule.scale(throttle))
    if omega is None:
        omega = np.geomspace(_LOWEST, 0.999 * np.pi / law.dt, _FREQUENCIES)
    gain, lag, delay = draw_at(plant, throttle, plants, seed)
    per_radian = 1.0 if plant.output_unit == "rad/s" else 1 / _DEGREES
    responses = hold_plants(per_radian * gain[:, None], lag[:, None], delay[:, None], omega, law.dt)
    ahead, back = law_responses(law, axis, omega)
    passed = np.ones(omega.size, complex)
    for chain in rate_filters(flown, throttle, frame):
        passed = passed * np.asarray(chain.response(omega / (2 * np.pi)))
    before = RateLoops(
        omega, -back[None], ahead[None], responses, cells_of(omega), np.ones_like(passed)
    )
    return ADRCLoop(law.dt, before, passed, scale, frame)


def gyro_filters(flown: Flown, throttle: float) -> list[FilterChain]:
    """The chains that a rate passed before it was logged."""
    law = flown.at(throttle)
    return [x for x in (law.gyro, FilterChain(law.filters, 1 / law.dt)) if x.filters]


def rate_filters(flown: Flown, throttle: float, frame: ADRCFrame) -> list[FilterChain]:
    """The chains before the observer: those of the gyro, and adrc_gyro_lpf_hz."""
    observer = (PT2(frame.lowpass_hz),) if frame.lowpass_hz > 0 else ()
    return [*gyro_filters(flown, throttle), FilterChain(observer, 1 / flown.law.dt)]


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
    flown = [loop.flown() for loop in loops]
    of = lambda design: _stage(design, [x.qualities(design[None]) for x in loops], flown)
    none = np.full(3, np.nan)
    stages = {"what flew": _stage(none if before is None else before, flown, flown)}
    if before is not None:
        stages["a third of the way"] = of(np.rint(a_third(before, best[None])[0]))
    default = np.array([row.default for row in rows_of(axis)], float)
    return stages | {"proposed": of(best), "defaults": of(default)}


def _stage(
    design: Design, qualities: Sequence[LoopQualities], flown: Sequence[LoopQualities]
) -> ADRCStage:
    joined, before = _together(qualities), _together(flown)
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


def _together(qualities: Sequence[LoopQualities]) -> LoopQualities:
    """Of one design, the plants of all throttles one after the other."""
    columns = zip(*qualities, strict=True)
    return LoopQualities(*(np.concatenate([x[0] for x in column]) for column in columns))


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
    flown, best = stages["what flew"], stages["proposed"]
    return beyond_limits(flown, stages.get("a third of the way", best), best, targets, edge)
