"""A fit as text, and as the content of `result.json`."""

from collections.abc import Sequence
from typing import NamedTuple, TYPE_CHECKING

import numpy as np

from ..uncertainty._derived import Tied
from ..uncertainty._discrepancy import Discrepancy, SHARES


if TYPE_CHECKING:
    from ._result import Fit


_SHOWN = 6  # optima of several starts


def fit_table(fit: "Fit") -> str:
    """The verdict where it is a refusal, the table of parameters, and how good the fit is."""
    lines = [] if fit.identifiable else [str(fit.verdict)]
    if fit.verdict.fitted:
        lines += [*_parameters(fit), _quality(fit), *_minima(fit)]
    return "\n".join(lines + [f"! {remark}" for remark in fit.remarks])


_MARK = " *"  # behind the name of a parameter that is not determined


class _Row(NamedTuple):
    """A parameter in the table."""

    name: str
    unit: str
    value: str
    error: str
    interval: str
    beside: str  # what the noise alone says
    percents: str  # Cramer-Rao bound and insensitivity
    determined: bool

    @property
    def label(self) -> str:
        return self.name if self.determined else f"{self.name}{_MARK}"


def _parameters(fit: "Fit") -> list[str]:
    tied = fit.tied
    rows = [*(_free(fit, k) for k in range(len(fit.names))), *(_of_tied(fit, t) for t in tied)]
    width = max(9, *(len(row.label) for row in rows))
    wide = max(len(row.unit) for row in rows)
    apart = fit.discrepancy is not None
    lines = [_heads(fit, width, wide)]
    for row in rows:
        value, interval, stopped = row.value, row.interval, ""
        if not row.determined:
            value, interval, stopped = "-", "not determined", row.value
        cells = [f"{row.unit:<{max(4, wide)}}"] if wide else []
        cells += [f"{value:>11}", row.error, f"{interval:>23}", *([row.beside] if apart else [])]
        lines.append(
            " ".join([f"{row.label:<{width}}", *cells, row.percents, f"{stopped:>11}"]).rstrip()
        )
    lines += _ties(tied)
    if apart:
        lines.append(_how_wide(fit))
    if not fit.identifiable:
        why = _NOT_DETERMINED.get(fit.verdict.kind, _INDIVIDUALLY)
        lines.append(f"* {why}: where the solver stopped is for comparison alone")
    return lines


def _heads(fit: "Fit", width: int, wide: int) -> str:
    heads = [f"{'parameter':<{width}}", *([f"{'unit':<{max(4, wide)}}"] if wide else [])]
    heads += [f"{'value':>11}", f"{'std. error':>10}", f"{'95 % interval':>23}"]
    heads += [_BESIDE] if fit.discrepancy is not None else []
    heads += [f"{'CR %':>7}", f"{'insens. %':>9}"]
    return " ".join([*heads, *([] if fit.identifiable else [f"{'stopped at':>11}"])])


def _free(fit: "Fit", k: int) -> _Row:
    low, high = fit.interval(fit.names[k])
    known = np.isfinite(fit.insensitivity[k])
    return _Row(
        fit.names[k],
        fit.parameter_units[k] if fit.parameter_units else "",
        f"{fit.values[k]:.5g}",
        f"{fit.standard_errors[k]:10.2g}",
        f"{low:.5g} .. {high:.5g}",
        _by_noise(fit, k),
        f"{fit.cramer_rao[k]:7.2f} {fit.insensitivity[k]:9.2f}" if known else _NO_PERCENTS,
        bool(fit.determined[k]),
    )


def _of_tied(fit: "Fit", tied: Tied) -> _Row:
    intervals = (tied.interval(), tied.interval(model_error=False))
    both, alone = (f"{low:.5g} .. {high:.5g}" for low, high in intervals)
    beside = f"{alone:>23} {'tied':>6}" if tied.determined else " " * len(_BESIDE)
    number = f"{tied.value:.5g}", f"{tied.standard_error:10.2g}"
    return _Row(tied.name, "", *number, both, beside, _NO_PERCENTS, tied.determined)


def _ties(tied: Sequence[Tied]) -> list[str]:
    """What each tied parameter follows."""
    texts = [f"{each.name} to {', '.join(each.follows) or 'fixed numbers'}" for each in tied]
    return [f"tied: {'; '.join(texts)}"] if texts else []


_NO_PERCENTS = f"{'-':>7} {'-':>9}"
_INDIVIDUALLY = "this record does not determine it individually"
_NOT_DETERMINED = {
    "no minimum": "not determined, because the fit found no minimum",
    "no model": "not determined, because no model of this structure holds",
}
_BESIDE = f"{'by noise alone':>23} {'width':>6}"


def _by_noise(fit: "Fit", k: int) -> str:
    """The interval by the noise alone, and what makes the other one as wide as it is."""
    if fit.discrepancy is None or not fit.determined[k]:
        return " " * len(_BESIDE)
    low, high = fit.interval(fit.names[k], model_error=False)
    return f"{f'{low:.5g} .. {high:.5g}':>23} {fit.discrepancy.widths[k]:>6}"


def _how_wide(fit: "Fit") -> str:
    """What the model leaves unexplained, and what the words under "width" mean."""
    found = fit.discrepancy
    if found is None:
        return ""
    size, degrees = 100 * SHARES[0] * found.amplitude, np.degrees(found.amplitude)
    text = f"95 % intervals count model error: {size:.2g} % of magnitude, {degrees:.2g} deg"
    text += " of phase"
    text += f" (probability of none: {100 * found.none:.0f} %)" if found.none > 0.05 else ""
    if "prior" in found.widths:
        text += "\nwidth prior: the record cannot show this error; it is that of usual models"
    return text


def counted(number: int, one: str, many: str = "") -> str:
    """`1 start`, `2 starts`."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def _minima(fit: "Fit") -> list[str]:
    """The optima at which the starts ended, if there were several."""
    if not fit.minima:
        return []
    starts = sum(len(point.starts) for point in fit.minima)
    lines = [f"{counted(starts, 'start')}, {counted(len(fit.minima), 'optimum', 'optima')}:"]
    for point in fit.minima[:_SHOWN]:
        values = ", ".join(f"{value:.4g}" for value in point.values)
        lines.append(f"  cost {point.cost:9.4g} from {len(point.starts)}: {point.kind}; {values}")
    rest = len(fit.minima) - _SHOWN
    return lines + ([f"  and {rest} more of higher cost"] if rest > 0 else [])


def _quality(fit: "Fit") -> str:
    condition = f"{fit.condition:.3g}" if fit.condition < 1e6 else "singular"
    return (
        f"cost {fit.cost:.4g} (average {fit.average_cost:.4g}), misfit / random error "
        f"{np.sqrt(fit.chi_squared):.2f}, {fit.points} points, condition {condition}, "
        f"Newton decrement {fit.newton_decrement:.1e}, {counted(fit.steps, 'step')}"
    )


def fit_content(fit: "Fit") -> dict[str, object]:
    """The verdict of a fit, and the numbers where something was fitted."""
    verdict = {
        "kind": fit.verdict.kind,
        "summary": fit.verdict.summary,
        "undetermined": fit.verdict.undetermined,
        "reasons": fit.verdict.reasons,
        "remedies": fit.verdict.remedies,
        "bounds": [bound._asdict() for bound in fit.verdict.bounds],
    }
    known: dict[str, object] = {
        "identifiable": fit.identifiable,
        "verdict": verdict,
        "remarks": fit.remarks,
    }
    if not fit.verdict.fitted:
        return known
    return {
        **known,
        "parameters": [_parameter(fit, k) for k in range(len(fit.names))],
        "tied": [_tied_content(each) for each in fit.tied],
        "combinations": [
            combination.content() | {"interval_95": combination.interval}
            for combination in fit.combinations
        ],
        "null_directions": fit.verdict.null_directions,
        "covariance": fit.covariance,
        "noise_covariance": fit.noise_covariance,
        "discrepancy": None if fit.discrepancy is None else _discrepancy(fit.discrepancy),
        "cost": fit.cost,
        "average_cost": fit.average_cost,
        "chi_squared": fit.chi_squared,
        "condition": fit.condition,
        "newton_decrement": fit.newton_decrement,
        "points": fit.points,
        "steps": fit.steps,
    }


def _parameter(fit: "Fit", k: int) -> dict[str, object]:
    return {
        "name": fit.names[k],
        "unit": fit.parameter_units[k] if fit.parameter_units else None,
        "value": fit.values[k],
        "standard_error": fit.standard_errors[k],
        "determined": bool(fit.determined[k]),
        "interval_95": fit.interval(fit.names[k]),
        "noise_standard_error": fit.noise_standard_errors[k],
        "noise_interval_95": fit.interval(fit.names[k], model_error=False),
        "width": None if fit.discrepancy is None else fit.discrepancy.widths[k],
        "cramer_rao_percent": fit.cramer_rao[k],
        "insensitivity_percent": fit.insensitivity[k],
    }


def _tied_content(tied: Tied) -> dict[str, object]:
    return {
        "name": tied.name,
        "tied_to": tied.follows,
        "value": tied.value,
        "standard_error": tied.standard_error,
        "determined": tied.determined,
        "interval_95": tied.interval(),
        "noise_standard_error": tied.noise_standard_error,
        "noise_interval_95": tied.interval(model_error=False),
    }


def _discrepancy(found: Discrepancy) -> dict[str, object]:
    return {
        "amplitude_rad": found.amplitude,
        "length_ln_omega": found.length,
        "probability_of_none": found.none,
    }
