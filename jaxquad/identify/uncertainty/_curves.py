"""Curves of a fitted model, over frequency and over time, with the band that its doubt leaves."""

import functools as ft
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float, Inexact, PyTree

from jaxquad._compile import hasty_options, Jit
from jaxquad.models import evaluate_response, simulate_linear, TransferFunction

from ..output_error._simulated import linear_model
from ._error_budget import Matrix
from ._verdict import reach_of_interval


_CHANGE = 1e-5  # of a parameter: central differences are then exact to about 1e-10
_AT_ONCE = 512  # frequencies of a program, so that all curves of a model share it


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

    **Arguments:**

    - `model`: a `jq.TransferFunction`, a `jq.StateSpace`, or a model with `transfer_function()` or
        `state_space()`.
    - `time`: equally spaced, from 0, in s.

    **Raises:**

    - `ValueError`: the model has none of these forms, or `time` is not equally spaced from 0.
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
    if isinstance(plant, TransferFunction):
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
    padded = np.pad(omega, (0, -omega.size % _AT_ONCE), mode="edge").reshape(-1, _AT_ONCE)
    parts = [np.asarray(_response(model, part)) for part in padded]
    return np.concatenate(parts)[: omega.size]


def fitted_step_response(
    fit: PyTree, time: Float[ArrayLike, " samples"], covariance: Matrix
) -> StepBand:
    """The step response of a fit, as `Fit.step_response` says; by a covariance of the parameters.

    The covariance is that of relative changes.
    """
    value, slopes = _slopes(fit, lambda model: step_response(model, time))
    return StepBand(np.asarray(time, float), value, _reach(fit, slopes, covariance))


def fitted_response(
    fit: PyTree, omega: Float[ArrayLike, " frequencies"], covariance: Matrix
) -> ResponseBand:
    """The frequency response of a fit, as `Fit.response_band` says; as `fitted_step_response`."""
    grid = np.asarray(omega, float)
    if grid.ndim != 1:
        raise ValueError(f"omega has the shape {grid.shape}: give a list of frequencies in rad/s")
    value, slopes = _slopes(fit, lambda model: model_response(model, grid))
    relative = slopes / value
    reach = lambda part: _reach(fit, part(relative), covariance)
    decibels = 20 / np.log(10) * reach(np.real)
    return ResponseBand(grid, value, decibels, np.degrees(reach(np.imag)))


def pole_reach(fit: PyTree, covariance: Matrix) -> Complex[np.ndarray, " poles"]:
    """Half of the 95 % interval of each pole, as `Fit.pole_reach` says."""
    start = linear_model(fit.model).poles

    def poles(model: PyTree) -> Complex[np.ndarray, " poles"]:
        left, ordered = list(linear_model(model).poles), []
        for pole in start:  # in the order of the fit's poles
            ordered.append(left.pop(int(np.argmin(np.abs(np.array(left) - pole)))))
        return np.array(ordered, complex)

    slopes = _slopes(fit, poles)[1]
    return _reach(fit, np.real(slopes), covariance) + 1j * _reach(fit, np.imag(slopes), covariance)


def _slopes(
    fit: PyTree, curve: Callable[[PyTree], Inexact[np.ndarray, "..."]]
) -> tuple[Inexact[np.ndarray, "..."], Inexact[np.ndarray, "parameters ..."]]:
    """A curve of the model, and its slopes by relative changes of the parameters.

    By differences: the program of the curve itself serves, whatever the model.
    """
    value, rows = curve(fit.model), []

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
    return value, np.stack(rows)


def _reach(
    fit: PyTree, slopes: Float[np.ndarray, "parameters ..."], covariance: Matrix
) -> Float[np.ndarray, "..."]:
    """Half of the 95 % band of quantities with these slopes by relative changes."""
    flat = slopes.reshape(len(slopes), -1)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        variance = np.einsum("ij,ik,kj->j", flat, covariance, flat)
        shares = flat**2 * np.diagonal(covariance)[:, None]
        doubt = np.sum(shares / fit.degrees_of_freedom[:, None], axis=0)
        freedom = np.where(doubt > 0, np.sum(shares, axis=0) / doubt, np.inf)
    reach = np.array([reach_of_interval(number) for number in freedom])
    return (reach * np.sqrt(np.maximum(variance, 0.0))).reshape(slopes.shape[1:])
