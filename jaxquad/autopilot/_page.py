"""A proposal for an autopilot as one page: filters, noise, steps, terms, and what changes."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from jaxquad._core import write_file
from jaxquad.identify import GainBand
from jaxquad.plot import FlownAgain, Spectrum, StepBand, ThrottleCurve
from jaxquad.report import (
    attempt,
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
    axes = [
        {
            "title": page.title, "headlines": list(page.headlines), "remarks": list(page.remarks),
            "sections": _sections(page),
        }
        for page in pages
    ]  # fmt: skip
    text = render_page(
        "pilot.html",
        title=f"{first.headlines[0].word}: {first.title}" if len(pages) == 1 else first.overview,
        axes=axes,
        origin=None if origin is None else attempt(provenance_section, origin),
    )
    return write_file(path, text)


_DRAWN = ("filters", "again", "noise", "steps", "b0", "balance")


def _sections(page: PilotPage) -> dict[str, object]:
    sections = {
        "changes": {"changes": page.changes, "stages": page.stages},
        **{name: attempt(_draw, name, page) for name in _DRAWN},
        "text": {"text": page.text} if page.text else None,
    }
    sections |= {name: {FAILED: reason} for name, reason in page.failures.items()}
    return {name: section for name, section in sections.items() if section is not None}


def _draw(name: str, page: PilotPage) -> object:
    from ._page_sections import SECTIONS  # here: with them comes matplotlib

    return SECTIONS[name](page)
