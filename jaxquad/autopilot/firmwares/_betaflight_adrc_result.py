"""From the gain over the throttle to parameters of Betaflight's proposed ADRC, and their report.

A design is a search over wc, wo and b0 on responses, as that of a PID is one over P, I and D.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxquad._core import announce, plain_content, write_file
from jaxquad.identify import GainBand, GainOverThrottle, UndeterminedError
from jaxquad.plot import StepBand, ThrottleCurve
from jaxquad.records import AXES
from jaxquad.report import Headline, Provenance, Table

from .._filters import FilterChain, PT2
from .._flight_channels import FlightChannels
from .._identified_log import StepGrid
from .._page import (
    B0Section,
    Chains,
    chains_of,
    change_rows,
    limits_text,
    logged_terms,
    motor_rows,
    PilotPage,
    VERDICTS,
)
from .._parameters import (
    change_table,
    find_parameter,
    gains_of,
    parameter_file,
    ParameterChange,
    propose_changes,
    stage_texts,
    store_parameters,
    what_flew,
    WordChange,
)
from .._proposal import write_result
from .._rate_design import best_on_grid, stored_near
from .._rate_loops import DesignSettings, Kind, Limits, with_more_plants, with_plants, worst_plants
from .._replay import Reproduction
from .._verdict import beyond_limits
from ._betaflight_adrc import (
    adrc_loops,
    adrc_parameters,
    ADRCProposal,
    ADRCTargets,
    b0_law,
    draw_at,
    Flown,
    FlownADRC,
    frame_of,
    judge_adrc,
    score_of,
    stages_of,
)


_POINTS, _LEVELS, _ROUGH, _NARROWED = 5, 8, 5, 0.55  # the first levels on one plant each
_CERTIFICATES, _WORST = 3, 8
_SPREAD = 4.0  # factor on b0 to either side


def propose_adrc(
    plant: GainOverThrottle, flown: Flown, axis: str, *, hover: float | None = None,
    targets: Limits | None = None, bins: int = 5, members: int = 32, fresh: int = 256,
    seed: int = 0,
) -> ADRCProposal:  # fmt: skip
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
    frame, scaled, b0 = frame_of(plant, flown, hover)
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
    before = gains_of(flown.law, place) if isinstance(flown, FlownADRC) else None
    if before is not None:
        ways = before / targets.change, before * targets.change
        low, high = (np.clip(x, low, high) for x in ways)
    else:
        low[2], high[2] = np.clip([b0 / _SPREAD, b0 * _SPREAD], low[2], high[2])
    loops = draw(max(1, members // len(grid)), seed)
    for attempt in range(1, _CERTIFICATES + 1):
        announce(f"searching wc, wo and b0 at {len(grid)} throttles")
        score = score_of(loops, targets, edge, before)
        first = with_plants(loops, (loop.plants[:1] for loop in loops))
        rough, ends = score_of(first, targets, edge, before), (np.log(low), np.log(high))
        middle, half = np.log(low * high) / 2, np.log(high / low) / 2
        for level in range(_LEVELS):
            used = rough if level < _ROUGH else score
            middle, half = best_on_grid(used, middle, half, ends, _POINTS), _NARROWED * half
        near = stored_near(np.exp(middle), rows, (low, high))
        best = near[np.argmin(score(near))]  # where none keep the targets: the nearest
        announce(f"certifying the whole numbers on {fresh} new plants")
        certified = draw(fresh, seed + attempt)
        stages = stages_of(certified, before, best, usual)
        third = stages.get("a third of the way", stages["proposed"])
        beyond = beyond_limits(stages["what flew"], third, stages["proposed"], targets, edge)
        if not beyond:
            break
        worst = (worst_plants([x], best[None], _WORST)[0] for x in certified)
        loops = with_more_plants(loops, worst)
    kind, verdict = judge_adrc(stages, beyond, targets, fresh, grid)
    values = {row.name: float(x) for row, x in zip(rows, best, strict=True)} | frame.parameters()
    stored = store_parameters("betaflight", values if kind == "proposed" else {})
    return ADRCProposal(kind, verdict, stored, frame, tuple(map(float, grid)), stages, scaled)


_BUILD = (2026, 6)  # whose names a file of the ADRC has
_STEM = "proposal"


@dataclasses.dataclass(frozen=True)
class ADRCAutopilot:
    """What `autopilot` found in a log, and what it proposes for the ADRC; `str()` is its report."""

    kind: Kind  # as of an `AutopilotProposal`
    verdict: str
    settings: DesignSettings
    path: Path  # of the log
    axis: str
    version: tuple[int, ...]  # of the firmware
    values: Mapping[str, str]  # the header's lines
    flown: Flown  # PID or ADRC
    plant: GainOverThrottle | None = None  # None where no level of throttle determines it
    # The flown loop compared with the flight, by the throttle of each level.
    reproductions: Mapping[float, Reproduction] = dataclasses.field(default_factory=dict)
    proposal: ADRCProposal | None = None  # None where the log cannot tell
    flight: FlightChannels | None = None

    @property
    def flew_adrc(self) -> bool:
        """Whether the ADRC flew, and not the PID."""
        return isinstance(self.flown, FlownADRC)

    @property
    def new(self) -> dict[str, float]:
        """The parameters that are proposed; empty where nothing is."""
        return {} if self.proposal is None else dict(self.proposal.parameters)

    @property
    def old(self) -> dict[str, float]:
        """What the firmware held of these; its defaults where the log does not say it."""
        flown = adrc_parameters(self.values)
        default = lambda name: float(find_parameter("betaflight", name).default)
        return {name: flown.get(name, default(name)) for name in self.new}

    def changes(self, share: float = 1.0) -> tuple[ParameterChange, ...]:
        """From what the firmware held to the proposal; where the PID flew all, changed or not."""
        old, new, reasons = self.old, self.new, {}
        if self.proposal is not None:
            after, before = self.proposal.stage, self.proposal.stages["what flew"]
            tuned = (
                f"effect of torque {after.rejection:.2f} and command noise {after.noise:.2f} of "
                f"what flew; Ms {before.peak:.2f} -> {after.peak:.2f}"
            )
            kept = "the certificate is of this value"
            reasons = {name: tuned if name.endswith(self.axis) else kept for name in new}
        if self.flew_adrc:
            return propose_changes("betaflight", old, new, share=share, reasons=reasons)
        return tuple(
            ParameterChange(find_parameter("betaflight", name), old[name], value, reasons[name])
            for name, value in new.items()
        )

    @property
    def words(self) -> tuple[WordChange, ...]:
        """What switches from the PID to the ADRC; empty where the ADRC flew."""
        if self.flew_adrc or self.proposal is None or not self.new:
            return ()
        law = self.proposal.law
        off = {} if self.proposal.scaled is None else self.proposal.scaled.deviations
        why = (
            f"nearest to the gain over the throttle: off by {100 * off[law]:.0f} % at most"
            if off else "the firmware's default: the log does not show b0 over the throttle"
        )  # fmt: skip
        return (
            WordChange("adrc_b0_law", b0_law(self.values) or "SQRT", law, why),
            WordChange("pid_type", "CLASSIC", "ADRC", "the ADRC of pull request 15400 flies"),
        )

    def content(self) -> dict[str, object]:
        """All of it, for JSON."""
        proposal, plant = self.proposal, self.plant
        content = {
            "kind": self.kind, "verdict": self.verdict, "firmware": "betaflight",
            "version": self.version, "axis": self.axis, "law": "adrc",
            "flown_law": "adrc" if self.flew_adrc else "pid", "flown": self.flown.parameters(),
            "unmodelled": self.flown.unmodelled, "old": self.old, "new": self.new,
            "words": [x._asdict() for x in self.words],
            "proposal": None if proposal is None else proposal.content(),
            "reproduction": [
                {"throttle": x} | loop.to_dict() for x, loop in self.reproductions.items()
            ],
            "plant": None if plant is None else plant.to_dict(),
            "remarks": self.remarks, "settings": self.settings.content(),
        }  # fmt: skip
        return {key: plain_content(value) for key, value in content.items()}

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a pilot has to know before the file is loaded."""
        remarks = []
        if self.words and "pid_type" not in self.values:
            version = ".".join(map(str, self.version))
            remarks.append(
                f"the firmware of the log, Betaflight {version}, has no ADRC: only a build of "
                "Betaflight's pull request 15400 with adrc_b0_law understands the file"
            )
        elif self.words and b0_law(self.values) is None:
            remarks.append(
                "the build of the log has no adrc_b0_law, and b0 follows the square of the "
                "throttle there: load the file into one that has it"
            )
        if self.words:
            others = " and ".join(axis for axis in AXES if axis != self.axis)
            remarks += [
                "pid_type, adrc_hover_throttle and adrc_b0_law are those of all three axes: before "
                f"a flight tune {others}, too, from logs of their own with the same hover throttle "
                f"({self.new['adrc_hover_throttle']:.0f} %), and load all three files",
                "there is no file for a third of the way, because between PID and ADRC there is "
                "none; the file that reverts it switches back to the PID",
            ]
        if self.words and not adrc_parameters(self.values):
            remarks.append("the log does not hold the old values: they are the firmware's defaults")
        if (linear := float(self.values.get("thrust_linear", 0.0))) > 0:
            remarks.append(
                f"thrust_linear {linear:g} flew and stays: the gain over the throttle is that with "
                "it, taken as a straight line"
            )
        proposal, plant = self.proposal, self.plant
        if proposal is None or plant is None:
            return tuple(remarks)
        schedule, scaled, throttle = proposal.frame.schedule, proposal.scaled, proposal.throttle
        most = float(schedule.scale(throttle[-1]))
        if scaled is None:
            remarks.append(
                f"b0 over the throttle is not known, and adrc_b0_law {schedule.law} is "
                f"{'what flew' if self.flew_adrc else 'the default'}: the certificate is of "
                f"{throttle[0]:.2f} throttle alone; {plant.what_to_fly()}"
            )
            return tuple(remarks)
        if most >= schedule.high > 1:
            remarks.append(
                f"at {throttle[-1]:.2f} throttle b0 is at adrc_b0_scale_max, {schedule.high:g}"
            )
        if self.flew_adrc and scaled.law != schedule.law:
            off = {law: f"{100 * share:.0f} %" for law, share in scaled.deviations.items()}
            remarks.append(
                f"adrc_b0_law {schedule.law} stays as it flew: it is off by up to "
                f"{off[schedule.law]}, and {scaled.law} by {off[scaled.law]}"
            )
        if scaled.extrapolated:
            remarks.append(
                f"the hover throttle of {scaled.hover:.2f} lies outside of what was flown, "
                f"{float(plant.low.min()):.2f} to {float(plant.high.max()):.2f}"
            )
        return tuple(remarks)

    def write(self, folder: str | Path) -> list[Path]:
        """Write the page, `autopilot.json`, and parameter files: without a proposal what flew.

        **Returns:** their paths.
        """
        files = lambda path: [write_file(path / name, x) for name, x in self._texts().items()]
        pages = lambda origin: [adrc_page(self, origin)]
        return write_result(Path(folder), self.path, self.settings, self.content(), files, pages)

    def _texts(self) -> dict[str, str]:
        """The parameter files, and the table of what changes; without a proposal what flew."""
        if not self.new:
            start = ("adrc_wc", "adrc_wo", "adrc_b0") if self.flew_adrc else ("p", "i", "d")
            flown, version = self.flown.parameters(), self.version or (2025, 12)
            names = [f"{name}_{self.axis}" for name in start]
            rows = [(find_parameter("betaflight", name), flown[name]) for name in names]
            text = parameter_file(
                "betaflight", [ParameterChange(row, x, x) for row, x in rows], revert=True,
                version=version, profile=None, title=what_flew(self.path.name),
                raised=[axis for axis in AXES if f"d_max_{axis}" in flown],
            )  # fmt: skip
            return {f"{_STEM}_revert.txt": text}
        file = lambda changes, title, revert: parameter_file(
            "betaflight", changes, revert=revert, version=_BUILD, profile=None, words=self.words,
            title="\n".join([title, *self.remarks]),
        )  # fmt: skip
        shares = {33: 1 / 3, 100: 1.0} if self.flew_adrc else {100: 1.0}
        stages = {percent: self.changes(share) for percent, share in shares.items()}
        return stage_texts(_STEM, "txt", stages, file, self.words, self.path.name)

    @property
    def shown_again(self) -> Mapping[float, Reproduction]:
        """The flown loop again by throttle, without what the verdict says of it."""
        doubted = doubted_throttle(self.reproductions)
        if doubted is None:
            return self.reproductions
        said = self.reproductions[doubted].verdict
        return {x: again for x, again in self.reproductions.items() if again.verdict != said}

    def __str__(self) -> str:
        version, law = ".".join(map(str, self.version)), "ADRC" if self.flew_adrc else "PID"
        head = f"betaflight {version}, rate loop of {self.axis}: the {law} flew"
        values = self.flown.parameters().items()
        lines = [head.replace(" ,", ",")]
        lines += [f"  {name} = {x:.6g}" for name, x in values if name.endswith(f"_{self.axis}")]
        if isinstance(self.flown, FlownADRC):
            schedule = self.flown.schedule
            lines.append(f"  adrc_b0_law = {schedule.law}, hover {100 * schedule.hover:.0f} %")
        lines += [f"  not modelled: {x}" for x in self.flown.unmodelled]
        again = [
            f"flown loop at {x:.2f} throttle: {y.verdict}" for x, y in self.shown_again.items()
        ]
        parts = (
            [] if self.plant is None else [str(self.plant)], again,
            [] if self.proposal is None else [self.proposal.table()],
            [change_table(self.changes(), self.words).rstrip()] if self.new else [],
            [limits_text(self.settings)] if self.new else [],
            [f"! {x}" for x in self.remarks],
        )  # fmt: skip
        for part in parts:
            lines += ["", *part] if part else []
        return "\n".join([*lines, "", self.verdict])


def doubted_throttle(again: Mapping[float, Reproduction]) -> float | None:
    """Where the flown loop is not reproduced; None where it is at one level, and off at none."""
    off = [throttle for throttle, check in again.items() if check.kind == "not flown"]
    blind = all(check.kind == "unknown" for check in again.values())
    return next(iter(off or (again if blind else ())), None)


_PLANTS, _SEED = 100, 77  # of the steps' bands
_CURVE = 60  # points over the throttle


def adrc_page(result: ADRCAutopilot, origin: Provenance) -> PilotPage:
    version, proposal = ".".join(map(str, result.version)), result.proposal
    flown, flight, axis = result.flown, result.flight, AXES.index(result.axis)
    headlines = [Headline(*VERDICTS[result.kind], result.verdict)]
    for throttle, again in result.shown_again.items():
        flew = again.kind == "flown"
        word = "THE FLOWN LOOP AGAIN" if flew else "THE FLOWN LOOP IS NOT REPRODUCED"
        level = "good" if flew else "warn" if again.kind == "unknown" else "bad"
        headlines.append(Headline(level, word, f"at {throttle:.2f} throttle: {again.verdict}"))
    pid, cutoff = flown, result.new.get("adrc_gyro_lpf_hz", 0.0)
    if isinstance(flown, FlownADRC):
        pid, cutoff = flown.pid, flown.frame.lowpass_hz
    chains = chains_of(pid.law, axis)
    observer = (FilterChain((PT2(cutoff),), 1 / pid.law.dt),) if cutoff > 0 else ()
    filters: dict[str, Chains] = {"flown": chains}
    if result.flew_adrc or result.new:
        design = "flown" if result.flew_adrc else "proposed"
        filters[design] = {"gyro": chains["gyro"], "observer": observer}
    steps, b0 = ({}, None) if proposal is None else _steps_and_b0(result, proposal)
    return PilotPage(
        title=f"betaflight {version}, ADRC for {result.axis}".replace(" ,", ","),
        headlines=headlines,
        remarks=[
            *result.remarks, *(f"not modelled: {text}" for text in flown.unmodelled),
            *([limits_text(result.settings)] if result.new else []),
        ],
        filters=filters, steps=steps, b0=b0, terms_are="as logged", unit="pidsum",
        terms={} if flight is None or not flight.terms else logged_terms(flight),
        motors=[] if flight is None else motor_rows(flight),
        stages=None if proposal is None else stage_table(proposal, result.settings.fresh),
        changes=change_rows(result.changes(), result.words) if result.new else None,
        text=str(result), provenance=origin,
    )  # fmt: skip


def _steps_and_b0(
    result: ADRCAutopilot, proposal: ADRCProposal
) -> tuple[dict[str, StepBand], B0Section | None]:
    """Steps at the middle one of the throttles that were certified, and b0 over all of them."""
    flown, schedule, plant = result.flown, proposal.frame.schedule, result.plant
    if plant is None:
        return {}, None
    middle = proposal.throttle[len(proposal.throttle) // 2]
    grid, place = StepGrid.of(flown.law.dt), AXES.index(result.axis)
    seed = result.settings.seed + _SEED
    loop = adrc_loops(plant, flown, place, middle, proposal.frame, _PLANTS, seed, grid.omega)
    at = f", {middle:.2f} throttle"
    steps = {f"{'ADRC' if result.flew_adrc else 'PID'} flown{at}": grid.band(loop.closed(None))}
    levels = [plant.b0(k) for k in range(plant.throttle.size)]
    low, high = np.array([level.interval for level in levels]).T
    measured = GainBand(plant.throttle, np.array([level.value for level in levels]), low, high)
    throttle, taken = np.linspace(float(plant.low.min()), float(plant.high.max()), _CURVE), {}
    if isinstance(flown, FlownADRC):
        b0 = proposal.stages["what flew"].b0 * flown.schedule.scale(throttle)
        taken["b0 that flew"] = ThrottleCurve(throttle, b0)
    if result.new:
        steps[f"ADRC proposed{at}"] = grid.band(loop.closed(np.array(proposal.stage[:3])))
        b0 = proposal.stage.b0 * schedule.scale(throttle)
        taken[f"b0 proposed, {proposal.law}"] = ThrottleCurve(throttle, b0)
    curve = None if proposal.scaled is None else plant.b0_over(throttle)
    text = plant.what_to_fly() if proposal.scaled is None else f"gain / lag: {proposal.scaled}"
    more = (
        " The best b0 is not gain / lag: the motors' own pole 1 / lag is a part of what the "
        "observer has to follow."
    )
    return steps, B0Section(measured, taken, curve, f"{text[0].upper()}{text[1:]}.{more}")


def stage_table(proposal: ADRCProposal, fresh: int) -> Table:
    rows = [[name, *stage.cells()] for name, stage in proposal.stages.items()]
    heads = (
        "parameters", "wc", "wo", "b0", "stable, %", "worst Ms", "worst peak", "crossover, Hz",
        "torque", "noise",
    )  # fmt: skip
    first, last = proposal.throttle[0], proposal.throttle[-1]
    where = f"at {first:.2f}" if first == last else f"from {first:.2f} to {last:.2f}"
    return Table(f"On {fresh} fresh plants, {where} throttle", heads, rows)
