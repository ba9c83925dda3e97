"""The angle loop around a rate loop, its margins, and plants whose rate is damped."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from jaxquad.autopilot import (
    ArduPilotRate,
    certify_angle,
    delay_margin,
    FilterChain,
    firmware_named,
    hold_plants,
    RateLoops,
)


DT, GAIN, LAG = 1 / 400, 80.0, 0.03
GAINS = np.array([0.135, 0.135, 0.0036])
OMEGA = np.geomspace(0.05, 0.999 * np.pi / DT, 1200)
column = lambda x: np.array([[x]])


def test_the_delay_margin_of_an_integrator_is_a_quarter_turn_at_its_gain():
    loops = np.array([k / (1j * OMEGA) for k in (3.0, 20.0)])
    np.testing.assert_allclose(
        delay_margin(loops, OMEGA), [math.pi / 2 / 3, math.pi / 2 / 20], rtol=1e-4
    )


def held_step(damping, delay):
    """State matrix and the columns of the command so many samples ago, by a matrix exponential."""
    generator = np.array([[-1 / LAG, 0, GAIN / LAG], [1, -damping, 0], [0, 0, 0]])
    whole, late = divmod(delay, DT)
    rest, early = expm(generator * (DT - late)), expm(generator * late)
    before = rest[:2, :2] @ early[:2, 2]
    return expm(generator * DT)[:2, :2], rest[:2, 2], before, int(whole)


@pytest.mark.parametrize(("damping", "delay"), [(0.0, 0.0), (2.1, 0.0013), (0.5, 0.0061)])
def test_a_held_plant_with_damping_is_the_exact_sampled_one(damping, delay):
    found = hold_plants(column(GAIN), column(LAG), column(delay), OMEGA, DT, column(damping))[0]
    state, now, before, wait = held_step(max(damping, 1e-9), delay)
    z = np.exp(1j * OMEGA * DT)
    exact = [
        np.linalg.solve(x * np.eye(2) - state, now * x**-wait + before * x ** (-wait - 1))[1]
        for x in z
    ]
    np.testing.assert_allclose(found, exact, rtol=1e-4)


def swing(value, seconds=60.0):
    """How much the angle of a simulated loop with ATC_ANG_RLL_P grows from its middle to its end.

    The law is written once more: set-points act one loop late, and all filters are off.
    """
    state, now, _, _ = held_step(0.0, 0.0)
    p, i, d = GAINS
    x, angle, integral, last, wanted = np.array([0.0, 0.01]), 0.0, 0.0, 0.0, 0.0
    angles = []
    for _ in range(int(seconds / DT)):
        error = wanted - x[1]
        integral += i * error * DT
        command = p * error + integral + d * (error - last) / DT
        last, wanted = error, -value * angle
        moved = state @ x + now * command
        angle += (x[1] + moved[1]) / 2 * DT
        x = moved
        angles.append(angle)
        if abs(angle) > 1e3:
            return np.inf
    half = len(angles) // 2
    return max(map(abs, angles[-half // 4 :])) / max(map(abs, angles[half : half + half // 4]))


def test_the_angle_loop_is_stable_up_to_the_gain_at_which_a_simulated_one_is():
    law = ArduPilotRate(
        *GAINS, gyro=FilterChain((), 1 / DT), target_hz=0.0, error_hz=0.0, derivative_hz=0.0, dt=DT
    )
    angle = firmware_named("ardupilot").angle_loop({"ATC_ANG_RLL_P": "4.5"}, 0, DT, levelled=False)
    assert angle is not None and angle.closed and angle.unit * angle.value == 4.5
    plants = hold_plants(column(GAIN), column(LAG), column(0.0), OMEGA, DT)
    loops = RateLoops.of(law, 0, plants, OMEGA, angle=angle)
    stable = lambda value: certify_angle([loops], GAINS, angle, value).stable == 1
    low, high = 1.0, 200.0
    assert stable(low) and not stable(high)
    for _ in range(12):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    assert swing(0.95 * low) < 1 < swing(1.05 * high)
    # The margin of delay of a loop that is stable is what brings it there.
    half = loops.outer_loops(GAINS, low / 2)
    late = half * np.exp(-1j * OMEGA * delay_margin(half, OMEGA)[0])
    assert np.min(np.abs(1 + late)) < 0.02


def test_a_search_in_single_precision_sees_what_a_certificate_in_double_does():
    random = np.random.default_rng(2)
    law = ArduPilotRate(*GAINS, gyro=FilterChain((), 1 / DT), dt=DT)
    spread = lambda middle: middle * np.exp(0.2 * random.standard_normal((16, 1)))
    plants = hold_plants(spread(GAIN), spread(LAG), spread(0.004), OMEGA, DT)
    loops = RateLoops.of(law, 0, plants, OMEGA)
    gains = GAINS * np.exp(random.uniform(0, 4, (200, 3)))
    exact, quick = loops.qualities(gains), loops.in_single_precision().qualities(gains)
    usual = exact.stable & (exact.peak < 3)
    assert 0.1 < np.mean(exact.stable) < 0.95 and np.sum(usual) > 200
    np.testing.assert_array_equal(quick.stable[exact.peak < 100], exact.stable[exact.peak < 100])
    for name in ("peak", "resonance", "crossover", "rejection", "noise"):
        one, other = getattr(quick, name)[usual], getattr(exact, name)[usual]
        np.testing.assert_allclose(one, other, rtol=1e-4, err_msg=name)
    assert quick.peak.dtype == np.float32 and exact.peak.dtype == np.float64


def test_betaflights_angle_loop_is_open_in_acro_and_has_no_yaw():
    values = {"levelPID": "50,75,75"}
    acro = firmware_named("betaflight").angle_loop(values, 0, 1 / 4000, levelled=False)
    assert acro is not None and not acro.closed and acro.unit * acro.value == pytest.approx(5.0)
    assert firmware_named("betaflight").angle_loop(values, 2, 1 / 4000, levelled=True) is None
    assert firmware_named("betaflight").angle_loop({}, 0, 1 / 4000, levelled=True) is None
