"""Predicted random errors against the scatter of repeated draws of the noise."""

import numpy as np
import pytest
from scipy import signal

from jaxquad.excitation import sweep
from jaxquad.records import Record
from jaxquad.spectra import frequency_response, JointInputOutput, Welch


RATE, DRAWS = 50.0, 200
OMEGA = np.geomspace(1.2, 50.0, 40)
SWEEP = sweep(1.0, 60.0, duration=60.0, sample_rate=RATE, amplitude=1.0).signal
WHITE = np.random.default_rng(0).standard_normal(SWEEP.size)
WELCH = Welch(12.0)


def filtered(numerator, denominator, x):
    return np.asarray(signal.lfilter(numerator, denominator, x))


def plant(u):
    return filtered([0.3, 0.1], [1.0, -0.7], u)


def white(k, deviation=0.3):
    return deviation * np.random.default_rng(k).standard_normal(SWEEP.size)


def drifting(k):
    """Noise whose power falls by 30 dB over the band."""
    return filtered([0.1], [1.0, -0.98], white(k))


def respond(u, y, r=None, estimator: Welch | JointInputOutput = WELCH):
    record = Record(np.arange(u.size) / RATE, u, y, r)
    return frequency_response(record, OMEGA, estimator=estimator)


def open_loop(u, noise):
    exact = respond(u, plant(u)).response
    return exact, [respond(u, plant(u) + noise(k)) for k in range(DRAWS)]


def closed_loop(r, noise):
    """y = G u + e under u = r - y / 2, by way of the joint estimate."""
    y, u = ([0.0, 0.4], [1.0, -0.6]), ([1.0, -0.8], [1.0, -0.6])  # from r, G = 0.4 / (z - 0.8)
    estimator, found = JointInputOutput(WELCH), []
    for k in range(DRAWS):
        fed_back = r - 0.5 * noise(k)  # what the loop makes of e, except e itself
        command = filtered(*u, fed_back)
        output = filtered(*y, fed_back) + noise(k)
        found.append(respond(command, output, r, estimator))
    # Through the same windows, whose leakage is no random error.
    exact = respond(filtered(*u, r), filtered(*y, r), r, estimator).response
    return exact, found


CASES = {
    "white input": lambda: open_loop(WHITE, white),
    "sweep": lambda: open_loop(SWEEP, white),
    "sweep under drifting noise": lambda: open_loop(SWEEP, drifting),
    "sweep in closed loop": lambda: closed_loop(SWEEP, white),
}


PARAMETERS = [
    pytest.param(name, id=name.replace(" ", "-"), marks=pytest.mark.slow) for name in CASES
]


@pytest.fixture(scope="module", params=PARAMETERS)
def draws(request):
    """Relative errors of all draws, the predicted errors, and the mean predicted covariance."""
    exact, found = CASES[request.param]()
    responses = np.stack([np.asarray(f.response)[:, 0, 0] for f in found])
    predicted = np.stack([np.asarray(f.random_error)[:, 0, 0] for f in found])
    covariance = np.mean([f.relative_covariance() for f in found], axis=0)
    return responses / np.asarray(exact)[:, 0, 0] - 1, predicted, covariance


def correlation(covariance):
    deviation = np.sqrt(np.real(np.diag(covariance)))
    return covariance / np.outer(deviation, deviation)


def test_the_random_error_is_the_scatter_of_magnitude_and_of_phase(draws):
    errors, predicted, _ = draws
    for part in (errors.real, errors.imag):
        ratio = np.median(predicted, axis=0) / np.std(part, axis=0)
        # 200 draws leave 5 % of doubt at a frequency, and 10 or so of the 40 are independent.
        assert np.mean(ratio) == pytest.approx(1, abs=0.1)
        assert 0.75 < np.min(ratio) and np.max(ratio) < 1.35


def test_its_square_is_half_the_diagonal_of_the_covariance(draws):
    _, predicted, covariance = draws
    twice = 2 * np.mean(predicted**2, axis=0)
    # Two sums over the windows, on grids of their own.
    np.testing.assert_allclose(np.diag(covariance), twice, rtol=1e-4)


@pytest.mark.parametrize("apart", [1, 2, 4])
def test_neighbouring_frequencies_share_the_predicted_part_of_their_error(draws, apart):
    errors, _, covariance = draws
    sample = np.conj(errors).T @ errors / len(errors)
    off = np.diag(correlation(np.conj(sample)) - correlation(covariance), apart)
    # A correlation from 200 draws is uncertain by 0.07, its mean over the band by a third.
    assert np.sqrt(np.mean(np.abs(off) ** 2)) < 0.11
    assert abs(np.mean(off)) < 0.06


def test_far_frequencies_share_none(draws):
    apart = np.abs(OMEGA[:, None] - OMEGA[None, :]) > 8.1 * 2 * np.pi / 12.0
    assert np.all(np.abs(correlation(draws[2]))[apart] < 0.01)


@pytest.mark.slow
def test_without_noise_the_random_error_is_as_small_as_the_leakage():
    found = respond(WHITE, plant(WHITE))
    assert np.all(np.asarray(found.random_error) < 0.02)
    assert np.all(np.isfinite(found.relative_covariance()))


def test_an_exact_copy_leaves_a_random_error_of_rounding_and_no_nan():
    found = respond(WHITE, 2 * WHITE)
    assert np.all(np.asarray(found.random_error) < 1e-10)
    assert np.all(np.isfinite(found.relative_covariance()))
    np.testing.assert_allclose(found.coherence, 1.0, rtol=1e-12)


def test_the_covariance_is_positive_semidefinite():
    values = np.linalg.eigvalsh(respond(SWEEP, plant(SWEEP) + white(0)).relative_covariance())
    assert values.min() > -1e-12 * values.max()


def test_every_output_has_the_error_it_would_have_alone():
    y, z = plant(WHITE) + white(2), 3 * WHITE + white(1)
    both = respond(WHITE, np.stack([y, z], axis=1))
    for o, alone in enumerate([respond(WHITE, y), respond(WHITE, z)]):
        np.testing.assert_allclose(
            both.random_error[:, o], np.asarray(alone.random_error)[:, 0], rtol=1e-10
        )
        np.testing.assert_allclose(
            np.diag(both.relative_covariance(o)), np.diag(alone.relative_covariance()), rtol=1e-8
        )
