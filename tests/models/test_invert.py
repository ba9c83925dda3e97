"""Inverses at many frequencies."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxquad.models._response import equilibrium, inverse, Split


def invert(matrix):
    parts = Split(*(jnp.moveaxis(part, 0, -1) for part in (jnp.real(matrix), jnp.imag(matrix))))
    found = inverse(parts, equilibrium(jnp.hypot(*parts)))
    return jnp.moveaxis(jax.lax.complex(*found), -1, 0)


def test_inverses_are_those_of_numpy_in_any_units():
    rng = np.random.default_rng(0)
    matrix = rng.standard_normal((50, 4, 4)) + 1j * rng.standard_normal((50, 4, 4))
    units = np.array([1.0, 1e-9, 1e6, 1e-3])
    scaled = units[:, None] * matrix / units[::-1]
    expected = units[::-1][:, None] * np.linalg.inv(matrix) / units
    np.testing.assert_allclose(invert(jnp.asarray(scaled)), expected, rtol=1e-9)


def test_inverses_leave_the_threads_of_a_program_alone():
    # Two calls of LAPACK for many matrices, side by side, wait for each other on two cores.
    text = jax.jit(invert).lower(jnp.ones((50, 3, 3), complex)).as_text()
    assert "custom_call" not in text
