"""Sine, cosine and arctangent by short polynomials are those of NumPy to the last bits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.models import arctan2, sincos


RNG = np.random.default_rng(0)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_sines_and_cosines_are_right_to_the_last_bits(dtype):
    exact = np.longdouble if dtype == np.float64 else np.float64
    # Large angles in single precision need the compiler's fused products and sums.
    run = jax.jit(sincos, compiler_options={"xla_backend_optimization_level": 2})
    for span in (1e-3, 2.0, 100.0, 1e6):
        x = RNG.uniform(-span, span, 20_000).astype(dtype)
        for found, of in zip(run(jnp.asarray(x)), (np.sin, np.cos), strict=True):
            error = np.abs(np.asarray(found).astype(exact) - of(x.astype(exact)))
            assert error.max() < 1.5 * np.finfo(dtype).eps
    far = np.array([1e300 if dtype == np.float64 else 1e30, np.inf, np.nan], dtype)
    assert np.isnan(sincos(jnp.asarray(far))).all()


def test_sines_differentiate_as_sines():
    third = jax.grad(jax.grad(jax.grad(lambda x: sincos(x)[0])))
    assert third(jnp.asarray(0.7)) == pytest.approx(-np.cos(0.7), rel=1e-15)


def test_arctangents_of_all_quadrants():
    angle = np.linspace(-np.pi, np.pi, 4001)[1:-1]
    for size in (1e-150, 1.0, 1e150):
        found = arctan2(size * np.sin(angle), size * np.cos(angle))
        np.testing.assert_allclose(
            found, np.arctan2(size * np.sin(angle), size * np.cos(angle)), atol=5e-16
        )
    assert arctan2(jnp.zeros(()), jnp.zeros(())) == 0
