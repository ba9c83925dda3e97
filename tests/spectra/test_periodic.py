"""Averages over periods: the variance formula against draws, distortion against a long run."""

import functools as ft
from typing import Literal

import numpy as np
import pytest
from scipy import signal

from jaxquad.records import Record
from jaxquad.spectra import frequency_response, JointInputOutput, Periodic


Method = Literal["direct", "joint"]
RATE, PERIOD, DRAWS = 50.0, 500, 80
LINES = np.arange(4, 120, 4)  # harmonics of the period
OMEGA = 2 * np.pi * LINES * RATE / PERIOD
Z = np.exp(1j * OMEGA / RATE)
PLANT = (0.3 + 0.1 / Z) / (1 - 0.7 / Z)
OPTIONS = Periodic(PERIOD / RATE)


def filtered(numerator, denominator, x):
    return np.asarray(signal.lfilter(numerator, denominator, x))


def plant(u):
    return filtered([0.3, 0.1], [1.0, -0.7], u)


def multisine(rng, lines=LINES):
    """Random phases, unit variance."""
    spectrum = np.zeros(PERIOD // 2 + 1, complex)
    spectrum[lines] = np.exp(2j * np.pi * rng.random(len(lines)))
    wave = np.fft.irfft(spectrum, PERIOD)
    return wave / np.std(wave)


def record(seed, *, periods=6, noise=0.1, cubic=0.0, input_noise=0.0):
    rng = np.random.default_rng(seed)
    u = np.tile(multisine(rng), periods)
    y = plant(u + cubic * u**3) + noise * rng.standard_normal(u.size)
    return Record(np.arange(u.size) / RATE, u + input_noise * rng.standard_normal(u.size), y)


def estimate(records, omega=None, options=OPTIONS, method: Method = "direct"):
    estimator = JointInputOutput(options) if method == "joint" else options
    return frequency_response(records, omega, estimator=estimator)


def distortion(found):
    assert found.distortion is not None
    return found.distortion


def variance(found):
    gain = np.sum(np.abs(np.asarray(found.errors.effect)) ** 2, axis=2)
    power = np.sum(np.abs(np.asarray(found.errors.noise)) ** 2, axis=2)
    return power[:, :, None] * gain[:, None, :]


def check_calibrated(found, exact):
    response = np.stack([np.asarray(each.response) for each in found])
    predicted = np.mean([variance(each) for each in found], axis=0)
    ratio = np.sqrt(predicted / np.mean(np.abs(response - exact) ** 2, axis=0))
    # The scatter of 80 complex draws is known to 6 % (1 sigma) at each of 29 lines.
    assert 0.95 < np.mean(ratio) < 1.05
    assert 0.8 < np.min(ratio) and np.max(ratio) < 1.25


@pytest.mark.slow
@pytest.mark.parametrize("realisations", [1, 3])
@pytest.mark.parametrize("input_noise", [0.0, 0.2])
def test_predicted_errors_are_those_of_repeated_draws(realisations, input_noise):
    found = [
        estimate([record(1000 * r + k, input_noise=input_noise) for r in range(realisations)])
        for k in range(DRAWS)
    ]
    check_calibrated(found, PLANT[:, None, None])


def test_without_noise_the_response_at_the_excited_lines_is_exact():
    found = estimate([record(0, noise=0.0)])
    np.testing.assert_allclose(found.omega, OMEGA, rtol=1e-9)
    np.testing.assert_allclose(found.response[:, 0, 0], PLANT, rtol=1e-9)


def test_one_record_gives_the_ratio_of_averaged_transforms():
    one = record(3)
    u, y = (x[PERIOD:, 0].reshape(5, PERIOD).mean(axis=0) for x in (one.inputs, one.outputs))
    expected = np.fft.rfft(y)[LINES] / np.fft.rfft(u)[LINES]
    np.testing.assert_allclose(estimate([one]).response[:, 0, 0], expected, rtol=1e-10)


def closed_loop(k):
    """y = G u + e under u = r - y / 2, G = 0.4 / (z - 0.8)."""
    rng = np.random.default_rng(k)
    r = np.tile(multisine(rng), 6)
    e = 0.3 * rng.standard_normal(r.size)
    y = filtered([0.0, 0.4], [1.0, -0.6], r) + filtered([1.0, -0.8], [1.0, -0.6], e)
    return Record(np.arange(r.size) / RATE, r - 0.5 * y, y, r)


@pytest.mark.parametrize("method", ["direct", "joint"])
def test_noise_that_is_fed_back_does_not_bias_it(method):
    found = [estimate([closed_loop(k)], method=method) for k in range(DRAWS)]
    check_calibrated(found, (0.4 / (Z - 0.8))[:, None, None])


def two_inputs(k):
    """Two records with independent phases on both inputs, two outputs."""
    records = []
    for n in range(2):
        rng = np.random.default_rng([k, n])
        u = np.stack([np.tile(multisine(rng), 6) for _ in range(2)], axis=1)
        y = np.stack([plant(u[:, 0]) + 0.5 * u[:, 1], plant(u[:, 1])], axis=1)
        y = y + 0.1 * rng.standard_normal(y.shape)
        records.append(Record(np.arange(len(u)) / RATE, u, y))
    return records


def test_two_inputs_at_once_need_as_many_records():
    exact = np.zeros((LINES.size, 2, 2), complex)
    exact[:, 0, 0], exact[:, 0, 1], exact[:, 1, 1] = PLANT, 0.5, PLANT
    found = [estimate(two_inputs(k)) for k in range(20)]
    response = np.stack([np.asarray(each.response) for each in found])
    predicted = np.stack([variance(each) for each in found])
    # Where the phases of two draws agree the inputs cannot be told apart: it is seldom, and said.
    assert np.mean(np.isnan(response)) < 0.01
    # Some are nearly alike: each error is compared with its own prediction.
    assert np.nanmean(np.abs(response - exact) ** 2 / predicted) == pytest.approx(1, abs=0.1)
    with pytest.raises(ValueError, match="need at least as many records"):
        estimate(two_inputs(0)[:1])


def test_a_linear_plant_shows_no_distortion():
    told = [distortion(estimate([record(1000 * r + k) for r in range(4)])) for k in range(20)]
    assert not any(each.significant[0] for each in told)
    assert "nonlinear distortion below the noise" in str(told[0])
    noise = np.mean([np.mean(each.noise**2) for each in told])
    assert noise == pytest.approx(0.1**2 / 5, rel=0.05)  # of averages over five periods


CUBIC = 0.1


@ft.cache
def long_run():
    """The best linear approximation of the cubic plant and the scatter, from 500 realisations."""
    spectra = []
    for k in range(500):
        u = np.tile(multisine(np.random.default_rng([k, 7])), 2)
        y = plant(u + CUBIC * u**3)
        spectra.append([np.fft.rfft(x[PERIOD:])[LINES] / np.sqrt(PERIOD) for x in (u, y)])
    u, y = np.moveaxis(np.array(spectra), 1, 0)
    best = np.sum(y * np.conj(u), axis=0) / np.sum(np.abs(u) ** 2, axis=0)
    return best, np.mean(np.abs(y - best * u) ** 2)


def test_a_cubic_plant_shows_its_best_linear_approximation_and_its_distortion():
    best, scatter = long_run()
    found = [
        estimate([record(100 * k + r, cubic=CUBIC, noise=0.02) for r in range(5)])
        for k in range(40)
    ]
    assert all(distortion(each).significant[0] for each in found)
    nonlinear = np.mean([np.mean(distortion(each).nonlinear ** 2) for each in found])
    # The lines' distortions rise and fall together: one estimate scatters by a third, 40 by 5 %.
    assert nonlinear == pytest.approx(scatter, rel=0.2)
    response = np.stack([np.asarray(each.response)[:, 0, 0] for each in found])
    predicted = np.mean([variance(each)[:, 0, 0] for each in found], axis=0)
    ratio = np.sqrt(np.mean(predicted) / np.mean(np.abs(response - best) ** 2))
    assert 0.88 < ratio < 1.12
    assert "nonlinear distortion -" in str(distortion(found[0]))


def test_rounding_errors_are_no_distortion():
    found = distortion(estimate([record(r, noise=0.0) for r in range(4)]))
    assert not found.significant[0]


def test_one_realisation_says_that_it_does_not_show_distortion():
    found = estimate([record(0)])
    assert "unknown" in str(distortion(found)) and np.all(np.isnan(distortion(found).nonlinear))


def test_a_transient_that_is_left_is_remarked():
    slow = record(0, noise=0.001)
    y = slow.outputs + 0.5 * np.exp(-slow.time[:, None] / 3.0)
    left = Record(slow.time, slow.inputs, y)
    assert any("discard more" in r for r in estimate([left], options=Periodic(10.0, 0)).remarks)
    assert not any("discard more" in r for r in estimate([slow]).remarks)


def test_omega_picks_among_the_excited_lines():
    found = estimate([record(0)], OMEGA[[2, 5]])
    np.testing.assert_allclose(found.omega, OMEGA[[2, 5]])
    with pytest.raises(ValueError, match="is not an excited line; the nearest one is"):
        estimate([record(0)], np.array([OMEGA[2] * 1.1]))


def test_a_period_of_no_whole_number_of_samples_is_refused():
    with pytest.raises(ValueError, match="not a whole number"):
        estimate([record(0)], options=Periodic(10.005))


def test_too_few_periods_and_bad_options_are_refused():
    with pytest.raises(ValueError, match="at least two must remain"):
        estimate([record(0, periods=2)])
    with pytest.raises(ValueError, match="period is -1"):
        Periodic(-1.0)
    with pytest.raises(ValueError, match="discard is -1"):
        Periodic(1.0, discard=-1)


def test_an_excitation_that_is_not_periodic_is_refused():
    rng = np.random.default_rng(0)
    u = rng.standard_normal(6 * PERIOD)
    with pytest.raises(ValueError, match="no harmonic of the period exceeds"):
        estimate([Record(np.arange(u.size) / RATE, u, plant(u))])
