from collections.abc import Callable, Mapping
from typing import Any

from jaxtyping import Array, Float

from jaxquad.identify import Fit, UndeterminedError


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
        return _plus_minus(*fit.derived(quantity, name)[1:])
    except UndeterminedError:
        return "not determined"


def _plus_minus(value: float, error: float) -> str:
    return f"{value:.5g} +- {error:.2g}"
