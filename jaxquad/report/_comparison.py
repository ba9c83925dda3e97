from collections.abc import Mapping
from typing import Any

from jaxquad.identify import Fit, NotIdentifiable


def comparison(
    fits: Mapping[str, Fit | NotIdentifiable], derived: Mapping[str, Any] | None = None
) -> str:
    """Fits of one model side by side, a row each: every number with its standard error.

    `derived` are further columns, functions of the model by name, for instance
    `{"lag + delay": lambda model: model.lag + model.delay}`.
    """
    names = next((fit.names for fit in fits.values() if isinstance(fit, Fit)), ())
    heads = [*names, *(derived or {}), "misfit / error"]
    rows = [["", *heads]] + [[name, *_cells(fit, derived or {})] for name, fit in fits.items()]
    widths = [
        max(len(row[k]) for row in rows if len(row) == len(rows[0])) for k in range(len(rows[0]))
    ]
    lines = [
        "   ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=False))
        for row in rows
    ]
    return "\n".join(line.rstrip() for line in lines)


def _cells(fit: Fit | NotIdentifiable, derived: Mapping[str, Any]) -> list[str]:
    if isinstance(fit, NotIdentifiable):
        return ["not identifiable"]
    numbers = zip(fit.names, fit.values, fit.standard_errors, strict=True)
    lost = fit.identifiability.undetermined
    cells = [
        "not determined" if name in lost else _plus_minus(value, error)
        for name, value, error in numbers
    ]
    cells += [_derived(fit, quantity, name) for name, quantity in derived.items()]
    return [*cells, f"{fit.chi_squared**0.5:.2f}"]


def _derived(fit: Fit, quantity: Any, name: str) -> str:
    try:
        return _plus_minus(*fit.derived(quantity, name)[1:])
    except NotIdentifiable:
        return "not determined"


def _plus_minus(value: float, error: float) -> str:
    return f"{value:.5g} +- {error:.2g}"
