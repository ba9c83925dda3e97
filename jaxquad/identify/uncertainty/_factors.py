"""A fitted transfer function as gain, zeros and poles with their standard errors."""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from jaxquad.models import TransferFunction

from ..frequency_domain._parameters import number_at
from ..frequency_domain._result import Fit
from ._derived import propagate
from ._identifiability import LIMIT
from ._verdict import Combination, UndeterminedError


def _factors_text(factors: "Factors") -> str:
    """`-7.03 +- 0.2 (2.89 +- 0.1) / ((89.1 +- 9) [0.626 +- 0.01, 6.11 +- 0.05])`."""
    above = [_factor_text(each) for each in factors.zeros]
    below = ["(0)"] * factors.integrators + [_factor_text(each) for each in factors.poles]
    lines = [" ".join([_number(*factors.gain[1:3]), *above])]
    lines[0] += f" / ({' '.join(below)})" if below else ""
    if factors.delay.value != 0:
        lines[0] += f" exp(-({_number(*factors.delay[1:3])}) s)"
    lines.append(
        "(a) is s + a, [zeta, omega] is s^2 + 2 zeta omega s + omega^2, rad/s; +- one std. error"
    )
    if any(each.repeated for each in (*factors.zeros, *factors.poles)):
        lines.append(
            "~ repeated within its error: the roots may be two, and have no first-order error"
        )
    return "\n".join(lines)


def _factor_text(factor: "Factor") -> str:
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


_CLOSE = 3.0  # standard errors between two roots, within which they count as repeated


class Factor(NamedTuple):
    """`(s + a)` for a real root -a, or `s^2 + 2 zeta omega s + omega^2` for a pair.

    `values` are (a,) or (zeta, omega) with a and omega in rad/s, nan where the record does not
    determine them. A `repeated` root lies so near another one that it has no first-order error:
    its standard errors are nan.
    """

    root: complex  # rad/s; the upper one of a pair
    values: tuple[float, ...]
    standard_errors: tuple[float, ...]
    repeated: bool = False


class Factors(eqx.Module):
    """Gain, zeros, poles and delay; `str` is the field's shorthand, `gain (a) / [zeta, omega]`."""

    gain: Combination  # of the highest powers
    zeros: tuple[Factor, ...]
    poles: tuple[Factor, ...]
    integrators: int
    delay: Combination  # s; its error is 0 where it was fixed

    def __str__(self) -> str:
        return _factors_text(self)


class _Spread(NamedTuple):
    """What turns slopes by the parameters' relative changes into standard errors."""

    covariance: Float[np.ndarray, "parameters parameters"]
    exact: Float[np.ndarray, "null parameters"]
    identifiable: bool

    def error(self, slope: Float[np.ndarray, " parameters"]) -> float:
        """Infinite along a direction that changes nothing."""
        if np.any(np.abs(self.exact @ slope) > 1e-6 * np.linalg.norm(slope)):
            return np.inf
        return float(np.sqrt(max(slope @ self.covariance @ slope, 0.0)))

    def given(self, value: float, slope: Float[np.ndarray, " parameters"]) -> tuple[float, float]:
        """Value and error, or nan and infinity if the error is too large for a number."""
        error = self.error(slope)
        lost = not self.identifiable and not error <= LIMIT * abs(value)
        return (np.nan, np.inf) if lost else (value, error)


def factors(fit: Fit) -> Factors:
    """Gain, zeros and poles of a fitted transfer function, with standard errors.

    Errors are propagated to first order: a change dc_j of a coefficient of the polynomial P moves
    its root r by -r^j dc_j / P'(r).

    **Arguments:**

    - `fit`: a fit of a `jq.TransferFunction`, as of `jq.fit_transfer_function`.

    **Returns:**

    `jq.identify.Factors`.

    **Raises:**

    - `ValueError`: the model is no `jq.TransferFunction`.
    - `UndeterminedError`: no coefficient is determined.
    """
    model = fit.model
    if not isinstance(model, TransferFunction):
        raise ValueError(
            f"a {type(model).__name__} has no gain, zeros and poles: fit a jq.TransferFunction, "
            "for instance with jq.fit_transfer_function"
        )
    if not np.any(fit.determined):
        reasons = "; ".join(fit.verdict.reasons)
        advice = reasons or "fit fewer zeros and poles, or excite a wider band"
        raise UndeterminedError(f"no factors, for no coefficient is determined: {advice}")
    spread = _Spread(fit.relative_covariance, fit.verdict.exact, fit.identifiable)
    above, below = (np.asarray(c) for c in (model.numerator, model.denominator))
    known = _slopes_of_numbers(fit)
    gain_slope = (
        _slopes(known, "numerator", 1)[0] / below[0]
        - above[0] / below[0] ** 2 * (_slopes(known, "denominator", 1)[0])
    )
    late = _slopes(known, "delay", 1)[0]
    integrators = _integrators(fit, below)
    gain = *spread.given(float(above[0] / below[0]), gain_slope), fit.freedom_of(gain_slope)
    return Factors(
        gain=Combination("gain", *gain),
        zeros=_factored(above, _slopes(known, "numerator", above.size), spread),
        poles=_factored(
            below[: below.size - integrators],
            _slopes(known, "denominator", below.size - integrators),
            spread,
        ),
        integrators=integrators,
        delay=Combination("delay", *spread.given(float(model.delay), late), fit.freedom_of(late)),
    )


Slopes = Mapping[str, Float[np.ndarray, " parameters"]]


def _slopes_of_numbers(fit: Fit) -> Slopes:
    """Derivatives of free and tied numbers by the relative changes of the free ones."""
    free = dict(zip(fit.names, np.diag(fit.units), strict=True))
    ties = fit.parameters.ties
    return free | {place.name: propagate(fit, number_at(place)).slope for place, _ in ties}


def _slopes(known: Slopes, leaf: str, count: int) -> Float[np.ndarray, "coefficients parameters"]:
    """Of the coefficients in one field of the model."""
    rows = np.zeros((count, len(next(iter(known.values())))))
    for name, slope in known.items():
        where, _, index = name.partition("[")
        row = int(index.rstrip("]") or 0)
        if where == leaf and row < count:
            rows[row] = slope
    return rows


def _integrators(fit: Fit, below: Float[np.ndarray, " powers"]) -> int:
    """Poles that are fixed at 0."""
    fixed = [c == 0 and f"denominator[{k}]" not in fit.names for k, c in enumerate(below)]
    return len(fixed) if all(fixed) else fixed[::-1].index(False)


def _factored(
    coefficients: Float[np.ndarray, " powers"],
    slopes: Float[np.ndarray, "powers parameters"],
    spread: _Spread,
) -> tuple[Factor, ...]:
    """The factors of one polynomial, slowest first."""
    roots = np.roots(coefficients).astype(complex)
    upper = sorted(np.flatnonzero(np.imag(roots) >= 0), key=lambda k: abs(roots[k]))
    powers = np.arange(coefficients.size - 1, -1, -1)
    found = []
    for k in upper:
        steep = np.polyval(np.polyder(coefficients), roots[k])
        with np.errstate(all="ignore"):
            slope = -(roots[k] ** powers) @ slopes / steep
        repeated = _is_repeated(np.delete(roots, k), roots[k], slope, spread)
        found.append(_factor(complex(roots[k]), slope, repeated, spread))
    return tuple(found)


def _is_repeated(
    others: Complex[np.ndarray, " others"],
    root: complex,
    slope: Complex[np.ndarray, " parameters"],
    spread: _Spread,
) -> bool:
    """Whether another root lies so near that the sum and difference of the two are mixed up."""
    distance = float(np.min(np.abs(others - root), initial=np.inf))
    if distance <= 1e-6 * abs(root) or not np.all(np.isfinite(slope)):
        return True
    error = np.hypot(spread.error(np.real(slope)), spread.error(np.imag(slope)))
    return bool(distance < min(_CLOSE * error, LIMIT * abs(root)))


def _factor(
    root: complex, slope: Complex[np.ndarray, " parameters"], repeated: bool, spread: _Spread
) -> Factor:
    size, across, along = abs(root), np.real(slope), np.imag(slope)
    if root.imag == 0:
        pairs = [(-root.real, -across)]
    else:
        wider = (root.real * across + root.imag * along) / size
        damping = -root.real / size
        pairs = [(damping, -(across + damping * wider) / size), (size, wider)]
    if repeated:
        return Factor(root, tuple(v for v, _ in pairs), (np.nan,) * len(pairs), True)
    given = [spread.given(*pair) for pair in pairs]
    return Factor(root, tuple(v for v, _ in given), tuple(e for _, e in given))
