"""Inverses at many frequencies, as responses of state spaces need them."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxquad as jq


OMEGA = np.geomspace(0.1, 100.0, 50)
F = np.random.default_rng(0).standard_normal((4, 4))
UNITS = np.array([1.0, 1e-9, 1e6, 1e-3])


def response(F):
    """Of every state to a push on each."""
    return jq.StateSpace(F=F, G=np.eye(4), H0=np.eye(4)).frequency_response(jnp.asarray(OMEGA))


def test_inverses_are_those_of_numpy_in_any_units():
    expected = np.linalg.inv(1j * OMEGA[:, None, None] * np.eye(4) - F)
    expected = UNITS[:, None] * expected / UNITS
    np.testing.assert_allclose(response(UNITS[:, None] * F / UNITS), expected, rtol=1e-9)


def test_inverses_leave_the_threads_of_a_program_alone():
    # Two calls of LAPACK for many matrices, side by side, wait for each other on two cores.
    assert "custom_call" not in jax.jit(response).lower(jnp.asarray(F)).as_text()
