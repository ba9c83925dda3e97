"""Several models on one record."""

from collections.abc import Mapping, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import PyTree

from jaxquad.records import Record

from ..frequency_domain._result import Fit
from ._verify import Verification, verify


class Comparison(eqx.Module):
    """How well each of several models predicts one record; prints as a table.

    `jq.plot.compare` draws it. `checks[name].simulated` is what a model predicts.
    """

    checks: dict[str, Verification]  # by the models' names
    source: str = eqx.field(static=True)  # of the record

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
        return "\n".join(lines + ["(TIC: Theil inequality coefficient, good below 0.25)"])


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

    **Arguments:**

    - `models`: by name, or a list, or one: models as `jq.verify` takes them, or fits.
    - `record`: with their inputs and outputs.
    - `band`, `hold`: as in `jq.verify`.

    **Returns:** a `jq.identify.Comparison`.

    **Raises:** what `jq.verify` raises; ValueError for no model, and for a fit that found none.
    """
    named = named_models(models)
    if not named:
        raise ValueError("there is no model to compare: give one or more, by name")
    checks = {
        name: each(record, band=band, hold=hold)
        if isinstance(each, Fit)
        else verify(each, record, band=band, hold=hold)
        for name, each in named.items()
    }
    return Comparison(checks, record.source)


def named_models(models: PyTree) -> dict[str, PyTree]:
    """Models by name; `model 1`, `model 2` for those of a list."""
    if isinstance(models, Mapping):
        return {str(name): each for name, each in models.items()}
    if not isinstance(models, list | tuple):
        return {"model": models}
    return {f"model {k}": each for k, each in enumerate(models, start=1)}
