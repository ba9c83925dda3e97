"""Pairs of output and input whose errors are correlated at each frequency."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxquad as jq


OMEGA = np.geomspace(0.5, 20.0, 24)
ERROR, CORRELATION = 0.05, 0.9


class Pair(eqx.Module):
    """Two outputs: gain / (s + 1), and 1 / (lag s + 1)."""

    gain: jax.Array
    lag: jax.Array  # s

    def frequency_response(self, omega):
        slow, fast = (
            jax.lax.complex(size * jnp.ones_like(omega), size * late * omega)
            for size, late in ((1 / self.gain, 1.0), (1.0, self.lag))
        )
        return jnp.stack([1 / slow, 1 / fast], axis=1)[:, :, None]


TRUTH = Pair(jnp.asarray(2.0), jnp.asarray(0.3))
START = Pair(jnp.asarray(1.6), jnp.asarray(0.4))


def response_of_pair(seed: int) -> jq.spectra.FrequencyResponse:
    exact = np.asarray(TRUTH.frequency_response(jnp.asarray(OMEGA)))
    shared = np.linalg.cholesky([[1.0, CORRELATION], [CORRELATION, 1.0]])
    root = np.sqrt(2) * ERROR * np.abs(exact) * shared  # frequencies outputs roots
    white = np.random.default_rng(seed).standard_normal((OMEGA.size, 2, 2)) @ [1.0, 1j]
    noise = (root @ white[:, :, None] / np.sqrt(2)).astype(complex)
    shape, effect = exact.shape, np.eye(OMEGA.size, dtype=complex)[:, None]
    return jq.spectra.FrequencyResponse(
        omega=jnp.asarray(OMEGA),
        response=jnp.asarray(exact + noise),
        coherence=jnp.full(shape, 0.95),
        random_error=jnp.full(shape, ERROR),
        errors=jq.spectra.ErrorCovariance(OMEGA, effect, root.astype(complex)),
        direct_coherence=jnp.full(shape, 0.95),
        multiple_coherence=jnp.full(shape[:2], 0.95),
        method="direct",
        input_names=("u",),
        output_names=("y0", "y1"),
    )


@pytest.mark.slow
def test_outputs_that_share_noise_sharpen_each_other_and_claim_what_they_scatter():
    frfs = [response_of_pair(seed) for seed in range(100)]
    fits = [jq.fit(START, frf) for frf in frfs]
    values = np.array([fit.values for fit in fits])
    claimed = np.mean([fit.noise_standard_errors for fit in fits], axis=0)
    # The standard deviation of 100 draws is itself uncertain by 7 %.
    np.testing.assert_allclose(claimed / values.std(axis=0), 1.0, atol=0.2)
    assert np.mean([fit.chi_squared for fit in fits]) == pytest.approx(1.0, abs=0.06)
    diagonal = np.abs(frfs[0].errors.noise[:, :, :1]) * np.eye(2) / [1.0, CORRELATION]
    apart = dataclasses.replace(frfs[0].errors, noise=diagonal.astype(complex))
    alone = jq.fit(START, dataclasses.replace(frfs[0], errors=apart))
    assert np.all(claimed < 0.7 * alone.noise_standard_errors)


@pytest.mark.slow
def test_pairs_that_share_noise_count_together_in_a_batch_as_in_one_fit():
    frfs = [response_of_pair(seed) for seed in range(3)]
    batch = jq.identify.fit_batch(START, frfs)
    for k, frf in enumerate(frfs):
        one, member = jq.fit(START, frf), batch.fit(k)
        np.testing.assert_allclose(batch.values[k], one.values, rtol=1e-6)
        np.testing.assert_allclose(member.standard_errors, one.standard_errors, rtol=1e-5)
        assert batch.costs[k] == pytest.approx(one.cost, rel=1e-7)


@pytest.mark.slow
def test_pairs_count_together_without_kernels_as_with_them():
    frfs = [response_of_pair(seed) for seed in range(3)]
    kernels = jq.identify.fit_batch(START, frfs)
    jq.engine(kernel="off")
    try:
        jax.clear_caches()
        plain = jq.identify.fit_batch(START, frfs)
    finally:
        jq.engine(kernel="auto")
        jax.clear_caches()
    np.testing.assert_allclose(kernels.values, plain.values, rtol=1e-8)
    np.testing.assert_allclose(kernels.costs, plain.costs, rtol=1e-12)
