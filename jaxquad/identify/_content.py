"""A fit as the mapping that `result.json` stores."""

from jaxtyping import PyTree

from ._discrepancy import Discrepancy


def fit_content(fit: PyTree) -> dict[str, object]:
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
        "combinations": [
            combination._asdict() | {"interval_95": combination.interval}
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


def _parameter(fit: PyTree, k: int) -> dict[str, object]:
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


def _discrepancy(found: Discrepancy) -> dict[str, object]:
    return {
        "amplitude_rad": found.amplitude,
        "length_ln_omega": found.length,
        "probability_of_none": found.none,
    }
