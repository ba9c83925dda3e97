"""The search: gains, and filters where the log shows the gyro's noise, that reject torque best."""

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from ._filters import FilterChain
from ._firmware import FilterChoice, Parameter
from ._gyro_noise import GyroNoise
from ._law import RateLoop
from ._rate_loops import (
    FIELDS,
    Filters,
    gain_row,
    Gains,
    gains_of,
    gyro_chain_response,
    law_paths,
    Paths,
    RateLoops,
)


Picks = Int[np.ndarray, "designs choices"]
_POINTS, _LEVELS, _NARROWED = 7, 6, 0.4  # of the search, along each gain and one after the other
_AROUND, _POINTS_AROUND, _LEVELS_AROUND = 0.3, 5, 4  # likewise, around known gains, in ln
_RESERVE = 0.97  # of the limit, because fresh plants reach further than those that were tuned on
_TOGETHER = 384  # loops of designs and plants evaluated at once: beyond, memory is slow
_ROUNDS, _DRAWN, _BEST, _KEPT = 14, 140, 18, 0.3  # of the search with filters
_WIDTH, _NARROWEST = (0.35, 0.25), (0.02, 0.3)  # of gains in ln, of filters in options
_SLOW = 2 * np.pi * 5.0  # rad/s, where delays are compared


class Targets(NamedTuple):
    """What a search keeps.

    **Attributes:**

    - `peak`: Ms at most; `resonance`: the peak from set-point to rate at most.
    - `noise`: of the flown gains' noise, at most.
    - `change`: factor by which a gain may rise or fall.
    - `crossover`: rad/s at most, where the identified band ends.
    """

    peak: float
    resonance: float
    noise: float
    change: float
    crossover: float


class OtherAxis(NamedTuple):
    """What an axis that is not tuned makes of its gyro's noise."""

    slow: Complex[np.ndarray, " frequencies"]  # by P and I
    quick: Complex[np.ndarray, " frequencies"]  # by D
    noise: Float[np.ndarray, " frequencies"]


def other_axes(
    law: RateLoop, noise: GyroNoise, omega: Float[np.ndarray, " frequencies"]
) -> tuple[OtherAxis, ...]:
    """Those whose gyro is in the log, under a law; behind the gyro's filters of that law."""
    others = []
    for k, density in noise.others.items():
        gains, (back, _) = gains_of(law, k), law_paths(law, k, omega)
        power = noise.powers(density, omega)
        others.append(OtherAxis(gains[:2] @ back[:2], gains[2] * back[2], power))
    return tuple(others)


class FilterBank:
    """The options of all free filters, as their responses over those that flew."""

    def __init__(
        self, choices: Sequence[FilterChoice], law: RateLoop, noise: GyroNoise,
        omega: Float[np.ndarray, " frequencies"],
    ):  # fmt: skip
        self.choices, self.measured = tuple(choices), omega / (2 * np.pi) <= noise.known_hz
        self.others = other_axes(law, noise, omega)
        low = int(np.searchsorted(omega, _SLOW))
        self.ratios, self.delays = [], []
        for choice in self.choices:
            every = np.stack([_response(option.filter, choice, omega) for option in choice.options])
            self.ratios.append(every / every[choice.flown])
            self.delays.append(-np.angle(self.ratios[-1][:, low]) / omega[low])

    @property
    def flown(self) -> Int[np.ndarray, " choices"]:
        """The picks of what flew."""
        return np.array([choice.flown for choice in self.choices])

    @property
    def counts(self) -> Int[np.ndarray, " choices"]:
        """How many options there are of each."""
        return np.array([len(choice.options) for choice in self.choices])

    def filters(self, picks: Picks) -> Filters:
        """The responses of each design's filters over those that flew."""
        ones = np.ones((len(picks), self.measured.size), complex)
        responses = {"gyro": ones, "derivative": ones}
        for k, choice in enumerate(self.choices):
            responses[choice.stage] = responses[choice.stage] * self.ratios[k][picks[:, k]]
        return Filters(responses["gyro"], responses["derivative"])

    def beyond(self, picks: Picks, filters: Filters) -> Float[np.ndarray, " designs"]:
        """How far the other axes get, over what is allowed: their delay may not grow."""
        late = {"gyro": np.zeros(len(picks)), "derivative": np.zeros(len(picks))}
        for k, choice in enumerate(self.choices):
            if choice.shared:
                late[choice.stage] = late[choice.stage] + self.delays[k][picks[:, k]]
        late["derivative"] = late["gyro"] + late["derivative"]
        worst = np.maximum(late["gyro"], late["derivative"])
        return np.where(worst > 1e-7, 1 + 1e3 * worst, 0.0)

    def other_noise(self, filters: Filters) -> Float[np.ndarray, " designs"]:
        """Of the other axes' commands, over what flew: rms, and of each frequency not known."""
        shared = _of_shared(self, filters)
        growth = [np.zeros(len(filters.gyro))]
        for axis in self.others:
            through = (axis.slow + axis.quick * shared.derivative) * shared.gyro
            growth.append(noise_growth(through, axis.slow + axis.quick, axis.noise, self.measured))
        return np.max(growth, axis=0)

    def parameters(self, picks: Int[np.ndarray, " choices"]) -> dict[str, float]:
        """The parameters of one design's filters that differ from what flew."""
        changed: dict[str, float] = {}
        for choice, pick in zip(self.choices, picks, strict=True):
            if pick != choice.flown:
                changed |= choice.options[pick].parameters
        return changed


def _of_shared(bank: FilterBank, filters: Filters) -> Filters:
    """Without the filters of the tuned axis alone, which are of the D term."""
    alone = [choice for choice in bank.choices if not choice.shared]
    return filters._replace(derivative=np.ones_like(filters.derivative)) if alone else filters


def _response(
    one, choice: FilterChoice, omega: Float[np.ndarray, " frequencies"]
) -> Complex[np.ndarray, " frequencies"]:
    if one is None:
        return np.ones(omega.size, complex)
    return np.asarray(FilterChain((one,), choice.rate_hz).response(omega / (2 * np.pi)))


def noise_growth(
    through: Paths,
    flown: Complex[np.ndarray, " frequencies"],
    noise: Float[np.ndarray, " frequencies"],
    measured: np.ndarray,
) -> Float[np.ndarray, " designs"]:
    """The command's noise over what flew: its rms, and the gain where the noise is not known."""
    before = np.abs(flown) ** 2
    power = np.abs(through) ** 2
    rms = np.sqrt(power @ noise / max(float(before @ noise), 1e-300))
    if measured.all():
        return rms
    unseen = np.sqrt((power / before)[:, ~measured].max(axis=1))
    return np.maximum(rms, unseen)


class Search:
    """Designs by their score: what is beyond a target comes after all that keep them."""

    def __init__(
        self, loops: RateLoops, flown: Float[np.ndarray, " gains"], targets: Targets,
        firmware: str, axis: int, bank: FilterBank | None = None,
        before: RateLoops | None = None,
    ):  # fmt: skip
        """`before` are the loops of what flew, where `loops` are behind other filters."""
        self.loops, self.flown, self.targets, self.bank = loops, flown, targets, bank
        self.noise = (before or loops).qualities(flown[None]).noise
        self.through = loops.paths(flown[None])[0]
        self.free = np.flatnonzero(flown > 0)
        self.rows = [gain_row(firmware, axis, FIELDS[k]) for k in self.free]
        least = np.array([max(row.low, 1e-9) for row in self.rows])
        most = np.array([row.high for row in self.rows])
        self.low = np.clip(flown[self.free] / targets.change, least, most)
        self.high = np.clip(flown[self.free] * targets.change, least, most)

    def gains(self, near: Float[np.ndarray, " gains"] | None = None) -> Float[np.ndarray, " gains"]:
        """The stored gains that reject torque best with the filters that flew.

        Gains of 0 stay. Where nothing keeps the targets, the gains that come nearest. With `near`
        they are looked for around these alone.
        """
        low, high = np.log(self.low), np.log(self.high)
        middle, half, points_each, levels = (low + high) / 2, (high - low) / 2, _POINTS, _LEVELS
        if near is not None:
            middle, half = np.log(near[self.free]), np.full(low.size, _AROUND)
            points_each, levels = _POINTS_AROUND, _LEVELS_AROUND
        for _ in range(levels):
            axes = [
                np.clip(np.linspace(m - h, m + h, points_each), a, b)
                for m, h, a, b in zip(middle, half, low, high, strict=True)
            ]
            points = np.stack([x.ravel() for x in np.meshgrid(*axes, indexing="ij")], axis=1)
            middle, half = points[np.argmin(self.score(np.exp(points)))], _NARROWED * half
        return self._stored(np.exp(middle), None)

    def gains_and_filters(
        self, start: Float[np.ndarray, " gains"], seed: int
    ) -> tuple[Float[np.ndarray, " gains"], Int[np.ndarray, " choices"]]:
        """Both together, from gains that suit the filters that flew: by cross-entropy.

        Source: Rubinstein and Kroese, The Cross-Entropy Method, 2004.
        """
        bank = self.bank
        assert bank is not None
        random, count = np.random.default_rng(seed), self.free.size
        low = np.concatenate([np.log(self.low), np.zeros(len(bank.counts))])
        high = np.concatenate([np.log(self.high), bank.counts - 1.0])
        best = np.clip(np.concatenate([np.log(start[self.free]), bank.flown]), low, high)
        floor = np.concatenate(
            [np.full(count, _NARROWEST[0]), np.full(len(bank.counts), _NARROWEST[1])]
        )
        width = np.concatenate([np.full(count, _WIDTH[0]), _WIDTH[1] * (bank.counts - 1.0)])
        width = np.maximum(width, floor)
        middle = best.copy()
        for _ in range(_ROUNDS):
            drawn = middle + width * random.standard_normal((_DRAWN, low.size))
            points = np.concatenate([best[None], np.clip(drawn, low, high)])
            points[:, count:] = np.rint(points[:, count:])
            score = self.score(np.exp(points[:, :count]), points[:, count:].astype(int))
            chosen = points[np.argsort(score, kind="stable")[:_BEST]]
            best = chosen[0]
            middle = _KEPT * middle + (1 - _KEPT) * chosen.mean(axis=0)
            width = np.maximum(_KEPT * width + (1 - _KEPT) * chosen.std(axis=0), floor)
        picks = best[count:].astype(int)
        return self._stored(np.exp(best[:count]), picks), picks

    def score(self, points: Gains, picks: Picks | None = None) -> Float[np.ndarray, " designs"]:
        """Of free gains, and picked filters."""
        gains = np.tile(self.flown, (len(points), 1))
        gains[:, self.free] = points
        plants = sum(len(group.plants) for group in self.loops.groups)
        count = max(1, _TOGETHER // max(plants, 1))
        parts = np.array_split(np.arange(len(gains)), -(-len(gains) // count))
        return np.concatenate(
            [self._of(gains[part], None if picks is None else picks[part]) for part in parts]
        )

    def _of(self, gains: Gains, picks: Picks | None) -> Float[np.ndarray, " designs"]:
        filters = None if picks is None or self.bank is None else self.bank.filters(picks)
        qualities, targets = self.loops.qualities(gains, filters), self.targets
        beyond = [
            np.max(qualities.peak, axis=1) / (_RESERVE * targets.peak),
            np.max(qualities.resonance, axis=1) / (_RESERVE * targets.resonance),
            np.mean(qualities.noise / self.noise, axis=1) / targets.noise,
            np.max(qualities.crossover, axis=1) / targets.crossover,
        ]
        if self.bank is not None and picks is not None and filters is not None:
            through, quiet = self.loops.paths(gains, filters)[0], np.zeros_like(self.loops.noise)
            unseen = noise_growth(through, self.through[0], quiet, self.bank.measured)
            beyond += [
                unseen / targets.noise, self.bank.other_noise(filters) / targets.noise,
                self.bank.beyond(picks, filters),
            ]  # fmt: skip
        worst = np.stack(beyond).max(axis=0)
        worst = np.where(np.all(qualities.stable, axis=1), worst, 1e6 * worst)
        rejection = np.sqrt(np.mean(qualities.rejection**2, axis=1))
        return np.where(worst <= 1, rejection, 1e9 * worst)

    def _stored(
        self, gains: np.ndarray, picks: Int[np.ndarray, " choices"] | None
    ) -> Float[np.ndarray, " gains"]:
        near = _stored_near(gains, self.rows, self.low, self.high)
        same = None if picks is None else np.tile(picks, (len(near), 1))
        stored = self.flown.copy()
        stored[self.free] = near[np.argmin(self.score(near, same))]
        return stored


def _stored_near(
    gains: np.ndarray, rows: Sequence[Parameter], low: np.ndarray, high: np.ndarray
) -> Gains:
    """The whole numbers, or numbers of three digits, around some gains, from `low` to `high`."""
    around = []
    for value, row, least, most in zip(gains, rows, low, high, strict=True):
        step = 1.0 if row.integer else 10 ** (np.floor(np.log10(value)) - 2)
        pair = np.round(np.array([np.floor(value / step), np.ceil(value / step)]) * step, 12)
        inside = (pair >= least * (1 - 1e-9)) & (pair <= most * (1 + 1e-9))
        around.append(np.unique(pair[inside] if inside.any() else pair))
    return np.array(list(itertools.product(*around)))


class SharedChange(NamedTuple):
    """What changed filters do to the axes that were not tuned.

    **Attributes:**

    - `delay_ms`: of the gyro's filters, and of those with the D term's, over what flew.
    - `noise`: the greatest growth of a command's noise.
    """

    delay_ms: tuple[float, float]
    noise: float


def shared_change(
    law: RateLoop,
    changed: RateLoop,
    noise: GyroNoise,
    omega: Float[np.ndarray, " frequencies"],
    axis: int,
) -> SharedChange:
    """By the laws as they are built, not by the ratios of a search."""
    at = np.array([_SLOW])
    phases = []
    measured = omega / (2 * np.pi) <= noise.known_hz
    ratio = gyro_chain_response(changed, omega) / gyro_chain_response(law, omega)
    growth = [0.0]
    for before, after in zip(
        other_axes(law, noise, omega), other_axes(changed, noise, omega), strict=True
    ):
        through = (after.slow + after.quick) * ratio
        growth.append(
            float(
                noise_growth(through[None], before.slow + before.quick, before.noise, measured)[0]
            )
        )
    for one in (law, changed):
        gyro, back = gyro_chain_response(one, at), law_paths(one, (axis + 1) % 3, at)[0]
        phases.append((np.angle(gyro)[0], np.angle(gyro * back[2])[0]))
    (gyro, slope), (later, steeper) = phases
    late = tuple(-1e3 * (b - a) / _SLOW for a, b in ((gyro, later), (slope, steeper)))
    return SharedChange((late[0], late[1]), max(growth))


def filter_values(names: Sequence[str], choices: Sequence[FilterChoice]) -> Mapping[str, float]:
    """What flew of some parameters of filters."""
    flown: dict[str, float] = {}
    for choice in choices:
        flown |= choice.options[choice.flown].parameters
    return {name: flown[name] for name in names}
