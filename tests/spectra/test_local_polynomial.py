"""The local polynomial method against least squares by numpy, and its errors against draws."""

import functools as ft
from typing import Literal

import numpy as np
import pytest
from scipy import signal

from jaxquad.excitation import harmonics, multisine, sweep
from jaxquad.records import Record
from jaxquad.spectra import frequency_response, JointInputOutput, LocalPolynomial


Method = Literal["direct", "joint"]
RATE, SAMPLES, DRAWS = 50.0, 2000, 40
OMEGA = np.geomspace(1.5, 40.0, 16)
Z = np.exp(1j * OMEGA / RATE)
SWEEP = sweep(1.0, 60.0, duration=39.0, sample_rate=RATE, amplitude=1.0, trim=0.5).signal[:SAMPLES]
WHITE = np.random.default_rng(0).standard_normal(SAMPLES)
PLANT = (0.3 + 0.1 / Z) / (1 - 0.7 / Z)
AUTO = LocalPolynomial()


def filtered(numerator, denominator, x):
    return np.asarray(signal.lfilter(numerator, denominator, x))


def plant(u):
    return filtered([0.3, 0.1], [1.0, -0.7], u)


def draw(k, *shape):
    return np.random.default_rng(1000 + k).standard_normal(shape or SAMPLES)


def estimate(u, y, r=None, *, omega=OMEGA, options=AUTO, method: Method = "direct"):
    record = Record(np.arange(len(u)) / RATE, u, y, r)
    estimator = JointInputOutput(options) if method == "joint" else options
    return frequency_response(record, omega, estimator=estimator)


def variance(found):
    return np.asarray(found.errors.variance())


def check_calibrated(found, exact):
    """Predicted over scattered error, and the bias against the error."""
    response = np.stack([np.asarray(each.response) for each in found])
    predicted = np.mean([variance(each) for each in found], axis=0)
    ratio = np.sqrt(predicted / np.mean(np.abs(response - exact) ** 2, axis=0))
    # The scatter of 40 complex draws is known to 8 % (1 sigma), neighbours share some of it.
    assert 0.92 < np.mean(ratio) < 1.1
    assert 0.7 < np.min(ratio) and np.max(ratio) < 1.4
    bias = np.abs(np.mean(response, axis=0) - exact) / np.sqrt(predicted / 2)
    # Half the random error, and what 40 draws leave of it at the worst of 16 frequencies.
    assert np.max(bias) < 0.5 + 3 * np.sqrt(2 / DRAWS)


def by_lstsq(records, omega, width, order):
    """Response, and mean squared residual over freedom, one frequency at a time by numpy."""
    rows, right = [], []
    for n, (u, y) in enumerate(records):
        grid = 2 * np.pi * np.fft.rfftfreq(len(u), 1 / RATE)
        near = (np.abs(grid - omega) <= width) & (grid > 0) & (grid < np.pi * RATE)
        x = (grid[near] - omega)[:, None] ** np.arange(order + 1)
        U, Y = (np.fft.rfft(s)[near] / np.sqrt(len(s)) for s in (u, y))
        own = np.kron(np.eye(len(records))[n], x)
        rows.append(np.hstack([U[:, None] * x, own]))
        right.append(Y)
    matrix, target = np.concatenate(rows), np.concatenate(right)
    found, *_ = np.linalg.lstsq(matrix, target, rcond=None)
    residual = target - matrix @ found
    return found[0], np.sum(np.abs(residual) ** 2) / (len(target) - matrix.shape[1])


@pytest.mark.parametrize("order", [1, 2, 4])
def test_a_given_width_gives_the_least_squares_of_numpy(order):
    pairs = [(WHITE, plant(WHITE) + 0.1 * draw(1)), (SWEEP[:2000], plant(SWEEP[:2000]))]
    records = [Record(np.arange(len(u)) / RATE, u, y) for u, y in pairs]
    options = LocalPolynomial(order=order, width=1.1, global_order=0)
    found = frequency_response(records, OMEGA, estimator=options)
    expected = [by_lstsq(pairs, w, 1.1, order)[0] for w in OMEGA]
    np.testing.assert_allclose(found.response[:, 0, 0], expected, rtol=1e-9)


SIGNALS = {"sweep": SWEEP, "white noise": WHITE}


@ft.cache
def draws(name):
    u = SIGNALS[name]
    return [estimate(u, plant(u) + 0.3 * draw(k)) for k in range(DRAWS)]


@pytest.mark.slow
@pytest.mark.parametrize("name", SIGNALS)
def test_predicted_errors_are_those_of_repeated_draws(name):
    check_calibrated(draws(name), PLANT[:, None, None])


@pytest.mark.slow
def test_predicted_errors_hold_in_coloured_noise():
    noise = [filtered([0.03], [1.0, -0.98], draw(k)) for k in range(DRAWS)]
    found = [estimate(WHITE, plant(WHITE) + each) for each in noise]
    check_calibrated(found, PLANT[:, None, None])


@pytest.mark.slow
def test_two_inputs_at_once_and_two_outputs_with_shared_noise():
    u = np.stack([WHITE, draw(99)], axis=1)
    clean = np.stack([plant(u[:, 0]) + 0.5 * u[:, 1], plant(u[:, 1])], axis=1)
    found = []
    for k in range(DRAWS):
        e = draw(k, SAMPLES, 2) @ np.array([[0.3, 0.25], [0.0, 0.1]])
        found.append(estimate(u, clean + e))
    exact = np.zeros((OMEGA.size, 2, 2), complex)
    exact[:, 0, 0], exact[:, 0, 1], exact[:, 1, 1] = PLANT, 0.5, PLANT
    check_calibrated(found, exact)
    response = np.stack([np.asarray(each.response) for each in found]) - exact
    shared = np.mean(response[:, :, 0, 0] * np.conj(response[:, :, 1, 0]), axis=0)
    root = np.mean([np.asarray(each.errors.noise) for each in found], axis=0)
    noise = root @ np.conj(np.swapaxes(root, 1, 2))
    gain = np.mean(
        [np.sum(np.abs(np.asarray(f.errors.effect)) ** 2, axis=2) for f in found], axis=0
    )
    assert np.sum(shared.real) / np.sum(noise[:, 0, 1].real * gain[:, 0]) == pytest.approx(
        1, abs=0.15
    )


@pytest.mark.slow
def test_neighbouring_frequencies_share_their_errors():
    found = draws("white noise")
    error = np.stack([np.asarray(each.response)[:, 0, 0] for each in found]) - PLANT
    shared = np.mean(error[:, 1:] * np.conj(error[:, :-1]), axis=0)
    claimed = [np.diagonal(each.errors.between((0, 0), (0, 0)), -1) for each in found]
    expected = np.mean(claimed, axis=0)
    assert np.sum(shared).real / np.sum(expected).real == pytest.approx(1, abs=0.2)


def closed_loop(r, k):
    """y = G u + e under u = r - y / 2, G = 0.4 / (z - 0.8)."""
    e = 0.5 * draw(k)
    y = filtered([0.0, 0.4], [1.0, -0.6], r) + filtered([1.0, -0.8], [1.0, -0.6], e)
    return r - 0.5 * y, y


@pytest.mark.slow
def test_the_joint_estimate_holds_in_closed_loop_and_the_direct_one_is_biased():
    loops = [closed_loop(WHITE, k) for k in range(DRAWS)]
    joint = [estimate(u, y, WHITE, method="joint") for u, y in loops]
    exact = (0.4 / (Z - 0.8))[:, None, None]
    check_calibrated(joint, exact)
    direct = np.mean([estimate(u, y).response for u, y in loops[:20]], axis=0)
    # The noise that is fed back biases it towards -1/C = -2.
    spread = np.sqrt(np.mean([variance(each) for each in joint], axis=0) / 20)
    assert np.median(np.abs(direct - exact) / spread) > 5
    coherence = np.asarray(joint[0].coherence)
    assert np.all((coherence > 0.3) & (coherence < 1.0))


def test_an_integrator_taken_out_leaves_its_response():
    y = filtered([1 / RATE], [1.0, -1.0], plant(SWEEP)) + 3.0
    exact = PLANT / RATE / (1 - 1 / Z)
    found = estimate(SWEEP, y, options=LocalPolynomial(integrators=1))
    np.testing.assert_allclose(found.response[:, 0, 0], exact, rtol=1e-3)


def test_a_long_delay_taken_out_leaves_wide_windows():
    """Without a global model, which describes a part of the delay."""
    y = np.concatenate([np.zeros(25), plant(WHITE)])[:SAMPLES] + 0.3 * draw(3)
    plain = estimate(WHITE, y, options=LocalPolynomial(global_order=0))
    helped = estimate(WHITE, y, options=LocalPolynomial(global_order=0, delay=0.5))
    exact = PLANT * Z**-25
    error = [
        np.sqrt(np.mean(np.abs(each.response[:, 0, 0] - exact) ** 2)) for each in (plain, helped)
    ]
    assert error[1] < 0.8 * error[0]
    # Each Fourier bin of a window is one atom of noise.
    bins = [np.count_nonzero(each.errors.effect, axis=(1, 2)) for each in (plain, helped)]
    assert np.median(bins[1]) > 2 * np.median(bins[0])


@pytest.mark.slow
def test_between_the_lines_of_a_multisine_windows_grow_until_they_hold_enough():
    lines = harmonics(1.5, 45.0, period=20.0, lines=30)
    u = multisine(lines, period=20.0, periods=2, sample_rate=RATE, amplitude=1.0).signal
    z = np.exp(1j * lines / RATE)
    exact = (0.3 + 0.1 / z) / (1 - 0.7 / z)
    found = [estimate(u, plant(u) + 0.03 * draw(k), omega=lines) for k in range(10)]
    error = np.stack([np.asarray(each.response)[:, 0, 0] for each in found]) - exact
    predicted = np.stack([variance(each)[:, 0, 0] for each in found])
    # 300 errors, neighbours alike.
    assert np.mean(np.abs(error) ** 2 / predicted) == pytest.approx(1, abs=0.25)


def test_coherence_is_the_explained_share_of_the_power():
    found = estimate(WHITE, plant(WHITE) + 0.3 * draw(4))
    expected = np.abs(PLANT) ** 2 / (np.abs(PLANT) ** 2 + 0.09)
    # Power of the input and of the noise near one frequency are known to some 20 %.
    np.testing.assert_allclose(found.coherence[:, 0, 0], expected, atol=0.15)
    assert np.mean(np.asarray(found.coherence[:, 0, 0]) - expected) == pytest.approx(0, abs=0.03)


def test_what_is_not_excited_is_unknown_and_said_to_be():
    period = np.tile(np.sin(2 * np.pi * np.arange(500) * 40 / 500), 4)
    found = estimate(period, plant(period) + 0.01 * draw(5))
    assert np.all(np.isnan(found.response)) or np.all(found.coherence[OMEGA < 15] < 0.6)
    silent = estimate(np.stack([WHITE, 2 * WHITE], axis=1), plant(WHITE))
    assert np.all(np.isnan(silent.response)) and np.all(np.asarray(silent.coherence) == 0)
    assert np.all(variance(silent) > 1e100)
    assert any("cannot be separated" in remark for remark in silent.remarks)


def test_a_width_that_holds_too_few_bins_says_what_would_do():
    found = estimate(WHITE, plant(WHITE), options=LocalPolynomial(width=0.2))
    assert np.all(np.isnan(found.response))
    assert any("use a larger width: " in remark for remark in found.remarks)


@pytest.mark.parametrize(
    "options",
    [
        {"order": 9},
        {"global_order": 21},
        {"width": 0.0},
        {"width": float("nan")},
        {"integrators": 4},
        {"delay": -1.0},
    ],
)
def test_options_out_of_range_are_refused(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        LocalPolynomial(**options)


def test_records_that_cannot_hold_the_fit_are_refused():
    with pytest.raises(ValueError, match="Record longer"):
        estimate(WHITE[:30], plant(WHITE[:30]))
    with pytest.raises(ValueError, match="one cycle"):
        estimate(WHITE, plant(WHITE), omega=np.array([0.01, 1.0]))
    with pytest.raises(ValueError, match="one external reference for each input"):
        estimate(WHITE, plant(WHITE), method="joint")
