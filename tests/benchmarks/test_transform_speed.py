"""Transforms of five window lengths at 100 frequencies beside scipy's and NumPy's, in one run.

    python -m pytest tests/benchmarks/test_transform_speed.py -o addopts=

120 s at 500 Hz, 9 channels, windows of 30, 20, 12, 8 and 5 s. ZoomFFT is on a linear grid of as
many frequencies and rfft on its own grid, since neither can do logarithmic spacing; both detrend
and taper stacked views first.
"""

import jax
import numpy as np
import pytest
from scipy.signal import ZoomFFT

from jaxquad.spectra._fourier_sums import fourier_sums, Taper
from jaxquad.spectra._windows import lattice_windows, window


jax.config.update("jax_enable_x64", True)

RATE = 500
ANGLE = np.geomspace(0.3, 100, 100) / RATE
LENGTHS = tuple(seconds * RATE for seconds in (30, 20, 12, 8, 5))
RECORD = np.random.default_rng(0).standard_normal((120 * RATE, 9))
ROWS = np.ascontiguousarray(RECORD.T)


def _tapered(length, starts):
    views = np.lib.stride_tricks.sliding_window_view(ROWS, length, axis=1)[:, np.array(starts)]
    return (views - views.mean(axis=2, keepdims=True)) * window("hann", length)


@pytest.fixture(params=[0.5, 0.8])
def windows(request):
    return lattice_windows(len(RECORD), LENGTHS, request.param, ANGLE[-1])


def test_jaxquad(benchmark, windows):
    def run():
        taper = (Taper("hann", RECORD.shape[1]),)
        return fourier_sums((RECORD,), ANGLE, windows, taper, detrend="constant", origin=0.0)[0]

    for (length, starts), sums in zip(windows, run(), strict=True):
        first = _tapered(length, starts[:1])[:, 0] @ np.exp(
            -1j * np.multiply.outer(np.arange(length), ANGLE)
        )
        error = np.max(np.abs(np.asarray(sums[:, 0]).T - first)) / np.max(np.abs(first))
        assert error < 1e-12
    benchmark(run)


def test_zoom_fft(benchmark, windows):
    band = [ANGLE[0] / np.pi, ANGLE[-1] / np.pi]
    zooms = {length: ZoomFFT(length, band, m=ANGLE.size) for length in LENGTHS}
    benchmark(lambda: [zooms[n](_tapered(n, starts), axis=2) for n, starts in windows])


def test_rfft(benchmark, windows):
    benchmark(lambda: [np.fft.rfft(_tapered(n, starts), axis=2) for n, starts in windows])
