"""Composite windows: their accuracy, their weights and their cost."""

import functools as ft

import numpy as np
import pytest
from scipy import optimize

from jaxquad.excitation import sweep
from jaxquad.records import Record
from jaxquad.spectra import Composite, frequency_response, Welch
from jaxquad.spectra._average import combine, Conditioned


RATE = 250.0
OMEGA = np.geomspace(0.6, 40.0, 60)
SWEEP = sweep(
    0.3, 60.0, duration=90.0, sample_rate=RATE, amplitude=0.1,
    lead_in_cycles=0, fade_in=3.0, fade_out=3.0, trim=0.0,
).signal  # fmt: skip
K, TAU, ZETA, WN, DELAY = 18.0, 0.045, 0.55, 7.0, 0.018


def plant(omega):
    """Second order with a lag and a delay."""
    s = 1j * omega
    return K * WN**2 / (s**2 + 2 * ZETA * WN * s + WN**2) / (TAU * s + 1) * np.exp(-DELAY * s)


def answer(u):
    """By way of the frequency domain, with zeros to let the response die out."""
    count = 2 * u.size
    omega = 2 * np.pi * np.fft.rfftfreq(count, 1 / RATE)
    return np.fft.irfft(np.fft.rfft(u, count) * plant(omega), count)[: u.size]


def noisy(seed, ratio_db=25.0):
    y = answer(SWEEP)
    white = np.random.default_rng(seed).standard_normal(y.size)
    return y + np.std(y) * 10 ** (-ratio_db / 20) * white


@ft.cache
def errors(estimator, draws=6):
    """Root mean squares over the band, in dB and degrees."""
    time, logs = np.arange(SWEEP.size) / RATE, []
    for seed in range(draws):
        found = frequency_response(Record(time, SWEEP, noisy(seed)), OMEGA, estimator=estimator)
        logs.append(np.log(np.asarray(found.response)[:, 0, 0] / plant(OMEGA)))
    logs = np.array(logs)
    return (
        20 / np.log(10) * np.sqrt(np.mean(np.real(logs) ** 2)),
        np.degrees(np.sqrt(np.mean(np.imag(logs) ** 2))),
    )


@pytest.mark.slow
def test_the_composite_of_a_90_s_sweep_is_within_half_a_decibel_and_two_degrees():
    decibels, degrees = errors(Composite())
    assert decibels < 0.46 and degrees < 1.9


@pytest.mark.slow
def test_it_is_better_than_any_of_its_windows():
    for length in (30.0, 12.0):
        assert np.all(np.less(errors(Composite(), draws=2), errors(Welch(length), draws=2)))


def test_one_window_alone_is_welch():
    record = Record(np.arange(SWEEP.size) / RATE, SWEEP, noisy(0))
    one = frequency_response(record, OMEGA, estimator=Composite(windows=(12.0,)))
    other = frequency_response(record, OMEGA, estimator=Welch(12.0))
    np.testing.assert_allclose(one.response, other.response, rtol=1e-12)
    np.testing.assert_allclose(one.random_error, other.random_error, rtol=1e-12)


def spectra(seed, groups=3, frequencies=7):
    """Spectra of several window lengths about one truth."""
    rng, shape = np.random.default_rng(seed), (groups, frequencies, 1, 1)
    gain = 2.0 + 0.2 * rng.standard_normal(shape[:3])
    response = (1 + 0.5j) * np.exp(0.1 * rng.standard_normal(shape))
    coherence = np.clip(0.8 + 0.1 * rng.standard_normal(shape), 0.3, 0.99)
    ones = np.ones(shape[:3])
    return Conditioned(
        response=response,
        solver=np.zeros((groups, frequencies, 1, 1), complex),
        power=gain,
        alone=ones,
        output_power=np.abs(response) ** 2 * gain[..., None] / coherence,
        coherence=coherence,
        instrument_share=ones,
        multiple=ones,
    )


def published(parts, freedom, f):
    """T&R eq. 10.4 at one frequency, minimised by scipy over four unknowns."""
    xx, yy, tt, g2 = (
        np.asarray(getattr(parts, name))[:, f].reshape(-1)
        for name in ("power", "output_power", "response", "coherence")
    )
    xy = tt * xx
    error = np.sqrt((1 - g2) / (g2 * 2 * freedom))
    weight = (error / error.min()) ** -4
    pilot = weight**2 / np.sum(weight**2)
    x0, y0, c0, g0 = (np.sum(pilot * each) for each in (xx, yy, xy, g2))

    def residuals(p):
        a, b, c = p[0], p[1], p[2] + 1j * p[3]
        rows = [(a - xx) / x0.real, (b - yy) / y0.real]
        rows += [(c - xy).real / abs(c0), (c - xy).imag / abs(c0)]
        rows += [np.sqrt(5) * (abs(c) ** 2 / (a * b) - g2) / g0.real]
        return np.concatenate([np.sqrt(weight) * row for row in rows])

    start = np.real([x0, y0, c0, -1j * c0])
    p = optimize.least_squares(residuals, start, x_scale=np.abs(start), xtol=1e-14, ftol=1e-14).x
    return (p[2] + 1j * p[3]) / p[0], (p[2] ** 2 + p[3] ** 2) / (p[0] * p[1])


def test_the_combination_minimises_the_published_cost():
    parts, freedom = spectra(0), np.array([4.0, 9.0, 20.0])
    combined, coherent, _ = combine(parts, np.ones(3), freedom, np.ones((3, 7), bool))
    for f in range(7):
        response, coherence = published(parts, freedom, f)
        assert complex(combined[f, 0, 0]) == pytest.approx(response, rel=1e-6)
        assert float(coherent[f, 0, 0]) == pytest.approx(coherence, rel=1e-6)


def test_a_window_is_left_out_below_two_of_its_cycles():
    record = Record(np.arange(SWEEP.size) / RATE, SWEEP, noisy(0))
    share = np.asarray(frequency_response(record, OMEGA, estimator=Composite()).errors.share)
    # The shortest window is 20 cycles of the highest frequency.
    short = OMEGA * 20 / OMEGA[-1] < 1.9
    assert np.any(short) and np.all(share[short, 0, 0, -1] == 0)
    np.testing.assert_allclose(np.sum(share, axis=3), 1.0, rtol=1e-12)


def test_the_default_windows_suit_the_record_and_the_band():
    record = Record(np.arange(SWEEP.size) / RATE, SWEEP, noisy(0))
    lengths = [member.window_length or 0.0 for member in Composite().windowed([record], OMEGA)]
    assert len(lengths) == 5 and lengths == sorted(lengths, reverse=True)
    assert lengths[0] == pytest.approx(30.0, rel=1e-3)  # a third of 90 s
    assert lengths[-1] == pytest.approx(20 * 2 * np.pi / 40.0)


def test_several_records_share_no_window():
    time = np.arange(SWEEP.size) / RATE
    apart = [Record(time, SWEEP, noisy(k) + 5 * k) for k in range(2)]
    both = frequency_response(apart, OMEGA)
    one, other = (np.asarray(frequency_response(r, OMEGA).random_error) for r in apart)
    mean = np.median(np.asarray(both.random_error) / ((one + other) / 2))
    assert mean == pytest.approx(np.sqrt(0.5), abs=0.12)
    logs = np.log(np.asarray(both.response)[:, 0, 0] / plant(OMEGA))
    assert np.sqrt(np.mean(np.abs(logs) ** 2)) < 0.06


@pytest.mark.parametrize(
    "options, message",
    [
        (dict(windows=()), r"windows are \(\): give one or more different lengths"),
        (dict(windows=(5.0, 5.0)), r"windows are \(5.0, 5.0\): give one or more different lengths"),
        (dict(windows=(5.0, -1.0)), "window_length is -1.0 s: it must be positive"),
        (dict(overlap=1.5), r"overlap is 1.5"),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Composite(**options)
