"""One frequency response of a 90 s record at 250 Hz beside scipy's calls for the same, in one run.

    python -m pytest tests/benchmarks/test_spectra_speed.py -o addopts=

Both use the same Hann windows of 18 s with an overlap of 0.8. Ours gives 100 log-spaced
frequencies, coherence, random error, the covariance between all frequencies, and remarks; scipy
gives its own 2251 equally spaced bins without errors.
"""

import jax
import numpy as np
import pytest
from scipy import signal

from jaxquad.excitation import sweep
from jaxquad.records import Record
from jaxquad.spectra import frequency_response, FrequencyResponse, spectral_density, Welch


jax.config.update("jax_enable_x64", True)

RATE, SAMPLES = 250.0, 22500
WINDOW = SAMPLES // 5
ESTIMATOR = Welch(WINDOW / RATE)
BINS = np.geomspace(1, 450, 100).astype(int)
BINS = np.unique(BINS) * 2 * np.pi * RATE / WINDOW


def flight() -> Record:
    command = sweep(0.5, 60.0, duration=84.0, sample_rate=RATE, amplitude=1.0).signal[:SAMPLES]
    noise = 0.01 * np.random.default_rng(0).standard_normal(SAMPLES)
    answer = np.asarray(signal.lfilter([0.02], [1.0, -0.98], command)) + noise
    return Record(np.arange(SAMPLES) / RATE, command, answer)


RECORD = flight()


def ours(omega=None) -> FrequencyResponse:
    return jax.block_until_ready(frequency_response(RECORD, omega, estimator=ESTIMATOR))


def scipys():
    u, y = RECORD.inputs[:, 0], RECORD.outputs[:, 0]
    frequency, cross = averaged(signal.csd, u, y)
    power, answer = averaged(signal.welch, u)[1], averaged(signal.welch, y)[1]
    coherence = averaged(signal.coherence, u, y)[1]
    return 2 * np.pi * frequency, cross / power, answer, coherence


def averaged(estimate, *channels):
    return estimate(*channels, fs=RATE, nperseg=WINDOW, noverlap=WINDOW * 4 // 5)


def test_both_find_the_same_response():
    found, (omega, response, _, coherence) = ours(BINS), scipys()
    place = np.searchsorted(omega, BINS - 1e-6)
    np.testing.assert_allclose(found.response[:, 0, 0], response[place], rtol=1e-8)
    np.testing.assert_allclose(found.coherence[:, 0, 0], coherence[place], rtol=1e-8)


@pytest.mark.benchmark(group="frequency response, 90 s at 250 Hz")
def test_jaxquad_with_errors_and_their_covariance(benchmark):
    benchmark.pedantic(ours, rounds=100, warmup_rounds=5)


@pytest.mark.benchmark(group="frequency response, 90 s at 250 Hz")
def test_jaxquad_spectra_alone(benchmark):
    spectra = lambda: jax.block_until_ready(spectral_density(RECORD, welch=ESTIMATOR))
    benchmark.pedantic(spectra, rounds=100, warmup_rounds=5)


@pytest.mark.benchmark(group="frequency response, 90 s at 250 Hz")
def test_scipy_csd_welch_and_coherence(benchmark):
    benchmark.pedantic(scipys, rounds=100, warmup_rounds=5)
