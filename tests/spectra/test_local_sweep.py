"""The local polynomial method on a sweep of 90 s, with and without a resonance."""

import numpy as np
import pytest
from scipy.signal import lfilter

from jaxquad.excitation import sweep
from jaxquad.records import Record
from jaxquad.spectra import frequency_response, LocalPolynomial


def sampled(wn, zeta, delay, tau, u, rate):
    """K wn^2 / (s^2 + 2 zeta wn s + wn^2) / (tau s + 1) exp(-delay s), by a padded transform."""
    omega = 2 * np.pi * np.fft.rfftfreq(4 * u.size, 1 / rate)
    return np.fft.irfft(np.fft.rfft(u, 4 * u.size) * second_order(wn, zeta, delay, tau, omega))[
        : u.size
    ]


def second_order(wn, zeta, delay, tau, omega):
    s = 1j * omega
    return 18 * wn**2 / (s**2 + 2 * zeta * wn * s + wn**2) / (tau * s + 1) * np.exp(-delay * s)


BAND = np.geomspace(0.6, 40.0, 60)
LONG = sweep(0.3, 60.0, duration=89.9, sample_rate=250.0, amplitude=0.1, lead_in_cycles=0, trim=0.0)


def variance(found):
    return np.asarray(found.errors.variance())[:, 0, 0]


def ninety_seconds(zeta, k, *, ratio=25.0, options: LocalPolynomial | None = None):
    model = (7.0, zeta, 0.018, 0.045)
    y = sampled(*model, LONG.signal, 250.0)
    y = y + np.std(y) * 10 ** (-ratio / 20) * np.random.default_rng(k).standard_normal(y.size)
    record = Record(LONG.time, LONG.signal, y)
    found = frequency_response(record, BAND, estimator=options or LocalPolynomial())
    return found, np.asarray(found.response)[:, 0, 0] / second_order(*model, BAND)


@pytest.mark.slow
def test_a_sweep_of_90_s_gives_half_the_error_of_composite_windows():
    ratios = np.stack([ninety_seconds(0.55, k)[1] for k in range(8)])
    # Five composite windows reach 0.46 dB and 1.9 deg.
    assert np.sqrt(np.mean((20 * np.log10(np.abs(ratios))) ** 2)) < 0.28
    assert np.degrees(np.sqrt(np.mean(np.angle(ratios) ** 2))) < 1.8


@pytest.mark.slow
def test_a_lightly_damped_resonance_stays_within_its_errors():
    for k in range(5):
        found, ratio = ninety_seconds(0.02, k)
        near = np.abs(np.log(BAND / 7.0)) < 0.15
        error = np.sqrt(variance(found) / 2) / np.abs(np.asarray(found.response)[:, 0, 0])
        assert np.all(np.abs(ratio - 1)[near] < 4 * error[near])
        assert np.all(error[near] < 0.05)


def test_a_resonance_sharper_than_the_band_takes_a_rational_function():
    near = np.abs(np.log(BAND / 7.0)) < 0.15
    _, ratio = ninety_seconds(0.02, 0, options=LocalPolynomial(global_order=0))
    alone = LocalPolynomial(width=0.5, global_order=0)
    _, polynomial = ninety_seconds(0.02, 0, options=alone)
    assert np.max(np.abs(ratio - 1)[near]) < 0.03
    assert np.max(np.abs(polynomial - 1)[near]) > 0.3


def test_without_noise_little_is_left_of_leakage():
    _, ratio = ninety_seconds(0.55, 0, ratio=300.0)
    assert np.max(np.abs(ratio - 1)) < 1e-3
    _, ratio = ninety_seconds(0.55, 0, ratio=300.0, options=LocalPolynomial(order=4))
    assert np.max(np.abs(ratio - 1)) < 1e-4


def test_beyond_the_end_of_a_sweep_nothing_is_taken_from_within_it():
    """A window that reached back into the sweep would claim 3 % there, and be wrong altogether."""
    slow = sweep(0.3, 5.0, duration=60.0, sample_rate=100.0, amplitude=1.0)
    omega, excess = np.geomspace(0.6, 30.0, 60), []
    held = np.exp(-0.005j * omega) * np.sinc(0.01 * omega / (2 * np.pi))
    lag = np.exp(-0.01 / 0.3)
    moved = np.asarray(lfilter([0.0, 1 - lag], [1.0, -lag], slow.signal))
    for k in range(4):
        noise = 0.03 * np.std(moved) * np.random.default_rng(k).standard_normal(moved.size)
        record = Record(slow.time, slow.signal, moved + noise)
        found = frequency_response(record, omega, estimator=LocalPolynomial())
        response = np.asarray(found.response)[:, 0, 0]
        error = np.abs(response - held / (0.3j * omega + 1)) ** 2
        excess.append(error / variance(found))
    beyond = np.sqrt(np.mean(excess, axis=0))[omega > 6.0]
    assert np.sqrt(np.mean(beyond**2)) < 1.5 and beyond.max() < 3.0


@pytest.mark.parametrize("rest", [0, 1500])
def test_a_mode_that_still_rings_when_the_record_ends_stays_within_its_errors(rest):
    slow = sweep(0.3, 5.0, duration=60.0, sample_rate=100.0, amplitude=1.0)
    omega = np.geomspace(0.6, 5.5, 50)
    u = np.concatenate([slow.signal, np.zeros(rest)])
    y = sampled(3.0, 0.05, 0.0, 0.0, u, 100.0)
    y = y + 0.003 * np.std(y) * np.random.default_rng(0).standard_normal(y.size)
    record = Record(0.01 * np.arange(u.size), u, y)
    found = frequency_response(record, omega, estimator=LocalPolynomial())
    ratio = np.asarray(found.response)[:, 0, 0] / second_order(3.0, 0.05, 0.0, 0.0, omega)
    error = np.asarray(found.random_error)[:, 0, 0]
    assert np.all(np.abs(ratio - 1) < 4 * error) and np.all(error[omega < 4.5] < 0.05)
    alone = frequency_response(record, omega, estimator=LocalPolynomial(global_order=0))
    off = np.abs(np.asarray(alone.response)[:, 0, 0] / second_order(3.0, 0.05, 0.0, 0.0, omega) - 1)
    assert rest or np.nanmax(off / np.asarray(alone.random_error)[:, 0, 0]) > 20
