"""What a reader has to know first: is there a result, and what speaks against it."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxquad.identify import FAILED, Fit, MISFIT, NotIdentifiable, Verification
from jaxquad.spectra import FrequencyResponse
from jaxquad.tuning import Certificate, Tuned

from ._html_text import element, Html, items, joined


GOOD_TIC = 0.25  # Theil inequality coefficient, below which agreement is good
_SIGNS = {"good": "\u2713", "warn": "!", "bad": "\u2717"}


class Verdict(NamedTuple):
    """`level` is good, warn or bad; `word` is the verdict itself."""

    level: str
    word: str
    reason: str


def verdict_of(fit: Fit | NotIdentifiable, remarks: int) -> Verdict:
    """Of the fit alone."""
    if isinstance(fit, NotIdentifiable):
        return Verdict("bad", "NOT IDENTIFIABLE", " ".join(str(fit).split()))
    if fit.newton_decrement > FAILED * max(fit.cost, 1e-9):
        return Verdict("bad", "NO RESULT", "the solver found no minimum: no number is shown")
    if not fit.identifiable:
        lost, known = ", ".join(fit.identifiability.undetermined), fit.combinations
        rest = f"determined: {', '.join(map(str, known))}" if known else "nothing of them is"
        return Verdict(
            "bad", "NOT IDENTIFIABLE", f"from this record, each by itself: {lost}; {rest}"
        )
    if fit.chi_squared > MISFIT**2:
        word = (
            f"IDENTIFIED, BUT IT MISFITS by {np.sqrt(fit.chi_squared):.1f} times the random error"
        )
        return Verdict("warn", word, _numbers(fit))
    if remarks:
        word = f"IDENTIFIED, with {remarks} remark{'s' * (remarks > 1)}"
        return Verdict("warn", word, _numbers(fit))
    return Verdict("good", "IDENTIFIED", _numbers(fit))


def _numbers(fit: Fit) -> str:
    shown = [
        f"{name} = {value:.4g} \u00b1 {1.96 * error:.2g}"
        for name, value, error in zip(fit.names, fit.values, fit.standard_errors, strict=True)
    ]
    more = f" and {len(shown) - 6} more" if len(shown) > 6 else ""
    return f"{', '.join(shown[:6])}{more} (95 %)"


def checked(name: str, check: Verification) -> Verdict:
    numbers = f"{name}: fit {check.fit_percent:.1f} %, TIC {check.tic:.3f}"
    if check.tic < GOOD_TIC:
        return Verdict("good", "VERIFIED", f"{numbers}, good below {GOOD_TIC}")
    return Verdict("bad", "VERIFICATION FAILS", f"{numbers}, to be below {GOOD_TIC}")


def certified(tuned: Tuned | Certificate) -> Verdict:
    certificate = tuned.certificate if isinstance(tuned, Tuned) else tuned
    if certificate is None:
        return Verdict("warn", "NOT CERTIFIED", "no fresh members were asked for")
    word, _, reason = str(certificate).splitlines()[0].partition(" on ")
    return Verdict("good" if certificate.holds else "bad", word, f"on {reason}")


def verdict_line(verdict: Verdict) -> Html:
    sign = element("b", _SIGNS[verdict.level], attributes={"aria-hidden": "true"})
    word = element("strong", verdict.word)
    return element("li", sign, " ", word, " ", element("span", verdict.reason), css=verdict.level)


def remarks_of(
    fit: Fit | NotIdentifiable,
    frfs: Mapping[str, FrequencyResponse],
    checks: Mapping[str, Verification],
) -> list[str]:
    """Of the fit, its responses and its checks, each once."""
    found = [] if isinstance(fit, NotIdentifiable) else list(fit.remarks)
    found += [remark for frf in frfs.values() for remark in frf.remarks]
    for name, check in checks.items():
        if not np.isfinite(check.tic):
            found.append(f"{name}: the simulation is not finite, so it verifies nothing")
    return list(dict.fromkeys(found))


def opening(heading: str, verdicts: list[Verdict], remarks: list[str]) -> Html:
    """Title with the verdict, the other verdicts, and all remarks."""
    first = verdicts[0]
    word = element("span", _SIGNS[first.level], " ", first.word, css=first.level)
    lead = element("p", first.reason, css="lead")
    lines = element("ul", *map(verdict_line, verdicts[1:]), css="verdicts") if verdicts[1:] else ""
    noted = items(remarks, css="remarks") if remarks else ""
    return joined(element("h1", word, Html("<br> "), heading), lead, lines, noted)
