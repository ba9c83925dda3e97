"""Conditioned composite responses of three inputs and six outputs beside scipy's, in one run.

    python -m pytest tests/benchmarks/test_composite_speed.py -o addopts=

120 s at 500 Hz, windows of 30, 20, 12, 8 and 5 s that overlap by half, 100 frequencies. The peer
stacks tapered segments, transforms them with `scipy.signal.ZoomFFT` (on a linear grid, since it has
no other), conditions by `numpy.linalg.solve` and combines by the published weights, without the
published cost's iterations. Ours are log-spaced, include that cost, all checks, coherence and the
random error; the covariance between frequencies is computed when a fit asks for it.
"""

import jax
import numpy as np
import pytest
from scipy.signal import ZoomFFT

import jaxquad as jq


jax.config.update("jax_enable_x64", True)

RATE, SECONDS, LENGTHS = 500.0, 120, (30.0, 20.0, 12.0, 8.0, 5.0)
SAMPLES = int(RATE * SECONDS)
OMEGA = np.geomspace(0.5, 100.0, 100)
LINEAR = np.linspace(0.5, 100.0, 100)


def flight() -> jq.Record:
    rng = np.random.default_rng(0)
    u = np.cumsum(rng.standard_normal((SAMPLES, 3)), axis=0) * 0.01
    mixed = np.hstack([u @ rng.standard_normal((3, 3)), np.roll(u, 5, axis=0)])
    y = mixed + 0.05 * rng.standard_normal((SAMPLES, 6))
    return jq.Record(np.arange(SAMPLES) / RATE, u, y)


RECORD = flight()
ESTIMATOR = jq.spectra.Composite(windows=LENGTHS, overlap=0.5)
COLUMNS = np.hstack([RECORD.inputs, RECORD.outputs])
BAND = (LINEAR[0] / (2 * np.pi), LINEAR[-1] / (2 * np.pi))
ZOOMS = {
    seconds: ZoomFFT(int(seconds * RATE), BAND, 100, fs=int(RATE), endpoint=True)
    for seconds in LENGTHS
}


def ours(omega=OMEGA):
    return jax.block_until_ready(jq.frequency_response(RECORD, omega, estimator=ESTIMATOR))


def transformed(seconds):
    length = int(seconds * RATE)
    views = np.lib.stride_tricks.sliding_window_view(COLUMNS, length, axis=0)[:: length // 2]
    taper = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length)
    return ZOOMS[seconds]((views - views.mean(axis=2, keepdims=True)) * taper)


def conditioned(seconds):
    sums = transformed(seconds)
    spectra = np.einsum("saf,sbf->fab", np.conj(sums), sums) / len(sums)
    scale = 2 / RATE / (0.375 * seconds * RATE)
    xx, xy = spectra[:, :3, :3] * scale, spectra[:, :3, 3:] * scale
    yy = np.real(np.diagonal(spectra, axis1=1, axis2=2))[:, 3:] * scale
    response = np.linalg.solve(xx, xy)
    power = 1 / np.real(np.diagonal(np.linalg.inv(xx), axis1=1, axis2=2))
    rest = yy - np.real(np.einsum("fio,fio->fo", np.conj(xy), response))
    own = np.abs(response) ** 2 * power[:, :, None]
    coherence = own / (own + rest[:, None, :])
    return response, power[:, :, None] * np.ones((1, 1, 6)), coherence, SECONDS / seconds


def peer():
    response, power, coherence, count = (
        np.stack(part) for part in zip(*map(conditioned, LENGTHS), strict=True)
    )
    error = (1 - coherence) / (coherence * 2 * (count[:, None, None, None] - 2))
    weight = (error.min(axis=0) / error) ** 2
    mean = np.sum(weight * power, axis=0)
    return np.sum(weight * power * response, axis=0) / mean


def test_both_find_the_same_response():
    found = np.swapaxes(np.asarray(ours(LINEAR).response), 1, 2)
    apart = np.abs(found - peer()) / np.abs(peer())
    assert np.median(apart) < 0.02


@pytest.mark.benchmark(group="composite, 3 x 6")
def test_jaxquad(benchmark):
    benchmark.pedantic(ours, rounds=60, warmup_rounds=5)


@pytest.mark.benchmark(group="composite, 3 x 6")
def test_zoom_fft(benchmark):
    benchmark.pedantic(peer, rounds=15, warmup_rounds=2)
