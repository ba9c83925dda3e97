import warnings

import numpy as np
import pytest
from scipy import signal

from jaxquad.records import read, Record, RecordWarning
from jaxquad.spectra import DOMINATED, frequency_response, JointInputOutput, Welch
from jaxquad.spectra._feedback import (
    lagged_products,
    phase_slope,
    share_from_output,
)


RATE, SAMPLES = 50.0, 3000
OMEGA = np.geomspace(2.0, 100.0, 40)
Z = np.exp(1j * OMEGA / RATE)
PLANT = 0.4 / (Z - 0.8)
GAIN = 0.5  # of the controller
WELCH = Welch(8.0)


def filtered(numerator, denominator, x):
    return np.asarray(signal.lfilter(numerator, denominator, x))


def closed_loop(seed, *, sweep=1.0, noise=1.0):
    """y = PLANT u + e under u = r - GAIN y, simulated by its exact difference equation."""
    r, e = np.array([[sweep], [noise]]) * np.random.default_rng(seed).standard_normal((2, SAMPLES))
    loop = [1.0, -0.8 + 0.4 * GAIN]
    y = filtered([0.0, 0.4], loop, r) + filtered([1.0, -0.8], loop, e)
    return Record(np.arange(SAMPLES) / RATE, r - GAIN * y, y, r)


def phase_rises(omega, response, error, coherence, covariance=None):
    slope = phase_slope(omega, response, error, coherence)
    return slope is not None and slope.rises(response, covariance)


def mean_response(estimator, noise):
    """The mean of 40 draws, and its standard error."""
    draws = [
        np.asarray(
            frequency_response(closed_loop(k, noise=noise), OMEGA, estimator=estimator).response
        )[:, 0, 0]
        for k in range(40)
    ]
    return np.mean(draws, axis=0), np.std(draws, axis=0) / np.sqrt(40)


def test_the_joint_estimate_is_unbiased_in_closed_loop():
    found, error = mean_response(JointInputOutput(WELCH), 0.5)
    # The largest of 40 values, and the ratio's own bias, which is the square of its error of 0.2.
    assert np.max(np.abs(found - PLANT) / error) < 4
    assert np.max(np.abs(found / PLANT - 1)) < 0.1


def test_the_direct_estimate_lies_between_the_plant_and_the_inverse_controller():
    found, error = mean_response(WELCH, 0.5)
    # The input's power is that of r less GAIN times the noise, and only r passes the plant.
    expected = (PLANT - GAIN * 0.5**2) / (1 + GAIN**2 * 0.5**2)
    assert np.max(np.abs(found - expected) / error) < 4
    assert np.median(np.abs(found - PLANT) / error) > 5


def test_without_a_reference_the_direct_estimate_shows_the_inverse_controller():
    # A little sensor noise keeps the input from being an exact copy of the output.
    found = frequency_response(closed_loop(0, sweep=0.05), OMEGA, estimator=WELCH)
    np.testing.assert_allclose(found.response[:, 0, 0], -1 / GAIN, rtol=0.15)


def test_the_direct_estimate_says_what_it_assumes_about_feedback():
    found = frequency_response(closed_loop(0), OMEGA, estimator=WELCH)
    assert "H1, unbiased in open loop; with feedback, name a reference" in str(found)


def test_a_reference_that_explains_input_and_output_needs_no_remark():
    estimator = JointInputOutput(WELCH)
    found = frequency_response(closed_loop(0, noise=0.05), OMEGA, estimator=estimator)
    assert found.remarks == ()


def test_a_reference_that_explains_neither_is_remarked():
    estimator = JointInputOutput(WELCH)
    found = frequency_response(closed_loop(0, sweep=0.1), OMEGA, estimator=estimator)
    assert any(remark.kind == DOMINATED for remark in found.remarks)


def tilted(delay, *, scatter=0.05, coherence=0.9):
    """The response of a lag or, of -1/C with a delayed controller, a lead; with noise."""
    noise = scatter * np.random.default_rng(0).standard_normal(OMEGA.size)
    phase = np.angle(np.exp(1j * (noise - delay * OMEGA)))
    flat = np.full(OMEGA.size, 1.0)
    return OMEGA, np.exp(1j * phase), scatter * flat, coherence * flat


def test_the_phase_of_a_lag_falls_and_that_of_an_inverse_controller_rises():
    assert phase_rises(*tilted(-0.01))
    assert not phase_rises(*tilted(0.01))
    assert not phase_rises(*tilted(0.0))


def test_a_rise_within_its_error_or_without_coherence_is_none():
    assert not phase_rises(*tilted(-0.0001))
    assert not phase_rises(*tilted(-0.01, coherence=0.5))


def test_a_rise_that_all_frequencies_share_by_chance_is_none():
    """Neighbours' errors turn the phase together, by a slope whose standard error is the rise's."""
    omega, response, error, coherence = tilted(-0.01)
    together = 0.01 * np.sqrt(2) * omega * response
    assert phase_rises(omega, response, error, coherence)
    covariance = lambda: np.outer(together, together.conj())
    assert not phase_rises(omega, response, error, coherence, covariance)


@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_the_share_is_that_of_the_simulated_powers(gain):
    rng = np.random.default_rng(0)
    y, r = rng.standard_normal((2, 40_000))
    u = r - gain * np.concatenate([[0.0], y[:-1]])
    found = share_from_output([np.stack([y, u])], 0.01, np.geomspace(30.0, 300.0, 20))
    # 40 000 samples and 12 lags: standard errors of 1.5 %.
    np.testing.assert_allclose(found.output_first, gain**2 / (1 + gain**2), atol=0.05)
    np.testing.assert_allclose(found.input_first, gain**2 / (1 + gain**2), atol=0.05)


def test_what_both_have_in_common_at_one_sample_is_counted_either_way():
    y, r = np.random.default_rng(0).standard_normal((2, 40_000))
    found = share_from_output([np.stack([y, r - 3.0 * y])], 0.01, np.geomspace(30.0, 300.0, 20))
    np.testing.assert_allclose(found.output_first, 0.9, atol=0.03)
    assert np.all(found.input_first < 0.03)


def test_too_short_a_record_says_nothing():
    x = np.random.default_rng(0).standard_normal((2, 100))
    assert not np.any(share_from_output([x], 0.01, np.geomspace(2.0, 60.0, 50)).output_first)


def test_sums_of_products_are_those_of_the_shifted_samples():
    x = np.random.default_rng(0).standard_normal((2, 300))
    found = lagged_products(x)
    order = len(found) // 2 - 1
    rows = np.concatenate([x[:, order - k : 300 - k] for k in range(order + 1)])
    np.testing.assert_allclose(found, rows @ rows.T, atol=1e-10)


def measured(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RecordWarning)  # of gaps of a few samples
        return frequency_response(read(path, **options))


def dominated(found):
    return any(remark.kind == DOMINATED for remark in found.remarks)


@pytest.mark.parametrize("axis", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_flight_without_excitation_is_dominated_by_feedback(data, axis):
    found = measured(
        data / "betaflight_ar8" / "LOG00037.npz",
        inputs=f"pid_sum[{axis}]",
        outputs=f"gyro_dps[{axis}]",
        references=f"setpoint_dps[{axis}]",
        sample_rate=900,
    )
    assert found.method == "joint"
    assert dominated(found)


def test_a_flight_with_a_random_set_point_is_not(data):
    path = data / "antx_pitch" / "antx_log3_prbs.npz"
    roles = dict(inputs="M", outputs="q", references="x0")
    assert not dominated(measured(path, **roles, sample_rate=250, start=50, stop=76))


def test_strong_manual_manoeuvres_are_not(data):
    mix = {"motor_u16[0]": -1, "motor_u16[1]": -1, "motor_u16[2]": 1, "motor_u16[3]": 1}
    path = data / "crazyflie_rollpitch" / "log15.npz"
    roles = dict(inputs={"roll": mix}, outputs="gyro_dps[0]")
    assert not dominated(measured(path, **roles, sample_rate=500, start=55, stop=90))
