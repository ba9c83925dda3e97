"""A fit as one page; what a reader has to know first comes first."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxquad._core import write_file
from jaxquad.identify import Combination, Fit, KnownFilter, MISFIT, Verification
from jaxquad.models import Model
from jaxquad.records import Record
from jaxquad.spectra import FrequencyResponse

from ._answers import answer_section
from ._loop import LawLoop, loop_section, step_section
from ._measured import check_section, GOOD_TIC, record_section, response_section, spectrum_section
from ._numbers import (
    identifiability_section,
    parameter_section,
    tuned_section,
    verdict_headlines,
)
from ._page import Headline, render_page
from ._results import attempt, Provenance, provenance_section


if TYPE_CHECKING:
    from jaxquad.simulation import Simulation
    from jaxquad.tuning import Certificate, Tuned


_ORDER = (
    "answers", "step", "loop", "tuned", "response", "parameters", "identifiability",
    "verification", "spectrum", "record", "provenance",
)  # fmt: skip


def write_report(
    path: str | Path, *, fit: Fit, frf: FrequencyResponse | Mapping[str, FrequencyResponse],
    models: Mapping[str, Model] | None = None,
    others: Mapping[str, FrequencyResponse] | None = None,
    record: Record | Mapping[str, Record] | None = None, spectrum: Record | None = None,
    filters: Sequence[KnownFilter] = (), law: LawLoop | None = None,
    checks: Verification | Mapping[str, Verification] | None = None,
    derived: Sequence[Combination] = (), texts: Mapping[str, str] | None = None,
    tuned: "Tuned | Certificate | None" = None, flights: "Mapping[str, Simulation] | None" = None,
    provenance: Provenance | None = None, title: str = "", formula: str = "",
) -> Path:  # fmt: skip
    """Write one self-contained HTML page on a fit, whole or not at all.

    The verdict and all remarks come first, then what the log can answer and what to fly next,
    results, and records at the end. Figures are inside the page; under a pointer they show the
    numbers of their curves, and they can be enlarged. The script that does this is part of the
    page, and the page's policy lets no other run. Nothing is fetched from elsewhere, and every text
    from a log is escaped. A section or a figure that cannot be computed says why; the rest is
    written.

    **Arguments:**

    - `path`: of the page.
    - `fit`: the fit; one that is not identifiable has a page, too.
    - `frf`: the response that was fitted, or several that one fit explains, by name.
    - `models`: with several responses, the models under a known change (`conditions=` of `jq.fit`)
      by the same names; by default the fit's own.
    - `others`: further estimates of the same response, by name.
    - `record`, `checks`: the records, and the model simulated on records; one, or several by name.
    - `spectrum`: the record whose spectrum is shown, such as one with the throttle beside its
        channels; by default the first record.
    - `filters`: of the outputs, up to whose inputs response and model are.
    - `law`: the flown loop where its law is known, which is shown instead of an estimate.
    - `derived`: rows below the parameters, see `Fit.derived`.
    - `texts`: what stands below them by title, such as `Fit.bands` and `Fit.explain` in print.
    - `tuned`: gains with their certificate, or a certificate alone.
    - `flights`: of these gains, by name, see `jaxquad.tuning.worst_flights`.
    - `provenance`: where the result comes from, see `jaxquad.report.provenance`.
    - `title`: by default "output / input" of the first response.
    - `formula`: the model in words.

    **Returns:** the path.

    **Raises:** ValueError for no response, and for `models` whose names no response has.
    """
    frfs = {"response": frf} if isinstance(frf, FrequencyResponse) else dict(frf)
    if not frfs:
        raise ValueError("frf is empty: give the response that was fitted, or several by name")
    records = {"record": record} if isinstance(record, Record) else dict(record or {})
    verified = {"verification": checks} if isinstance(checks, Verification) else dict(checks or {})
    drawn: dict[str, Model] = dict(models or {})
    unknown = [name for name in drawn if name not in frfs]
    if unknown:
        raise ValueError(f"models of no response: {unknown}; the responses are {list(frfs)}")
    if fit.verdict.fitted:
        drawn = {name: fit.model for name in frfs} | drawn
    first = next(iter(frfs.values()))  # of the responses that were fitted
    names = (first.output_names[0], first.input_names[0])
    channels = {*first.input_names, *first.output_names}
    flown = next((one for one in records.values() if channels <= {*one.names}), None)
    first_record = next(iter(records.values()), None)
    sections: dict[str, object] = {
        "answers": attempt(answer_section, fit, first, first_record, verified),
        "identifiability": attempt(identifiability_section, fit),
    }
    if fit.verdict.fitted:
        sections["parameters"] = attempt(parameter_section, fit, derived, texts or {})
    if provenance is not None:
        sections["provenance"] = attempt(provenance_section, provenance)
    remarks = remarks_of(fit, verified)
    headlines = [fit_headline(fit, len(remarks))]
    headlines += [check_headline(name, check, fit) for name, check in verified.items()]
    if tuned is not None:
        headlines += verdict_headlines(tuned)
        sections["tuned"] = attempt(tuned_section, tuned, flights or {})
    sections["response"] = attempt(response_section, frfs, drawn, others or {})
    if flown is not None:
        computed = None if law is None else law.step
        sections["step"] = attempt(step_section, fit, first, flown, tuple(filters), computed)
        sections["loop"] = attempt(loop_section, first, flown, law)
    if (shown := flown if spectrum is None else spectrum) is not None:
        sections["spectrum"] = attempt(spectrum_section, first, shown)
    if records:
        sections["record"] = attempt(record_section, records)
    if verified:
        sections["verification"] = attempt(check_section, verified)
    text = render_page(
        "report.html", title=f"{headlines[0].word}: {title or ' / '.join(names)}",
        title_text=title, names=names, headlines=headlines, remarks=remarks, formula=formula,
        sections={name: sections[name] for name in _ORDER if sections.get(name) is not None},
    )  # fmt: skip
    return write_file(path, text)


def fit_headline(fit: Fit, remarks: int) -> Headline:
    """Of the fit alone; `remarks` is their number."""
    if fit.verdict.kind in ("no minimum", "no model"):
        return Headline("bad", fit.verdict.kind.upper(), fit.verdict.summary)
    if not fit.identifiable:
        return Headline("bad", "NOT IDENTIFIABLE", fit.verdict.summary)
    numbers = []
    units = fit.parameter_units or ("",) * len(fit.names)
    for name, value, unit in zip(fit.names, fit.values, units, strict=True):
        low, high = fit.interval(name)
        number = f"{value:.4g} \u00b1 {(high - low) / 2:.2g}"
        if low == 0 or high == 0:  # it keeps its sign: no symmetrical interval
            number = f"{low:.2g} .. {high:.2g}"
        numbers.append(f"{name} = {number} {unit}".rstrip())
    more = f" and {len(numbers) - 6} more" if len(numbers) > 6 else ""
    reason = f"{', '.join(numbers[:6])}{more} (95 % intervals)"
    if fit.chi_squared > MISFIT**2:
        ratio = np.sqrt(fit.chi_squared)
        word = f"IDENTIFIED, but the misfit is {ratio:.1f} times the random error"
        return Headline("warn", word, reason)
    if remarks:
        word = f"IDENTIFIED, with {remarks} remark{'s' * (remarks > 1)}"
        return Headline("warn", word, reason)
    return Headline("good", "IDENTIFIED", reason)


def check_headline(name: str, check: Verification, fit: Fit) -> Headline:
    """Of the model simulated on a record."""
    numbers = f"{name}: fit {check.fit_percent:.1f} %, TIC {check.tic:.3f}"
    if check.tic < GOOD_TIC and not fit.identifiable:
        lost = ", ".join(fit.verdict.undetermined)
        reason = f"{numbers}: right in what it does, but its record does not determine {lost}"
        return Headline("warn", "VERIFIED AS A WHOLE", reason)
    if check.tic < GOOD_TIC:
        return Headline("good", "VERIFIED", f"{numbers} (good: below {GOOD_TIC})")
    return Headline("bad", "VERIFICATION FAILS", f"{numbers} (good: below {GOOD_TIC})")


def remarks_of(fit: Fit, checks: Mapping[str, Verification]) -> list[str]:
    """Of the fit, with those of its responses that concern it, and of its checks, each once."""
    remarks: list[str] = [*fit.remarks]
    for name, check in checks.items():
        if not np.isfinite(check.tic):
            remarks.append(f"{name}: the simulation diverges, so it verifies nothing")
    return list(dict.fromkeys(remarks))
