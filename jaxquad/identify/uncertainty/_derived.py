"""Functions of a fitted model with their errors: quantities asked for, and tied parameters."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..frequency_domain._parameters import number_at
from ._identifiability import LIMIT
from ._verdict import Combination, reach_of_interval, UndeterminedError, USUAL


if TYPE_CHECKING:
    from ..frequency_domain._result import Fit


_ROUNDING = 1e-12  # of a variance, to those that cancel in it

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
    found = propagate(fit, quantity)
    if found.is_open:
        lost = ", ".join(fit.verdict.undetermined)
        raise UndeterminedError(
            f"{name} depends on what this record does not determine ({lost}): «fit with a "
            "jq.identify.Prior or a second record, or ask for a determined combination»"
        )
    slope = found.slope
    covariance = fit.relative_covariance if model_error else fit.relative_noise_covariance
    variance = float(slope @ covariance @ slope)
    if variance < _ROUNDING * float(np.abs(slope) @ np.abs(covariance) @ np.abs(slope)):
        raise UndeterminedError(
            f"the standard error of {name} is lost in the rounding of those of "
            f"{', '.join(fit.names)}, which are many times as large: fix one of them"
        )
    return Combination(name, found.value, float(np.sqrt(variance)), fit.freedom_of(slope))


def tied_parameters(fit: "Fit") -> tuple[Tied, ...]:
    """The tied parameters, in the order of `tied=`; none where nothing was fitted."""
    if not fit.verdict.fitted:
        return ()
    found = [propagate(fit, number_at(place)) for place, _ in fit.parameters.ties]
    pairs = zip(fit.parameters.ties, found, strict=True)
    return tuple(_tied(fit, place.name, each) for (place, _), each in pairs)


def _tied(fit: "Fit", name: str, found: Propagated) -> Tied:
    slope = found.slope
    parts = (fit.relative_covariance, fit.relative_noise_covariance)
    error, by_noise = (float(np.sqrt(max(slope @ part @ slope, 0.0))) for part in parts)
    sharp = fit.identifiable or error <= LIMIT * abs(found.value)
    return Tied(
        name,
        found.value,
        np.inf if found.is_open else error,
        np.inf if found.is_open else by_noise,
        fit.freedom_of(slope),
        tuple(each for each, s in zip(fit.names, slope, strict=True) if s != 0),
        bool(sharp and not found.is_open),
    )


def propagate(fit: "Fit", quantity: Quantity) -> Propagated:
    """Value and slope of a quantity, and whether it is left open."""
    others = fit.verdict.alternatives
    (value, gradient), *there = _values_and_gradients(fit, quantity, (fit.values, *others))
    slope = gradient * fit.units
    differs = any(abs(other - value) > 1e-6 * abs(value) for other, _ in there)
    return Propagated(value, slope, differs or _changes_undetermined(fit, slope))


def _changes_undetermined(fit: "Fit", slope: Float[np.ndarray, " parameters"]) -> bool:
    """Whether a quantity of this `slope` changes where the responses do not."""
    verdict = fit.verdict
    along_null = np.abs(verdict.exact @ slope) > 1e-6 * np.linalg.norm(slope)
    on_curved = [slope[fit.names.index(name)] != 0 for name in verdict.curved]
    return bool(np.any(along_null) or any(on_curved))


def _values_and_gradients(
    fit: "Fit", quantity: Quantity, places: Sequence[Float[np.ndarray, " n"]]
) -> list[tuple[float, Float[np.ndarray, " n"]]]:
    """Of a quantity at several physical values of the free parameters."""
    arrays, rest = eqx.partition(fit.model, eqx.is_inexact_array)

    def of_values(x, arrays):
        value = quantity(fit.parameters.replace(eqx.combine(arrays, rest), x))
        if jnp.shape(value):
            raise ValueError(
                "the quantity is an array: ask for each of its numbers, by a function of its own"
            )
        return value

    function = jax.value_and_grad(of_values)
    found = [function(jnp.asarray(values), arrays) for values in places]
    return [(float(value), np.asarray(gradient)) for value, gradient in found]
