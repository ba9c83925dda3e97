"""What `jaxquad tune` leaves behind: gains, certificate, report, figures, C header."""

from pathlib import Path
from typing import Any

from ._tuning import Case
from .export import write_c_header
from .identify import Fit
from .records import Record
from .report import (
    certificate_figure,
    convergence_figure,
    provenance,
    write_json,
    write_report,
)
from .spectra import FrequencyResponse
from .tune import Tuned


def write_tuning(
    out: Path,
    record: Record,
    frf: FrequencyResponse,
    found: Fit,
    tuned: Tuned,
    case: Case,
    log: Path,
    name: str,
) -> list[str]:
    """Write the folder; returns the names of the files."""
    origin = provenance(log, settings=case._asdict())
    write_json(out / "tuned.json", tuned_content(tuned, case) | {"provenance": origin.content()})
    write_c_header(out / f"{name}.h", tuned.controller, name=name, axes=1)
    figures = {"convergence.png": convergence_figure(tuned.history)}
    if tuned.certificate is not None:
        figures["certificate.png"] = certificate_figure(tuned.certificate)
    for file, figure in figures.items():
        figure.savefig(out / file, dpi=130)
    write_report(
        out / "report.html", fit=found, frf=frf, record=record, tuned=tuned, provenance=origin
    )
    return ["tuned.json", f"{name}.h", "report.html", *figures]


def tuned_content(tuned: Tuned, case: Case) -> dict[str, Any]:
    """For JSON."""
    names = ("values", "cost", "converged", "stabilised", "evaluations", "seconds", "remarks")
    content = {name: getattr(tuned, name) for name in names}
    judged = {} if tuned.certificate is None else {"certificate": tuned.certificate.content()}
    return {"holds": tuned.holds} | content | judged | {"case": case._asdict()}
