"""How the errors of several outputs and inputs are correlated."""

import numpy as np
import pytest

import jaxquad as jq
from jaxquad.spectra._noise import smooth_noise


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


def correlation_found(exact: np.ndarray, open_loop: bool) -> np.ndarray:
    """Of two outputs, by residuals of 12 degrees of freedom at 60 frequencies."""
    rng = np.random.default_rng(1)
    white = rng.standard_normal((60, 2, 12, 2)) @ [1.0, 1j] / np.sqrt(2)
    other = (
        np.conj(exact)[:, None] * white[:, 0]
        + np.sqrt(1 - np.abs(exact[:, None]) ** 2) * (white[:, 1])
    )
    both = np.stack([white[:, 0], other], axis=1)
    scatter = both @ np.conj(np.swapaxes(both, 1, 2)) / 12
    noise = smooth_noise(OMEGA, 0.15 * OMEGA, scatter, np.full(60, 12.0), open_loop=open_loop)
    return noise.correlation[:, 0, 1]


def test_outputs_are_correlated_as_in_a_wide_band_unless_that_changes_along_frequency():
    rms = lambda x: np.sqrt(np.mean(np.abs(x) ** 2))
    steady, turning = np.full(60, 0.5 + 0j), 0.8 * np.exp(1.5j * np.log(OMEGA))
    narrow, wide = (correlation_found(steady, each) - steady for each in (False, True))
    assert rms(wide) < 0.6 * rms(narrow)
    narrow, wide = (correlation_found(turning, each) - turning for each in (False, True))
    assert rms(wide) < 1.15 * rms(narrow)
