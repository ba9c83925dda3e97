"""The parameters of a fit, their correlation, what the record determines; fits side by side."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from jaxquad.identify import Combination, factors, Fit, UndeterminedError
from jaxquad.models import TransferFunction

from ._page import Cell, Table


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
    rows = [_parameter(fit, k) for k in range(len(fit.names))]
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
    return {
        "table": Table("Identified parameters", heads, rows),
        "bounds": [f"{bound:g}" for bound in _BOUNDS],
        "is_marked": not fit.identifiable,
        "factors": poles_and_zeros,
        "facts": facts,
        "correlation": _correlation(fit),
        "text": str(fit),
        "texts": [{"title": title, "text": text} for title, text in texts.items()],
    }


def _parameter(fit: Fit, k: int) -> list[str | Cell]:
    name = fit.names[k]
    value, error = float(fit.values[k]), float(fit.standard_errors[k])
    low, high = fit.interval(name)
    cells = [*_estimate(Combination(name, value, error))[:-1], f"{low:.5g} .. {high:.5g}"]
    stopped = [] if fit.identifiable else [""]
    by_noise = [] if fit.discrepancy is None else ["", ""]
    if fit.discrepancy is not None and fit.determined[k]:
        low, high = fit.interval(name, model_error=False)
        by_noise = [f"{low:.5g} .. {high:.5g}", fit.discrepancy.widths[k]]
    if not fit.determined[k]:
        stopped = [cells[1]]
        cells = [Cell(f"{name} *"), "", cells[2], "not determined"]
    percents = zip((fit.cramer_rao[k], fit.insensitivity[k]), _BOUNDS, strict=True)
    shares = [_marked(f"{x:.2f}" if np.isfinite(x) else "", bool(x > most)) for x, most in percents]
    return [*cells, *by_noise, *shares, *stopped]


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


def _correlation(fit: Fit) -> Table | None:
    determined = np.flatnonzero(fit.determined).tolist()
    if len(determined) < 2:
        return None
    rows = []
    for k in determined:
        values = [(float(fit.correlation[k, m]), k == m) for m in determined]
        cells = [_marked(f"{x:.2f}", bool(abs(x) >= _CORRELATED)) for x, _ in values]
        cells = ["1" if same else cell for cell, (_, same) in zip(cells, values, strict=True)]
        rows.append([Cell(fit.names[k]), *cells])
    title = f"Correlation of the estimates (bold from {_CORRELATED:g})"
    return Table(title, ["", *(Cell(fit.names[k]) for k in determined)], rows)


def identifiability_section(fit: Fit) -> dict[str, object]:
    """What the record determines, and what to do about the rest."""
    none: dict[str, object] = {
        "lost": [], "texts": [], "combinations": None, "directions": None, "remedies": []
    }  # fmt: skip
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
