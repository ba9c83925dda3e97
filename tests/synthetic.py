"""Frequency responses of known models with known noise."""

import jax.numpy as jnp
import numpy as np

import jaxquad as jq


OMEGA = np.geomspace(0.5, 20.0, 30)


def response_of(
    model, *, error=0.02, correlation=0.0, seed=None, omega=OMEGA
) -> jq.FrequencyResponse:
    """The response of `model`, noisy if there is a `seed`; neighbours' errors are correlated."""
    exact = np.asarray(model.frequency_response(jnp.asarray(omega)))
    apart = np.abs(np.arange(omega.size)[:, None] - np.arange(omega.size)[None, :])
    covariance = 2 * error**2 * correlation**apart
    relative = np.zeros(omega.size, complex)
    if seed is not None:
        rng = np.random.default_rng(seed)
        white = rng.standard_normal((omega.size, 2)) @ np.array([1.0, 1.0j])
        relative = np.linalg.cholesky(covariance) @ white / np.sqrt(2)
    shape = exact.shape
    return jq.FrequencyResponse(
        jnp.asarray(omega),
        jnp.asarray(exact * (1 + relative)[:, None, None]),
        jnp.full(shape, 0.95),
        jnp.full(shape, error),
        jnp.asarray(np.broadcast_to(covariance.astype(complex), shape[1:] + covariance.shape)),
        jnp.full(shape, 0.95),
        "joint",
        tuple(f"u{k}" for k in range(shape[2])),
        tuple(f"y{k}" for k in range(shape[1])),
    )
