"""From the gain over the throttle to the parameters of Betaflight's proposed ADRC.

The observer's response is rational in exp(-j omega T) and b0 divides it, so that a design is a
search over wc, wo and b0 on responses, as `_rate_gains` searches P, I and D.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from jaxquad._core import announce
from jaxquad.control.autopilots import (
    FilterChain,
    find_parameter,
    FlownBetaflight,
    Parameter,
    PT2,
    store_parameters,
)
from jaxquad.identify import GainOverThrottle
from jaxquad.records import AXES

from ._rate_gains import (
    cells_of,
    gyro_chain_response,
    hold_plants,
    law_responses,
    LoopQualities,
    RateLoops,
)


Designs = Float[np.ndarray, "designs 3"]  # wc, wo, b0
Kind = Literal["proposed", "not to be flown"]
_LAWS: Mapping[str, float] = {"FIXED": 0.0, "SQRT": 0.5, "LINEAR": 1.0, "QUADRATIC": 2.0}
_LARGEST = 3.0  # adrc_b0_scale_max
_DEGREES = 180 / np.pi
_LOWEST, _FREQUENCIES = 0.05, 300  # rad/s
_POINTS, _LEVELS, _ROUGH, _NARROWED = 5, 8, 5, 0.55  # the first levels on one plant each
_RESERVE = 0.97  # of the limits, because fresh plants reach further than those that were tuned on
_CERTIFICATES, _WORST = 3, 8
_SPREAD = 4.0  # factor on b0 to either side


@dataclasses.dataclass(frozen=True, kw_only=True)
class ADRCTargets:
    """What tuned ADRC parameters keep on every plant and at every throttle.

    **Arguments:**

    - `sensitivity`: greatest |S| at most.
    - `resonance`: peak of the response from set-point to rate at most.
    - `noise`: of the command, relative to the PID that flew, of white noise before the gyro's
        filters.
    """

    sensitivity: float = 1.8
    resonance: float = 1.4
    noise: float = 1.5

    def __post_init__(self):
        if not (self.sensitivity > 1 and self.resonance > 1 and self.noise > 0):
            raise ValueError(
                f"sensitivity {self.sensitivity:g}, resonance {self.resonance:g} and noise "
                f"{self.noise:g}: the first two must be above 1, the last above 0"
            )


class ADRCStage(NamedTuple):
    """What parameters give on fresh plants, over all throttles.

    **Attributes:**

    - `wc`, `wo`, `b0`: as the firmware stores them.
    - `stable`: share of the loops; `peak`, `resonance`: the greatest of them.
    - `crossover`: their median in rad/s.
    - `rejection`, `noise`: relative to the PID that flew, root mean square.
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


@dataclasses.dataclass(frozen=True)
class ADRCProposal:
    """Parameters of Betaflight's proposed ADRC, certified; `str()` is a report.

    **Attributes:**

    - `kind`: "proposed", or "not to be flown" where no parameters keep the targets.
    - `verdict`: the same in words.
    - `parameters`: of the firmware by name, empty where nothing is proposed.
    - `law`: adrc_b0_law.
    - `throttle`: at which the loops were certified.
    - `stage`: what the parameters give on fresh plants.
    - `defaults`: what the firmware's default wc, wo and b0 give there.
    """

    kind: Kind
    verdict: str
    parameters: Mapping[str, float]
    law: str
    throttle: tuple[float, ...]
    stage: ADRCStage
    defaults: ADRCStage

    def __str__(self) -> str:
        rows = [
            f"{'on fresh plants':<16} {'wc':>4} {'wo':>4} {'b0':>6}   stable   worst Ms   resonance"
            "   crossover   torque   noise"
        ]
        for name, each in (("proposed", self.stage), ("defaults", self.defaults)):
            rows.append(
                f"{name:<16} {each.wc:4.0f} {each.wo:4.0f} {each.b0:6.0f} "
                f"{100 * each.stable:6.1f} % {each.peak:10.2f} {each.resonance:11.2f} "
                f"{each.crossover / (2 * np.pi):8.1f} Hz {each.rejection:8.2f} {each.noise:7.2f}"
            )
        sets = [f"set {name} = {value:g}" for name, value in self.parameters.items()]
        sets += [f"set adrc_b0_law = {self.law}"] if sets else []
        return "\n".join([*rows, *sets, "", self.verdict])


def propose_adrc(
    found: GainOverThrottle,
    flown: FlownBetaflight,
    axis: str,
    *,
    hover: float,
    targets: ADRCTargets | None = None,
    bins: int = 5,
    members: int = 32,
    fresh: int = 256,
    seed: int = 0,
) -> ADRCProposal:
    """Tune wc, wo and b0 of Betaflight's proposed ADRC on the plants that a log leaves possible.

    The law of b0 over the throttle is the one nearest to the measured gain. Wanted is the least
    rate after a step of torque, with the targets kept on every plant at every throttle that was
    flown, behind the filters of the gyro that flew and adrc_gyro_lpf_hz of 150; wo is at least wc,
    and b0 within a factor of 4 of the identified one. The whole numbers are certified on fresh
    plants; where that fails the worst of these join the search, three times at most. Loops are
    taken as linear. Source: docs/autopilots.md.

    **Arguments:**

    - `found`: of `jq.identify.gain_over_throttle`, with the filters of the gyro divided out.
    - `flown`: the loop of the log's header, `betaflight_loop`: its filters stay, and its PID is
        what noise and torque are compared with.
    - `axis`: "roll", "pitch" or "yaw".
    - `hover`: adrc_hover_throttle, 0 to 1.
    - `bins`: throttles, evenly from the lowest to the highest flown.
    - `members`, `fresh`: plants to tune on, and to certify on at each throttle.
    - `seed`: of the draws.

    **Returns:** an `ADRCProposal`.

    **Raises:**

    - `UndeterminedError`: the log does not tell the lag or the thrust curve; says what to fly.
    - `ValueError`: for another axis, a hover throttle beyond 0 to 1, or units that are not known.

    !!! example

        ```python
        flown = betaflight_loop(settings.values, settings.version)
        chains = [flown.law.gyro, FilterChain(flown.law.filters, 1 / flown.law.dt)]
        found = jq.identify.gain_over_throttle(record, throttle_range=(0, 1000), filters=chains)
        print(jq.workflows.propose_adrc(found, flown, "roll", hover=0.3))
        ```
    """
    if axis not in AXES:
        raise ValueError(f"axis is {axis!r}: give one of {', '.join(AXES)}")
    targets, scaled = targets or ADRCTargets(), found.adrc_b0(hover, largest=_LARGEST)
    grid = np.linspace(found.low.min(), found.high.max(), bins)
    scales = np.clip((grid / hover) ** _LAWS[scaled.law], 1.0, _LARGEST)
    pairs = list(zip(map(float, grid), map(float, scales), strict=True))
    make = lambda plants, seed: [
        _make_loop(found, flown, AXES.index(axis), x, scale, plants, seed) for x, scale in pairs
    ]
    edge = np.inf if found.fit.origin is None else found.fit.origin.band[1]
    default = np.array([row.default for row in _rows(axis)], float)
    loops, attempt = make(max(1, members // bins), seed), 1
    while True:
        announce(f"searching wc, wo and b0 at {bins} throttles")
        best = _search(loops, scaled.b0.value, targets, edge, axis)
        announce(f"certifying the whole numbers on {fresh} new plants")
        new = make(fresh, seed + attempt)
        stage = _stage(new, best)
        if attempt == _CERTIFICATES or not _beyond(stage, targets, edge):
            break
        loops = [old.joined(each, best) for old, each in zip(loops, new, strict=True)]
        attempt += 1
    kind, verdict = _judge(stage, targets, edge, fresh, grid)
    values = {row.name: float(x) for row, x in zip(_rows(axis), best, strict=True)}
    values["adrc_hover_throttle"] = round(100 * hover)
    stored = store_parameters("betaflight", values) if kind == "proposed" else {}
    at = tuple(map(float, grid))
    return ADRCProposal(kind, verdict, stored, scaled.law, at, stage, _stage(new, default))


def _rows(axis: str) -> list[Parameter]:
    """Of wc, wo and b0."""
    return [find_parameter("betaflight", f"adrc_{name}_{axis}") for name in ("wc", "wo", "b0")]


def _judge(
    stage: ADRCStage, targets: ADRCTargets, edge: float, fresh: int, grid: np.ndarray
) -> tuple[Kind, str]:
    if beyond := _beyond(stage, targets, edge):
        return "not to be flown", (
            f"no parameters are proposed: {'; '.join(beyond)}. Allow more (`targets`), or fly more "
            "excitation"
        )
    return "proposed", (
        f"proposed: stable on all {fresh} fresh plants from {grid[0]:.2f} to {grid[-1]:.2f} "
        f"throttle, worst Ms {stage.peak:.2f} of at most {targets.sensitivity:g}, "
        f"{stage.rejection:.2f} of the effect of torque with the PID that flew"
    )


class _Loop(NamedTuple):
    """The loops of all plants at one throttle."""

    dt: float
    loops: RateLoops  # with the PID that flew as its only design
    passed: Complex[np.ndarray, " frequencies"]  # all filters of the rate
    scale: float  # of b0

    def qualities(self, designs: Designs) -> LoopQualities:
        return self._with(designs).qualities(np.eye(len(designs)))

    def first(self) -> "_Loop":
        """With one plant alone."""
        return self._replace(loops=dataclasses.replace(self.loops, plants=self.loops.plants[:1]))

    def joined(self, others: "_Loop", design: np.ndarray) -> "_Loop":
        """With the worst plants of the others."""
        worst = others._with(design[None]).worst(np.eye(1), _WORST)
        return self._replace(loops=self.loops.joined(worst))

    def _with(self, designs: Designs) -> RateLoops:
        back, ahead = observer_responses(designs, self.loops.omega, self.dt)
        back, ahead = back * self.passed / self.scale, ahead / self.scale
        return dataclasses.replace(self.loops, feedback=_DEGREES * back, ahead=_DEGREES * ahead)


def observer_responses(
    designs: Designs, omega: Float[np.ndarray, " frequencies"], dt: float, forgetting: float = 0.3
) -> tuple[Complex[np.ndarray, "designs frequencies"], Complex[np.ndarray, "designs frequencies"]]:
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


def _make_loop(
    found: GainOverThrottle,
    flown: FlownBetaflight,
    axis: int,
    throttle: float,
    scale: float,
    plants: int,
    seed: int,
) -> _Loop:
    law = flown.at(throttle)
    omega = np.geomspace(_LOWEST, 0.999 * np.pi / law.dt, _FREQUENCIES)
    drawn = found.draw(np.array([throttle]), plants, seed=seed)
    per_radian = 1.0 if found.output_unit == "rad/s" else 1 / _DEGREES
    held = hold_plants(
        per_radian * drawn.gain.T, drawn.lag[:, None], drawn.delay[:, None], omega, law.dt
    )
    ahead, back = law_responses(law, axis, omega)
    lowpass = FilterChain((PT2(150.0),), 1 / law.dt).response(omega / (2 * np.pi))
    passed = gyro_chain_response(law, omega) * np.asarray(lowpass)
    pid = RateLoops(omega, -back[None], ahead[None], held, cells_of(omega), np.ones_like(passed))
    return _Loop(law.dt, pid, passed, scale)


def _search(
    loops: Sequence[_Loop], b0: float, targets: ADRCTargets, edge: float, axis: str
) -> Float[np.ndarray, "3"]:
    """The whole numbers with the least effect of torque; where none keep the targets: nearest."""
    rows = _rows(axis)
    low = np.array([row.low for row in rows])
    high = np.array([row.high for row in rows])
    low[2], high[2] = np.clip([b0 / _SPREAD, b0 * _SPREAD], low[2], high[2])
    score = _Score(loops, targets, edge)
    rough = _Score([each.first() for each in loops], targets, edge)
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

    def __init__(self, loops: Sequence[_Loop], targets: ADRCTargets, edge: float):
        self.loops, self.targets, self.edge = loops, targets, edge
        self.flown = [each.loops.qualities(np.eye(1)) for each in loops]

    def __call__(self, designs: Designs) -> Float[np.ndarray, " designs"]:
        parts = np.array_split(designs, max(1, len(designs) // 64))
        return np.concatenate([self._of(part) for part in parts])

    def _of(self, designs: Designs) -> Float[np.ndarray, " designs"]:
        worst, rejected = designs[:, 0] / designs[:, 1], np.zeros(len(designs))  # wc at most wo
        targets = self.targets
        for loop, flown in zip(self.loops, self.flown, strict=True):
            each = loop.qualities(designs)
            beyond = np.stack([
                np.max(each.peak, axis=1) / (_RESERVE * targets.sensitivity),
                np.max(each.resonance, axis=1) / (_RESERVE * targets.resonance),
                np.mean(each.noise / flown.noise, axis=1) / (_RESERVE * targets.noise),
                np.max(each.crossover, axis=1) / self.edge,
            ]).max(axis=0)  # fmt: skip
            worst = np.maximum(worst, np.where(np.all(each.stable, axis=1), beyond, 1e6 * beyond))
            rejected += np.mean((each.rejection / flown.rejection) ** 2, axis=1)
        return np.where(worst <= 1, np.sqrt(rejected / len(self.loops)), 1e9 * worst)


def _stage(loops: Sequence[_Loop], design: np.ndarray) -> ADRCStage:
    found = [each.qualities(design[None]) for each in loops]
    flown = [each.loops.qualities(np.eye(1)) for each in loops]
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


def _beyond(stage: ADRCStage, targets: ADRCTargets, edge: float) -> list[str]:
    """In words, which of the targets a stage does not keep."""
    words = []
    if stage.stable < 1:
        words.append(f"only {100 * stage.stable:.1f} % of the loops are stable")
    if stage.peak > targets.sensitivity:
        words.append(f"the worst Ms is {stage.peak:.2f}, above {targets.sensitivity:g}")
    if stage.resonance > targets.resonance:
        words.append(
            f"the worst peak from set-point to rate is {stage.resonance:.2f}, above "
            f"{targets.resonance:g}"
        )
    if stage.noise > targets.noise:
        words.append(f"the noise is {stage.noise:.2f} of what flew, above {targets.noise:g}")
    if stage.crossover > edge:
        words.append(
            f"the crossover of {stage.crossover / (2 * np.pi):.1f} Hz is beyond the identified "
            f"{edge / (2 * np.pi):.1f} Hz"
        )
    return words
