"""A proposal for an autopilot as one page: filters, noise, steps, terms, and what changes."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jaxquad.plot as plot
import jaxquad.report as report
from jaxquad._core import write_file
from jaxquad.identify import GainBand
from jaxquad.plot import FlownAgain, Spectrum, StepBand, ThrottleCurve
from jaxquad.report import (
    attempt,
    Cell,
    FAILED,
    Headline,
    Provenance,
    provenance_section,
    render_page,
    Table,
)

from ._filters import FilterChain


Chains = Mapping[str, Sequence[FilterChain]]  # by the signal that they filter


@dataclasses.dataclass(frozen=True)
class B0Section:
    """b0 over the throttle, for `jaxquad.plot.b0_figure`.

    **Attributes:**

    - `levels`, `curve`, `taken`: as the figure takes them.
    - `text`: what they say, in words.
    """

    levels: GainBand
    taken: Mapping[str, ThrottleCurve]
    curve: GainBand | None = None
    text: str = ""


@dataclasses.dataclass(frozen=True)
class PilotPage:
    """What the page of a proposal shows; what is None or empty is left out.

    **Attributes:**

    - `title`: of the page; `headlines`: the verdict first.
    - `remarks`: what of the firmware is not modelled, and other doubts.
    - `filters`: the chains of "flown", and of "proposed" where they change, each by the signal that
      they filter: "gyro", "D term".
    - `gyro`, `derivative`: spectra by what they are, for `jaxquad.plot.spectra_figure`.
    - `noise`: what the spectra are of, in words.
    - `steps`: for `jaxquad.plot.steps_figure`, with `step_facts`.
    - `b0`: over the throttle, of an ADRC.
    - `terms`: root mean squares of P, I, D and F; `terms_are`: logged, or computed.
    - `motors`: rows of name and shares of samples at the lowest and the highest command.
    - `stages`, `changes`: tables.
    - `unit`: of the command.
    - `failures`: why a section could not be computed, by its name (a key of the page's sections:
      "changes", "filters", "noise", "steps", "b0", "balance"); the reason stands in its place.
    """

    title: str
    headlines: Sequence[Headline]
    filters: Mapping[str, Chains]
    remarks: Sequence[str] = ()
    gyro: Mapping[str, Spectrum] = dataclasses.field(default_factory=dict)
    derivative: Mapping[str, Spectrum] = dataclasses.field(default_factory=dict)
    noise: str = ""
    steps: Mapping[str, StepBand] = dataclasses.field(default_factory=dict)
    b0: B0Section | None = None
    terms: Mapping[str, float] = dataclasses.field(default_factory=dict)
    terms_are: str = ""
    motors: Sequence[tuple[str, float, float]] = ()
    stages: Table | None = None
    changes: Table | None = None
    text: str = ""
    unit: str = ""
    again: FlownAgain | None = None
    again_text: str = ""
    overview: str = ""
    provenance: Provenance | None = None
    failures: Mapping[str, str] = dataclasses.field(default_factory=dict)


def write_pilot_page(path: str | Path, *pages: PilotPage) -> Path:
    """Write one self-contained HTML page on proposals for an autopilot, whole or not at all.

    It is made as `jaxquad.report.write_report` makes its page: figures inside it, nothing fetched,
    texts from a log escaped, and a section or a figure that cannot be computed says why.

    **Arguments:**

    - `path`: of the page.
    - `pages`: what it shows, one for each axis; the provenance is that of the first.

    **Returns:** the path.
    """
    first, origin = pages[0], pages[0].provenance
    axes = []
    for page in pages:
        sections = {
            "changes": {"changes": page.changes, "stages": page.stages},
            **{name: attempt(section, page) for name, section in SECTIONS.items()},
            "text": {"text": page.text} if page.text else None,
        }
        sections |= {name: {FAILED: reason} for name, reason in page.failures.items()}
        axes.append({
            "title": page.title, "headlines": list(page.headlines), "remarks": list(page.remarks),
            "sections": {name: section for name, section in sections.items() if section},
        })  # fmt: skip
    text = render_page(
        "pilot.html",
        title=f"{first.headlines[0].word}: {first.title}" if len(pages) == 1 else first.overview,
        axes=axes,
        origin=None if origin is None else attempt(provenance_section, origin),
    )
    return write_file(path, text)


# The sections that hold figures, None for what a page does not have. `plot` and `embed_figure` are
# looked up when a page is written: with them comes matplotlib.

PageSection = dict[str, object] | None
_SHOWN = (10.0, 50.0)  # Hz, of a table of delays


def filters_section(page: PilotPage) -> PageSection:
    """Magnitude and delay of what each signal has passed, and the shares of the delay."""
    drawn = {}
    for design, chains in page.filters.items():
        passed: list[FilterChain] = []  # what filters the gyro filters the D term, too
        for signal, group in chains.items():
            passed = [*passed, *(chain for chain in group if chain.filters)]
            if passed:
                drawn[f"{signal}, {design}"] = passed
    if not drawn:
        return {"image": None, "tables": []}
    image = report.embed_figure(
        lambda: plot.filters_figure(drawn),
        alt=f"Magnitude and delay over the frequency of {', '.join(drawn)}.",
        caption="Magnitude and phase delay; what filters the gyro filters the D term, too.",
    )
    heads = ("filter", "of", *(f"delay at {x:g} Hz, ms" for x in _SHOWN))
    tables = []
    for design, chains in page.filters.items():
        rows: list[list[str | Cell]] = []
        for signal, group in chains.items():
            total = [0.0] * len(_SHOWN)
            for share in (share for chain in group for share in chain.shares(_SHOWN)[:-1]):
                late = [float(x) for x in share.delay_ms]
                total = [a + b for a, b in zip(total, late, strict=True)]
                rows.append([Cell(share.name), signal, *(f"{x:.2f}" for x in late)])
            rows.append([f"all of the {signal}'s", signal, *(f"{x:.2f}" for x in total)])
        title = f"Filters {design}, with their shares of the delay"
        tables.append(Table(title, heads, rows, texts=2))
    return {"image": image, "tables": tables}


def noise_section(page: PilotPage) -> PageSection:
    """Spectra of gyro and D term."""
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
    """Steps of the set-point, and their overshoot."""
    if not page.steps:
        return None
    image = report.embed_figure(
        lambda: plot.steps_figure(page.steps),
        alt=f"Rate after a step of the set-point: {', '.join(page.steps)}; 95 % of the plants.",
        caption="The logged rate after a step of 1 of the set-point, without feed-forward: median "
        "and 95 % of the plants that the log leaves possible.",
    )
    rows: list[list[str | Cell]] = []
    for name, band in page.steps.items():
        half = 1e3 * float(band.time[(band.middle >= 0.5).argmax()])
        over = [100 * max(float(x.max()) - 1, 0.0) for x in (band.middle, band.high)]
        rows.append([Cell(name), f"{over[0]:.0f}", f"{over[1]:.0f}", f"{half:.0f}"])
    heads = ("gains", "overshoot, %", "worst, %", "half way after, ms")
    return {"image": image, "table": Table("Step responses", heads, rows)}


def again_section(page: PilotPage) -> PageSection:
    """A part of the flight as logged and as law and plant make it."""
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
    """b0 over the throttle."""
    section = page.b0
    if section is None:
        return None
    levels = section.levels
    image = report.embed_figure(
        lambda: plot.b0_figure(levels, section.taken, curve=section.curve),
        alt=f"b0 over the throttle: of the log, and {', '.join(section.taken)}.",
        caption="b0 over the throttle: gain / lag of the log with what it leaves uncertain, and "
        "what the ADRC takes.",
    )
    rows: list[list[str | Cell]] = [
        [f"{x:.2f}", f"{value:.0f}", f"{low:.0f} .. {high:.0f}"]
        for x, value, low, high in zip(*levels, strict=True)
    ]
    heads = ("throttle", "gain / lag, deg/s^3", "95 %")
    return {"image": image, "table": Table("Levels flown", heads, rows), "text": section.text}


def balance_section(page: PilotPage) -> PageSection:
    """How large the terms were, and how often motors were at their limits."""
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
    rows: list[list[str | Cell]] = [
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
