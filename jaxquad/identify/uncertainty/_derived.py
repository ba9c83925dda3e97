"""What follows from a fitted model, with its error: quantities, factors, curves, drawn models."""

import functools as ft
from collections.abc import Callable, Iterable
from typing import NamedTuple, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Complex, Float, Inexact, PyTree

from jaxquad._compile import hasty_options, Jit
from jaxquad._core import as_array, concrete_values
from jaxquad.models import (
    evaluate_response,
    require_sampled,
    simulate_linear,
    StateSpace,
    TransferFunction,
)

from ..frequency_domain._parameters import Parameters
from ..output_error._simulated import linear_model, sample_interval
from ._error_budget import Matrix
from ._verdict import Combination, LIMIT, NO_MINIMUM, reach_of_interval, UndeterminedError, USUAL


if TYPE_CHECKING:
    from ..frequency_domain._result import Fit


_ROUNDING = 1e-12  # of a variance, to those that cancel in it
_CLOSE = 3.0  # standard errors between two roots, within which they count as repeated
_CHANGE = 1e-5  # of a parameter: central differences are then exact to about 1e-10
_AT_ONCE = 512  # frequencies of a program, so that all curves of a model share it

Quantity = Callable[[PyTree], Float[Array, ""]]  # of a model
Vector = Float[np.ndarray, " parameters"]


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


def derive(fit: "Fit", quantity: Quantity, name: str, *, model_error: bool) -> Combination:
    """A quantity with its standard error, as `Fit.derived` says."""
    value, slope, is_open = _propagate(fit, quantity)
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
    error, rate = float(np.sqrt(variance)), slope / fit.units
    derived = Combination(name, value, error, fit.freedom_of(slope))
    for profile in fit.profiles:
        numbers = np.array(
            [float(number) for number, _ in _evaluated(fit, quantity, profile.values)]
        )
        sides = profile.sides_of(numbers, value, error, rate, model_error=model_error)
        derived = derived.widened(sides)
    return derived


def tied_parameters(fit: "Fit") -> tuple[Tied, ...]:
    """The tied parameters, in the order of `tied=`; none where nothing was fitted."""
    ties = []
    for place, _ in fit.parameters.ties if fit.verdict.fitted else ():
        value, slope, is_open = _propagate(fit, place.number)
        parts = (fit.relative_covariance, fit.relative_noise_covariance)
        error, by_noise = (float(np.sqrt(max(slope @ part @ slope, 0.0))) for part in parts)
        sharp = fit.identifiable or error <= LIMIT * abs(value)
        follows = tuple(name for name, s in zip(fit.names, slope, strict=True) if s != 0)
        errors = (np.inf, np.inf) if is_open else (error, by_noise)
        freedom, determined = fit.freedom_of(slope), bool(sharp and not is_open)
        ties.append(Tied(place.name, value, *errors, freedom, follows, determined))
    return tuple(ties)


def _propagate(fit: "Fit", quantity: Quantity) -> tuple[float, Vector, bool]:
    """A quantity, its slope by relative changes, and whether it moves where responses do not."""
    verdict = fit.verdict
    value, *others = _evaluated(fit, quantity, (fit.values, *verdict.alternatives))
    value, slope = float(value[0]), np.asarray(value[1]) * fit.units
    differs = any(abs(float(other) - value) > 1e-6 * abs(value) for other, _ in others)
    along_null = np.abs(verdict.exact @ slope) > 1e-6 * np.linalg.norm(slope)
    on_curved = [slope[fit.names.index(name)] != 0 for name in verdict.curved]
    return value, slope, bool(differs or np.any(along_null) or any(on_curved))


def _evaluated(fit: "Fit", quantity: Quantity, places: Iterable[Vector]) -> list[tuple]:
    """A quantity and its slope at several values of the parameters."""
    arguments = quantity, fit.parameters, fit.model
    try:
        return [_value_and_slope(*arguments, values) for values in places]
    except jax.errors.ConcretizationTypeError:  # a quantity that asks for numbers
        with jax.disable_jit():
            return [_value_and_slope(*arguments, values) for values in places]


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
        def number(value: float, error: float) -> str:
            if np.isnan(value):
                return "not determined"
            return f"{value:.4g} +- {error:.2g}" if error else f"{value:.4g}"

        def text(factor: Factor) -> str:
            if factor.repeated:
                inside = ", ".join(f"~{value:.4g}" for value in factor.values)
            else:
                inside = ", ".join(map(number, factor.values, factor.standard_errors))
            return f"[{inside}]" if len(factor.values) > 1 else f"({inside})"

        below = ["(0)"] * self.integrators + [text(factor) for factor in self.poles]
        lines = [" ".join([number(*self.gain[1:3]), *map(text, self.zeros)])]
        lines[0] += f" / ({' '.join(below)})" if below else ""
        if self.delay.value != 0:
            lines[0] += f" exp(-({number(*self.delay[1:3])}) s)"
        lines.append(
            "(a) is s + a, [zeta, omega] is s^2 + 2 zeta omega s + omega^2, rad/s; +- one std. "
            "error"
        )
        if any(factor.repeated for factor in (*self.zeros, *self.poles)):
            lines.append(
                "~ repeated within its error: the roots may be two, and have no first-order error"
            )
        return "\n".join(lines)


def factors(fit: "Fit") -> Factors:
    """Gain, zeros and poles of a fitted transfer function, with standard errors.

    Errors are propagated to first order: a change dc_j of a coefficient of the polynomial P moves
    its root r by -r^j dc_j / P'(r).

    **Raises:** ValueError where the model is no `jq.TransferFunction`; UndeterminedError where no
    coefficient is determined.
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

    def error_of(slope: Vector) -> float:
        """Infinite along a direction that changes nothing."""
        if np.any(np.abs(fit.verdict.exact @ slope) > 1e-6 * np.linalg.norm(slope)):
            return np.inf
        return float(np.sqrt(max(slope @ fit.relative_covariance @ slope, 0.0)))

    def number(value: float, slope: Vector) -> tuple[float, float]:
        """Value and error, or nan and infinity if the error is too large for a number."""
        error = error_of(slope)
        lost = not fit.identifiable and not error <= LIMIT * abs(value)
        return (np.nan, np.inf) if lost else (value, error)

    above, below = (np.asarray(c) for c in (model.numerator, model.denominator))
    # Derivatives of the coefficients, free and tied, by the relative changes of the free ones.
    slopes = dict(zip(fit.names, np.diag(fit.units), strict=True))
    for place, _ in fit.parameters.ties:
        slopes[place.name] = _propagate(fit, place.number)[1]
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
    gain = *number(float(above[0] / below[0]), gain_slope), fit.freedom_of(gain_slope)
    delay = *number(float(model.delay), late), fit.freedom_of(late)

    def factored(coefficients: np.ndarray, slopes: np.ndarray) -> tuple[Factor, ...]:
        """The factors of one polynomial, slowest first."""
        roots, factors = np.roots(coefficients).astype(complex), []
        powers = np.arange(coefficients.size - 1, -1, -1)
        for k in sorted(np.flatnonzero(np.imag(roots) >= 0), key=lambda k: abs(roots[k])):
            root, others = complex(roots[k]), np.delete(roots, k)
            steep = np.polyval(np.polyder(coefficients), roots[k])
            with np.errstate(all="ignore"):
                slope = -(roots[k] ** powers) @ slopes / steep
            size, real, imag = abs(root), np.real(slope), np.imag(slope)
            pairs = [(-root.real, -real)]
            if root.imag != 0:
                wider = (root.real * real + root.imag * imag) / size
                damping = -root.real / size
                pairs = [(damping, -(real + damping * wider) / size), (size, wider)]
            # Of another root so near that the sum and difference of the two are mixed up.
            distance = float(np.min(np.abs(others - root), initial=np.inf))
            repeated = distance <= 1e-6 * size or not np.all(np.isfinite(slope))
            if not repeated:
                error = np.hypot(error_of(real), error_of(imag))
                repeated = bool(distance < min(_CLOSE * error, LIMIT * size))
            numbers = [(v, np.nan) if repeated else number(v, slope) for v, slope in pairs]
            values, errors = zip(*numbers, strict=True)
            factors.append(Factor(root, values, errors, repeated))
        return tuple(factors)

    return Factors(
        gain=Combination("gain", *gain),
        zeros=factored(above, d_above),
        poles=factored(below[:left], d_below[:left]),
        integrators=integrators,
        delay=Combination("delay", *delay),
    )


class ResponseBand(NamedTuple):
    """The frequency response of a fitted model, with half of its 95 % band."""

    omega: Float[np.ndarray, " frequencies"]  # rad/s
    response: Complex[np.ndarray, "frequencies outputs inputs"]
    decibels: Float[np.ndarray, "frequencies outputs inputs"]  # from the magnitude to either end
    degrees: Float[np.ndarray, "frequencies outputs inputs"]  # from the phase to either end


class StepBand(NamedTuple):
    """The answer to a unit step of each input, with half of its 95 % band."""

    time: Float[np.ndarray, " samples"]  # s, from the step
    value: Float[np.ndarray, "samples outputs inputs"]
    reach: Float[np.ndarray, "samples outputs inputs"]  # from the value to either end of the band

    @property
    def low(self) -> Float[np.ndarray, "samples outputs inputs"]:
        """The lower end of the 95 % band."""
        return self.value - self.reach

    @property
    def high(self) -> Float[np.ndarray, "samples outputs inputs"]:
        """The upper end of the 95 % band."""
        return self.value + self.reach


def step_response(
    model: PyTree, time: Float[ArrayLike, " samples"]
) -> Float[np.ndarray, "samples outputs inputs"]:
    """The answer of a linear model at rest to a unit step of each input at time 0.

    The model is a `jq.TransferFunction`, a `jq.StateSpace`, a `jq.models.DiscreteTransferFunction`,
    whose sample interval is that of `time`, or has `transfer_function()` or `state_space()`.

    **Raises:** ValueError for other models, and where `time` is not equally spaced from 0, in s.
    """
    t, plant = np.asarray(time, float), linear_model(model)
    if t.ndim != 1:
        raise ValueError(f"time has the shape {t.shape}: give times in s, equally spaced from 0")
    steps = np.diff(t)
    if t.ndim != 1 or t.size < 2 or t[0] != 0 or not np.allclose(steps, steps[:1], rtol=1e-6):
        raise ValueError(
            "time is not equally spaced from 0: give two or more, as np.linspace(0, 2, 401)"
        )
    dt = float(t[-1] / (t.size - 1))
    if not isinstance(plant, StateSpace):
        return np.asarray(simulate_linear(plant, np.ones(t.size), dt))[:, None, None]
    inputs = np.eye(plant.G.shape[1])
    steps = (np.broadcast_to(unit, (t.size, len(inputs))) for unit in inputs)
    return np.stack([np.asarray(simulate_linear(plant, u, dt)) for u in steps], axis=-1)


@ft.partial(Jit, options=hasty_options)
def _response(model: PyTree, omega: Float[Array | np.ndarray, " frequencies"]) -> Array:
    return evaluate_response(model, jnp.asarray(omega))


def model_response(
    model: PyTree, omega: Float[np.ndarray, " frequencies"]
) -> Complex[np.ndarray, "frequencies outputs inputs"]:
    """The response of a model at frequencies in rad/s, by one program whatever their number."""
    if (dt := sample_interval(model)) is not None:
        require_sampled(dt, omega=omega)
    padded = np.pad(omega, (0, -omega.size % _AT_ONCE), mode="edge").reshape(-1, _AT_ONCE)
    parts = [np.asarray(_response(model, part)) for part in padded]
    return np.concatenate(parts)[: omega.size]


def with_reach(
    fit: "Fit", curve: Callable[[PyTree], Inexact[np.ndarray, "..."]]
) -> tuple[np.ndarray, Callable[[Callable[[np.ndarray], np.ndarray]], np.ndarray]]:
    """A curve of the model, and half of the 95 % band of what a function makes of its slopes.
    Slopes are by differences: the program of the curve itself serves, whatever the model."""
    value, rows = curve(fit.model), []
    # Directions along which no response changes are left out.
    covariance = fit.relative_covariance if fit.identifiable else known_covariance(fit)

    def changed(k: int, by: float) -> Inexact[np.ndarray, "..."]:
        values = np.array(fit.values, float)
        values[k] += by * fit.units[k]
        return curve(fit.parameters.replace(fit.model, values))

    for k in range(len(fit.names)):
        above = changed(k, _CHANGE)
        if fit.values[k]:
            rows.append((above - changed(k, -_CHANGE)) / (2 * _CHANGE))
        else:  # a lag or delay of 0 has no lower neighbour
            rows.append((above - value) / _CHANGE)

    def reach(part: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        slopes = part(np.stack(rows))
        flat = slopes.reshape(len(slopes), -1)
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            variance = np.einsum("ij,ik,kj->j", flat, covariance, flat)
            shares = flat**2 * np.diagonal(covariance)[:, None]
            doubt = np.sum(shares / fit.degrees_of_freedom[:, None], axis=0)
            freedom = np.where(doubt > 0, np.sum(shares, axis=0) / doubt, np.inf)
        factor = np.array([reach_of_interval(number) for number in freedom])
        return (factor * np.sqrt(np.maximum(variance, 0.0))).reshape(slopes.shape[1:])

    return value, reach


def draw_models(
    fit: "Fit", scores: Float[ArrayLike, "parameters members"], *, hold_undetermined: bool = False
) -> PyTree:
    """Draw models from a fit at given standard normal numbers, as `Fit.ensemble` does.

    `scores` has one column for each model.

    **Raises:** as `Fit.ensemble`.
    """
    check_drawable(fit, hold_undetermined)
    covariance = known_covariance(fit)
    logarithmic = np.array(fit.parameters.logarithmic[: len(fit.names)])
    here = np.asarray(concrete_values(fit.values, "Fit.ensemble"))
    units = np.asarray(fit.units)
    at_zero = [fit.names.index(bound.name) for bound in fit.verdict.bounds]
    along = covariance[at_zero] / np.diagonal(covariance)[at_zero, None]
    # In other units than its value a parameter is mixed up with others near zero.
    scaled = logarithmic & (here != 0) & ~np.isclose(units, here, rtol=1e-9, atol=0.0)
    mixed_up = np.setdiff1d(np.flatnonzero(scaled), at_zero)
    relative = np.asarray(fit.relative_covariance)[mixed_up]
    along = np.concatenate([along, relative / relative[np.arange(len(relative)), mixed_up, None]])
    at_zero += mixed_up.tolist()
    logarithmic[at_zero] = False
    variances, directions = np.linalg.eigh(covariance)
    root = directions * np.sqrt(np.maximum(variances, 0.0))
    spread = _Spread(root, tuple(at_zero), along, fit.values, units, logarithmic)
    drawn = jax.tree.leaves(_drawn(fit.parameters, fit.model, spread, as_array(scores)))
    places = (*fit.parameters.places[: len(fit.names)], *(p for p, _ in fit.parameters.ties))
    leaves, structure = jax.tree.flatten(fit.model)
    floating = [k for k, leaf in enumerate(leaves) if eqx.is_inexact_array(leaf)]
    for k in {floating[place.leaf] for place in places}:
        leaves[k] = drawn[k]
    return jax.tree.unflatten(structure, leaves)


class _Spread(NamedTuple):
    """How the free parameters of a fit are drawn."""

    root: Matrix  # of the covariance of relative changes
    at_zero: tuple[int, ...]  # parameters at or near their bound
    along: Float[np.ndarray, "bounds parameters"]  # what changes with each of these
    here: Float[Array | np.ndarray, " parameters"]
    units: Float[np.ndarray, " parameters"]
    logarithmic: Bool[np.ndarray, " parameters"]


@eqx.filter_jit  # as one program: eager, it would be half a dozen for each number of members
def _drawn(
    parameters: Parameters,
    model: PyTree,
    spread: _Spread,
    scores: Float[Array, "parameters members"],
) -> PyTree:
    """The models, with the members on the last axis of every array."""
    changes = spread.root @ scores
    here, units = spread.here[:, None], spread.units[:, None]
    for k, along in zip(spread.at_zero, spread.along, strict=True):
        # Folded to one side of zero, with what goes along with it: they keep their sign.
        drawn = spread.here[k] / spread.units[k] + changes[k]
        folded = jnp.abs(drawn) - drawn
        changes += along[:, None] * folded[None]
    linear = here + units * changes
    # Several that go along with each other may have pushed one back.
    near = np.isin(np.arange(len(linear)), spread.at_zero)[:, None]
    linear = jnp.where(near, jnp.copysign(linear, units), linear)
    values = jnp.where(spread.logarithmic[:, None], here * jnp.exp(changes), linear)
    return jax.vmap(lambda v: parameters.replace(model, v), in_axes=-1, out_axes=-1)(values)


def check_drawable(fit: "Fit", hold_undetermined: bool) -> None:
    """Raise ValueError for a fit that cannot be drawn from, as `Fit.ensemble` says."""
    if not fit.verdict.fitted:
        raise UndeterminedError(f"there is nothing to draw from: {fit.verdict.summary}")
    stopped = [remark for remark in fit.remarks if remark.kind == NO_MINIMUM]
    if stopped:
        raise ValueError(
            f"the fit did not converge, so there is nothing to draw from: {stopped[0]}"
        )
    errors = fit.standard_errors[fit.determined]
    if not (np.all(np.isfinite(fit.relative_covariance)) and np.all(np.isfinite(errors))):
        raise ValueError(
            "the fit's standard errors are not finite, so there is nothing to draw from: use a "
            "response with random errors, and fit again"
        )
    lost = fit.verdict.undetermined
    if lost and not hold_undetermined:
        names, sums = ", ".join(lost), " and ".join(c.name for c in fit.combinations)
        raise UndeterminedError(
            f"the record does not determine {names}{f' (only {sums} is)' if sums else ''}, so they "
            "cannot be drawn: fix them at measured values as far as needed, give a "
            "jq.identify.Prior or a second record; or, for quantities that depend on determined "
            "combinations alone, give hold_undetermined=True"
        )


def known_covariance(fit: "Fit") -> Matrix:
    """The covariance of relative changes, without the directions that are not determined.

    These are undetermined exactly or by the noise; quantities that depend on none of them keep
    their variance.
    """
    verdict, names = fit.verdict, fit.names
    shares = [[row.get(name, 0.0) for name in names] for row in verdict.null_directions]
    null = np.array(shares).reshape(-1, len(names))
    single = np.eye(len(names))[~fit.determined & ~np.any(null, axis=0)]
    # The printed directions leave small shares out; the exact ones must not.
    rest = null - null @ verdict.exact.T @ verdict.exact
    count = len(null) - len(verdict.exact)
    noisy = np.linalg.svd(rest, full_matrices=False)[2][:count] if count > 0 else rest[:0]
    lost = np.linalg.qr(np.concatenate([verdict.exact, noisy, single]).T)[0].T
    keep = np.eye(len(names)) - lost.T @ lost
    return keep @ fit.relative_covariance @ keep
