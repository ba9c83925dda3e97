"""Tuned gains, and their certificate on fresh members."""

from collections.abc import Mapping

import numpy as np

from jaxquad.plot import certificate_figure, convergence_figure, flight
from jaxquad.simulation import Simulation
from jaxquad.tuning import Certificate, KNOWN_INERTIA, QUANTITIES, Tuned

from ._fit import count_starts
from ._page import Cell, embed_figure, Headline, Table


_DRAWN = 7  # designs that can be distinguished in a figure


def verdict_headlines(tuned: Tuned | Certificate) -> list[Headline]:
    """The three verdicts of a design; of gains that were given, those that were asked for."""
    headlines = []
    for verdict in tuned.verdicts:
        if verdict.holds is not None:
            level, fails = ("good", "") if verdict.holds else ("bad", " FAILS")
            text = ". ".join(filter(None, (verdict.text, verdict.remedy)))
            headlines.append(Headline(level, f"{verdict.name}{fails}", text))
    if isinstance(tuned, Tuned) and tuned.certificate is None:
        text = "no fresh members were drawn to certify on"
        headlines.insert(0, Headline("warn", "NOT CERTIFIED", text))
    return headlines


def tuned_section(
    tuned: Tuned | Certificate, flights: Mapping[str, Simulation]
) -> dict[str, object]:
    """The verdicts, the gains, how the tune went, how they fly, and the certificate."""
    certificate, image = tuned.certificate if isinstance(tuned, Tuned) else tuned, None
    if flights:
        image = embed_figure(
            lambda: flight(flights),
            alt="Angle with its set-point, command and disturbing torque over time: "
            f"{', '.join(flights)}.",
            caption="The tuned gains in flight, with the members of the certificate that do worst.",
        )
    return {
        "verdicts": [str(verdict) for verdict in tuned.verdicts],
        "gains": _gains(tuned) if isinstance(tuned, Tuned) else None,
        "flight": image,
        "certificate": None if certificate is None else _certificate(certificate),
        "text": str(tuned),
    }


def _gains(tuned: Tuned) -> dict[str, object]:
    rows = [[Cell(name), f"{value:.5g}"] for name, value in tuned.values.items()]
    end = "converged" if tuned.converged else "did NOT converge"
    facts = {
        "controller": type(tuned.controller).__name__,
        "optimisation": f"cost {tuned.cost:.5g}; {end} after {tuned.evaluations} gradient "
        f"evaluations in {tuned.seconds:.1f} s",
    }
    if tuned.minima:
        facts["starts"] = count_starts([len(point.starts) for point in tuned.minima])
    image = None
    if tuned.history:
        image = embed_figure(
            lambda: convergence_figure(tuned.history),
            alt="Cost above the best found and share of stable members, by gradient evaluation.",
        )
    table = Table("Gains", ("gain", "value"), rows)
    return {"table": table, "facts": facts, "remarks": tuned.remarks, "image": image}


def _certificate(certificate: Certificate) -> dict[str, object]:
    every = certificate.designs.values()
    quantities = [
        quantity
        for quantity in ("itae", "sensitivity_peak")
        if all(quantity in x.by_axis and np.isfinite(x.of(quantity)).any() for x in every)
    ]
    designs = tuple(certificate.designs)[:_DRAWN]
    image = embed_figure(
        lambda: certificate_figure(certificate, quantities=quantities, designs=designs),
        alt="Every member over its inertia: whether it is stable, and its "
        f"{' and '.join(QUANTITIES[q].title for q in quantities)}, for {', '.join(designs)}.",
    )
    return {
        "verdict": str(certificate).splitlines()[0],
        "limits": [str(distance) for distance in certificate.distances],
        "remarks": certificate.remarks,
        "untuned": KNOWN_INERTIA if KNOWN_INERTIA in certificate.designs else "",
        "designs": _designs(certificate),
        "image": image,
    }


def _designs(certificate: Certificate) -> Table:
    """Designs side by side, by every quantity that was evaluated."""
    summaries = certificate.summaries
    percent = lambda x: "n/a" if x is None else f"{100 * x:.3g}"
    share = lambda row: None if row.unstable is None else row.unstable / row.members
    rows = [["unstable, %", "found", *(percent(share(row)) for row in summaries.values())]]
    if certificate.independent:
        bounds = [percent(row.unstable_at_most) for row in summaries.values()]
        rows.append(["unstable, % (95 % confidence)", "at most", *bounds])
    diverged = [percent(row.diverged / row.members) for row in summaries.values()]
    rows.append(["diverged, %", "found", *diverged])
    for quantity in certificate.design.by_axis:
        shown = QUANTITIES[quantity]
        title = f"{shown.title}, {shown.unit}" if shown.unit else shown.title
        for which in ("mean", "worst"):
            cells = [
                shown.text(row.statistics[quantity]._asdict()[which], unit=False)
                if quantity in row.statistics
                else "n/a"
                for row in summaries.values()
            ]
            rows.append([title, which, *cells])
    heads = ("quantity", "of the members", *map(Cell, summaries))
    title = f"{certificate.name} and other designs on {certificate.members} members"
    return Table(title, heads, rows, texts=2)
