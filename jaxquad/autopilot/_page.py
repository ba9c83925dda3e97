"""A proposal for an autopilot as one page: filters, noise, steps, terms, and what changes."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TYPE_CHECKING, TypeVar

import numpy as np
from jaxtyping import Float

import jaxquad.plot as plot
import jaxquad.report as report
from jaxquad._core import write_file
from jaxquad.identify import GainBand
from jaxquad.plot import FlownAgain, Spectrum, StepBand, ThrottleCurve
from jaxquad.report import Cell, Headline, Provenance, Table

from ._filter_bank import gyro_noise, GyroNoise, hann_spectra, NoNoise, SLOWEST
from ._filters import FilterChain
from ._firmware import firmware_named
from ._flight_channels import FlightChannels
from ._flight_qualities import measured_step
from ._identified_log import StepGrid
from ._law import RateLoop
from ._parameters import gains_in, gains_of, list_reasons, ParameterChange, WordChange
from ._rate_loops import draw_loops, gyro_chain_response, law_paths, Limits, Stage, WAYS


if TYPE_CHECKING:
    from ._proposal import AutopilotProposal

Chains = Mapping[str, Sequence[FilterChain]]  # by the signal that they filter


class B0Section(NamedTuple):
    """b0 over the throttle, for `jaxquad.plot.b0_figure`."""

    levels: GainBand
    taken: Mapping[str, ThrottleCurve]
    curve: GainBand | None = None
    text: str = ""  # what they say


@dataclasses.dataclass(frozen=True)
class PilotPage:
    """What the page of a proposal shows; what is None or empty is left out."""

    title: str
    headlines: Sequence[Headline]  # the verdict first
    filters: Mapping[str, Chains]  # of "flown", and of "proposed" where they change
    remarks: Sequence[str] = ()  # what of the firmware is not modelled, and other doubts
    gyro: Mapping[str, Spectrum] = dataclasses.field(default_factory=dict)
    derivative: Mapping[str, Spectrum] = dataclasses.field(default_factory=dict)
    noise: str = ""  # what the spectra are of
    steps: Mapping[str, StepBand] = dataclasses.field(default_factory=dict)
    measured: StepBand | None = None  # the step of the log itself
    b0: B0Section | None = None  # over the throttle, of an ADRC
    terms: Mapping[str, float] = dataclasses.field(default_factory=dict)  # rms of P, I, D and F
    terms_are: str = ""  # logged, or computed
    # Rows of name and shares of samples at the lowest and the highest command.
    motors: Sequence[tuple[str, float, float]] = ()
    stages: Table | None = None
    changes: Table | None = None
    text: str = ""
    unit: str = ""  # of the command
    again: FlownAgain | None = None
    again_text: str = ""
    overview: str = ""  # title of a page of several axes
    provenance: Provenance | None = None
    # Why a section could not be computed, by its name; the reason stands in its place.
    failures: Mapping[str, str] = dataclasses.field(default_factory=dict)


def write_pilot_page(
    path: str | Path, *pages: PilotPage, files: Mapping[str, str] | None = None
) -> Path:
    """Write one self-contained HTML page on proposals for an autopilot, whole or not at all.

    It is made as `jaxquad.report.write_report` makes its page: figures inside it, nothing fetched,
    texts from a log escaped, and a section or a figure that cannot be computed says why. There is a
    page for each axis; the provenance is that of the first. `files` are texts to load by the names
    of the files beside the page, to which it links. Returns the path.
    """
    first, origin = pages[0], pages[0].provenance
    axes = []
    for page in pages:
        sections = {
            "changes": {"changes": page.changes, "stages": page.stages},
            **{name: report.attempt(section, page) for name, section in SECTIONS.items()},
            "text": {"text": page.text} if page.text else None,
        }
        sections |= {name: {report.FAILED: reason} for name, reason in page.failures.items()}
        axes.append({
            "title": page.title, "headlines": list(page.headlines), "remarks": list(page.remarks),
            "sections": {name: section for name, section in sections.items() if section},
        })  # fmt: skip
    text = report.render_page(
        "pilot.html",
        title=f"{first.headlines[0].word}: {first.title}" if len(pages) == 1 else first.overview,
        axes=axes,
        files=files or {},
        origin=None if origin is None else report.attempt(report.provenance_section, origin),
    )
    return write_file(path, text)


# The sections that hold figures, None for what a page does not have. `plot` and `embed_figure` are
# looked up when a page is written: with them comes matplotlib.

PageSection = dict[str, object] | None
Rows = list[list[str | Cell]]
_DELAYS = (10.0, 50.0)  # Hz, of a table of delays


def filters_section(page: PilotPage) -> PageSection:
    """Magnitude and delay of what each signal has passed, and the shares of the delay."""
    drawn, tables = {}, []
    heads = ("filter", "of", *(f"delay at {x:g} Hz, ms" for x in _DELAYS))
    for design, chains in page.filters.items():
        passed: list[FilterChain] = []  # what filters the gyro filters the D term, too
        rows: Rows = []
        for signal, group in chains.items():
            passed = [*passed, *(chain for chain in group if chain.filters)]
            if passed:
                drawn[f"{signal}, {design}"] = passed
            total = [0.0] * len(_DELAYS)
            for share in (share for chain in group for share in chain.shares(_DELAYS)[:-1]):
                late = [float(x) for x in share.delay_ms]
                total = [a + b for a, b in zip(total, late, strict=True)]
                rows.append([Cell(share.name), signal, *(f"{x:.2f}" for x in late)])
            rows.append([f"all of the {signal}'s", signal, *(f"{x:.2f}" for x in total)])
        title = f"Filters {design}, with their shares of the delay"
        tables.append(Table(title, heads, rows, texts=2))
    if not drawn:
        return {"image": None, "tables": []}
    image = report.embed_figure(
        lambda: plot.filters_figure(drawn),
        alt=f"Magnitude and delay over the frequency of {', '.join(drawn)}.",
        caption="Magnitude and phase delay; what filters the gyro filters the D term, too.",
    )
    return {"image": image, "tables": tables}


def noise_section(page: PilotPage) -> PageSection:
    if not page.gyro:
        return None
    image = report.embed_figure(
        lambda: plot.spectra_figure(page.gyro, page.derivative, unit=page.unit),
        alt=f"Spectra of the gyro and of the D term: {', '.join(page.gyro)}.",
        caption="Noise of the gyro, and what the D term makes of it; before the filters by the "
        "gain that flew.",
    )
    return {"image": image, "text": page.noise}


def steps_section(page: PilotPage) -> PageSection:
    steps = dict(page.steps) if page.measured is None else {**page.steps, "measured": page.measured}
    if not steps:
        return None
    caption = (
        "The logged rate after a step of 1 of the set-point, without feed-forward: median and 95 % "
        "of the plants that the log leaves possible."
    )
    if page.measured is not None:
        caption += (
            " Measured: the log's own response, with feed-forward and all else that flew; where it "
            "differs, these do it."
        )
    image = report.embed_figure(
        lambda: plot.steps_figure(page.steps, measured=page.measured),
        alt=f"Rate after a step of the set-point: {', '.join(steps)}; bands of 95 %.",
        caption=caption,
    )
    rows: Rows = []
    for name, band in steps.items():
        middle, worst = band.overshoot
        times = f"{1e3 * band.half_way:.0f}"
        rows.append([Cell(name), f"{100 * middle:.0f}", f"{100 * worst:.0f}", times])
    heads = ("gains", "overshoot, %", "worst, %", "half way after, ms")
    return {"image": image, "table": Table("Step responses", heads, rows)}


def again_section(page: PilotPage) -> PageSection:
    flight = page.again
    if flight is None:
        return None
    image = report.embed_figure(
        lambda: plot.again_figure(flight),
        alt="Set-point, logged rate, and the rate that law and plant make of the set-point.",
        caption="The liveliest part of the flight: the rate as logged, and as the law that flew "
        "and the identified plant make it of the logged set-point alone, without gusts.",
    )
    return {"image": image, "text": page.again_text}


def b0_section(page: PilotPage) -> PageSection:
    if page.b0 is None:
        return None
    levels, taken, curve, text = page.b0
    image = report.embed_figure(
        lambda: plot.b0_figure(levels, taken, curve=curve),
        alt=f"b0 over the throttle: of the log, and {', '.join(taken)}.",
        caption="b0 over the throttle: gain / lag of the log with what it leaves uncertain, and "
        "what the ADRC takes.",
    )
    rows: Rows = [
        [f"{x:.2f}", f"{value:.0f}", f"{low:.0f} .. {high:.0f}"]
        for x, value, low, high in zip(*levels, strict=True)
    ]
    heads = ("throttle", "gain / lag, deg/s^3", "95 %")
    return {"image": image, "table": Table("Levels flown", heads, rows), "text": text}


def balance_section(page: PilotPage) -> PageSection:
    if not page.terms and not page.motors:
        return None
    image = None
    if page.terms:
        shown = ", ".join(f"{name} {value:.3g}" for name, value in page.terms.items())
        image = report.embed_figure(
            lambda: plot.balance_figure(page.terms, unit=page.unit),
            alt=f"Root mean squares of the terms: {shown} {page.unit}.",
            caption=f"Root mean square of each term of the command in the log, {page.terms_are}; "
            "the mean of I is left out.",
        )
    rows: Rows = [
        [Cell(name), f"{100 * low:.2f}", f"{100 * high:.2f}"] for name, low, high in page.motors
    ]
    motors = Table("Motors at their limits", ("motor", "lowest, %", "highest, %"), rows)
    return {"image": image, "motors": motors if rows else None}


SECTIONS: Mapping[str, Callable[[PilotPage], PageSection]] = {
    "filters": filters_section,
    "again": again_section,
    "noise": noise_section,
    "steps": steps_section,
    "b0": b0_section,
    "balance": balance_section,
}

_PLANTS, _SEED = 100, 77  # of the steps' bands
_WINDOW = 4.0  # s, of computed terms
_NEAR = 0.005  # of a motor's range, from its ends
VERDICTS = {
    "proposed": ("good", "PROPOSED"), "kept": ("good", "WHAT FLEW IS KEPT"),
    "cannot tell": ("warn", "THIS LOG CANNOT TELL"), "not to be flown": ("bad", "NOT TO BE FLOWN"),
}  # fmt: skip
Designs = Mapping[str, tuple[RateLoop, Float[np.ndarray, " gains"]]]
Spectra = dict[str, Spectrum]
Part = TypeVar("Part")


def pilot_page(proposal: "AutopilotProposal", origin: Provenance, overview: str) -> PilotPage:
    """All that the page shows; what cannot be computed says why. `overview` is of all axes."""
    flown, flight, new = proposal.flown, proposal.flown.flight, proposal.new
    law, axis, filters = flown.law, flown.axis, proposal.filters
    failures: dict[str, str] = {}

    def computed(section: str, compute: Callable[[], Part], missing: Part) -> Part:
        try:
            return compute()
        except Exception as error:  # the page holds the rest
            failures[section] = report.reason_of(error)
            return missing

    def spectra() -> tuple[GyroNoise | None, Spectra, Spectra]:
        noise = proposal.noise
        if noise is None and flight is not None:
            try:
                noise = gyro_noise(flight, law, axis, SLOWEST)
            except NoNoise:
                pass
        return noise, *(({}, {}) if noise is None else noise_spectra(noise, axis, designs))

    designs = _designs_of(proposal)
    noise, gyro, derivative = computed("noise", spectra, (None, {}, {}))
    steps = computed("steps", lambda: proposed_steps(proposal), {})
    measured = computed("steps", lambda: measured_step(flight), None)
    logged = flight is not None and {"P", "I"} <= set(flight.terms)
    compute_terms = lambda: (
        {} if flight is None else logged_terms(flight) if logged
        else computed_terms(flight, law, axis)
    )  # fmt: skip
    headlines = [Headline(*VERDICTS[proposal.kind], proposal.verdict)]
    check, throttle = proposal.reproduction, proposal.throttle
    if check is not None and check.kind == "flown":  # else the verdict says it
        headlines.append(Headline("good", "THE FLOWN LOOP AGAIN", check.verdict))
    if filters is not None:
        headlines.append(Headline("good" if filters.flown else "warn", "FILTERS", filters.text))
    if (sticks := proposal.sticks) is not None:
        level = "good" if sticks.keeps else "warn"
        headlines.append(Headline(level, "FEED-FORWARD", sticks.text))
    if throttle is not None:
        level = "warn" if throttle.gains is None else "good"
        headlines.append(Headline(level, "THROTTLE", throttle.text))
        if throttle.curve is not None:
            level = "warn" if throttle.curve.change else "good"
            headlines.append(Headline(level, "THRUST CURVE", throttle.curve.text))
    return PilotPage(
        title=proposal.title,
        headlines=headlines,
        remarks=[
            *(f"not modelled: {text}" for text in flown.loop.unmodelled),
            *([flown.filters_text] if flown.filters_text else []),
            *([limits_text(proposal.settings)] if new else []),
            *([FORWARD_STAYS] if new and proposal.sticks is None else []),
        ],
        filters={
            name: chains_of(other, axis)
            for name, (other, _) in designs.items() if name == "flown" or other is not law
        },
        gyro=gyro,
        derivative=derivative,
        noise="" if noise is None else (
            f"Noise of {noise.source}, less what the set-point explains. Below "
            f"{noise.least_hz:.0f} Hz motion is taken for noise, so the level above is used."
        ),
        steps=steps,
        measured=None if measured is None else measured.step,
        terms=computed("balance", compute_terms, {}),
        terms_are="as logged" if logged else "computed by the law from set-point and rate",
        motors=[] if flight is None else motor_rows(flight),
        stages=stage_rows(proposal) if proposal.stages else None,
        changes=change_rows(proposal.changes) if new else None,
        text=str(proposal),
        unit=firmware_named(flown.firmware).unit,
        again=None if check is None else check.shown,
        again_text="" if check is None else f"{check.verdict[0].upper()}{check.verdict[1:]}.",
        overview=overview,
        provenance=origin,
        failures=failures,
    )  # fmt: skip


def chains_of(law: RateLoop, axis: int) -> dict[str, tuple[FilterChain, ...]]:
    """The filters of the gyro and those of the D term alone."""
    gyro, slope = law.gyro_chains(), law.derivative_chain(axis)
    chains = {"gyro": tuple(chain for chain in gyro if chain.filters)}
    if slope.filters and gains_of(law, axis)[2] > 0:
        chains["D term"] = (slope,)
    return chains


def noise_spectra(noise: GyroNoise, axis: int, designs: Designs) -> tuple[Spectra, Spectra]:
    """Of gyro and D term: before all filters, then behind those of each design."""
    inside = (noise.before.hertz > 1.0) & (noise.before.hertz <= noise.known_hz)
    hertz, before = noise.before.hertz[inside], noise.before.power[inside]
    behind, (law, gains) = noise.behind.power[inside], designs["flown"]
    omega = 2 * np.pi * np.minimum(hertz, 0.4999 / law.dt)
    gyro, derivative = {"before the filters": Spectrum(hertz, before)}, {}
    chain = gyro_chain_response(law, omega)
    for name, (other, its_gains) in designs.items():
        changed = np.abs(gyro_chain_response(other, omega) / chain) ** 2
        if name == "flown" or other is not law:
            gyro[name] = Spectrum(hertz, behind * changed)
        through = np.abs(its_gains[2] * law_paths(other, axis, omega)[0][2]) ** 2
        if name == "flown" and gains[2] > 0:
            [slope] = chains_of(law, axis).get("D term", [FilterChain((), 1 / law.dt)])
            open = before * through / np.abs(np.asarray(slope.response(hertz))) ** 2
            derivative["before the filters"] = Spectrum(hertz, open)
        if its_gains[2] > 0:
            derivative[name] = Spectrum(hertz, behind * changed * through)
    return gyro, derivative


def _designs_of(proposal: "AutopilotProposal") -> Designs:
    """Law and gains of what flew, and of the proposal where there is one."""
    law, axis = proposal.flown.law, proposal.flown.axis
    designs = {"flown": (law, gains_of(law, axis))}
    if new := proposal.new:
        filters = proposal.filters
        changed = {} if filters is None else {name: new[name] for name in filters.flown}
        after = proposal.flown.with_filters(changed) if changed else law
        designs["proposed"] = (after, gains_in(law, axis, new))
    return designs


def proposed_steps(proposal: "AutopilotProposal") -> dict[str, StepBand]:
    """Flown and proposed, from set-point to rate, of plants drawn from the fit: by their responses.

    Empty where the log does not determine the plant.
    """
    designs = _designs_of(proposal)
    if not proposal.identification.fit.identifiable:
        return {}
    flown, seed = proposal.flown, proposal.settings.seed + _SEED
    grid, steps = StepGrid.of(flown.law.dt), {}
    loops = draw_loops(
        proposal.identification, proposal.throttle, flown, _PLANTS, seed, omega=grid.omega
    )
    for name, (law, gains) in designs.items():
        mine = loops if law is flown.law else loops.of_law(law, flown.axis)
        [back], [ahead] = mine.paths(gains[None])
        steps[name] = grid.band(ahead * mine.plants / (1 + back * mine.plants))
    return steps


def logged_terms(flight: FlightChannels) -> dict[str, float]:
    """Root mean squares of P, I, D and F as they were logged, I without its mean."""
    moved = {name: x - x.mean() if name == "I" else x for name, x in flight.terms.items()}
    return {name: float(np.sqrt(np.mean(x**2))) for name, x in moved.items()}


def computed_terms(flight: FlightChannels, law: RateLoop, axis: int) -> dict[str, float]:
    """Likewise, by the law from set-point and rate."""
    size = min(int(_WINDOW / flight.dt), len(flight.setpoint))
    hertz = np.fft.rfftfreq(size, flight.dt)
    inside = (hertz > 0) & (hertz < 0.4999 / law.dt)
    back, ahead = law_paths(law, axis, 2 * np.pi * hertz[inside])
    rate = flight.rates[min(axis, len(flight.rates) - 1)]
    r, y = (x[:, inside] for x in hann_spectra(size, flight.setpoint, rate))
    terms = {}
    for k, (name, gain) in enumerate(zip("PID", gains_of(law, axis), strict=True)):
        power = np.mean(np.sum(np.abs(gain * (ahead[k] * r - back[k] * y)) ** 2, axis=1))
        terms[name] = float(np.sqrt(2 * power / (size * np.sum(np.hanning(size) ** 2))))
    return terms


def motor_rows(flight: FlightChannels) -> list[tuple[str, float, float]]:
    """Each motor's shares of samples at the lowest and at the highest command."""
    low, high = flight.motor_ends
    near = _NEAR * (high - low)
    return [
        (f"motor {k + 1}", float(np.mean(x <= low + near)), float(np.mean(x >= high - near)))
        for k, x in enumerate(() if flight.motors is None else flight.motors.T)
    ]


def stage_rows(proposal: "AutopilotProposal") -> Table:
    stages: dict[str, Stage] = dict(zip(WAYS, proposal.stages, strict=True))
    levels = () if proposal.throttle is None else proposal.throttle.logged
    if proposal.filters is not None and proposal.filters.flown and proposal.filters.gains_alone:
        stages["gains alone, filters as flown"] = proposal.filters.gains_alone
    further = lambda x: [  # with the integral held, and of the angle loop
        *([] if x.relaxed is None else [f"{x.relaxed:.2f}"]),
        *([] if x.angle is None else [f"{x.angle.peak:.2f}", f"{x.angle.resonance:.2f}"]),
    ]
    rows: Rows = [
        [
            name, *x.cells(), *further(x), *(f"{peak:.2f}" for peak in x.peaks[: len(levels)]),
        ]
        for name, x in stages.items()
    ]  # fmt: skip
    first = proposal.stages[0]
    heads = (
        "gains", "stable, %", "worst Ms", "worst peak", "crossover, Hz", "delay margin, ms",
        "torque", "noise", *(("Ms, integral held",) if first.relaxed is not None else ()),
        *(("Ms, angle loop", "peak, angle loop") if first.angle is not None else ()),
        *(f"Ms at throttle {level:.2f}" for level in levels),
    )  # fmt: skip
    return Table(f"On {proposal.settings.fresh} fresh plants", heads, rows)


def change_rows(changes: Sequence[ParameterChange], words: Sequence[WordChange] = ()) -> Table:
    rows: Rows = [
        [Cell(row.name), f"{old:.5g}", f"{new:.5g}", row.unit, row.range_text]
        for row, old, new, _ in changes
    ]
    rows += [[Cell(word.name), word.old, word.new, "", ""] for word in words]
    heads = ("parameter", "old", "new", "unit", "range")
    notes = list_reasons(changes, words)
    return Table("From what flew to the proposal", heads, rows, notes=notes)


FORWARD_STAYS = "feed-forward stays as it flew"


def limits_text(limits: Limits) -> str:
    """What the search was allowed, relative to what, and when to stop."""
    return (
        f"limits: the response to the set-point may peak at {limits.resonance:g} (`resonance`), "
        f"which is an overshoot of up to about {100 * (limits.resonance - 1):.0f} % after a quick "
        f"stick; the command's noise, which heats the motors, may grow {limits.noise:g} times "
        f"(`noise`), each gain {limits.change:g} times (`change`) of this flight. They compound "
        "from log to log: stop where a log keeps what flew, or the motors get warm"
    )
