"""Tuned gains, and what was shown of them on fresh members."""

import numpy as np

from jaxquad.plot import certificate_figure, convergence_figure
from jaxquad.tuning import Certificate, SHOWN, Tuned

from ._html_figure import figure
from ._html_fit import definitions
from ._html_text import element, given, Html, items, joined, scrolling, section, table


_DRAWN = 7  # designs that can be told apart in a figure


def tuned_section(tuned: Tuned | Certificate) -> Html:
    certificate = tuned.certificate if isinstance(tuned, Tuned) else tuned
    gains = _gains(tuned) if isinstance(tuned, Tuned) else Html("")
    shown = _certificate(certificate) if certificate is not None else Html("")
    text = scrolling(element("pre", str(tuned)), "Tune and certificate as text")
    printed = element("details", element("summary", "As printed"), text)
    return section("tuned", "Tuned gains", gains, shown, printed)


def _gains(tuned: Tuned) -> Html:
    rows = [[given(name), f"{value:.5g}"] for name, value in tuned.values.items()]
    facts = {
        "controller": type(tuned.controller).__name__,
        "descent": f"cost {tuned.cost:.5g}, {'converged' if tuned.converged else 'NOT converged'}"
        f" after {tuned.evaluations} gradients in {tuned.seconds:.1f} s",
    }
    if tuned.minima:
        starts = sum(len(o.starts) for o in tuned.minima)
        facts["starts"] = f"{starts}, which ended at {len(tuned.minima)} points"
    history = Html("")
    if tuned.history:
        history = figure(
            lambda: convergence_figure(tuned.history),
            alt="Cost above the best found and share of stable members, by gradient evaluation.",
            formulas=True,  # powers of ten
        )
    remarks = items(tuned.remarks, css="remarks") if tuned.remarks else Html("")
    return joined(
        table(("number", "value"), rows, title="Gains"), definitions(facts), remarks, history
    )


def _certificate(certificate: Certificate) -> Html:
    quantities = [q for q in ("itae", "sensitivity_peak") if _is_known(certificate, q)]
    designs = tuple(certificate.designs)[:_DRAWN]
    verdict = str(certificate).splitlines()[0]
    limits = items([str(distance) for distance in certificate.distances])
    remarks = items(certificate.remarks, css="remarks") if certificate.remarks else Html("")
    return joined(
        element("h3", "Certificate"),
        element("p", element("strong", verdict)),
        limits if certificate.distances else Html(""),
        remarks,
        _designs(certificate),
        figure(
            lambda: certificate_figure(certificate, quantities=quantities, designs=designs),
            alt="Every member over its inertia: whether it is stable, and its "
            f"{' and '.join(SHOWN[q].title for q in quantities)}, for {', '.join(designs)}.",
            formulas=True,
        ),
    )


def _is_known(certificate: Certificate, quantity: str) -> bool:
    designs = certificate.designs.values()
    return all(quantity in d.by_axis and np.isfinite(d.of(quantity)).any() for d in designs)


def _designs(certificate: Certificate) -> Html:
    """Designs side by side, by every quantity that was judged."""
    rows_of, known = certificate.rows, certificate.independent
    percent = lambda x: "n/a" if x is None else f"{100 * x:.3g}"
    share = lambda row: None if row.unstable is None else row.unstable / row.members
    rows = [["unstable, %", "found", *(percent(share(row)) for row in rows_of.values())]]
    if known:
        bounds = [percent(row.unstable_at_most) for row in rows_of.values()]
        rows.append(["unstable, % (95 % confidence)", "at most", *bounds])
    rows.append(
        ["diverged, %", "found", *(percent(r.diverged / r.members) for r in rows_of.values())]
    )
    for quantity in certificate.design.by_axis:
        shown = SHOWN[quantity]
        title = f"{shown.title}, {shown.unit}" if shown.unit else shown.title
        for which in ("mean", "worst"):
            cells = [
                shown.text(getattr(row.statistics[quantity], which), unit=False)
                if quantity in row.statistics
                else "n/a"
                for row in rows_of.values()
            ]
            rows.append([title, which, *cells])
    heads = ("quantity", "of members", *map(given, rows_of))
    title = f"{certificate.name} and its peers on {certificate.members} members"
    return table(heads, rows, title=title, texts=2)
