"""A fit as a table for a report."""

import functools as ft
from typing import TYPE_CHECKING

import numpy as np

from ..uncertainty._discrepancy import SHARES


if TYPE_CHECKING:
    from ._result import Fit


_SHOWN = 6  # optima of several starts
_MARK = " *"  # behind the name of a parameter that is not determined
_NO_PERCENTS = f"{'-':>7} {'-':>9}"
_BY_NOISE = f"{'by noise alone':>23} {'width':>6}"
_NOT_DETERMINED = {
    "no minimum": "not determined, because the fit found no minimum",
    "no model": "not determined, because no model of this structure holds",
}


def counted(number: int, one: str, many: str = "") -> str:
    """`1 start`, `2 starts`."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def parameter_lines(fit: "Fit") -> list[str]:
    """The parameters with their errors and intervals, and what the marks mean."""
    rows, discrepancy = [], fit.discrepancy
    for k, name in enumerate(fit.names):
        percents = _NO_PERCENTS
        if np.isfinite(fit.insensitivity[k]):
            percents = f"{fit.cramer_rao[k]:7.2f} {fit.insensitivity[k]:9.2f}"
        unit = fit.parameter_units[k] if fit.parameter_units else ""
        width = "" if discrepancy is None else discrepancy.widths[k]
        numbers = fit.values[k], fit.standard_errors[k], ft.partial(fit.interval, name)
        rows.append((name, unit, *numbers, width, percents, bool(fit.determined[k])))
    for tied in fit.tied:
        numbers = tied.value, tied.standard_error, tied.interval
        rows.append((tied.name, "", *numbers, "tied", _NO_PERCENTS, tied.determined))
    labels = [row[0] if row[-1] else f"{row[0]}{_MARK}" for row in rows]
    width, wide = max(9, *map(len, labels)), max(len(row[1]) for row in rows)
    pad = lambda text: [f"{text:<{max(4, wide)}}"] if wide else []
    heads = [f"{'parameter':<{width}}", *pad("unit"), f"{'value':>11}", f"{'std. error':>10}"]
    heads += [f"{'95 % interval':>23}", *([_BY_NOISE] if discrepancy is not None else [])]
    heads += [f"{'CR %':>7}", f"{'insens. %':>9}"]
    lines = [" ".join([*heads, *([] if fit.identifiable else [f"{'stopped at':>11}"])])]
    between = lambda ends: f"{ends[0]:.5g} .. {ends[1]:.5g}"
    for label, (_, unit, value, error, interval, source, percents, determined) in zip(
        labels, rows, strict=True
    ):
        shown, ends, stopped = f"{value:.5g}", between(interval()), ""
        by_noise = f"{between(interval(model_error=False)):>23} {source:>6}"
        if not determined:
            shown, ends, stopped = "-", "not determined", shown
            by_noise = " " * len(_BY_NOISE)
        cells = [f"{label:<{width}}", *pad(unit), f"{shown:>11}", f"{error:10.2g}"]
        cells += [f"{ends:>23}", *([by_noise] if discrepancy is not None else [])]
        lines.append(" ".join([*cells, percents, f"{stopped:>11}"]).rstrip())
    if fit.tied:
        ties = (f"{t.name} to {', '.join(t.follows) or 'fixed numbers'}" for t in fit.tied)
        lines.append(f"tied: {'; '.join(ties)}")
    if discrepancy is not None:
        size, degrees = 100 * SHARES[0] * discrepancy.amplitude, np.degrees(discrepancy.amplitude)
        none = f" (probability of none: {100 * discrepancy.none:.0f} %)"
        lines.append(
            f"95 % intervals count model error: {size:.2g} % of magnitude, {degrees:.2g} deg of "
            f"phase{none if discrepancy.none > 0.05 else ''}"
        )
        if "prior" in discrepancy.widths:
            lines.append(
                "width prior: the record cannot show this error; it is that of usual models"
            )
    if not fit.identifiable:
        individually = "this record does not determine it individually"
        why = _NOT_DETERMINED.get(fit.verdict.kind, individually)
        lines.append(f"* {why}: where the solver stopped is for comparison alone")
    return lines


def quality_lines(fit: "Fit") -> list[str]:
    """How good the fit is, and the optima at which the starts ended, if there were several."""
    condition = f"{fit.condition:.3g}" if fit.condition < 1e6 else "singular"
    lines = [
        f"cost {fit.cost:.4g} (average {fit.average_cost:.4g}), misfit / random error "
        f"{np.sqrt(fit.chi_squared):.2f}, {fit.points} points, condition {condition}, "
        f"Newton decrement {fit.newton_decrement:.1e}, {counted(fit.steps, 'step')}"
    ]
    if fit.minima:
        starts = counted(sum(len(point.starts) for point in fit.minima), "start")
        lines.append(f"{starts}, {counted(len(fit.minima), 'optimum', 'optima')}:")
    for point in fit.minima[:_SHOWN]:
        values = ", ".join(f"{value:.4g}" for value in point.values)
        lines.append(f"  cost {point.cost:9.4g} from {len(point.starts)}: {point.kind}; {values}")
    rest = len(fit.minima) - _SHOWN
    return lines + ([f"  and {rest} more of higher cost"] if rest > 0 else [])
