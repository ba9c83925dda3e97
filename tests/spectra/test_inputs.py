"""Several inputs at once: responses conditioned on the other inputs."""

import numpy as np
import pytest
from scipy import signal

from jaxquad.records import Record
from jaxquad.spectra import (
    Composite,
    frequency_response,
    JointInputOutput,
    LocalPolynomial,
    Periodic,
    Welch,
)


RATE, LENGTH, SAMPLES = 50.0, 200, 4000
OMEGA = 2 * np.pi * RATE / LENGTH * np.array([3, 5, 8, 12, 20, 32, 50, 70])  # scipy's bins
WELCH = Welch(LENGTH / RATE)
PLANT = (([0.3, 0.1], [1.0, -0.7]), ([0.0, -0.5], [1.0, -0.4]))  # of each input


def noise(seed, columns=1, deviation=1.0):
    return deviation * np.random.default_rng(seed).standard_normal((SAMPLES, columns))


def together(seed=0, share=0.6):
    """Two inputs, the second of which follows the first."""
    u = noise(seed, 2)
    return np.stack([u[:, 0], share * u[:, 0] + 0.8 * u[:, 1]], axis=1)


def answer(u, seed=None, deviation=0.3):
    y = np.sum([signal.lfilter(*part, u[:, k]) for k, part in enumerate(PLANT)], axis=0)
    return y if seed is None else y + noise(seed, deviation=deviation)[:, 0]


def exact():
    z = np.exp(1j * OMEGA / RATE)
    return np.stack([np.polyval(b, z) / np.polyval(a, z) for b, a in PLANT], axis=1)


def respond(u, y, r=None, estimator: Welch | JointInputOutput = WELCH):
    return frequency_response(
        Record(np.arange(SAMPLES) / RATE, u, y, r), OMEGA, estimator=estimator
    )


def csd(a, b):
    bins = np.round(OMEGA * LENGTH / (2 * np.pi * RATE)).astype(int)
    found = signal.csd(a, b, fs=RATE, nperseg=LENGTH, noverlap=LENGTH * 4 // 5, window="hann")
    return np.asarray(found[1])[bins]


def test_two_inputs_follow_the_closed_form_of_the_textbook():
    u = together()
    y = answer(u, seed=1)
    (x1, x2), found = u.T, np.asarray(respond(u, y).response)[:, 0, 0]
    g11, g22, g12 = csd(x1, x1), csd(x2, x2), csd(x1, x2)
    g1y, g2y = csd(x1, y), csd(x2, y)
    coherence = np.abs(g12) ** 2 / np.real(g11 * g22)
    textbook = g1y / g11 * (1 - g12 * g2y / (g22 * g1y)) / (1 - coherence)
    np.testing.assert_allclose(found, textbook, rtol=1e-9)


def test_partial_and_multiple_coherence_are_those_of_the_residual_spectra():
    u = together()
    y = answer(u, seed=1, deviation=2.0)
    found = respond(u, y)
    g22, gyy, g11 = (np.real(csd(each, each)) for each in (u[:, 1], y, u[:, 0]))
    g2y, g12, g1y = csd(u[:, 1], y), csd(u[:, 1], u[:, 0]), csd(u[:, 0], y)
    # All that the second input explains is taken out of the first and of the output.
    x = g11 - np.abs(g12) ** 2 / g22
    rest = gyy - np.abs(g2y) ** 2 / g22
    cross = g1y - np.conj(g12) * g2y / g22
    partial = np.abs(cross) ** 2 / (x * rest)
    np.testing.assert_allclose(found.coherence[:, 0, 0], partial, rtol=1e-9)
    multiple = 1 - (1 - np.abs(g2y) ** 2 / (g22 * gyy)) * (1 - partial)
    np.testing.assert_allclose(found.multiple_coherence[:, 0], multiple, rtol=1e-9)


def test_each_input_alone_is_biased_by_the_other_and_conditioned_it_is_not():
    u = together(share=1.0)
    y = answer(u)
    alone = np.asarray(respond(u[:, 0], y).response)[:, 0, 0]
    assert np.median(np.abs(alone / exact()[:, 0] - 1)) > 0.2
    np.testing.assert_allclose(respond(u, y).response[:, 0], exact(), rtol=0.03)


def test_permuted_channels_permute_the_responses():
    u, y = together(), np.stack([answer(together(), 1), answer(together()[:, ::-1], 2)], axis=1)
    found, swapped = respond(u, y), respond(u[:, ::-1], y[:, ::-1])
    for name in ("response", "coherence", "random_error"):
        one, other = (np.asarray(getattr(f, name)) for f in (found, swapped))
        np.testing.assert_allclose(one[:, ::-1, ::-1], other, rtol=1e-9)


def test_other_units_scale_the_responses_and_change_no_error():
    u, y = together(), answer(together(), 1)
    found, scaled = respond(u, y), respond(u * np.array([1e6, 1e-6]), 1e3 * y)
    expected = np.asarray(found.response) * 1e3 / np.array([1e6, 1e-6])
    np.testing.assert_allclose(scaled.response, expected, rtol=1e-9)
    np.testing.assert_allclose(scaled.random_error, found.random_error, rtol=1e-9)


@pytest.fixture(scope="module")
def draws():
    """Responses to a common input under fresh noise, and their relative errors."""
    u = together(share=1.5)
    found = [respond(u, answer(u, seed=k + 1)) for k in range(150)]
    responses = np.stack([np.asarray(f.response)[:, 0] for f in found])
    return found, responses.mean(axis=0), responses / responses.mean(axis=0) - 1


@pytest.mark.slow
def test_the_random_error_of_both_inputs_is_their_scatter(draws):
    found, _, errors = draws
    predicted = np.stack([np.asarray(f.random_error)[:, 0] for f in found])
    half = np.sqrt(np.mean(np.abs(errors) ** 2, axis=0) / 2)
    ratio = np.sqrt(np.mean(predicted**2, axis=0)) / half
    # 150 draws leave 6 % of doubt at each of the 16 numbers.
    assert np.mean(ratio) == pytest.approx(1, abs=0.05)
    assert 0.8 < ratio.min() and ratio.max() < 1.25


@pytest.mark.slow
def test_the_errors_of_both_inputs_are_correlated_as_they_scatter(draws):
    found, truth, errors = draws
    sample = np.mean(errors[:, :, 0] * errors[:, :, 1].conj(), axis=0)
    between = np.mean([np.diag(f.errors.between((0, 0), (0, 1))) for f in found[:20]], axis=0)
    predicted = between / (truth[:, 0] * truth[:, 1].conj())
    size = np.sqrt(np.prod([np.mean(np.abs(errors[:, :, i]) ** 2, axis=0) for i in (0, 1)], axis=0))
    assert np.min(np.abs(predicted) / size) > 0.6
    assert np.max(np.abs(sample - predicted) / size) < 0.2


def test_two_references_give_both_responses_in_closed_loop():
    r, e = noise(5, 2), noise(6, deviation=0.5)[:, 0]
    y, u = np.zeros(SAMPLES), np.zeros((SAMPLES, 2))
    for k in range(2, SAMPLES):
        y[k] = 0.8 * y[k - 1] + 0.4 * u[k - 1, 0] - 0.3 * u[k - 1, 1] + e[k] - 0.8 * e[k - 1]
        u[k] = r[k] - np.array([0.5, -0.4]) * y[k]
    z = np.exp(1j * OMEGA / RATE)
    truth = np.stack([0.4 / (z - 0.8), -0.3 / (z - 0.8)], axis=1)
    joint, direct = respond(u, y, r, JointInputOutput(WELCH)), respond(u, y)
    apart = [
        np.abs(np.asarray(f.response)[:, 0] / truth - 1) / np.asarray(f.random_error)[:, 0]
        for f in (joint, direct)
    ]
    # 1.2 is the median of noise alone.
    assert np.median(apart[0]) < 1.6 and np.median(apart[1]) > 2.2


def test_inputs_that_cannot_be_told_apart_are_marked_where_they_cannot():
    u = together()
    high = signal.butter(4, 0.5, "high", output="sos")
    u = np.stack([u[:, 0] + signal.sosfiltfilt(high, u[:, 1]), u[:, 0]], axis=1)
    found = respond(u, answer(u, seed=1))
    lost = ~np.isfinite(np.asarray(found.response)[:, 0, 0])
    assert lost[0] and not lost[-1]
    assert np.all(np.isinf(np.asarray(found.random_error)[lost]))
    assert np.all(np.isfinite(np.asarray(found.random_error)[~lost]))
    assert any("cannot be separated from the other inputs at" in remark for remark in found.remarks)


def test_inputs_that_move_together_are_remarked():
    u = together(share=2.0)
    found = respond(u, answer(u, seed=1))
    correlated = "input u1 is correlated with the other inputs"
    assert any(remark.startswith(correlated) for remark in found.remarks)
    independent = respond(noise(1, 2), answer(noise(1, 2)))
    assert not any("is correlated with" in remark for remark in independent.remarks)


@pytest.mark.slow
def test_ten_inputs_and_twenty_outputs_are_estimated_at_once():
    u, gain = noise(0, 10), np.random.default_rng(1).standard_normal((10, 20))
    found = respond(u, u @ gain + 1e-3 * noise(2, 20), estimator=Welch(2.0))
    np.testing.assert_allclose(
        found.response, np.broadcast_to(gain.T, (OMEGA.size, 20, 10)), atol=2e-3
    )
    assert found.errors.noise.shape == (OMEGA.size, 20, 20)


def decoupled(seed):
    """Two outputs, each of which responds to its own input; the references move both inputs."""
    r = noise(0, 2) @ np.array([[1.0, 0.5], [0.0, 1.0]])
    u = r + noise(seed, 2, 0.2)
    y = np.stack([signal.lfilter(*part, u[:, k]) for k, part in enumerate(PLANT)], axis=1)
    return Record(np.arange(SAMPLES) / RATE, u, y + noise(seed + 1, 2, 0.05), r)


@pytest.mark.parametrize(
    "spectra",
    [LocalPolynomial(), WELCH, pytest.param(Composite((4.0, 8.0)), marks=pytest.mark.slow)],
)
@pytest.mark.parametrize("joint", [False, True])
def test_a_pair_without_any_response_has_no_coherence(spectra, joint):
    estimator = JointInputOutput(spectra) if joint else spectra
    found = frequency_response(decoupled(2), OMEGA, estimator=estimator)
    typical = np.median(np.asarray(found.coherence), axis=0)
    assert np.all(np.diag(typical) > 0.9)
    assert np.all(typical[[0, 1], [1, 0]] < 0.3)


def test_a_pair_without_any_response_has_no_coherence_over_periods_either():
    rng, samples = np.random.default_rng(3), 200
    spectrum = np.exp(2j * np.pi * rng.uniform(size=(101, 2)))
    spectrum[[0, *range(41, 101)]] = 0
    wave = np.fft.irfft(spectrum, samples, axis=0)
    records = []
    for sign in (1, -1):
        u = np.tile(wave * np.array([1, sign]), (8, 1)) / np.std(wave)
        y = np.stack([signal.lfilter(*part, u[:, k]) for k, part in enumerate(PLANT)], axis=1)
        time = np.arange(len(u)) / RATE
        records.append(Record(time, u, y + 0.05 * rng.standard_normal(y.shape)))
    found = frequency_response(records, estimator=Periodic(samples / RATE))
    typical = np.median(np.asarray(found.coherence), axis=0)
    assert np.all(np.diag(typical) > 0.9) and np.all(typical[[0, 1], [1, 0]] < 0.3)
