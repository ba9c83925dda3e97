"""Levenberg-Marquardt finds the minimum that SciPy finds, alone and in a batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from jaxquad._core import (
    CONVERGED,
    decrement,
    invert_definite,
    minimise,
    Normal,
    normal_equations,
    RUNNING,
    solve_definite,
    STALLED,
)


TIME = np.linspace(0.0, 2.0, 8)
DATA = 2 * np.exp(-0.7 * TIME) + 0.05 * np.cos(9 * np.arange(8))
STARTS = np.array([[1.0, 1.0], [3.0, 0.1], [0.5, 2.0]])


def residual(z, data):
    return z[0] * jnp.exp(-z[1] * TIME) - data


def evaluate(z):
    normal = jax.vmap(lambda z: normal_equations(residual, z, DATA), in_axes=1, out_axes=-1)(z)
    return Normal(*normal)


@pytest.mark.slow
def test_every_member_of_a_batch_reaches_the_minimum_of_scipy():
    found = jax.jit(lambda z: minimise(evaluate, z, 50))(STARTS.T)
    expected = least_squares(lambda z: np.asarray(residual(z, DATA)), STARTS[0], xtol=1e-14)
    assert np.all(found.status == CONVERGED)
    np.testing.assert_allclose(found.z, np.tile(expected.x[:, None], 3), rtol=1e-6)
    assert np.all(decrement(evaluate(found.z)) < 1e-12)


def test_too_few_steps_are_told_and_a_wall_of_nan_stalls():
    once = jax.jit(lambda z: minimise(evaluate, z, 1))(STARTS.T)
    assert np.all(once.status == RUNNING)

    def walled(z):
        inside = jnp.where(z[0] < 1, 3 - z[0], jnp.nan)  # falls towards a wall at 1
        return Normal(inside**2 / 2, -inside[None], jnp.ones((1, 1, *inside.shape)))

    stopped = jax.jit(lambda z: minimise(walled, z, 200))(np.array([[0.0, 2.0]]))
    np.testing.assert_array_equal(stopped.status, STALLED)
    # As near as the damping lets it, or not at all from a start behind the wall.
    np.testing.assert_allclose(stopped.z[0], [1.0, 2.0], atol=1e-6)


def test_a_definite_matrix_is_told_from_others():
    matrix = np.stack([[[4.0, 1.0], [1.0, 3.0]], [[1.0, 2.0], [2.0, 1.0]]], axis=-1)
    solution, definite = solve_definite(jnp.asarray(matrix), jnp.ones((2, 2)))
    np.testing.assert_array_equal(definite, [True, False])
    np.testing.assert_allclose(solution[:, 0], np.linalg.solve(matrix[..., 0], np.ones(2)))


def test_inverse_and_determinant_of_definite_matrices_are_those_of_numpy():
    root = np.random.default_rng(0).standard_normal((3, 2, 5, 8))
    matrix = jnp.asarray(root @ np.swapaxes(root, -1, -2))
    inverse, volume = invert_definite(matrix)
    np.testing.assert_allclose(inverse, np.linalg.inv(matrix), rtol=1e-9)
    np.testing.assert_allclose(volume, np.linalg.slogdet(matrix)[1], rtol=1e-12)
    # d ln det A / dA = A^-1
    slopes = jax.grad(lambda x: jnp.sum(invert_definite(x)[1]))(matrix)
    np.testing.assert_allclose(slopes, inverse, rtol=1e-9)


def test_a_start_close_to_the_minimum_along_a_weak_direction_is_not_taken_for_it():
    """The first step is damped: there it is shorter than 1e-8, and the minimum 1e-6 away."""
    slopes = np.diag([1.0, 1e-3])

    def misfit(z, _):
        return slopes @ z - 1.0

    def normal(z):
        return jax.vmap(lambda z: normal_equations(misfit, z, None), in_axes=1, out_axes=-1)(z)

    least = np.linalg.solve(slopes, np.ones(2))
    found = jax.jit(lambda z: minimise(normal, z, 50))((least + [0.0, 1e-6 * least[1]])[:, None])
    assert found.status == CONVERGED
    np.testing.assert_allclose(found.z[:, 0], least, rtol=1e-8)
