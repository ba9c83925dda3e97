"""How far a local window reaches, by the number of Fourier bins that it holds."""

import numpy as np

from jaxquad.records import Record
from jaxquad.spectra import frequency_response, LocalPolynomial


SAMPLES, RATE = 4000, 20.0
LINES = 2 * np.pi * np.fft.rfftfreq(SAMPLES, 1 / RATE)  # rad/s
OMEGA = np.array([6.0, 8.0, 20.0])
WIDE = 0.6  # of the frequency; the widest window is 1.2 / 1.8 of it, as no bias shows


def half_widths(power):
    """Of windows for a plant without dynamics, where only the excitation limits them."""
    random = np.random.default_rng(0)
    root = np.sqrt(np.broadcast_to(power, LINES.shape))
    spectrum = root * np.exp(2j * np.pi * random.random(LINES.size))
    u = np.fft.irfft(spectrum * (LINES > 0), SAMPLES)
    y = 2 * u + 1e-4 * np.std(u) * random.standard_normal(SAMPLES)
    record = Record(np.arange(SAMPLES) / RATE, u, y)
    found = frequency_response(record, OMEGA, estimator=LocalPolynomial())
    np.testing.assert_allclose(found.response[:, 0, 0], 2.0, rtol=0.05)
    bins = np.count_nonzero(found.errors.effect, axis=(1, 2))
    return bins * (LINES[1] - LINES[0]) / 2


def test_a_flat_spectrum_and_that_of_an_exponential_sweep_let_windows_be_wide():
    assert np.all(half_widths(1.0) > WIDE * OMEGA)
    assert np.all(half_widths(1 / np.maximum(LINES, 0.1)) > WIDE * OMEGA)


def test_where_a_sweep_has_ended_windows_do_not_reach_back_into_it():
    reached = half_widths(np.where(LINES < 5.0, 1.0, 1e-6))
    assert np.all((OMEGA - reached)[:2] > 3.8)  # a step of the search beyond 5 rad/s


def test_between_lines_windows_reach_to_the_lines_on_both_sides():
    apart = np.round(LINES / (LINES[1] - LINES[0])).astype(int) % 20 == 0
    assert np.all(half_widths(np.where(apart, 1.0, 0.0)) > WIDE * OMEGA)
