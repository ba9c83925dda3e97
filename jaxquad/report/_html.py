from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxquad.identify import Combination, Fit, NotIdentifiable, Verification
from jaxquad.records import Record
from jaxquad.spectra import FrequencyResponse
from jaxquad.tuning import Certificate, Tuned

from ._html_checks import check_section
from ._html_fit import identifiability_section, parameter_section
from ._html_page import page, write_page
from ._html_provenance import Provenance, provenance_section
from ._html_record import record_section
from ._html_response import residual_section, response_section
from ._html_text import element, escaped, given, Html, joined
from ._html_tuned import tuned_section
from ._html_verdict import certified, checked, opening, remarks_of, verdict_of


def write_report(
    path: str | Path,
    *,
    fit: Fit | NotIdentifiable,
    frf: FrequencyResponse | Mapping[str, FrequencyResponse],
    models: Mapping[str, Any] | None = None,
    others: Mapping[str, FrequencyResponse] | None = None,
    record: Record | Mapping[str, Record] | None = None,
    checks: Verification | Mapping[str, Verification] | None = None,
    derived: Sequence[Combination] = (),
    tuned: Tuned | Certificate | None = None,
    provenance: Provenance | None = None,
    title: str = "",
    formula: str = "",
) -> Path:
    """Write one self-contained HTML page on a fit, whole or not at all; returns its path.

    The verdict and all remarks come first. Figures are inside, there is no script, and nothing is
    fetched; every text from a log is escaped. Where nothing was identifiable, the exception may
    stand for the fit. Several responses that one fit explains are a mapping by name; `models` are
    then those under a known change (`conditions=` of `jq.fit`), by the same names, and the fit's
    own where there is none. `others` are further estimates of the same response. Records and checks
    may be mappings by name, too. `derived` are rows below the parameters, see `Fit.derived`.
    `title` is "output / input" of the first response by default, `formula` the model in words.
    Raises ValueError for no response, and for `models` of none.
    """
    frfs = _by_name(frf, "response")
    if not frfs:
        raise ValueError("frf is empty: give the response that was fitted, or several by name")
    text = _page(
        fit, frfs, _models(fit, frfs, models or {}), others or {}, _by_name(record, "record"),
        _by_name(checks, "verification"), derived, tuned, provenance, title, formula,
    )  # fmt: skip
    return write_page(Path(path), text)


def _by_name(one: Any, name: str) -> dict[str, Any]:
    if one is None:
        return {}
    return dict(one) if isinstance(one, Mapping) else {name: one}


def _models(
    fit: Fit | NotIdentifiable, frfs: Mapping[str, Any], models: Mapping[str, Any]
) -> dict[str, Any]:
    unknown = [name for name in models if name not in frfs]
    if unknown:
        raise ValueError(f"models of no response: {unknown}; the responses are {list(frfs)}")
    if isinstance(fit, NotIdentifiable):
        return dict(models)
    return {name: models.get(name, fit.model) for name in frfs}


def _page(
    fit, frfs, models, others, records, checks, derived, tuned, provenance, title, formula
) -> str:
    remarks = remarks_of(fit, frfs, checks)
    verdicts = [verdict_of(fit, len(remarks))]
    verdicts += [checked(name, check) for name, check in checks.items()]
    verdicts += [certified(tuned)] if tuned is not None else []
    heading = escaped(title) if title else _ratio(next(iter(frfs.values())))
    parts = {
        "Record": record_section(records) if records else "",
        "Response": response_section(frfs, models, others),
        "Residuals": residual_section(frfs, models) if models else "",
        "Parameters": parameter_section(fit, derived) if isinstance(fit, Fit) else "",
        "Identifiability": identifiability_section(fit),
        "Verification": check_section(checks) if checks else "",
        "Tuned gains": tuned_section(tuned) if tuned is not None else "",
        "Provenance": provenance_section(provenance) if provenance is not None else "",
    }
    shown = {name: part for name, part in parts.items() if part}
    model = element("p", "Model: ", given(formula)) if formula else ""
    body = joined(
        element("header", opening(heading, verdicts, remarks), model, _links(shown)),
        element("main", *shown.values()),
    )
    plain = title or "{} / {}".format(*_names(next(iter(frfs.values()))))
    return page(f"{verdicts[0].word}: {plain}", body)


def _names(frf: FrequencyResponse) -> tuple[str, str]:
    return frf.output_names[0], frf.input_names[0]


def _ratio(frf: FrequencyResponse) -> Html:
    output, source = _names(frf)
    return joined(given(output), " / ", given(source))


def _links(parts: Mapping[str, str]) -> Html:
    links = [
        element("li", element("a", name, attributes={"href": f"#{_anchor(part)}"}))
        for name, part in parts.items()
    ]
    return element("nav", element("ul", *links), attributes={"aria-label": "Sections"})


def _anchor(part: str) -> str:
    return part.partition('id="')[2].partition('"')[0]
