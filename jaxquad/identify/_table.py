"""The printed face of a fit."""

from typing import TYPE_CHECKING

import numpy as np


if TYPE_CHECKING:
    from ._result import Fit


def fit_table(fit: "Fit") -> str:
    """Identifiability first, then the table of parameters, then how good the fit is."""
    lines = [*_verdict(fit), *_parameters(fit), _quality(fit)]
    return "\n".join(lines + [f"! {remark}" for remark in fit.remarks])


def _verdict(fit: "Fit") -> list[str]:
    if fit.identifiable:
        return []
    lost = fit.identifiability.undetermined
    lines = [f"NOT IDENTIFIABLE one by one: {', '.join(lost)}"]
    known = ", ".join(combination.name for combination in fit.combinations)
    lines.append(f"  only {known} is determined by this record" if known else "  nothing about them is determined")
    lines += [f"    {combination}" for combination in fit.combinations]
    for direction in fit.null_directions:
        parts = " ".join(f"{share:+.3f} {name}" for name, share in direction.items())
        lines.append(f"  null direction (relative changes): {parts}")
    one, many = lost[0], " or ".join(lost)
    lines += [
        "  to resolve it: fix one of them at a measured value (leave it out of free=); or state what is",
        f"  known with jq.Prior(name, value, standard_error) on {many} or on a function of them",
        f"  (a static test); or fit a second record under a known change of {one} (conditions=)",
    ]
    return lines


def _parameters(fit: "Fit") -> list[str]:
    width = max(9, *(len(name) for name in fit.names))
    lines = [f"{'parameter':<{width}} {'value':>11} {'std.err.':>10} {'95 % interval':>25} {'CR %':>7} {'I %':>7}"]
    for k, name in enumerate(fit.names):
        if name in fit.identifiability.undetermined:
            lines.append(f"{name:<{width}} {'-':>11} {'-':>10} {'not determined':>25} {'-':>7} {fit.insensitivity[k]:7.2f}")
            continue
        low, high = fit.interval(name)
        span = f"{low:.5g} .. {high:.5g}"
        lines.append(
            f"{name:<{width}} {fit.values[k]:11.5g} {fit.standard_errors[k]:10.2g} {span:>25} "
            f"{fit.cramer_rao[k]:7.2f} {fit.insensitivity[k]:7.2f}"
        )
    return lines


def _quality(fit: "Fit") -> str:
    condition = f"{fit.condition:.3g}" if fit.condition < 1e6 else "singular"
    return (
        f"cost {fit.cost:.4g} (average {fit.average_cost:.4g}), misfit / random error "
        f"{np.sqrt(fit.chi_squared):.2f}, {fit.points} frequencies, condition {condition}, "
        f"Newton decrement {fit.newton_decrement:.1e}, {fit.steps} steps"
    )
