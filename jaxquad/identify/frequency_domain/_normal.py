"""Normal equations of a fit; those of a plain state space by products instead of derivatives."""

import functools as ft

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from jaxquad._compile import evaluate_once, FEW, no_fuse
from jaxquad._core import Normal, normal_equations
from jaxquad.models import arctan2, Entry, factor_slopes, matrices_of, Split, StateSpace

from ._condition import is_unchanged
from ._mixing import mix_parts
from ._problem import prior_misfits, Problem, residuals


def problem_normal(z: Float[Array, " parameters"], problem: Problem) -> Normal:
    """Cost, gradient and Gauss-Newton Hessian of the residuals of a fit.

    For a plain `jq.StateSpace` with nothing tied, slopes are products of the resolvent's columns
    and rows, at a quarter of the cost of differentiation; any other model is differentiated.

    **Arguments:**

    - `z`: the free parameters as the solver sees them.
    - `problem`: of `jq.identify.make_problem`.
    """
    if not is_plain(problem):
        once = evaluate_once(lambda z: normal_equations(residuals, z, problem), least=FEW)
        return once(z)
    parts = [part for k in range(len(problem.omega)) for part in _record(z, problem, k)]
    if problem.quantities:
        parts.append(normal_equations(prior_misfits, z, problem))
    return ft.reduce(lambda a, b: jax.tree.map(jnp.add, a, b), parts)


def is_plain(problem: Problem) -> bool:
    """Whether slopes are products of the resolvent's columns and rows."""
    plain = type(problem.model) is StateSpace and not problem.parameters.ties
    plain = plain and all(each is None for each in problem.aliases) and not any(problem.silent)
    return plain and all(map(is_unchanged, problem.conditions))


def _record(z: Float[Array, " parameters"], problem: Problem, k: int) -> list[Normal]:
    """Of one record, magnitude and phase apart: side by side they would have to be copied."""
    parameters, omega = problem.parameters, jnp.asarray(problem.omega[k])
    matrices = matrices_of(parameters.insert(problem.model, z))
    entries = [_entry(place.path) for place in parameters.places[: z.size]]
    value, slopes = factor_slopes(matrices, omega, entries, jnp.asarray(parameters.slopes(z)))
    misfit = no_fuse(_logarithm, value, jnp.asarray(problem.measured[k]))
    mixing = problem.mixings[k]
    weights = jnp.moveaxis(jnp.asarray(problem.weights[k]), (0, 3), (3, 0))
    if len(weights) == 1 and mixing is None and slopes.multiplies_sooner:
        square = sum(jnp.sum((part * weights[0]) ** 2) for part in misfit)
        return [Normal(0.5 * jnp.asarray(square), *slopes.normal_products(weights[0], misfit))]
    both = Split(weights[0], weights[-1])
    residual = [part * weight for part, weight in zip(misfit, both, strict=True)]
    mixed = mix_parts(mixing, *residual), mix_parts(mixing, *slopes.multiply_out(both))
    return [_products(*each) for each in zip(*mixed, strict=True)]


def _products(
    residual: Float[Array, "outputs inputs frequencies"],
    slopes: Float[Array, "parameters outputs inputs frequencies"],
) -> Normal:
    r, rows = residual.reshape(-1), slopes.reshape(len(slopes), -1)
    return Normal(0.5 * jnp.sum(r**2), rows @ r, rows @ rows.T)


def _logarithm(value: Split, measured: Complex[Array, "frequencies outputs inputs"]) -> Split:
    """`ln|T/T^|` and the wrapped phase of `T/T^` in rad."""
    there = jnp.moveaxis(measured, 0, -1)
    real, imag = jnp.real(there), jnp.imag(there)
    a = value.real * real + value.imag * imag
    b = value.imag * real - value.real * imag
    power = real * real + imag * imag
    size = (value.real * value.real + value.imag * value.imag) / power
    return Split(0.5 * jnp.log(size), jnp.asarray(arctan2(b, a)))


def _entry(name: str) -> Entry:
    field, *index = name.replace("]", "").split("[")
    row, column = (int(i) for i in (*index, "0")[:2])
    return Entry(field, row, column)
