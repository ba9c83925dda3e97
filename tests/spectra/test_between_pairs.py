"""How the errors of several outputs and inputs are correlated."""

import numpy as np
import pytest
from scipy import signal

import jaxquad as jq


@pytest.mark.parametrize("estimator", [None, jq.spectra.Composite(windows=(4.0, 8.0))])
def test_the_covariance_at_each_frequency_is_that_between_all_pairs(estimator):
    rng, time = np.random.default_rng(0), np.arange(1000) * 0.02
    u, noise = rng.standard_normal((1000, 2)), 0.3 * rng.standard_normal((1000, 2))
    y = np.cumsum(u, axis=0) @ [[0.02, 0.01], [-0.01, 0.02]] + noise @ [[1.0, 0.5], [0.0, 1.0]]
    frf = jq.frequency_response(
        jq.Record(time, u, y), np.geomspace(4.0, 12.0, 5), estimator=estimator
    )
    errors, pairs = frf.errors, list(np.ndindex(2, 2))
    assert (errors.sensitivity is not None) == (estimator is None)
    found = errors.at_each_frequency()
    for a, first in enumerate(pairs):
        for b, second in enumerate(pairs):
            between = np.diagonal(errors.between(first, second))
            np.testing.assert_allclose(found[:, a, b], between, rtol=1e-9, atol=1e-12)


OMEGA = np.geomspace(0.5, 20.0, 60)


def error_of_correlation(size: float, turn: float, seed: int) -> float:
    """Of the noise of two outputs, of which the correlation turns along frequency; its RMS."""
    rng, samples, dt = np.random.default_rng(seed), 3000, 0.02
    exact = lambda omega: size * np.exp(1j * turn * np.log(np.maximum(omega, 0.1)))
    first, other = np.fft.rfft(rng.standard_normal((2, samples)))
    between = exact(2 * np.pi * np.fft.rfftfreq(samples, dt))
    second = np.conj(between) * first + np.sqrt(1 - np.abs(between) ** 2) * other
    noise, u = np.fft.irfft([first, second], samples).T, rng.standard_normal(samples)
    y = np.asarray(signal.lfilter([0.1], [1.0, -0.9], u))[:, None] + noise
    record = jq.Record(dt * np.arange(samples), u, y, hold=dt)
    estimator = jq.spectra.LocalPolynomial(global_order=0)
    root = np.asarray(jq.frequency_response(record, OMEGA, estimator=estimator).errors.noise)
    power = root @ np.conj(np.swapaxes(root, 1, 2))
    found = power[:, 0, 1] / np.sqrt(np.real(power[:, 0, 0] * power[:, 1, 1]))
    return float(np.sqrt(np.mean(np.abs(found - exact(OMEGA)) ** 2)))


@pytest.mark.slow
def test_outputs_are_correlated_as_in_a_wide_band_unless_that_changes_along_frequency():
    """A wide band knows a steady correlation three times better, and would miss all of a turn."""
    steady, turning = (
        np.median([error_of_correlation(*case, seed) for seed in range(4)])
        for case in ((0.5, 0.0), (0.8, 1.5))
    )
    assert steady < 0.1 and turning < 0.3
