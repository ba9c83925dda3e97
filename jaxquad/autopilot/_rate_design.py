"""The design of a rate loop: searched, rounded, and certified on fresh plants."""

import dataclasses
import functools as ft
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from jaxquad._core import announce

from ._files import propose_changes
from ._firmware import firmware_named, OuterLoop
from ._flight_channels import FlightChannels, FlownAutopilot
from ._gyro_noise import gyro_noise, GyroNoise, NoNoise
from ._identified import DesignSettings, IdentifiedPlant
from ._over_throttle import ThrottleVerdict
from ._parameters import filter_choices, find_parameter
from ._rate_loops import (
    ceiling_in,
    gains_in,
    gains_of,
    grouped,
    parameters_of,
    RateLoops,
)
from ._rate_search import filter_values, FilterBank, Search, shared_change, SharedChange, Targets
from ._stages import beyond_angle, beyond_limits, certify_angle, certify_gains, Stage


Kind = Literal["proposed", "kept", "cannot tell", "not to be flown"]
_THIRD = 1 / 3
_WORTH = 0.95  # of the flown effect of torque, above which gains are not worth a change
_FILTERS_WORTH = 0.97  # of that with gains alone, above which filters are not worth one
_ALLOWED = 1.03  # of a limit that the search kept on the ratio of filters, for the law itself
_CERTIFICATES = 3  # at most: the worst plants of one that fails are tuned on, too
_WORST = 16
_HARD = 14  # plants of a search with filters
_NEARLY = 1.05  # of the limit of the resonance, which a third of the way may reach without a word
_ANGLES, _RESERVE = 25, 0.98  # gains of the angle loop that are tried; of its limits


@dataclasses.dataclass(frozen=True)
class FilterVerdict:
    """What the search made of the filters.

    **Attributes:**

    - `text`: which freedom brought what, or why the filters stay.
    - `flown`: of the filters that change, what flew.
    - `reason`: why they change.
    - `at_once`: parameters of a notch that is switched on, which has no third of the way.
    - `gains_alone`: the best gains with the filters that flew, on fresh plants.
    - `shared`: what the changed filters do to the other axes.
    """

    text: str
    flown: Mapping[str, float] = dataclasses.field(default_factory=dict)
    reason: str = ""
    at_once: tuple[str, ...] = ()
    gains_alone: Stage | None = None
    shared: SharedChange | None = None

    def content(self) -> dict[str, object]:
        """All of it, for JSON."""
        return {
            "text": self.text,
            "flown": dict(self.flown),
            "gains_alone": None if self.gains_alone is None else self.gains_alone._asdict(),
            "shared": None if self.shared is None else self.shared._asdict(),
        }


class RateDesign(NamedTuple):
    """What is proposed, and what it gives on fresh plants: what flew, a third, and all of it."""

    kind: Kind
    verdict: str
    stages: tuple[Stage, ...]
    new: dict[str, float]
    filters: FilterVerdict
    noise: GyroNoise | None


def design_gains(
    settings: DesignSettings,
    plant: IdentifiedPlant,
    flown: FlownAutopilot,
    flight: FlightChannels | None,
    throttle: ThrottleVerdict,
    filters: Mapping[str, float],
) -> RateDesign:
    """Search gains, and filters where the log shows the gyro's noise; certify the rounded ones.

    With `filters` that another axis has changed, these stay, and gains alone are searched.
    """
    swings = 0.0 if flight is None else float(np.mean(flight.limited))
    work = _Work(settings, plant, flown, throttle, swings=swings)
    noise, why = _noise_of(settings, flown, flight, work)
    if filters:
        return _design_behind(dataclasses.replace(work, noise=noise), filters, swings)
    work = dataclasses.replace(work, noise=noise)
    loops = work.loops(settings.members, 0)
    targets = work.targets(loops)
    bank = work.bank(loops)
    if noise is not None and bank is None:
        why = "the firmware's filters are off, so there is none to change"
    gains = None
    for attempt in range(1, _CERTIFICATES + 1):
        fresh = work.fresh(attempt)
        announce(f"searching gains on {len(loops.plants)} plants")
        search = Search(loops, work.before, targets, flown.firmware, flown.axis, bank)
        gains = search.gains(gains)
        plain = work.certified(fresh, parameters_of(flown.law, flown.axis, gains), {})
        design, verdict = plain, FilterVerdict(f"as they flew: {why}")
        if bank is not None and noise is not None:
            announce("searching gains and filters together")
            hard = loops.worst(gains[None], _HARD)
            search = Search(hard, work.before, targets, flown.firmware, flown.axis, bank)
            both, picks = search.gains_and_filters(gains, settings.seed)
            filters = bank.parameters(picks)
            if filters:
                design = work.certified(fresh, parameters_of(flown.law, flown.axis, both), filters)
            design, verdict = _compared(work, plain, design, bank, noise)
        kind, text = _judge(
            design.stages, settings, plant.band[1], verdict.shared, throttle, swings
        )
        if kind != "not to be flown":
            break
        loops = loops.joined(design.loops[-1].worst(design.gains[-1][None], _WORST))
    return RateDesign(kind, text, design.stages, design.new, verdict, noise)


def _design_behind(work: "_Work", filters: Mapping[str, float], swings: float) -> RateDesign:
    """Gains alone, behind filters that another axis has changed."""
    flown, settings = work.flown, work.settings
    loops, gains = work.loops(settings.members, 0), None
    for attempt in range(1, _CERTIFICATES + 1):
        behind = work.filtered(loops, filters)
        announce(f"searching gains on {len(loops.plants)} plants")
        search = Search(
            behind, work.before, work.targets(loops), flown.firmware, flown.axis, None, loops
        )
        gains = search.gains(gains)
        parameters = parameters_of(flown.law, flown.axis, gains)
        design = work.certified(work.fresh(attempt), parameters, filters)
        edge = work.plant.band[1]
        kind, text = _judge(design.stages, settings, edge, None, work.throttle, swings)
        if kind != "not to be flown":
            break
        loops = loops.joined(work.fresh(attempt).worst(design.gains[-1][None], _WORST))
    before = work.flown_filters(filters)
    listed = ", ".join(filters)
    verdict = FilterVerdict(f"{listed} as changed for another axis", before, "for another axis")
    return RateDesign(kind, text, design.stages, design.new, verdict, work.noise)


class _Certified(NamedTuple):
    stages: tuple[Stage, ...]
    new: dict[str, float]
    filters: dict[str, float]
    gains: list[np.ndarray]
    loops: list[RateLoops]


@dataclasses.dataclass(frozen=True)
class _Work:
    settings: DesignSettings
    plant: IdentifiedPlant
    flown: FlownAutopilot
    throttle: ThrottleVerdict
    noise: GyroNoise | None = None
    swings: float = 0.0

    @property
    def before(self) -> np.ndarray:
        """The gains that flew."""
        return gains_of(self.flown.law, self.flown.axis)

    def targets(self, loops: RateLoops) -> Targets:
        """What is kept; gains that made a loop swing may be left further than others."""
        kept = self.settings
        stable = float(np.mean(loops.qualities(self.before[None]).stable))
        far = 2 if stable < _BELIEVED and self.swings > _SWINGING else 1
        return Targets(
            kept.sensitivity, kept.resonance, kept.noise, kept.change**far, self.plant.band[1]
        )

    def loops(self, count: int, seed: int) -> RateLoops:
        """Of what flew, with the noise of the log where it shows it.

        Where the log has several levels of throttle, the plants are spread over those that are
        certified.
        """
        share = -(-count // max(len(self.throttle.certified), 1))
        first, *others = self._groups(share, seed)
        if all(flown.law is self.flown.law for flown in self._flown_there):  # one group is quicker
            plants = np.concatenate([first.plants, *(flown.plants for flown in others)])
            return dataclasses.replace(first, plants=plants)
        return grouped([first, *others])

    def fresh(self, attempt: int) -> RateLoops:
        """Other plants, all of them at each throttle that is certified."""
        return grouped(self._groups(self.settings.fresh, attempt))

    def _groups(self, count: int, seed: int) -> list[RateLoops]:
        source, seed = (
            self.throttle.plants(self.plant, self.flown.measured),
            self.settings.seed + seed,
        )
        places = self.throttle.certified or (None,)
        groups = [
            source.loops(flown.law, flown.axis, count, seed, throttle=throttle, angle=flown.angle)
            for flown, throttle in zip(self._flown_there, places, strict=True)
        ]
        return self._heard(groups)

    @ft.cached_property
    def _flown_there(self) -> list[FlownAutopilot]:
        """What flew, at each throttle that is certified."""
        if not self.throttle.certified:
            return [self.flown]
        return [self.flown.at(throttle) for throttle in self.throttle.logged]

    def _heard(self, groups: list[RateLoops]) -> list[RateLoops]:
        """With the noise of the log, which was measured at all throttles together."""
        if self.noise is None:
            return groups
        # What was measured has passed the flown loop.
        opened = [
            np.abs(1 + (self.before @ group.feedback) * group.plants) ** 2 for group in groups
        ]
        power = self.noise.powers(self.noise.behind, groups[0].omega)
        noise = power * np.median(np.concatenate(opened), axis=0)
        return [dataclasses.replace(group, noise=noise) for group in groups]

    def bank(self, loops: RateLoops) -> FilterBank | None:
        if self.noise is None:
            return None
        flown, line = self.flown, self.noise.line
        choices = filter_choices(
            flown.firmware, flown.values, flown.version, axis=flown.axis, throttle=flown.throttle,
            change=self.settings.change,
            line_hz=None if line is None else line.omega / (2 * np.pi),
        )  # fmt: skip
        return FilterBank(choices, flown.law, self.noise, loops.omega) if choices else None

    def certified(
        self, fresh: RateLoops, gains: Mapping[str, float], filters: Mapping[str, float]
    ) -> _Certified:
        """What flew, a third of the way and all of it, with their filters, as stored."""
        announce(f"certifying the rounded numbers on {self.settings.fresh} new plants")
        law, axis, new = self.flown.law, self.flown.axis, dict(gains) | dict(filters)
        third = self._third(new, filters)
        ways = (third, new)
        ceiling = ceiling_in(law, axis, ways)
        loops = [grouped(dataclasses.replace(group, ceiling=ceiling) for group in fresh.groups)]
        for way in ways:
            parts = {name: way[name] for name in filters}
            loops.append(self.filtered(loops[0], parts) if filters else loops[0])
        designs = [self.before, *(gains_in(law, axis, way) for way in ways)]
        stages = certify_gains(loops, designs)
        angle = self.flown.angle
        if angle is not None:
            last = self._angle_value(loops[-1].worst(designs[-1][None], _WORST), designs[-1], angle)
            if last != angle.value:
                new[angle.name] = last
            values = angle.value, self._third(new, filters).get(angle.name, angle.value), last
            stages = [
                stage._replace(angle=certify_angle(one, gains, angle, value))
                for stage, one, gains, value in zip(stages, loops, designs, values, strict=True)
            ]
        return _Certified(tuple(stages), new, dict(filters), designs, loops)

    def _angle_value(self, loops: RateLoops, gains: np.ndarray, angle: OuterLoop) -> float:
        """The greatest stored gain, up to what flew, with which the angle loop keeps the limits."""
        kept = self.settings
        row = find_parameter(self.flown.firmware, angle.name)
        values = angle.value * np.geomspace(1.0, 1 / kept.change, _ANGLES)
        values[1:] = [np.rint(x) if row.integer else float(f"{x:.2g}") for x in values[1:]]
        if not angle.closed:
            return angle.value
        for value in values:
            around = loops.outer_qualities(gains, angle.gain(value))
            most = np.max(around.peak) / kept.sensitivity, np.max(around.resonance) / kept.resonance
            if np.all(around.stable) and max(most) <= (1.0 if value == angle.value else _RESERVE):
                return float(value)
        return float(values[-1])

    def filtered(self, flown: RateLoops, filters: Mapping[str, float]) -> RateLoops:
        """The loops with other filters, at each throttle."""
        laws = [flown_there.with_filters(filters) for flown_there in self._flown_there]
        return grouped(
            loops.of_law(law, self.flown.axis)
            for loops, law in zip(flown.groups, laws, strict=True)
        )

    def _third(self, new: Mapping[str, float], filters: Mapping[str, float]) -> dict[str, float]:
        """A third of the way, as the firmware stores it."""
        flown = self.flown
        bank = {} if not filters else self.flown_filters(filters)
        old = flown.old | bank
        if flown.angle is not None and flown.angle.name in new:
            old[flown.angle.name] = flown.angle.value
        changes = propose_changes(
            flown.firmware,
            old,
            new,
            share=_THIRD,
            beyond=list(new),
            at_once=switched(flown.firmware, bank),
        )
        return old | {change.parameter.name: change.new for change in changes}

    def flown_filters(self, names: Mapping[str, float]) -> dict[str, float]:
        """What flew of these filters."""
        flown, line = self.flown, None if self.noise is None else self.noise.line
        choices = filter_choices(
            flown.firmware, flown.values, flown.version, axis=flown.axis, throttle=flown.throttle,
            line_hz=None if line is None else line.omega / (2 * np.pi),
        )  # fmt: skip
        return dict(filter_values(list(names), choices))


def switched(firmware: str, flown: Mapping[str, float]) -> tuple[str, ...]:
    """Of filters that flew, the parameters of notches that were off."""
    notches = {name for pair in firmware_named(firmware).notches for name in pair}
    notch = [name for name in flown if name in notches]
    off = any(flown[name] == 0 for name in notch)
    return tuple(notch) if off else ()


def _noise_of(
    settings: DesignSettings, flown: FlownAutopilot, flight: FlightChannels | None, work: _Work
) -> tuple[GyroNoise | None, str]:
    """The noise, or why filters stay."""
    if settings.keep_filters:
        return None, "asked for by `keep_filters`"
    if flight is None:
        return None, "the channels of gyro and set-point could not be read from the log"
    announce("the gyro's noise")
    loops = work.loops(1, 0)
    crossover = float(loops.qualities(work.before[None]).crossover[0, 0])
    noise = gyro_noise(flight, flown.law, flown.axis, 2 * crossover / (2 * np.pi))
    return (None, noise.reason) if isinstance(noise, NoNoise) else (noise, "")


def _compared(
    work: _Work, plain: _Certified, both: _Certified, bank: FilterBank, noise: GyroNoise
) -> tuple[_Certified, FilterVerdict]:
    """Gains alone beside gains and filters, on the same fresh plants."""
    alone, freed = plain.stages[-1], both.stages[-1]
    names = ", ".join(name for choice in bank.choices for name in choice.names)
    heard = f"the noise is of {noise.source}"
    if not both.filters or freed.rejection > _FILTERS_WORTH * alone.rejection:
        text = (
            f"as they flew: with gains alone the effect of torque is {alone.rejection:.2f} of what "
            f"flew, and freeing {names} brings less than {100 * (1 - _FILTERS_WORTH):.0f} % more; "
            f"{heard}"
        )
        return plain, FilterVerdict(text, gains_alone=alone)
    shared = shared_change(
        work.flown.law, work.flown.with_filters(both.filters), noise, plain.loops[0].omega,
        work.flown.axis,
    )  # fmt: skip
    flown = work.flown_filters(both.filters)
    gyro, slope = shared.delay_ms
    elsewhere = (
        f"The other axes have the same filters: their commands' noise is at most "
        f"{shared.noise:.2f} of what flew"
        if shared.noise > 0
        else "The other axes have the same filters; the log shows no noise of their gyros"
    )
    text = (
        f"gains alone leave {alone.rejection:.2f} of the flown effect of torque, with filters it "
        f"is {freed.rejection:.2f}; command noise {alone.noise:.2f} and {freed.noise:.2f} of what "
        f"flew. Delay of the gyro's filters {gyro:+.2f} ms, with those of the D term {slope:+.2f} "
        f"ms. {elsewhere}. {heard[0].upper()}{heard[1:]}"
    )
    reason = (
        f"delay of gyro {gyro:+.2f} ms, of D {slope:+.2f} ms, at command noise {freed.noise:.2f}"
    )
    return both, FilterVerdict(
        text, flown, reason, switched(work.flown.firmware, flown), alone, shared
    )


_SWINGING = 0.1  # of a flight with a motor at its limit, from which the motors bound a swing
_BELIEVED = 0.5  # share of plants on which the loop that flew has to be stable


def _judge(
    stages: Sequence[Stage],
    settings: DesignSettings,
    edge: float,
    shared: SharedChange | None,
    throttle: ThrottleVerdict,
    swings: float = 0.0,
) -> tuple[Kind, str]:
    """The verdict; `swings` is the share of the flight with a motor at its limit."""
    flown, third, new = stages
    bounded = flown.stable < _BELIEVED and swings > _SWINGING  # by the motors alone
    third = new if bounded else third
    beyond = beyond_limits(flown, third, new, settings, edge, loud=_ALLOWED)
    if shared is not None and shared.noise > _ALLOWED * settings.noise:
        beyond.append(
            f"the command's noise on another axis is {shared.noise:.2f} of what flew, above "
            f"{settings.noise:g}"
        )
    if new.angle is not None and new.angle.closed:
        beyond += beyond_angle(new.angle, settings)
    if beyond and flown.stable < _BELIEVED and not bounded:
        return "cannot tell", (
            "this log cannot tell: the loop flew, but with the gains that flew it is stable on "
            f"{100 * flown.stable:.1f} % only of the plants within the error bars, so most of "
            "these are not the vehicle. Fly more excitation on this axis (a chirp of the rate "
            "set-point, or strong and quick stick)"
        )
    if beyond:
        return "not to be flown", (
            f"no gains are proposed: {'; '.join(beyond)}. Allow more (`sensitivity`, `resonance`, "
            "`noise`, `change`), or fly more excitation"
        )
    limit, plants = settings.sensitivity, f"{settings.fresh} fresh plants"
    if throttle.logged:
        at = ", ".join(f"{level:.2f}" for level in throttle.logged)
        plants += f" at each of the throttles {at}"
    better = f"{new.rejection:.2f} of the flown effect of a step of torque"
    within = flown.peak <= limit and flown.resonance <= settings.resonance
    if flown.angle is not None and flown.angle.closed:
        within = within and not beyond_angle(flown.angle, settings)
    if flown.stable == 1 and within and new.rejection > _WORTH:
        return "kept", (
            f"what flew is kept: within the limits the best gains leave {better}. Its worst Ms on "
            f"{plants} is {flown.peak:.2f}"
        )
    if bounded:
        return "proposed", (
            f"proposed: stable on all {plants}, worst Ms {new.peak:.2f} of at most {limit:g}"
            f"{_around(flown, new)}. What flew is stable on {100 * flown.stable:.0f} % of them: "
            f"it swung between the motors' limits ({100 * swings:.0f} % of the flight). A third of "
            "the way would swing, too, so both files hold all of it, and gains may be further from "
            f"what flew than {settings.change:g} times (`change`): hover low with it first"
        )
    return "proposed", (
        f"proposed: stable on all {plants}, worst Ms {new.peak:.2f} of at most "
        f"{limit:g}, {better}{_around(flown, new)}. {_first(flown, third, settings)}"
    )


def _around(flown: Stage, new: Stage) -> str:
    """What the proposal does to the angle loop."""
    before, after = flown.angle, new.angle
    if before is None or after is None or not after.closed:
        return ""
    moved = f"{after.parameter} {before.value:.3g}"
    moved += f" -> {after.value:.3g}" if after.value != before.value else " as it flew"
    return f"; with the angle loop around it ({moved}) worst Ms {after.peak:.2f}"


def _first(flown: Stage, third: Stage, settings: DesignSettings) -> str:
    """How to go on; a third of the way from a bad loop may be beyond the limits, too."""
    near = third.resonance <= _NEARLY * settings.resonance
    if third.peak <= settings.sensitivity and near:
        return "Load the file for a third of the way first"
    return (
        f"The file for a third of the way is beyond the limits (worst Ms {third.peak:.2f}, peak "
        f"from set-point to rate {third.resonance:.2f}), but better than what flew "
        f"({flown.peak:.2f}, {flown.resonance:.2f}): hover with it alone, then load all of it"
    )
