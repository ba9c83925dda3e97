from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import PyTree

from ._cost import Band, Range
from ._origin import free_again, Origin
from ._parameters import with_values
from ._problem import on_device


class Bands(NamedTuple):
    """One model fitted to the lower and to the upper half of the band; prints as a table.

    **Attributes:**

    - `whole`, `lower`, `upper`: each a `jq.identify.Fit`; the halves are None where the solver
      diverged.
    - `split`: the frequency between them, in rad/s.
    """

    whole: PyTree
    lower: PyTree
    upper: PyTree
    split: float

    def overlap(self, name: str) -> bool | None:
        """Whether the 95 % intervals of both halves overlap; None where one determines nothing."""
        halves = [each for each in (self.lower, self.upper) if _determines(each, name)]
        if len(halves) < 2:
            return None
        (low, high), (other_low, other_high) = (each.interval(name) for each in halves)
        return low <= other_high and other_low <= high

    def __str__(self) -> str:
        low, high = self.whole.origin.band
        heads = ("parameter", "whole band", f"{low:.3g} .. {self.split:.3g} rad/s")
        heads = (*heads, f"{self.split:.3g} .. {high:.3g} rad/s", "overlap")
        words = {True: "yes", False: "NO", None: "-"}
        rows: list[tuple[str, ...]] = [heads]
        for name in self.whole.names:
            cells = [_interval(each, name) for each in (self.whole, self.lower, self.upper)]
            rows.append((name, *cells, words[self.overlap(name)]))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(f"{c:<{w}}" for c, w in zip(row, widths, strict=True)) for row in rows]
        return "\n".join([line.rstrip() for line in lines] + [self._footnote()])

    def _footnote(self) -> str:
        hertz = self.split / (2 * np.pi)
        halves = f"the halves meet at {self.split:.3g} rad/s, {hertz:.3g} Hz"
        return f"(95 % intervals, with model error; {halves})"


def _determines(fit: PyTree, name: str) -> bool:
    if fit is None or not fit.verdict.fitted:
        return False
    return bool(fit.determined[fit.names.index(name)])


def _interval(fit: PyTree, name: str) -> str:
    if fit is None:
        return "the fit diverged"
    if not _determines(fit, name):
        return "not determined"
    low, high = fit.interval(name)
    return f"{low:.4g} .. {high:.4g}"


def require_origin(fit: PyTree) -> Origin:
    """The origin of a fit of `jq.fit`. Raise ValueError for any other."""
    if fit.origin is None or not fit.verdict.fitted:
        raise ValueError(
            "this fit cannot be made again: it is none of jq.fit, or nothing was fitted; fit the "
            "response with jq.fit first"
        )
    return fit.origin


def model_to_start_from(fit: PyTree) -> PyTree:
    """The fitted model; a parameter that came out as 0 starts at a small part of its size."""
    parameters, values = fit.parameters, np.asarray(fit.values)
    small = 0.05 * np.asarray(parameters.scale)[: values.size]
    places = parameters.places[: values.size]
    return on_device(with_values(fit.model, places, np.where(values == 0, small, values)))


def fit_bands(fit: PyTree) -> Bands:
    """Fit both halves of the band, as `Fit.bands` says."""
    origin = require_origin(fit)
    low, high = origin.band
    split = float(np.sqrt(low * high))
    lower, upper = (_fit_within(fit, origin, half) for half in ((low, split), (split, high)))
    return Bands(fit, lower, upper, split)


def _fit_within(fit: PyTree, origin: Origin, half: Range) -> PyTree:
    band = _within(origin, half)
    free = free_again(fit.parameters)
    options = origin.options._replace(free=free, starts=1, band=band)
    try:
        return origin.run(model_to_start_from(fit), origin.frfs, options)
    except ValueError:
        return None


def _within(origin: Origin, half: Range) -> Band:
    """The part of every pair's band that lies within `half`."""
    band = origin.options.band
    if not isinstance(band, Mapping):
        return half
    frf = origin.frfs[0]
    pairs = [(o, i) for o in frf.output_names for i in frf.input_names]
    return {pair: _common(band.get(pair, half), half) for pair in pairs}


def _common(one: Range | None, other: Range) -> Range | None:
    if one is None:
        return None
    low, high = max(one[0], other[0]), min(one[1], other[1])
    return (low, high) if low < high else None
