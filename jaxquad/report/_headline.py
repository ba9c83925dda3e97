"""What a reader has to know first: is there a result, and what speaks against it."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxquad.identify import Fit, MISFIT, Verification
from jaxquad.spectra import FrequencyResponse
from jaxquad.tuning import Certificate, Tuned

from ._record import GOOD_TIC


class Headline(NamedTuple):
    """`level` is good, warn or bad; `word` is the verdict, `reason` why."""

    level: str
    word: str
    reason: str


def fit_headline(fit: Fit, remarks: int) -> Headline:
    """Of the fit alone; `remarks` is their number."""
    if fit.verdict.kind == "no minimum":
        return Headline("bad", "NO MINIMUM", fit.verdict.summary)
    if not fit.identifiable:
        return Headline("bad", "NOT IDENTIFIABLE", fit.verdict.summary)
    if fit.chi_squared > MISFIT**2:
        ratio = np.sqrt(fit.chi_squared)
        word = f"IDENTIFIED, but the misfit is {ratio:.1f} times the random error"
        return Headline("warn", word, _numbers(fit))
    if remarks:
        word = f"IDENTIFIED, with {remarks} remark{'s' * (remarks > 1)}"
        return Headline("warn", word, _numbers(fit))
    return Headline("good", "IDENTIFIED", _numbers(fit))


def _numbers(fit: Fit) -> str:
    shown = [
        f"{name} = {value:.4g} \u00b1 {1.96 * error:.2g}"
        for name, value, error in zip(fit.names, fit.values, fit.standard_errors, strict=True)
    ]
    more = f" and {len(shown) - 6} more" if len(shown) > 6 else ""
    return f"{', '.join(shown[:6])}{more} (95 % intervals)"


def check_headline(name: str, check: Verification) -> Headline:
    """Of the model simulated on a record."""
    numbers = f"{name}: fit {check.fit_percent:.1f} %, TIC {check.tic:.3f}"
    if check.tic < GOOD_TIC:
        return Headline("good", "VERIFIED", f"{numbers} (good: below {GOOD_TIC})")
    return Headline("bad", "VERIFICATION FAILS", f"{numbers} (good: below {GOOD_TIC})")


def certificate_headline(tuned: Tuned | Certificate) -> Headline:
    """Of tuned gains."""
    certificate = tuned.certificate if isinstance(tuned, Tuned) else tuned
    if certificate is None:
        return Headline("warn", "NOT CERTIFIED", "no fresh members were drawn to certify on")
    word, _, reason = str(certificate).splitlines()[0].partition(" on ")
    return Headline("good" if certificate.holds else "bad", word, f"on {reason}")


def remarks_of(
    fit: Fit, frfs: Mapping[str, FrequencyResponse], checks: Mapping[str, Verification]
) -> list[str]:
    """Of the fit, its responses and its checks, each once."""
    found = list(fit.remarks)
    found += [remark for frf in frfs.values() for remark in frf.remarks]
    for name, check in checks.items():
        if not np.isfinite(check.tic):
            found.append(f"{name}: the simulation diverges, so it verifies nothing")
    return list(dict.fromkeys(found))
