"""Numbers in tables: parameters of a fit and what the record determines; gains, certificates."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TYPE_CHECKING

import numpy as np
from jaxtyping import Array, Float

import jaxquad.plot as plot
from jaxquad.identify import Combination, factors, Fit, UndeterminedError
from jaxquad.models import TransferFunction

from ._page import Cell, embed_figure, Headline, Table


if TYPE_CHECKING:
    from jaxquad.simulation import Simulation
    from jaxquad.tuning import Certificate, Tuned

_BOUNDS = (20.0, 10.0)  # %, of Cramer-Rao bound and insensitivity (Tischler & Remple, sec. 11.1)
_CORRELATED = 0.9
_DASH = "\u2013"


def parameter_section(
    fit: Fit, derived: Sequence[Combination], texts: Mapping[str, str]
) -> dict[str, object]:
    """Every number with its standard error, and how good the fit is."""
    units = fit.parameter_units
    heads = ("parameter", *(["unit"] if units else []), "value", "std. error", "95 % interval")
    heads += ("by noise alone", "width") if fit.discrepancy is not None else ()
    heads += ("CR, %", "insensitivity, %")
    heads += () if fit.identifiable else ("stopped at",)
    rows: list[list[str | Cell]] = []
    for k, (name, value, error) in enumerate(
        zip(fit.names, fit.values, fit.standard_errors, strict=True)
    ):
        cells = _estimate(Combination(name, float(value), float(error)))
        low, high = fit.interval(name)
        cells[-1] = f"{low:.5g} .. {high:.5g}"
        stopped = [] if fit.identifiable else [""]
        by_noise = [] if fit.discrepancy is None else ["", ""]
        if fit.discrepancy is not None and fit.determined[k]:
            low, high = fit.interval(name, model_error=False)
            by_noise = [f"{low:.5g} .. {high:.5g}", fit.discrepancy.widths[k]]
        if not fit.determined[k]:
            stopped = [cells[1]]
            cells = [Cell(f"{name} *"), "", cells[2], "not determined"]
        percents = zip((fit.cramer_rao[k], fit.insensitivity[k]), _BOUNDS, strict=True)
        shares = [_marked(f"{x:.2f}" if np.isfinite(x) else "", bool(x > m)) for x, m in percents]
        rows.append([*cells, *by_noise, *shares, *stopped])
    dashes = [_DASH] * (len(heads) - 4 - bool(units))
    rows += [[*_estimate(combination), *dashes] for combination in derived]
    if units:
        rows = _with_units(rows, [*units, *(combination.unit or _DASH for combination in derived)])
    for tied in fit.tied:
        low, high = tied.interval()
        name = f"{tied.name}, tied to {', '.join(tied.follows) or 'fixed numbers'}"
        cells = [Cell(name), *([_DASH] if units else []), f"{tied.value:.5g}"]
        cells += [f"{tied.standard_error:.2g}", f"{low:.5g} .. {high:.5g}"]
        if not tied.determined:
            cells[-3:] = ["", cells[-2], "not determined"]
        rows.append([*cells, *[_DASH] * (len(heads) - len(cells))])
    poles_and_zeros = ""
    if isinstance(fit.model, TransferFunction):
        try:
            poles_and_zeros = str(factors(fit))
        except UndeterminedError as error:
            poles_and_zeros = str(error)
    condition = f"{fit.condition:.3g}" if fit.condition < 1e6 else "singular"
    ratio, plural = np.sqrt(fit.chi_squared), "s" * (fit.steps != 1)
    facts = {
        "misfit / random error": f"{ratio:.2f} (about 1 if the model explains the response)",
        "cost": f"{fit.cost:.4g}, on average {fit.average_cost:.4g} for each response",
        "points": f"{fit.points} frequencies",
        "condition of the Jacobian": condition,
        "solver": f"{fit.steps} step{plural}, Newton decrement {fit.newton_decrement:.1e}",
    }
    if fit.minima:
        facts["starts"] = count_starts([len(point.starts) for point in fit.minima])
    determined, correlation = np.flatnonzero(fit.determined).tolist(), None
    if len(determined) > 1:
        title = f"Correlation of the estimates (bold from {_CORRELATED:g})"
        names, values = [Cell(fit.names[k]) for k in determined], fit.correlation
        cell = lambda k, m: _marked(f"{values[k, m]:.2f}", bool(abs(values[k, m]) >= _CORRELATED))
        body = [["1" if k == m else cell(k, m) for m in determined] for k in determined]
        lines = [[name, *cells] for name, cells in zip(names, body, strict=True)]
        correlation = Table(title, ["", *names], lines)
    return {
        "table": Table("Identified parameters", heads, rows),
        "bounds": [f"{bound:g}" for bound in _BOUNDS],
        "is_marked": not fit.identifiable,
        "factors": poles_and_zeros,
        "facts": facts,
        "correlation": correlation,
        "text": str(fit),
        "texts": [{"title": title, "text": text} for title, text in texts.items()],
    }


def _estimate(one: Combination) -> list[str | Cell]:
    low, high = one.interval
    interval = f"{low:.5g} .. {high:.5g}"
    return [Cell(one.name), f"{one.value:.5g}", f"{one.standard_error:.2g}", interval]


def _marked(text: str, beyond: bool) -> str | Cell:
    return Cell(text, high=True) if beyond else text


def count_starts(starts: Sequence[int]) -> str:
    """How many starts led to how many different optima: "3 starts, 1 optimum"."""
    total, optima = sum(starts), len(starts)
    return f"{total} start{'s' * (total > 1)}, {optima} optim{'a' if optima > 1 else 'um'}"


def identifiability_section(fit: Fit) -> dict[str, object]:
    """What the record determines, and what to do about the rest."""
    none: dict[str, object] = dict.fromkeys(("lost", "texts", "remedies"), ())
    none |= {"combinations": None, "directions": None}
    verdict = fit.verdict
    bounds = [f"{bound}." for bound in verdict.bounds]
    if fit.identifiable:
        text = "The record determines every free parameter individually."
        nonzero = [k for k, value in enumerate(fit.values) if value != 0]
        shares = [(float(abs(fit.standard_errors[k] / fit.values[k])), k) for k in nonzero]
        if shares:
            share, k = max(shares)
            text += f" The least accurate is {fit.names[k]}: its standard error is "
            text += f"{100 * share:.2g} % of its value."
        return none | {"texts": [text, *bounds]}
    remedies = [f"{text[:1].upper()}{text[1:]}." for text in verdict.remedies]
    if verdict.kind != "not identifiable":
        return none | {"texts": [f"{verdict.summary}."], "remedies": remedies}
    texts = [] if fit.combinations else ["No combination of them is determined either."]
    combinations = directions = None
    if fit.combinations:
        heads = ("combination", "value", "std. error", "95 % interval")
        rows = [_estimate(combination) for combination in fit.combinations]
        if fit.parameter_units:
            heads = ("combination", "unit", *heads[1:])
            rows = _with_units(rows, [one.unit or _DASH for one in fit.combinations])
        combinations = Table("Combinations that are determined", heads, rows)
    if verdict.null_directions:
        names = list(dict.fromkeys(name for one in verdict.null_directions for name in one))
        rows = [
            [f"direction {k}", *(f"{one[n]:+.3f}" if n in one else _DASH for n in names)]
            for k, one in enumerate(verdict.null_directions, start=1)
        ]
        title = "Null directions: relative changes that leave the responses as they are"
        directions = Table(title, ["", *map(Cell, names)], rows)
    return {
        "lost": verdict.undetermined,
        "texts": [*texts, *(f"{reason}." for reason in verdict.reasons), *bounds],
        "combinations": combinations,
        "directions": directions,
        "remedies": remedies,
    }


def _with_units(rows: Sequence[list[str | Cell]], units: Sequence[str]) -> list[list[str | Cell]]:
    """Rows with a unit behind each name."""
    return [[name, unit, *rest] for (name, *rest), unit in zip(rows, units, strict=True)]


Quantity = Callable[[Any], Float[Array, ""]]  # of a model


def compare_fits(
    fits: Mapping[str, Fit | None], derived: Mapping[str, Quantity] | None = None
) -> str:
    """A table of fits of one model, a row for each: every number with its standard error.

    **Arguments:**

    - `fits`: by name; None for one that diverged.
    - `derived`: further columns, functions of the model by name, for instance
      `{"lag + delay": lambda model: model.lag + model.delay}`.
    """
    derived = derived or {}
    names = next((fit.names for fit in fits.values() if fit is not None), ())
    rows = [["", *names, *derived, "misfit / error"]]
    for name, fit in fits.items():
        if fit is None or not fit.verdict.fitted:
            rows.append([name, "the fit diverged" if fit is None else "not identifiable"])
            continue
        numbers = zip(fit.determined, fit.values, fit.standard_errors, strict=True)
        cells = [
            _plus_minus(value, error) if determined else "not determined"
            for determined, value, error in numbers
        ]
        for title, quantity in derived.items():
            try:
                sum_of = fit.derived(quantity, title)
                cells.append(_plus_minus(sum_of.value, sum_of.standard_error))
            except UndeterminedError:
                cells.append("not determined")
        rows.append([name, *cells, f"{fit.chi_squared**0.5:.2f}"])
    full = [row for row in rows if len(row) == len(rows[0])]
    widths = [max(map(len, column)) for column in zip(*full, strict=True)]
    widths[0] = max(len(row[0]) for row in rows)
    lines = [
        "   ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=False))
        for row in rows
    ]
    return "\n".join(line.rstrip() for line in lines) + "\n(+- one standard error)"


def _plus_minus(value: float, error: float) -> str:
    """With the digits that the error supports, two of its own: `284 +- 15`, `0.0164 +- 0.0022`."""
    if not (np.isfinite(error) and error > 0):
        return f"{value:.5g} +- {error:.2g}"
    last = 1 - int(np.floor(np.log10(float(f"{error:.1e}"))))  # decimal that is shown
    if not 0 <= last <= 6:
        digits = 1 + int(np.floor(np.log10(abs(value)))) if value else 1  # before the point
        return f"{value:.{max(digits + last, 1)}g} +- {error:.2g}"
    return f"{value:.{last}f} +- {error:.{last}f}"


_DRAWN = 7  # designs that can be distinguished in a figure


def verdict_headlines(tuned: "Tuned | Certificate") -> list[Headline]:
    """The three verdicts of a design; of gains that were given, those that were asked for."""
    headlines, certified = [], getattr(tuned, "certificate", tuned) is not None
    for verdict in tuned.verdicts:
        undecided = verdict.holds is None and bool(verdict.remedy) and certified
        if verdict.holds is not None or undecided:
            level, fails = ("good", "") if verdict.holds else ("bad", " FAILS")
            level, fails = ("warn", " NOT DECIDED") if undecided else (level, fails)
            text = ". ".join(filter(None, (verdict.text, verdict.remedy)))
            headlines.append(Headline(level, f"{verdict.name}{fails}", text))
    if not certified:
        text = "no fresh members were drawn to certify on"
        headlines.insert(0, Headline("warn", "NOT CERTIFIED", text))
    return headlines


def tuned_section(
    tuned: "Tuned | Certificate", flights: "Mapping[str, Simulation]"
) -> dict[str, object]:
    """The verdicts, the gains, how the tune went, how they fly, and the certificate."""
    from jaxquad.tuning import Tuned  # here: the room of tuning takes 0.2 s

    image = gains = None
    if flights:
        image = embed_figure(
            lambda: plot.flight(flights),
            alt="Angle with its set-point, command and disturbing torque over time: "
            f"{', '.join(flights)}.",
            caption="The tuned gains in flight, with the members of the certificate that do worst.",
        )
    certificate = tuned.certificate if isinstance(tuned, Tuned) else tuned
    if isinstance(tuned, Tuned):
        end, curve = "converged" if tuned.converged else "did NOT converge", None
        facts = {
            "controller": type(tuned.controller).__name__,
            "optimisation": f"cost {tuned.cost:.5g}; {end} after {tuned.evaluations} gradient "
            f"evaluations in {tuned.seconds:.1f} s",
        }
        if tuned.minima:
            facts["starts"] = count_starts([len(point.starts) for point in tuned.minima])
        if tuned.history:
            curve = embed_figure(
                lambda: plot.convergence_figure(tuned.history),
                alt="Cost above the best found and share of stable members, by gradient "
                "evaluation.",
            )
        rows = [[Cell(name), f"{value:.5g}"] for name, value in tuned.values.items()]
        table = Table("Gains", ("gain", "value"), rows)
        gains = {"table": table, "facts": facts, "remarks": tuned.remarks, "image": curve}
    return {
        "verdicts": [str(verdict) for verdict in tuned.verdicts], "gains": gains, "flight": image,
        "certificate": None if certificate is None else _certificate(certificate),
        "text": str(tuned),
    }  # fmt: skip


def _certificate(certificate: "Certificate") -> dict[str, object]:
    """Its figure, and designs side by side, by every quantity that was evaluated."""
    from jaxquad.tuning import KNOWN_INERTIA, QUANTITIES

    every, summary_of = certificate.designs.values(), certificate.summaries
    summaries = summary_of.values()
    quantities = [
        quantity
        for quantity in ("itae", "sensitivity_peak")
        if all(quantity in x.by_axis and np.isfinite(x.of(quantity)).any() for x in every)
    ]
    designs = tuple(certificate.designs)[:_DRAWN]
    titles = " and ".join(QUANTITIES[quantity].title for quantity in quantities)
    image = embed_figure(
        lambda: plot.certificate_figure(certificate, quantities=quantities, designs=designs),
        alt=f"Every member over its inertia: whether it is stable, and its {titles}, for "
        f"{', '.join(designs)}.",
    )
    percent = lambda x: "n/a" if x is None else f"{100 * x:.3g}"
    share = lambda row: None if row.unstable is None else row.unstable / row.members
    rows = [["unstable, %", "found", *(percent(share(row)) for row in summaries)]]
    if certificate.independent:
        bounds = [percent(row.unstable_at_most) for row in summaries]
        rows.append(["unstable, % (95 % confidence)", "at most", *bounds])
    diverged = [percent(row.diverged / row.members) for row in summaries]
    rows.append(["diverged, %", "found", *diverged])
    for quantity in certificate.design.by_axis:
        shown = QUANTITIES[quantity]
        title = f"{shown.title}, {shown.unit}" if shown.unit else shown.title
        for which in ("mean", "worst"):
            cells = [
                shown.text(row.statistics[quantity]._asdict()[which], unit=False)
                if quantity in row.statistics
                else "n/a"
                for row in summaries
            ]
            rows.append([title, which, *cells])
    heads = ("quantity", "of the members", *map(Cell, summary_of))
    title = f"{certificate.name} and other designs on {certificate.members} members"
    return {
        "verdict": str(certificate).splitlines()[0],
        "limits": [str(distance) for distance in certificate.distances],
        "remarks": certificate.remarks,
        "untuned": KNOWN_INERTIA if KNOWN_INERTIA in certificate.designs else "",
        "designs": Table(title, heads, rows, texts=2), "image": image,
    }  # fmt: skip
