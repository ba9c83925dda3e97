"""Frequency responses of known models with known noise."""

import jax.numpy as jnp
import numpy as np

import jaxquad as jq


OMEGA = np.geomspace(0.5, 20.0, 30)


def response_of(
    model, *, error=0.02, correlation=0.0, seed=None, omega=OMEGA
) -> jq.spectra.FrequencyResponse:
    """The response of `model`, noisy if there is a `seed`; neighbours' errors are correlated."""
    exact = np.asarray(model.frequency_response(jnp.asarray(omega)))
    apart = np.abs(np.arange(omega.size)[:, None] - np.arange(omega.size)[None, :])
    covariance = 2 * error**2 * correlation**apart
    relative = np.zeros(exact.shape, complex)
    if seed is not None:
        pairs = exact.shape[1] * exact.shape[2]
        white = np.random.default_rng(seed).standard_normal((omega.size, pairs, 2))
        root = np.linalg.cholesky(covariance) / np.sqrt(2)
        relative = (root @ (white @ np.array([1.0, 1.0j]))).reshape(exact.shape)
    shape = exact.shape
    return jq.spectra.FrequencyResponse(
        omega=jnp.asarray(omega),
        response=jnp.asarray(exact * (1 + relative)),
        coherence=jnp.full(shape, 0.95),
        random_error=jnp.full(shape, error),
        errors=shared_errors(omega, exact, covariance),
        direct_coherence=jnp.full(shape, 0.95),
        multiple_coherence=jnp.full(shape[:2], 0.95),
        method="joint",
        input_names=tuple(f"u{k}" for k in range(shape[2])),
        output_names=tuple(f"y{k}" for k in range(shape[1])),
    )


def shared_errors(omega, exact, covariance) -> jq.spectra.ErrorCovariance:
    """Relative errors of one covariance between frequencies, independent between pairs."""
    count, outputs, inputs = exact.shape
    if not np.any(covariance - np.diag(np.diag(covariance))):
        variance = np.diag(covariance)[:, None, None] * np.abs(exact) ** 2
        return jq.spectra.independent_errors(jnp.asarray(omega), jnp.asarray(variance))
    assert outputs == inputs == 1, "neighbours share errors in single responses only"
    effect = exact * np.linalg.cholesky(covariance)[:, None, :]
    noise = jnp.ones((count, 1, 1), complex)
    return jq.spectra.ErrorCovariance(jnp.asarray(omega), jnp.asarray(effect), noise)
