"""Several models beside one record."""

from collections.abc import Mapping, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import PyTree

from jaxquad.records import Record

from ._verify import Fitted, predict, Verification, verify


class Comparison(eqx.Module):
    """How well each of several models predicts one record; prints as a table.

    `jq.plot.compare` draws it. `checks[name].simulated` is what a model predicts.
    """

    checks: dict[str, Verification]  # by the models' names
    source: str = eqx.field(static=True)  # of the record
    # Models whose simulation diverges: all are then predicted, one sample ahead.
    diverging: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def fit_percent(self) -> dict[str, float]:
        """100 (1 - |difference| / |measured - mean|) of each model, over all outputs."""
        return {name: check.fit_percent for name, check in self.checks.items()}

    @property
    def best(self) -> str:
        """The name of the model that predicts the record best."""
        return max(self.fit_percent, key=lambda name: np.nan_to_num(self.fit_percent[name]))

    def __str__(self) -> str:
        heads = ("model", "output", "fit %", "accounted for %", "TIC", "rms difference")
        rows: list[tuple[str, ...]] = [heads]
        for name, check in self.checks.items():
            for one in check.outputs:
                numbers = (f"{one.fit_percent:.1f}", f"{one.variance_percent:.1f}")
                numbers = (*numbers, f"{one.tic:.3f}", f"{one.rms:.4g} {one.unit}".rstrip())
                rows.append((name, one.name, *numbers))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        texts = lambda row: [f"{c:<{w}}" for c, w in zip(row[:2], widths, strict=False)]
        numbers = lambda row: [f"{c:>{w}}" for c, w in zip(row[2:], widths[2:], strict=True)]
        lines = ["  ".join([*texts(row), *numbers(row)]).rstrip() for row in rows]
        lines.append("(TIC: Theil inequality coefficient, good below 0.25)")
        if self.diverging:
            names, check = ", ".join(self.diverging), next(iter(self.checks.values()))
            lines.append(f"(all {check.method}: the simulation of {names} diverges)")
        return "\n".join(lines)


def compare(
    models: PyTree | Mapping[str, PyTree] | Sequence[PyTree],
    record: Record,
    *,
    band: tuple[float, float] | None = None,
    hold: str | None = None,
) -> Comparison:
    """Simulate models on a record that none of them was fitted to, and compare them.

    !!! example

        ```python
        print(jq.compare({"with lag": one, "without": other}, second_flight))
        ```

    Where the simulation of one diverges, all are predicted one sample ahead (`jq.predict`).

    **Arguments:**

    - `models`: by name, or a list, or one: models as `jq.verify` takes them, or fits.
    - `record`: with their inputs and outputs.
    - `band`, `hold`: as in `jq.verify`.

    **Raises:** what `jq.verify` raises; ValueError for no model, and for a fit that found none.
    """
    if isinstance(models, Mapping):
        named = {str(name): model for name, model in models.items()}
    elif isinstance(models, list | tuple):
        named = {f"model {k}": model for k, model in enumerate(models, start=1)}
    else:
        named = {"model": models}
    if not named:
        raise ValueError("there is no model to compare: give one or more, by name")
    checks = {
        name: model(record, band=band, hold=hold)
        if isinstance(model, Fitted)
        else verify(model, record, band=band, hold=hold)
        for name, model in named.items()
    }
    diverging = tuple(name for name, check in checks.items() if check.prediction)
    # A prediction knows later outputs than a simulation: all models have to know the same ones.
    # Inputs of a closed loop answer to disturbances: only one step ahead is the true model best.
    for name, model in named.items() if diverging else ():
        checks[name] = predict(model, record, band=checks[name].band, hold=hold)
    return Comparison(checks, record.source, diverging)
