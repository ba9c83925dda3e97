"""The field's shorthand: `K (a) / ((b) [zeta, omega])`, with standard errors."""

from typing import Any

import numpy as np


def factors_text(factors: Any) -> str:
    """`-7.03 +- 0.2 (2.89 +- 0.1) / ((89.1 +- 9) [0.626 +- 0.01, 6.11 +- 0.05])`."""
    above = [_factor(each) for each in factors.zeros]
    below = ["(0)"] * factors.integrators + [_factor(each) for each in factors.poles]
    lines = [" ".join([_number(*factors.gain[1:]), *above])]
    lines[0] += f" / ({' '.join(below)})" if below else ""
    if factors.delay.value != 0:
        lines[0] += f" exp(-({_number(*factors.delay[1:])}) s)"
    lines.append("(a) is s + a, [zeta, omega] is s^2 + 2 zeta omega s + omega^2, rad/s")
    if any(each.repeated for each in (*factors.zeros, *factors.poles)):
        lines.append("~ repeated within its error: it may split, and has no first-order error")
    return "\n".join(lines)


def _factor(factor: Any) -> str:
    pairs = zip(factor.values, factor.standard_errors, strict=True)
    if factor.repeated:
        inside = ", ".join(f"~{value:.4g}" for value in factor.values)
    else:
        inside = ", ".join(_number(*pair) for pair in pairs)
    return f"[{inside}]" if len(factor.values) > 1 else f"({inside})"


def _number(value: float, error: float) -> str:
    if np.isnan(value):
        return "not determined"
    return f"{value:.4g} +- {error:.2g}" if error else f"{value:.4g}"
