"""The parameters of a fit, their correlation, what the record determines; fits side by side."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from jaxquad.identify import Combination, factors, Fit, Tied, UndeterminedError
from jaxquad.models import TransferFunction

from ._page import Cell, Table


_BOUNDS = (20.0, 10.0)  # %, of Cramer-Rao bound and insensitivity (Tischler & Remple, sec. 11.1)
_CORRELATED = 0.9
_DASH = "\u2013"


def parameter_section(
    fit: Fit, derived: Sequence[Combination], beside: Mapping[str, str]
) -> dict[str, object]:
    """Every number with its standard error, and how good the fit is."""
    units = fit.parameter_units
    heads = ("parameter", *(["unit"] if units else []), "value", "std. error", "95 % interval")
    heads += ("by noise alone", "width") if fit.discrepancy is not None else ()
    heads += ("CR, %", "insensitivity, %")
    heads += () if fit.identifiable else ("stopped at",)
    rows = [_parameter(fit, k) for k in range(len(fit.names))]
    rows += [[*_estimate(each), *[_DASH] * (len(heads) - 4 - bool(units))] for each in derived]
    if units:
        rows = _with_units(rows, [*units, *(each.unit or _DASH for each in derived)])
    rows += [_tied(fit, each, len(heads)) for each in fit.tied]
    return {
        "table": Table("Identified parameters", heads, rows),
        "bounds": [f"{bound:g}" for bound in _BOUNDS],
        "is_marked": not fit.identifiable,
        "factors": _factored(fit),
        "facts": _quality(fit),
        "correlation": _correlation(fit),
        "text": str(fit),
        "beside": [{"title": title, "text": text} for title, text in beside.items()],
    }


def _parameter(fit: Fit, k: int) -> list[str | Cell]:
    name = fit.names[k]
    value, error = float(fit.values[k]), float(fit.standard_errors[k])
    low, high = fit.interval(name)
    cells = [*_estimate(Combination(name, value, error))[:-1], f"{low:.5g} .. {high:.5g}"]
    stopped = [] if fit.identifiable else [""]
    if not fit.determined[k]:
        stopped = [cells[1]]
        cells = [Cell(f"{name} *"), "", cells[2], "not determined"]
    percents = zip((fit.cramer_rao[k], fit.insensitivity[k]), _BOUNDS, strict=True)
    shares = [_marked(f"{x:.2f}" if np.isfinite(x) else "", bool(x > most)) for x, most in percents]
    return [*cells, *_by_noise(fit, k), *shares, *stopped]


def _tied(fit: Fit, tied: Tied, columns: int) -> list[str | Cell]:
    """A row of a parameter that follows from others."""
    low, high = tied.interval()
    name = f"{tied.name}, tied to {', '.join(tied.follows) or 'fixed numbers'}"
    cells = [Cell(name), *([_DASH] if fit.parameter_units else []), f"{tied.value:.5g}"]
    cells += [f"{tied.standard_error:.2g}", f"{low:.5g} .. {high:.5g}"]
    if not tied.determined:
        cells[-3:] = ["", cells[-2], "not determined"]
    return [*cells, *[_DASH] * (columns - len(cells))]


def _by_noise(fit: Fit, k: int) -> list[str]:
    if fit.discrepancy is None:
        return []
    if not fit.determined[k]:
        return ["", ""]
    low, high = fit.interval(fit.names[k], model_error=False)
    return [f"{low:.5g} .. {high:.5g}", fit.discrepancy.widths[k]]


def _estimate(one: Combination) -> list[str | Cell]:
    low, high = one.interval
    interval = f"{low:.5g} .. {high:.5g}"
    return [Cell(one.name), f"{one.value:.5g}", f"{one.standard_error:.2g}", interval]


def _marked(text: str, beyond: bool) -> str | Cell:
    return Cell(text, high=True) if beyond else text


def _factored(fit: Fit) -> str:
    """Poles and zeros, where the model has them."""
    if not isinstance(fit.model, TransferFunction):
        return ""
    try:
        return str(factors(fit))
    except UndeterminedError as error:
        return str(error)


def _quality(fit: Fit) -> dict[str, str]:
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
    return facts


def count_starts(starts: Sequence[int]) -> str:
    """How many starts led to how many different optima: "3 starts, 1 optimum"."""
    total, found = sum(starts), len(starts)
    return f"{total} start{'s' * (total > 1)}, {found} optim{'a' if found > 1 else 'um'}"


def _correlation(fit: Fit) -> Table | None:
    known = np.flatnonzero(fit.determined).tolist()
    if len(known) < 2:
        return None
    matrix = fit.correlation
    rows = [
        [Cell(fit.names[k]), *(_correlated(matrix[k, m], k == m) for m in known)] for k in known
    ]
    title = f"Correlation of the estimates (bold from {_CORRELATED:g})"
    return Table(title, ["", *(Cell(fit.names[k]) for k in known)], rows)


def _correlated(value: float, same: bool) -> str | Cell:
    return "1" if same else _marked(f"{value:.2f}", bool(abs(value) >= _CORRELATED))


def identifiability_section(fit: Fit) -> dict[str, object]:
    """What the record determines, and what to do about the rest."""
    none: dict[str, object] = {
        "lost": [], "texts": [], "combinations": None, "directions": None, "remedies": []
    }  # fmt: skip
    verdict = fit.verdict
    bounds = [f"{bound}." for bound in verdict.bounds]
    if fit.identifiable:
        return none | {"texts": [_least_sharp(fit), *bounds]}
    remedies = [f"{text[:1].upper()}{text[1:]}." for text in verdict.remedies]
    if verdict.kind != "not identifiable":
        return none | {"texts": [f"{verdict.summary}."], "remedies": remedies}
    texts = [] if fit.combinations else ["No combination of them is determined either."]
    return {
        "lost": verdict.undetermined,
        "texts": [*texts, *(f"{reason}." for reason in verdict.reasons), *bounds],
        "combinations": _combinations(fit),
        "directions": _directions(fit),
        "remedies": remedies,
    }


def _least_sharp(fit: Fit) -> str:
    text = "The record determines every free parameter individually."
    known = [k for k, value in enumerate(fit.values) if value != 0]
    if not known:
        return text
    share, k = max((float(abs(fit.standard_errors[k] / fit.values[k])), k) for k in known)
    worst = f"The least accurate is {fit.names[k]}: its standard error is {100 * share:.2g} %"
    return f"{text} {worst} of its value."


def _combinations(fit: Fit) -> Table | None:
    if not fit.combinations:
        return None
    heads = ("combination", "value", "std. error", "95 % interval")
    rows = [_estimate(each) for each in fit.combinations]
    if fit.parameter_units:
        heads = ("combination", "unit", *heads[1:])
        rows = _with_units(rows, [each.unit or _DASH for each in fit.combinations])
    return Table("Combinations that are determined", heads, rows)


def _with_units(rows: Sequence[list[str | Cell]], units: Sequence[str]) -> list[list[str | Cell]]:
    """Rows with a unit behind each name."""
    return [[name, each, *rest] for (name, *rest), each in zip(rows, units, strict=True)]


def _directions(fit: Fit) -> Table | None:
    directions = fit.verdict.null_directions
    if not directions:
        return None
    names = list(dict.fromkeys(name for each in directions for name in each))
    rows = [
        [f"direction {k}", *(f"{each[n]:+.3f}" if n in each else _DASH for n in names)]
        for k, each in enumerate(directions, start=1)
    ]
    title = "Null directions: relative changes that leave the responses as they are"
    return Table(title, ["", *map(Cell, names)], rows)


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
    rows += [[name, *_cells(fit, derived)] for name, fit in fits.items()]
    whole = [row for row in rows if len(row) == len(rows[0])]
    widths = [max(map(len, column)) for column in zip(*whole, strict=True)]
    widths[0] = max(len(row[0]) for row in rows)
    lines = [
        "   ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=False))
        for row in rows
    ]
    return "\n".join(line.rstrip() for line in lines) + "\n(+- one standard error)"


def _cells(fit: Fit | None, derived: Mapping[str, Quantity]) -> list[str]:
    if fit is None:
        return ["the fit diverged"]
    if not fit.verdict.fitted:
        return ["not identifiable"]
    numbers = zip(fit.determined, fit.values, fit.standard_errors, strict=True)
    cells = [
        _plus_minus(value, error) if determined else "not determined"
        for determined, value, error in numbers
    ]
    cells += [_derived(fit, quantity, name) for name, quantity in derived.items()]
    return [*cells, f"{fit.chi_squared**0.5:.2f}"]


def _derived(fit: Fit, quantity: Quantity, name: str) -> str:
    try:
        found = fit.derived(quantity, name)
    except UndeterminedError:
        return "not determined"
    return _plus_minus(found.value, found.standard_error)


def _plus_minus(value: float, error: float) -> str:
    """With the digits that the error supports, two of its own: `284 +- 15`, `0.0164 +- 0.0022`."""
    if not (np.isfinite(error) and error > 0):
        return f"{value:.5g} +- {error:.2g}"
    last = 1 - int(np.floor(np.log10(float(f"{error:.1e}"))))  # decimal that is shown
    if not 0 <= last <= 6:
        return f"{value:.{max(_digits(value) + last, 1)}g} +- {error:.2g}"
    return f"{value:.{last}f} +- {error:.{last}f}"


def _digits(value: float) -> int:
    """Before the decimal point; negative for zeros behind it."""
    return 1 + int(np.floor(np.log10(abs(value)))) if value else 1
