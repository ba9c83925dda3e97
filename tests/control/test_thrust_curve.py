"""One thrust curve out of gains that were found in bins of the collective."""

import numpy as np
import pytest

from jaxquad.control.autopilots import (
    adrc_b0_law,
    motor_command,
    pool_gains,
    thrust_linear,
)


BINS = np.array([0.15, 0.25, 0.35, 0.5, 0.7])
ERROR = np.array([30.0, 15.0, 12.0, 20.0, 40.0])
FACTOR = 0.6


def gains(factor, x, full=1200.0):
    """Of a plant whose thrust is (1 - f) x + f x^2: its derivative."""
    return full * (1 - factor + 2 * factor * x)


def test_the_factor_and_the_gain_cover_the_truth_as_often_as_they_say():
    random = np.random.default_rng(5)
    inside = np.zeros(2)
    draws = 600
    for _ in range(draws):
        curve = pool_gains(BINS, gains(FACTOR, BINS) + ERROR * random.standard_normal(5), ERROR)
        inside[0] += abs(curve.factor - FACTOR) < 1.96 * curve.factor_error
        value, error = curve.gain(np.array([0.4]))
        inside[1] += abs(value - gains(FACTOR, 0.4))[0] < 1.96 * error[0]
    # The error is never below that of the bins, so cover is a little above 95 %.
    assert np.all((inside / draws > 0.93) & (inside / draws < 0.985))


def test_a_curve_that_was_compensated_in_flight_is_found_all_the_same():
    flown = 0.3
    x = motor_command(BINS, flown)
    np.testing.assert_allclose((1 - flown) * x + flown * x**2, BINS, rtol=1e-12)
    gain = gains(FACTOR, x) / (1 - flown + 2 * flown * x)
    curve = pool_gains(BINS, gain, ERROR, flown_factor=flown)
    assert curve.factor == pytest.approx(FACTOR, rel=1e-12)
    assert motor_command(BINS, 0.0) is BINS
    falling = motor_command(BINS, -0.5)
    np.testing.assert_allclose(1.5 * falling - 0.5 * falling**2, BINS, rtol=1e-12)


def test_a_log_of_one_collective_cannot_tell_and_says_what_to_fly():
    near = np.array([0.29, 0.3, 0.31])
    curve = pool_gains(near, gains(FACTOR, near), np.full(3, 20.0))
    assert "cannot tell" in curve.verdict and "climbs" in curve.verdict
    assert pool_gains(BINS, gains(FACTOR, BINS), ERROR).verdict == ""
    with pytest.raises(ValueError, match="two bins"):
        pool_gains(near[:1], near[:1], near[:1])


def test_a_misfit_of_the_bins_widens_the_error():
    bent = gains(FACTOR, BINS) * (1 + 0.3 * np.cos(9 * BINS))
    curve = pool_gains(BINS, bent, ERROR)
    smooth = pool_gains(BINS, gains(FACTOR, BINS), ERROR)
    wider = np.sqrt(curve.covariance[0, 0] / smooth.covariance[0, 0])
    assert curve.misfit > 2 and wider == pytest.approx(np.sqrt(curve.misfit))


@pytest.mark.parametrize("version", [(2025, 12), (2026, 6)])
def test_thrust_linear_makes_the_gain_more_even(version):
    curve = pool_gains(BINS, gains(FACTOR, BINS), ERROR)
    percent, error = thrust_linear(curve, version=version)
    e, t = percent / 100, np.linspace(0.1, 0.9, 50)
    motor = t * (1 + e * (1 - t) ** 2)
    if version >= (2026, 6):
        motor = t * (1 + e * (1 - t) * (1 + e * (1 - 2 * t)))
    slope = np.gradient(FACTOR * motor**2 + (1 - FACTOR) * motor, t)
    assert np.std(slope) < 0.5 * np.std(gains(FACTOR, t, 1.0))
    assert 0 < error < 30


def test_the_b0_law_is_the_one_that_a_thrust_curve_is_nearest_to():
    square = pool_gains(BINS, gains(1.0, BINS), ERROR)  # the gain grows as the throttle
    linear = pool_gains(BINS, gains(0.0, BINS), ERROR)
    found = adrc_b0_law(square, hover=0.3, lag=0.03)
    assert found.law == "LINEAR" and found.deviation < 1e-9
    assert found.b0 == pytest.approx(180 / np.pi * gains(1.0, 0.3) / 30)
    assert adrc_b0_law(linear, hover=0.3, lag=0.03).law == "FIXED"
    assert (
        adrc_b0_law(pool_gains(BINS, gains(0.55, BINS), ERROR), hover=0.3, lag=0.03).law == "SQRT"
    )
