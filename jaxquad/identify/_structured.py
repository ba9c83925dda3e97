"""Normal equations of a fit, from the structure of a state space where the model is one."""

import functools as ft

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from jaxquad.models import StateSpace
from jaxquad.models._apart import apart
from jaxquad.models._entry_slopes import Entry, logarithmic_slopes
from jaxquad.models._resolvent import Split
from jaxquad.models._state_space import matrices_of

from ._levenberg import Normal, normal_equations
from ._problem import prior_misfits, Problem, residuals, unchanged


def problem_normal(z: Float[Array, " parameters"], problem: Problem) -> Normal:
    """Cost, gradient and Gauss-Newton Hessian of `residuals`.

    Of a plain `StateSpace` with nothing tied, each slope is a product of what the response is made
    of already, at a quarter of the price; any other model is differentiated.
    """
    plain = type(problem.model) is StateSpace and not problem.parameters.ties
    if not plain or any(condition is not unchanged for condition in problem.conditions):
        return normal_equations(residuals, z, problem)
    parts = [part for k in range(len(problem.omega)) for part in _record(z, problem, k)]
    if problem.quantities:
        parts.append(normal_equations(prior_misfits, z, problem))
    return ft.reduce(lambda a, b: jax.tree.map(jnp.add, a, b), parts)


def _record(z: Float[Array, " parameters"], problem: Problem, k: int) -> list[Normal]:
    """Of one record, magnitude and phase apart: side by side they would have to be copied."""
    parameters, omega = problem.parameters, problem.omega[k]
    matrices = matrices_of(parameters.insert(problem.model, z))
    entries = [_entry(place.name) for place in parameters.places[: z.size]]
    value, slopes = logarithmic_slopes(matrices, omega, entries)
    misfit, scale = _logarithm(value, problem.measured[k]), parameters.slopes(z)
    weights = jnp.moveaxis(problem.weights[k], (0, 3), (3, 0))
    return [_products(*each, scale) for each in zip(misfit, slopes, weights, strict=True)]


def _products(
    misfit: Float[Array, "outputs inputs frequencies"],
    slopes: Float[Array, "parameters outputs inputs frequencies"],
    weights: Float[Array, "outputs inputs frequencies"],
    scale: Float[Array, " parameters"],
) -> Normal:
    r, rows = (misfit * weights).reshape(-1), apart(_weighted, slopes, weights, scale)
    rows = rows.reshape(len(scale), -1)
    return Normal(0.5 * jnp.sum(r**2), rows @ r, rows @ rows.T)


def _weighted(slopes: Array, weights: Array, scale: Array) -> Array:
    return slopes * weights[None] * scale[:, None, None, None]


def _logarithm(value: Split, measured: Complex[Array, "frequencies outputs inputs"]) -> Split:
    """`ln|T/T^|` and the wrapped phase of `T/T^` in rad."""
    there = jnp.moveaxis(measured, 0, -1)
    real, imag = jnp.real(there), jnp.imag(there)
    a = value.real * real + value.imag * imag
    b = value.imag * real - value.real * imag
    power = real * real + imag * imag
    size = (value.real * value.real + value.imag * value.imag) / power
    return Split(0.5 * jnp.log(size), jnp.arctan2(b, a))


def _entry(name: str) -> Entry:
    field, *index = name.replace("]", "").split("[")
    row, column = (int(i) for i in (*index, "0")[:2])
    return Entry(field, row, column)
