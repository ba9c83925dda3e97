"""The design of a rate loop: gains and filters searched, rounded, and certified on fresh plants."""

import copy
import dataclasses
import functools as ft
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxquad._core import announce

from ._feed_forward import design_feed_forward
from ._filter_bank import (
    filter_choices,
    FilterBank,
    gyro_noise,
    GyroNoise,
    noise_growth,
    NoNoise,
    Picks,
    shared_change,
)
from ._firmware import FilterChoice, firmware_named, OuterLoop, Parameter
from ._flight_channels import FlownAutopilot
from ._parameters import (
    ceiling_in,
    find_parameter,
    gains_in,
    gains_of,
    names_by_field,
    parameters_of,
    propose_changes,
)
from ._proposal import AutopilotProposal, FilterVerdict
from ._rate_loops import (
    certify_angle,
    certify_gains,
    DesignSettings,
    draw_loops,
    Gains,
    OneGains,
    RateLoops,
    Stage,
    together,
    with_more_plants,
    with_plants,
    worst_plants,
)
from ._verdict import BELIEVED, judge, SWINGING


_THIRD = 1 / 3
_FILTERS_WORTH = 0.97  # of that with gains alone, above which filters are not worth one
_CERTIFICATES = 3  # at most: the worst plants of one that fails are tuned on, too
_HOPELESS = 1.05  # times a limit on plants tuned on, from which more of them change nothing
_WORST = 16
_HARD = 14  # plants of a search with filters
_ANGLES, _ANGLE_RESERVE = 25, 0.98  # gains of the angle loop that are tried; of its limits


def design_gains(proposal: AutopilotProposal, filters: Mapping[str, float]) -> AutopilotProposal:
    """Search gains, and filters where the log shows the gyro's noise; certify the rounded ones.

    With `filters` that another axis has changed, these stay, and gains alone are searched. The
    plants stay drawn: `retuned` of what comes out searches again for other limits.
    """
    return _searched(_Design(proposal), proposal, filters)


def _searched(
    design: "_Design", proposal: AutopilotProposal, filters: Mapping[str, float]
) -> AutopilotProposal:
    settings, flown = proposal.settings, proposal.flown
    law, axis, noise = flown.law, flown.axis, design.noise
    loops, gains = design.loops(settings.members, 0), None
    # Gains that made a loop swing may be left further than others.
    stable = float(np.mean(together(x.qualities(design.before[None]) for x in loops).stable))
    change = settings.change ** (2 if stable < BELIEVED and design.swings > SWINGING else 1)
    bank = None if filters else design.bank
    why = design.no_noise or "the firmware's filters are off, so there is none to change"
    verdict = FilterVerdict(f"as they flew: {why}")
    if filters:
        text = f"{', '.join(filters)} as changed for another axis"
        verdict = FilterVerdict(text, design.flown_filters(filters), "for another axis")
    for attempt in range(1, _CERTIFICATES + 1):
        fresh = design.groups(settings.fresh, attempt)
        announce(f"searching gains on {len(loops[0].plants)} plants")
        behind = design.filtered(loops, filters) if filters else loops
        search = _Search(design, behind, loops, change)
        gains = search.gains(gains)
        excess = search.excess(gains)
        best = design.certified(fresh, parameters_of(law, axis, gains), filters)
        if bank is not None and noise is not None:
            announce("searching gains and filters together")
            hard, alone = with_plants(loops, worst_plants(loops, gains[None], _HARD)), best
            search = _Search(design, hard, hard, change, bank)
            both, picks = search.gains_and_filters(gains, settings.seed)
            excess = min(excess, search.excess(both, picks))
            if changed := bank.parameters(picks):
                best = design.certified(fresh, parameters_of(law, axis, both), changed)
            best, verdict = design.compared(alone, best, bank, noise)
        kind, text = judge(
            best.stages, settings, proposal.identification.band[1], verdict.shared,
            design.throttle.logged, design.swings,
        )  # fmt: skip
        if kind != "not to be flown" or excess > _HOPELESS:
            break
        hardest = fresh if filters else best.loops[-1]
        more = worst_plants(hardest, best.gains[-1][None], _WORST)
        more = more if len(loops) > 1 else [np.concatenate(more)]
        loops = with_more_plants(loops, more)
    new, sticks = {}, None
    if kind == "proposed":
        behind = design.filtered(loops, best.filters) if best.filters else loops
        sticks = design_feed_forward(flown, behind, best.loops[-1], best.gains[-1], settings)
        new = best.new if sticks is None else best.new | sticks.new
    return dataclasses.replace(
        proposal, kind=kind, verdict=text, stages=best.stages, filters=verdict, sticks=sticks,
        noise=noise, new=new, search=ft.partial(_search_again, design),
    )  # fmt: skip


def _search_again(
    design: "_Design", proposal: AutopilotProposal, filters: Mapping[str, float]
) -> AutopilotProposal:
    return _searched(design.within(proposal.settings), proposal, filters)


class _Certified(NamedTuple):
    """What flew, a third of the way and all of it; `new` are the parameters of the last."""

    stages: tuple[Stage, ...]
    new: dict[str, float]
    filters: dict[str, float]
    gains: list[np.ndarray]
    loops: list[list[RateLoops]]


class _Design:
    """What one axis' search and certificates are made of."""

    def __init__(self, proposal: AutopilotProposal):
        flight, throttle = proposal.flown.flight, proposal.throttle
        assert flight is not None and throttle is not None
        self.settings, self.flown, self.throttle = proposal.settings, proposal.flown, throttle
        self.plant, self.edge = proposal.identification, proposal.identification.band[1]  # rad/s
        self.before = gains_of(self.flown.law, self.flown.axis)
        self.drawn: dict[tuple[int, int], list[RateLoops]] = {}
        self.swings = float(np.mean(flight.limited))  # of the flight, a motor at its limit
        # What flew, at each throttle that is certified.
        self.flown_there = [self.flown]
        if throttle.certified:
            self.flown_there = [self.flown.at(level) for level in throttle.logged]
        self.noise: GyroNoise | None = None
        self.no_noise = "asked for by `keep_filters`"  # why filters stay
        if not self.settings.keep_filters:
            announce("the gyro's noise")
            crossover = self.loops(1, 0)[0].qualities(self.before[None]).crossover[0, 0]
            least_hz = 2 * float(crossover) / (2 * np.pi)
            try:
                self.noise = gyro_noise(flight, self.flown.law, self.flown.axis, least_hz)
                self.no_noise = ""
            except NoNoise as error:
                self.no_noise = str(error)

    def within(self, limits: DesignSettings) -> "_Design":
        """The same plants and noise with other limits."""
        other = copy.copy(self)
        other.settings = limits
        if limits.change != self.settings.change:
            for name in ("choices", "bank"):
                other.__dict__.pop(name, None)
        return other

    def loops(self, count: int, seed: int) -> list[RateLoops]:
        """Of what flew, with the noise of the log where it shows it.

        Where the log has several levels of throttle, the plants are spread over those that are
        certified.
        """
        groups = self.groups(-(-count // len(self.flown_there)), seed)
        if all(flown.law is self.flown.law for flown in self.flown_there):  # one group is quicker
            plants = np.concatenate([group.plants for group in groups])
            return [dataclasses.replace(groups[0], plants=plants)]
        return groups

    def groups(self, count: int, seed: int) -> list[RateLoops]:
        """Likewise, with so many plants at each throttle that is certified; drawn once."""
        if (count, seed) not in self.drawn:
            self.drawn[count, seed] = self._drawn_groups(count, seed)
        return self.drawn[count, seed]

    def _drawn_groups(self, count: int, seed: int) -> list[RateLoops]:
        places, seed = self.throttle.certified or (None,), self.settings.seed + seed
        groups = [
            draw_loops(self.plant, self.throttle, flown, count, seed, throttle=throttle)
            for flown, throttle in zip(self.flown_there, places, strict=True)
        ]
        if self.noise is None:
            return groups
        # The noise was measured at all throttles together, and has passed the flown loop.
        opened = [
            np.abs(1 + (self.before @ group.feedback) * group.plants) ** 2 for group in groups
        ]
        power = self.noise.powers(self.noise.behind, groups[0].omega)
        noise = power * np.median(np.concatenate(opened), axis=0)
        return [dataclasses.replace(group, noise=noise) for group in groups]

    @ft.cached_property
    def choices(self) -> tuple[FilterChoice, ...]:
        flown, line = self.flown, None if self.noise is None else self.noise.line
        return filter_choices(
            flown.firmware, flown.values, flown.version, axis=flown.axis, throttle=flown.throttle,
            change=self.settings.change,
            line_hz=None if line is None else line.omega / (2 * np.pi),
        )  # fmt: skip

    @ft.cached_property
    def bank(self) -> FilterBank | None:
        """None where no filter can change, or the log does not show the noise."""
        if self.noise is None or not self.choices:
            return None
        omega = self.loops(self.settings.members, 0)[0].omega
        return FilterBank(self.choices, self.flown.law, self.noise, omega)

    def flown_filters(self, names: Mapping[str, float]) -> dict[str, float]:
        """What flew of these filters; a notch may be for a line of another axis alone."""
        if not names:
            return {}
        kind, flown = firmware_named(self.flown.firmware), {}
        for pair, values in zip(kind.notches, kind.flown_notches(self.flown.values), strict=False):
            flown |= dict(zip(pair, values, strict=True))
        for choice in self.choices:
            flown |= choice.flown_parameters
        return {name: flown[name] for name in names}

    def filtered(self, loops: Sequence[RateLoops], filters: Mapping[str, float]) -> list[RateLoops]:
        laws = [flown.with_filters(filters) for flown in self.flown_there]
        return [x.of_law(law, self.flown.axis) for x, law in zip(loops, laws, strict=True)]

    def certified(
        self, fresh: Sequence[RateLoops], gains: Mapping[str, float], filters: Mapping[str, float]
    ) -> _Certified:
        """What flew, a third of the way and all of it, with their filters, as stored."""
        announce(f"certifying the rounded numbers on {self.settings.fresh} new plants")
        law, axis, angle = self.flown.law, self.flown.axis, self.flown.angle
        new = dict(gains) | dict(filters)
        ways = self._third(new, filters), new
        ceiling = ceiling_in(law, axis, ways)
        loops = [[dataclasses.replace(group, ceiling=ceiling) for group in fresh]]
        for way in ways:
            parts = {name: way[name] for name in filters}
            loops.append(self.filtered(loops[0], parts) if filters else loops[0])
        designs = [self.before, *(gains_in(law, axis, way) for way in ways)]
        stages = certify_gains(loops, designs)
        if angle is not None:
            worst = worst_plants(loops[-1], designs[-1][None], _WORST)
            last = self._angle_value(with_plants(loops[-1], worst), designs[-1], angle)
            if last != angle.value:
                new[angle.name] = last
            values = angle.value, self._third(new, filters).get(angle.name, angle.value), last
            stages = [
                stage._replace(angle=certify_angle(one, gains, angle, value))
                for stage, one, gains, value in zip(stages, loops, designs, values, strict=True)
            ]
        return _Certified(tuple(stages), new, dict(filters), designs, loops)

    def _angle_value(self, loops: Sequence[RateLoops], gains: OneGains, angle: OuterLoop) -> float:
        """The greatest stored gain, up to what flew, with which the angle loop keeps the limits."""
        limits, row = self.settings, find_parameter(self.flown.firmware, angle.name)
        values = angle.value * np.geomspace(1.0, 1 / limits.change, _ANGLES)
        values[1:] = [np.rint(x) if row.integer else float(f"{x:.2g}") for x in values[1:]]
        if not angle.closed:
            return angle.value
        for value in values:
            around = certify_angle(loops, gains, angle, float(value))
            most = max(around.peak / limits.sensitivity, around.resonance / limits.resonance)
            if around.stable == 1 and most <= (1.0 if value == angle.value else _ANGLE_RESERVE):
                return float(value)
        return float(values[-1])

    def _third(self, new: Mapping[str, float], filters: Mapping[str, float]) -> dict[str, float]:
        flown, changed = self.flown, self.flown_filters(filters)
        old = flown.old | changed
        if flown.angle is not None and flown.angle.name in new:
            old[flown.angle.name] = flown.angle.value
        changes = propose_changes(
            flown.firmware, old, new, share=_THIRD, beyond=list(new),
            at_once=_switched(flown, changed),
        )  # fmt: skip
        return old | {change.parameter.name: change.new for change in changes}

    def compared(
        self, plain: _Certified, both: _Certified, bank: FilterBank, noise: GyroNoise
    ) -> tuple[_Certified, FilterVerdict]:
        """Gains alone beside gains and filters, on the same fresh plants."""
        alone, freed, law = plain.stages[-1], both.stages[-1], self.flown.law
        names = ", ".join(name for choice in bank.choices for name in choice.flown_parameters)
        heard = f"the noise is of {noise.source}"
        if not both.filters or freed.rejection > _FILTERS_WORTH * alone.rejection:
            text = (
                f"as they flew: with gains alone the effect of torque is {alone.rejection:.2f} of "
                f"what flew, and freeing {names} brings less than {100 * (1 - _FILTERS_WORTH):.0f} "
                f"% more; {heard}"
            )
            return plain, FilterVerdict(text, gains_alone=alone)
        omega, changed = plain.loops[0][0].omega, self.flown.with_filters(both.filters)
        shared = shared_change(law, changed, noise, omega, self.flown.axis)
        flown, (gyro, slope) = self.flown_filters(both.filters), shared.delay_ms
        elsewhere = (
            f"The other axes have the same filters: their commands' noise is at most "
            f"{shared.noise:.2f} of what flew"
            if shared.noise > 0
            else "The other axes have the same filters; the log shows no noise of their gyros"
        )
        text = (
            f"gains alone leave {alone.rejection:.2f} of the flown effect of torque, with filters "
            f"it is {freed.rejection:.2f}; command noise {alone.noise:.2f} and {freed.noise:.2f} "
            f"of what flew. Delay of the gyro's filters {gyro:+.2f} ms, with those of the D term "
            f"{slope:+.2f} ms. {elsewhere}. {heard[0].upper()}{heard[1:]}"
        )
        reason = (
            f"delay of gyro {gyro:+.2f} ms, of D {slope:+.2f} ms, at command noise "
            f"{freed.noise:.2f}"
        )
        at_once = _switched(self.flown, flown)
        return both, FilterVerdict(text, flown, reason, at_once, alone, shared)


def _switched(flown: FlownAutopilot, filters: Mapping[str, float]) -> tuple[str, ...]:
    """Of filters that flew, the parameters of notches that were off."""
    notches = {name for pair in firmware_named(flown.firmware).notches for name in pair}
    notch = tuple(name for name in filters if name in notches)
    return notch if any(filters[name] == 0 for name in notch) else ()


_POINTS, _LEVELS, _NARROWED = 7, 6, 0.4  # of the search, along each gain and one after the other
_AROUND, _POINTS_AROUND, _LEVELS_AROUND = 0.3, 5, 4  # likewise, around known gains, in ln
_RESERVE = 0.97  # of the limit, because fresh plants reach further than those that were tuned on
_BEYOND = 1e9  # times the worst excess: the score of what does not keep the limits
_TOGETHER = 384  # loops of designs and plants evaluated at once: beyond, memory is slow
_ROUNDS, _DRAWN, _BEST, _KEPT = 14, 140, 18, 0.3  # of the search with filters
_WIDTH, _NARROWEST = (0.35, 0.25), (0.02, 0.3)  # of gains in ln, of filters in options


def best_on_grid(
    score: Callable[[Gains], Float[np.ndarray, " designs"]], middle: np.ndarray, half: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray], points: int,
) -> np.ndarray:  # fmt: skip
    """The best of a grid of designs around `middle`, whose logarithms this and `bounds` are."""
    axes = [
        np.clip(np.linspace(m - h, m + h, points), low, high)
        for m, h, low, high in zip(middle, half, *bounds, strict=True)
    ]
    grid = np.stack([x.ravel() for x in np.meshgrid(*axes, indexing="ij")], axis=1)
    return grid[np.argmin(score(np.exp(grid)))]


def stored_near(
    values: np.ndarray, rows: Sequence[Parameter], bounds: tuple[np.ndarray, np.ndarray]
) -> Gains:
    """The whole numbers, or numbers of three digits, around some values, within their bounds."""
    around = []
    for value, row, low, high in zip(values, rows, *bounds, strict=True):
        step = 1.0 if row.integer else 10 ** (np.floor(np.log10(value)) - 2)
        pair = np.round(np.array([np.floor(value / step), np.ceil(value / step)]) * step, 12)
        inside = (pair >= low * (1 - 1e-9)) & (pair <= high * (1 + 1e-9))
        around.append(np.unique(pair[inside] if inside.any() else pair))
    return np.array(list(itertools.product(*around)))


class _Search:
    """Designs by their score: what is beyond a limit comes after all that keep them."""

    def __init__(
        self, design: _Design, loops: Sequence[RateLoops], before: Sequence[RateLoops],
        change: float, bank: FilterBank | None = None,
    ):  # fmt: skip
        """`before` are the loops of what flew, where `loops` are behind other filters."""
        self.loops = [x.in_single_precision() for x in loops]  # the certificate is in double
        self.bank, self.flown = bank, design.before
        self.limits, self.edge = design.settings, design.edge
        self.noise = together(x.qualities(self.flown[None]) for x in before).noise
        self.through = loops[0].paths(self.flown[None])[0][0]
        self.free = np.flatnonzero(self.flown > 0)
        firmware = design.flown.firmware
        names = names_by_field(firmware, design.flown.axis)
        self.rows = [find_parameter(firmware, names[design.flown.law.tuned[k]]) for k in self.free]
        least = np.array([max(row.low, 1e-9) for row in self.rows])
        most = np.array([row.high for row in self.rows])
        self.low = np.clip(self.flown[self.free] / change, least, most)
        self.high = np.clip(self.flown[self.free] * change, least, most)

    def gains(self, near: OneGains | None = None) -> OneGains:
        """The stored gains that reject torque best with the filters that flew.

        Gains of 0 stay. Where nothing keeps the limits, the gains that come nearest. With `near`
        they are looked for around these alone.
        """
        low, high = np.log(self.low), np.log(self.high)
        middle, half, points_each, levels = (low + high) / 2, (high - low) / 2, _POINTS, _LEVELS
        if near is not None:
            middle, half = np.log(near[self.free]), np.full(low.size, _AROUND)
            points_each, levels = _POINTS_AROUND, _LEVELS_AROUND
        for _ in range(levels):
            middle = best_on_grid(self.score, middle, half, (low, high), points_each)
            half = _NARROWED * half
        return self._stored(np.exp(middle), None)

    def gains_and_filters(
        self, start: OneGains, seed: int
    ) -> tuple[OneGains, Int[np.ndarray, " choices"]]:
        """Both together, from gains that suit the filters that flew: by cross-entropy.

        Source: Rubinstein and Kroese, The Cross-Entropy Method, 2004.
        """
        bank, random, count = self.bank, np.random.default_rng(seed), self.free.size
        assert bank is not None
        ends, options = np.zeros(len(bank.counts)), bank.counts - 1.0
        low, high = np.append(np.log(self.low), ends), np.append(np.log(self.high), options)
        best = np.clip(np.append(np.log(start[self.free]), bank.flown), low, high)
        floor = np.append(np.full(count, _NARROWEST[0]), ends + _NARROWEST[1])
        width = np.maximum(np.append(np.full(count, _WIDTH[0]), _WIDTH[1] * options), floor)
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

    def excess(self, gains: OneGains, picks: Int[np.ndarray, " choices"] | None = None) -> float:
        """How many times a limit the gains are, 0 where they keep all."""
        one = None if picks is None else picks[None]
        [score] = self.score(gains[None, self.free], one)
        return float(score) / _BEYOND if score >= _BEYOND else 0.0

    def score(self, points: Gains, picks: Picks | None = None) -> Float[np.ndarray, " designs"]:
        """Of free gains, and picked filters."""
        gains = np.tile(self.flown, (len(points), 1))
        gains[:, self.free] = points
        plants = sum(len(loop.plants) for loop in self.loops)
        count = max(1, _TOGETHER // max(plants, 1))
        parts = np.array_split(np.arange(len(gains)), -(-len(gains) // count))
        return np.concatenate(
            [self._of(gains[part], None if picks is None else picks[part]) for part in parts]
        )

    def _of(self, gains: Gains, picks: Picks | None) -> Float[np.ndarray, " designs"]:
        filters = None if picks is None or self.bank is None else self.bank.filters(picks)
        qualities, limits = together(x.qualities(gains, filters) for x in self.loops), self.limits
        beyond = [
            np.max(qualities.peak, axis=1) / (_RESERVE * limits.sensitivity),
            np.max(qualities.resonance, axis=1) / (_RESERVE * limits.resonance),
            np.mean(qualities.noise / self.noise, axis=1) / limits.noise,
            np.max(qualities.crossover, axis=1) / self.edge,
        ]
        if self.bank is not None and picks is not None and filters is not None:
            first = self.loops[0]
            through, quiet = first.paths(gains, filters)[0], np.zeros_like(first.noise)
            unseen = noise_growth(through, self.through, quiet, self.bank.measured)
            beyond += [
                unseen / limits.noise, self.bank.other_noise(filters) / limits.noise,
                self.bank.beyond(picks),
            ]  # fmt: skip
        worst = np.stack(beyond).max(axis=0)
        worst = np.where(np.all(qualities.stable, axis=1), worst, 1e6 * worst)
        rejection = np.sqrt(np.mean(qualities.rejection**2, axis=1))
        return np.where(worst <= 1, rejection, _BEYOND * worst)

    def _stored(
        self, free: Float[np.ndarray, " free"], picks: Int[np.ndarray, " choices"] | None
    ) -> OneGains:
        """The best of the whole numbers, or numbers of three digits, around some gains."""
        near = stored_near(free, self.rows, (self.low, self.high))
        same = None if picks is None else np.tile(picks, (len(near), 1))
        stored = self.flown.copy()
        stored[self.free] = near[np.argmin(self.score(near, same))]
        return stored
