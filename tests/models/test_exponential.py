"""The exponential of small matrices, of many at once, and its derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from jaxquad.models import matrix_exponential


SIZES = np.array([0.0, 0.5, 2.0, 8.0, 40.0])  # no squarings, none, and more and more
GIVEN = np.random.default_rng(0).standard_normal((5, 4, 4)) - 2 * np.eye(4)
GIVEN = SIZES[:, None, None] * GIVEN / np.linalg.norm(GIVEN, axis=(1, 2), keepdims=True)
TOWARDS = np.random.default_rng(1).standard_normal((5, 4, 4))


def total(matrices):
    return jnp.sum(jax.vmap(matrix_exponential)(matrices) * TOWARDS)


def test_of_many_matrices_each_is_squared_as_often_as_it_needs():
    found = jax.jit(jax.vmap(matrix_exponential))(GIVEN)
    np.testing.assert_allclose(found, scipy.linalg.expm(GIVEN), rtol=1e-11, atol=1e-13)


def test_derivatives_are_those_of_frechet_in_both_modes():
    slope = jax.jit(jax.grad(total))(GIVEN)
    moved = jax.jit(lambda x: jax.jvp(jax.vmap(matrix_exponential), (x,), (TOWARDS,))[1])(GIVEN)
    for k, given in enumerate(GIVEN):
        for found, matrix in ((slope[k], given.T), (moved[k], given)):
            expected = scipy.linalg.expm_frechet(matrix, TOWARDS[k], compute_expm=False)
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-11)
