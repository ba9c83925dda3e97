"""Functions of a fitted model with their errors: any quantity, tied parameters, zeros and poles."""

from collections.abc import Callable
from typing import NamedTuple, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, PyTree

from jaxquad.models import TransferFunction

from ..frequency_domain._parameters import number_at, Parameters
from ._verdict import Combination, LIMIT, reach_of_interval, UndeterminedError, USUAL


if TYPE_CHECKING:
    from ..frequency_domain._result import Fit


_ROUNDING = 1e-12  # of a variance, to those that cancel in it
_CLOSE = 3.0  # standard errors between two roots, within which they count as repeated

Quantity = Callable[[PyTree], Float[Array, ""]]  # of a model


class Tied(NamedTuple):
    """A parameter that follows from others (`tied=`), with the error that theirs give it."""

    name: str
    value: float
    standard_error: float
    noise_standard_error: float  # by the measured noise alone
    degrees_of_freedom: float  # of the noise estimate behind the errors
    follows: tuple[str, ...]  # which free parameters; none where all it follows is fixed
    determined: bool  # by the record

    def interval(
        self, *, level: float | int = USUAL, model_error: bool = True
    ) -> tuple[float, float]:
        """As `Fit.interval`, without limits at zero."""
        error = self.standard_error if model_error else self.noise_standard_error
        reach = reach_of_interval(self.degrees_of_freedom, level) * error
        return self.value - reach, self.value + reach


class Propagated(NamedTuple):
    """A function of the model at the solution, to first order."""

    value: float
    slope: Float[np.ndarray, " parameters"]  # by relative changes of the free parameters
    is_open: bool  # whether it changes where the responses do not


def derive(fit: "Fit", quantity: Quantity, name: str, *, model_error: bool) -> Combination:
    """A quantity with its standard error, as `Fit.derived` says."""
    value, slope, is_open = propagate(fit, quantity)
    if is_open:
        lost = ", ".join(fit.verdict.undetermined)
        raise UndeterminedError(
            f"{name} depends on what this record does not determine ({lost}): «fit with a "
            "jq.identify.Prior or a second record, or ask for a determined combination»"
        )
    covariance = fit.relative_covariance if model_error else fit.relative_noise_covariance
    variance = float(slope @ covariance @ slope)
    if variance < _ROUNDING * float(np.abs(slope) @ np.abs(covariance) @ np.abs(slope)):
        raise UndeterminedError(
            f"the standard error of {name} is lost in the rounding of those of "
            f"{', '.join(fit.names)}, which are many times as large: fix one of them"
        )
    return Combination(name, value, float(np.sqrt(variance)), fit.freedom_of(slope))


def tied_parameters(fit: "Fit") -> tuple[Tied, ...]:
    """The tied parameters, in the order of `tied=`; none where nothing was fitted."""
    ties = []
    for place, _ in fit.parameters.ties if fit.verdict.fitted else ():
        value, slope, is_open = propagate(fit, number_at(place))
        parts = (fit.relative_covariance, fit.relative_noise_covariance)
        error, by_noise = (float(np.sqrt(max(slope @ part @ slope, 0.0))) for part in parts)
        sharp = fit.identifiable or error <= LIMIT * abs(value)
        follows = tuple(name for name, s in zip(fit.names, slope, strict=True) if s != 0)
        errors = (np.inf, np.inf) if is_open else (error, by_noise)
        freedom, determined = fit.freedom_of(slope), bool(sharp and not is_open)
        ties.append(Tied(place.name, value, *errors, freedom, follows, determined))
    return tuple(ties)


def propagate(fit: "Fit", quantity: Quantity) -> Propagated:
    """Value and slope of a quantity, and whether it is left open."""
    verdict, places = fit.verdict, (fit.values, *fit.verdict.alternatives)
    arguments = quantity, fit.parameters, fit.model
    try:
        value, *others = [_value_and_slope(*arguments, values) for values in places]
    except jax.errors.ConcretizationTypeError:  # a quantity that asks for numbers
        with jax.disable_jit():
            value, *others = [_value_and_slope(*arguments, values) for values in places]
    value, slope = float(value[0]), np.asarray(value[1]) * fit.units
    differs = any(abs(float(other) - value) > 1e-6 * abs(value) for other, _ in others)
    # Whether it changes where the responses do not.
    along_null = np.abs(verdict.exact @ slope) > 1e-6 * np.linalg.norm(slope)
    on_curved = [slope[fit.names.index(name)] != 0 for name in verdict.curved]
    return Propagated(value, slope, bool(differs or np.any(along_null) or any(on_curved)))


@eqx.filter_jit
def _value_and_slope(
    quantity: Quantity,
    parameters: Parameters,
    model: PyTree,
    values: Float[Array | np.ndarray, " parameters"],
) -> tuple[Float[Array, ""], Float[Array, " parameters"]]:
    def of_values(x: Float[Array, " parameters"]) -> Float[Array, ""]:
        value = quantity(parameters.replace(model, x))
        if jnp.shape(value):
            raise ValueError(
                "the quantity is an array: ask for each of its numbers, by a function of its own"
            )
        return value

    return jax.value_and_grad(of_values)(jnp.asarray(values))


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
        above = [_factor_text(factor) for factor in self.zeros]
        below = ["(0)"] * self.integrators + [_factor_text(factor) for factor in self.poles]
        lines = [" ".join([_number(*self.gain[1:3]), *above])]
        lines[0] += f" / ({' '.join(below)})" if below else ""
        if self.delay.value != 0:
            lines[0] += f" exp(-({_number(*self.delay[1:3])}) s)"
        lines.append(
            "(a) is s + a, [zeta, omega] is s^2 + 2 zeta omega s + omega^2, rad/s; +- one std. "
            "error"
        )
        if any(factor.repeated for factor in (*self.zeros, *self.poles)):
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

    def number(self, value: float, slope: Float[np.ndarray, " parameters"]) -> tuple[float, float]:
        """Value and error, or nan and infinity if the error is too large for a number."""
        error = self.error(slope)
        lost = not self.identifiable and not error <= LIMIT * abs(value)
        return (np.nan, np.inf) if lost else (value, error)


def factors(fit: "Fit") -> Factors:
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
    # Derivatives of the coefficients, free and tied, by the relative changes of the free ones.
    slopes = dict(zip(fit.names, np.diag(fit.units), strict=True))
    for place, _ in fit.parameters.ties:
        slopes[place.name] = propagate(fit, number_at(place)).slope
    none = np.zeros(len(fit.names))
    rows = lambda field, count: np.array(
        [slopes.get(f"{field}[{k}]", none) for k in range(count)]
    ).reshape(count, -1)
    d_above, d_below = rows("numerator", above.size), rows("denominator", below.size)
    gain_slope = d_above[0] / below[0] - above[0] / below[0] ** 2 * d_below[0]
    late = slopes.get("delay", none)
    # Poles that are fixed at 0.
    fixed = [c == 0 and f"denominator[{k}]" not in fit.names for k, c in enumerate(below)]
    integrators = len(fixed) if all(fixed) else fixed[::-1].index(False)
    left = below.size - integrators
    gain = *spread.number(float(above[0] / below[0]), gain_slope), fit.freedom_of(gain_slope)
    delay = *spread.number(float(model.delay), late), fit.freedom_of(late)
    return Factors(
        gain=Combination("gain", *gain),
        zeros=_factored(above, d_above, spread),
        poles=_factored(below[:left], d_below[:left], spread),
        integrators=integrators,
        delay=Combination("delay", *delay),
    )


def _factored(
    coefficients: Float[np.ndarray, " powers"],
    slopes: Float[np.ndarray, "powers parameters"],
    spread: _Spread,
) -> tuple[Factor, ...]:
    """The factors of one polynomial, slowest first."""
    roots = np.roots(coefficients).astype(complex)
    upper = sorted(np.flatnonzero(np.imag(roots) >= 0), key=lambda k: abs(roots[k]))
    powers = np.arange(coefficients.size - 1, -1, -1)
    factors = []
    for k in upper:
        steep = np.polyval(np.polyder(coefficients), roots[k])
        with np.errstate(all="ignore"):
            slope = -(roots[k] ** powers) @ slopes / steep
        factors.append(_factor(complex(roots[k]), np.delete(roots, k), slope, spread))
    return tuple(factors)


def _factor(
    root: complex,
    others: Complex[np.ndarray, " others"],
    slope: Complex[np.ndarray, " parameters"],
    spread: _Spread,
) -> Factor:
    size, real, imag = abs(root), np.real(slope), np.imag(slope)
    if root.imag == 0:
        pairs = [(-root.real, -real)]
    else:
        wider = (root.real * real + root.imag * imag) / size
        damping = -root.real / size
        pairs = [(damping, -(real + damping * wider) / size), (size, wider)]
    # Of another root so near that the sum and difference of the two are mixed up.
    distance = float(np.min(np.abs(others - root), initial=np.inf))
    repeated = distance <= 1e-6 * size or not np.all(np.isfinite(slope))
    if not repeated:
        error = np.hypot(spread.error(real), spread.error(imag))
        repeated = bool(distance < min(_CLOSE * error, LIMIT * size))
    if repeated:
        return Factor(root, tuple(v for v, _ in pairs), (np.nan,) * len(pairs), True)
    numbers = [spread.number(*pair) for pair in pairs]
    return Factor(root, tuple(v for v, _ in numbers), tuple(e for _, e in numbers))
