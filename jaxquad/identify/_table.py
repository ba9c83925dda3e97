"""The printed face of a fit."""

from typing import Any

import numpy as np

from ._remarks import FEWER


_SHOWN = 6  # stops of several starts


def fit_table(fit: Any) -> str:
    """Identifiability first, then the table of parameters, then how good the fit is."""
    lines = [*_verdict(fit), *_parameters(fit), _quality(fit), *_minima(fit)]
    return "\n".join(lines + [f"! {remark}" for remark in fit.remarks])


def _verdict(fit: Any) -> list[str]:
    if fit.identifiable:
        return []
    lost = fit.identifiability.undetermined
    lines = [f"NOT IDENTIFIABLE from this record, each by itself: {', '.join(lost)}"]
    if fit.combinations:
        known = " and ".join(combination.name for combination in fit.combinations)
        apart = all(name in lost for row in fit.null_directions for name in row)
        only = "only " if apart else ""  # else a parameter in it is determined by itself, too
        lines.append(f"  {only}{known} is determined by this record")
    elif fit.identifiability.curved:
        curved = ", ".join(fit.identifiability.curved)
        lines.append(f"  what it determines of {curved} is neither a product nor a sum of them")
    else:
        lines.append("  nothing about them is determined by this record")
    lines += [f"    {combination}" for combination in fit.combinations]
    for direction in fit.null_directions:
        parts = ", ".join(f"{share:+.3f} {name}" for name, share in direction.items())
        lines.append(f"  null direction (relative changes that change nothing): {parts}")
    if not any("ran to" in remark or FEWER in remark for remark in fit.remarks):
        lines += _remedies(lost)
    return lines


def _remedies(lost: tuple[str, ...]) -> list[str]:
    names = " or ".join(lost)
    return [
        f"  to resolve it: fix {names} at a measured value (leave it out of free=); or give what a",
        "  data sheet or a static test says of them, jq.Prior(name or function, value, std.err.);",
        f"  or fit a second record under a known change of {names} (conditions=)",
    ]


def _parameters(fit: Any) -> list[str]:
    width = max(9, *(len(name) for name in fit.names))
    heads = (f"{'parameter':<{width}}", f"{'value':>11}", f"{'std.err.':>10}")
    lines = [" ".join([*heads, f"{'95 % interval':>25}", f"{'CR %':>7}", f"{'I %':>7}"])]
    for k, name in enumerate(fit.names):
        cells = [f"{'-':>11}", f"{'-':>10}", f"{'not determined':>25}", f"{'-':>7}", f"{'-':>7}"]
        if name not in fit.identifiability.undetermined:
            low, high = fit.interval(name)
            cells = [f"{fit.values[k]:11.5g}", f"{fit.standard_errors[k]:10.2g}"]
            cells += [f"{f'{low:.5g} .. {high:.5g}':>25}"]
            cells += [f"{fit.cramer_rao[k]:7.2f}", f"{fit.insensitivity[k]:7.2f}"]
        lines.append(" ".join([f"{name:<{width}}", *cells]))
    return lines


def _minima(fit: Any) -> list[str]:
    """Where the starts led, if there were several."""
    if not fit.minima:
        return []
    starts = sum(len(point.starts) for point in fit.minima)
    lines = [f"{starts} starts led to {len(fit.minima)} points:"]
    for point in fit.minima[:_SHOWN]:
        values = ", ".join(f"{value:.4g}" for value in point.values)
        lines.append(f"  cost {point.cost:9.4g} from {len(point.starts)}: {point.kind}; {values}")
    rest = len(fit.minima) - _SHOWN
    return lines + ([f"  and {rest} more of higher cost"] if rest > 0 else [])


def _quality(fit: Any) -> str:
    condition = f"{fit.condition:.3g}" if fit.condition < 1e6 else "singular"
    return (
        f"cost {fit.cost:.4g} (average {fit.average_cost:.4g}), misfit / random error "
        f"{np.sqrt(fit.chi_squared):.2f}, {fit.points} points, condition {condition}, "
        f"Newton decrement {fit.newton_decrement:.1e}, {fit.steps} steps"
    )
