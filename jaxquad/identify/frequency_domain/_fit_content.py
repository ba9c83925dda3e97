"""A fit as text, and as the content of `result.json`."""

from typing import NamedTuple, TYPE_CHECKING

import numpy as np

from ..uncertainty._error_budget import SHARES


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


def fit_table(fit: "Fit") -> str:
    """The verdict where it is a refusal, the table of parameters, and how good the fit is."""
    lines = [] if fit.identifiable else [str(fit.verdict)]
    if fit.verdict.fitted:
        lines += [*_parameter_lines(fit), *_quality_lines(fit)]
    return "\n".join(lines + [f"! {remark}" for remark in fit.remarks])


def counted(number: int, one: str, many: str = "") -> str:
    """`1 start`, `2 starts`."""
    return f"{number} {one if number == 1 else many or one + 's'}"


class _Row(NamedTuple):
    """A parameter in the table."""

    name: str
    unit: str
    value: float
    error: float
    interval: tuple[float, float]
    noise_interval: tuple[float, float]
    width: str  # what makes the interval as wide as it is
    percents: str  # Cramer-Rao bound and insensitivity
    determined: bool

    @property
    def label(self) -> str:
        return self.name if self.determined else f"{self.name}{_MARK}"


def _parameter_lines(fit: "Fit") -> list[str]:
    rows, discrepancy = [], fit.discrepancy
    units = fit.parameter_units or ("",) * len(fit.names)
    for k, (name, unit) in enumerate(zip(fit.names, units, strict=True)):
        bounds, percents = (fit.cramer_rao[k], fit.insensitivity[k]), _NO_PERCENTS
        if np.isfinite(bounds[1]):
            percents = f"{bounds[0]:7.2f} {bounds[1]:9.2f}"
        intervals = fit.interval(name), fit.interval(name, model_error=False)
        width = "" if discrepancy is None else discrepancy.widths[k]
        numbers = (fit.values[k], fit.standard_errors[k], *intervals)
        rows.append(_Row(name, unit, *numbers, width, percents, bool(fit.determined[k])))
    for tied in fit.tied:
        intervals = tied.interval(), tied.interval(model_error=False)
        numbers = (tied.value, tied.standard_error, *intervals)
        rows.append(_Row(tied.name, "", *numbers, "tied", _NO_PERCENTS, tied.determined))
    width = max(9, *(len(row.label) for row in rows))
    wide = max(len(row.unit) for row in rows)
    pad = lambda text: [f"{text:<{max(4, wide)}}"] if wide else []
    heads = [f"{'parameter':<{width}}", *pad("unit"), f"{'value':>11}", f"{'std. error':>10}"]
    heads += [f"{'95 % interval':>23}", *([_BY_NOISE] if discrepancy is not None else [])]
    heads += [f"{'CR %':>7}", f"{'insens. %':>9}"]
    lines = [" ".join([*heads, *([] if fit.identifiable else [f"{'stopped at':>11}"])])]
    between = lambda ends: f"{ends[0]:.5g} .. {ends[1]:.5g}"
    for row in rows:
        value, interval, stopped = f"{row.value:.5g}", between(row.interval), ""
        by_noise = f"{between(row.noise_interval):>23} {row.width:>6}"
        if not row.determined:
            value, interval, stopped = "-", "not determined", value
            by_noise = " " * len(_BY_NOISE)
        cells = [f"{row.label:<{width}}", *pad(row.unit), f"{value:>11}", f"{row.error:10.2g}"]
        cells += [f"{interval:>23}", *([by_noise] if discrepancy is not None else [])]
        lines.append(" ".join([*cells, row.percents, f"{stopped:>11}"]).rstrip())
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


def _quality_lines(fit: "Fit") -> list[str]:
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


def fit_content(fit: "Fit") -> dict[str, object]:
    """The verdict of a fit, and the numbers where something was fitted."""
    verdict, discrepancy = fit.verdict, fit.discrepancy
    content: dict[str, object] = {
        "identifiable": fit.identifiable,
        "verdict": {
            "kind": verdict.kind,
            "summary": verdict.summary,
            "undetermined": verdict.undetermined,
            "reasons": verdict.reasons,
            "remedies": verdict.remedies,
            "bounds": [bound._asdict() for bound in verdict.bounds],
        },
        "remarks": fit.remarks,
    }
    if not verdict.fitted:
        return content
    parameters = [
        {
            "name": name,
            "unit": fit.parameter_units[k] if fit.parameter_units else None,
            "value": fit.values[k],
            "standard_error": fit.standard_errors[k],
            "determined": bool(fit.determined[k]),
            "interval_95": fit.interval(name),
            "noise_standard_error": fit.noise_standard_errors[k],
            "noise_interval_95": fit.interval(name, model_error=False),
            "width": None if discrepancy is None else discrepancy.widths[k],
            "cramer_rao_percent": fit.cramer_rao[k],
            "insensitivity_percent": fit.insensitivity[k],
        }
        for k, name in enumerate(fit.names)
    ]
    ties = [
        {
            "name": tied.name,
            "tied_to": tied.follows,
            "value": tied.value,
            "standard_error": tied.standard_error,
            "determined": tied.determined,
            "interval_95": tied.interval(),
            "noise_standard_error": tied.noise_standard_error,
            "noise_interval_95": tied.interval(model_error=False),
        }
        for tied in fit.tied
    ]
    size = None
    if discrepancy is not None:
        size = {
            "amplitude_rad": discrepancy.amplitude,
            "length_ln_omega": discrepancy.length,
            "probability_of_none": discrepancy.none,
        }
    return {
        **content,
        "parameters": parameters,
        "tied": ties,
        "combinations": [
            combination.content() | {"interval_95": combination.interval}
            for combination in fit.combinations
        ],
        "null_directions": verdict.null_directions,
        "covariance": fit.covariance,
        "noise_covariance": fit.noise_covariance,
        "discrepancy": size,
        "cost": fit.cost,
        "average_cost": fit.average_cost,
        "chi_squared": fit.chi_squared,
        "condition": fit.condition,
        "newton_decrement": fit.newton_decrement,
        "points": fit.points,
        "steps": fit.steps,
    }
