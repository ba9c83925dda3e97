"""The global model below the local polynomials: rings, leakage, and the errors of both."""

from typing import cast

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from jaxquad.excitation import harmonics, multisine, sweep
from jaxquad.records import Record
from jaxquad.spectra import (
    frequency_response,
    FrequencyResponse,
    JointInputOutput,
    LocalPolynomial,
)


DT = 0.02
OMEGA = np.geomspace(0.6, 14.0, 40)
U = sweep(0.3, 15.0, duration=60.0, sample_rate=1 / DT, amplitude=1.0, trim=0.0).signal
MODE = ([100.0], [1.0, 0.4, 100.0])  # 10 rad/s, damping ratio 0.02
HELD = cast(tuple[np.ndarray, np.ndarray, float], signal.cont2discrete(MODE, DT))


def exact(omega):
    z = np.exp(1j * omega * DT)
    return np.polyval(HELD[0][0], z) / np.polyval(HELD[1], z)


def ringing(seed, u=U, noise=0.02):
    y = np.asarray(signal.lfilter(HELD[0][0], HELD[1], u))
    return y + noise * np.std(y) * np.random.default_rng(seed).standard_normal(y.size)


def estimate(seed, **options) -> FrequencyResponse:
    record = Record(DT * np.arange(U.size), U, ringing(seed))
    return frequency_response(record, OMEGA, estimator=LocalPolynomial(**options))


def parts_over_error(found, response):
    """Errors of real and imaginary part over the claimed one."""
    measured = np.asarray(found.response)[:, 0, 0]
    error = np.asarray(found.random_error)[:, 0, 0] * np.abs(measured)
    return np.stack([(measured - response).real, (measured - response).imag]) / error


def test_a_light_mode_that_rings_at_the_end_is_measured_within_its_errors():
    found = [estimate(seed) for seed in range(4)]
    off = np.stack([parts_over_error(each, exact(OMEGA)) for each in found])
    assert np.max(np.abs(off)) < 4.5 and 0.6 < np.sqrt(np.mean(off**2)) < 1.3
    alone = parts_over_error(estimate(0, global_order=0), exact(OMEGA))
    assert np.nanmax(np.abs(alone)) > 20
    assert not any(each.remarks for each in found)


def test_a_model_that_is_too_small_is_remarked_and_rest_is_advised():
    remarks = " ".join(estimate(0, global_order=1).remarks)
    assert "still moves when the record ends" in remarks and "rest at the end" in remarks


def test_a_line_is_not_told_from_a_mode_that_rings_and_both_are_named():
    """A plant without any mode, and a tone in its output."""
    y = np.asarray(signal.lfilter([0.05], [1, -0.95], U))
    noise = 0.02 * np.random.default_rng(0).standard_normal(y.size)
    tone = np.sin(5 * DT * np.arange(U.size) + 1)
    record = Record(DT * np.arange(U.size), U, y + np.std(y) * (noise + tone))
    found = frequency_response(record, OMEGA, estimator=LocalPolynomial(global_order=1))
    ringing = [remark for remark in found.remarks if "a mode that rings" in remark]
    assert len(ringing) == 2 and all("or a line (a tone" in remark for remark in ringing)


def check_that_errors_agree(errors, o, i):
    """Variance, covariance and projection of one pair."""
    assert errors.sensitivity is not None
    covariance, variance = errors.between((o, i), (o, i)), errors.variance()[:, o, i]
    np.testing.assert_allclose(np.real(np.diag(covariance)), variance, rtol=1e-9)
    # The real part of an error, and the imaginary part, add up to its mean square.
    columns = np.zeros((*errors.variance().shape, 2), complex)
    columns[7, o, i] = 1.0, 1.0j
    parts = np.asarray(errors.project(jnp.asarray(columns)))
    assert np.trace(parts) == pytest.approx(variance[7], rel=1e-9)
    turned = errors.scaled(jnp.full(errors.omega.size, 2.0j)).pair(o, i)
    np.testing.assert_allclose(turned.variance()[:, 0, 0], 4 * variance, rtol=1e-9)


def test_variance_covariance_and_projection_of_shared_parameters_agree():
    check_that_errors_agree(estimate(0).errors, 0, 0)


@pytest.mark.slow
def test_errors_of_a_long_record_agree_where_windows_take_few_of_its_bins():
    """Of 10 minutes at 1 kHz: most atoms have no part in the errors of the models."""
    samples, rng = 600_000, np.random.default_rng(0)
    white, noise = rng.standard_normal((2, samples, 2))
    u = np.asarray(signal.lfilter([0.02], [1, -0.98], white, axis=0))
    y = np.asarray(signal.lfilter([0.01], [1, -0.99], u, axis=0)) + 0.02 * noise
    record = Record(np.arange(samples) / 1000.0, u, y)
    errors = frequency_response(record, np.geomspace(0.5, 60.0, 30)).errors
    first = np.asarray(errors.first)
    atoms = np.max(first) + errors.effect.shape[2] - np.min(first)
    assert errors.drive is not None and errors.drive.shape[1] < 0.6 * atoms
    check_that_errors_agree(errors, 1, 0)


def test_beyond_a_chirp_that_stops_at_once_there_is_no_response():
    """u = sin(t^2 / 10) ends near 8 rad/s; beyond, its transform is leakage."""
    time = np.arange(0.0, 40.0, DT)
    u = np.sin(time**2 / 10)
    y = signal.lsim(([3.0], [1.0, 2.0]), u, time)[1]
    omega = np.geomspace(0.8, 30.0, 40)
    found = frequency_response(Record(time, u, y), omega)
    response = np.asarray(found.response)[:, 0, 0]
    assert np.all(np.isnan(response[omega > 11]))
    inside = omega < 7
    np.testing.assert_allclose(response[inside], 3 / (1j * omega[inside] + 2), rtol=5e-3)


@pytest.mark.slow
def test_records_that_ring_share_a_model_and_have_transients_of_their_own():
    off = []
    for seed in range(6):
        parts = []
        for k, length in enumerate((2000, 2600)):
            u = U[-length:]
            parts.append(Record(DT * np.arange(length), u, ringing(10 * seed + k, u)))
        found = frequency_response(parts, OMEGA[10:], estimator=LocalPolynomial())
        off.append(parts_over_error(found, exact(OMEGA[10:])))
    assert np.max(np.abs(off)) < 4.5 and 0.7 < np.sqrt(np.mean(np.square(off))) < 1.3


def closed(seed, gust):
    """y = G (u + w), u = r - 0.1 (y + noise), the mode G under a weak feedback."""
    rng = np.random.default_rng(seed)
    w = gust * np.asarray(signal.lfilter([0.2], [1.0, -0.98], rng.standard_normal(U.size)))
    above, below = HELD[0][0], HELD[1]
    loop = np.polyadd(below, 0.1 * above)
    y = np.asarray(signal.lfilter(above, loop, U + w))
    return U - 0.1 * y, y


@pytest.mark.slow
def test_the_joint_estimate_knows_the_errors_of_its_two_models():
    off = []
    for seed in range(12):
        u, y = closed(seed, 0.02)
        record = Record(DT * np.arange(U.size), u, y, U)
        found = frequency_response(record, OMEGA, estimator=JointInputOutput())
        off.append(parts_over_error(found, exact(OMEGA)))
    worst = np.nanmax(np.abs(off), axis=(1, 2))
    assert np.median(worst) < 4 and 0.7 < np.sqrt(np.nanmean(np.square(off))) < 1.3


def test_bins_are_thinned_without_losing_the_lines_of_a_periodic_input():
    """Of 4500 bins every second one would hold no line of two periods: they are the odd ones."""
    lines = harmonics(0.6, 60.0, period=90.0)
    u = multisine(lines, period=90.0, periods=2, sample_rate=1 / DT, amplitude=1.0).signal
    omega = np.geomspace(1.0, 55.0, 30)
    found = frequency_response(Record(DT * np.arange(u.size), u, ringing(3, u)), omega)
    errors = np.abs(np.asarray(found.response).ravel() / exact(omega) - 1)
    assert np.all(errors < 5 * np.sqrt(2) * np.asarray(found.random_error).ravel() + 1e-3)


def late(omega=None):
    """A mode behind 1.5 samples of delay, at the samples: its output, or its response."""
    above, below, _ = cast(
        tuple[np.ndarray, np.ndarray, float],
        signal.cont2discrete(([36.0], [1.0, 4.8, 36.0]), DT / 2),
    )
    if omega is None:
        fast = signal.lfilter(above[0], below, np.repeat(U, 2))
        return np.concatenate([np.zeros(3), fast])[: 2 * U.size : 2]
    z = np.exp(1j * (omega * DT / 2 + np.pi * np.arange(2)[:, None]))  # and its alias
    each = np.polyval(above[0], z) / np.polyval(below, z) * (1 + 1 / z) / z**3
    return np.mean(each, axis=0)


@pytest.mark.slow
def test_what_the_order_of_the_model_cannot_see_biases_no_response():
    """Noise and the same noise of the other sign: their mean shows the bias alone."""
    y, biases = late(), []
    for seed in range(3):
        noise = 0.02 * np.std(y) * np.random.default_rng(seed).standard_normal(y.size)
        both = [
            frequency_response(Record(DT * np.arange(U.size), U, y + sign * noise), OMEGA)
            for sign in (1, -1)
        ]
        first, mean = both[0], sum(np.asarray(each.response)[:, 0, 0] for each in both) / 2
        error = np.asarray(first.random_error * np.abs(first.response))[:, 0, 0]
        biases.append((mean - late(OMEGA)) / error)
    assert np.sqrt(np.mean(np.abs(biases) ** 2)) < 0.13


def test_an_estimate_does_not_depend_on_those_before_it():
    first, other, again = (estimate(seed) for seed in (0, 1, 0))
    np.testing.assert_array_equal(again.response, first.response)
    between = np.abs(np.asarray(other.response) - np.asarray(first.response)).ravel()
    assert np.all(between > 0)
