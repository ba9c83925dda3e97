"""PID against scipy's continuous systems, in a saturated loop, and its linear form."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from jaxquad.control import BackCalculation, Clamping, PID, Setpoint


DT, KP, KI, KD, BANDWIDTH = 0.01, 12.0, 5.0, 3.0, 40.0
TIME = DT * np.arange(400)


def commands(pid, reference, angle):
    step = lambda state, now: pid.step(state, *now)
    inputs = jax.tree.map(lambda x: jnp.asarray(x)[:, None], (reference, angle))
    start = pid.init(jnp.zeros(1), inputs[1][0])
    run = jax.jit(lambda: jax.lax.scan(step, start, inputs)[1])
    return np.asarray(run())[:, 0]


def broken_lines(seed):
    """Random values, straight in between: what the law is exact for."""
    return 0.1 * np.random.default_rng(seed).standard_normal((2, len(TIME)))


def through(numerator, denominator, x):
    """scipy's answer to `x`, taken as straight between samples, from rest at its first value."""
    return signal.lsim((numerator, denominator), x - x[0], TIME)[1]


@pytest.mark.parametrize("weights", [(1.0, 0.0), (0.3, 0.6)])
def test_it_is_the_continuous_pid_for_signals_straight_between_samples(weights):
    r, y = broken_lines(0)
    b, c = weights
    pid = PID(
        [KP], [KI], [KD], filter=[BANDWIDTH], proportional_weight=b, derivative_weight=c, dt=DT
    )
    error = r - y
    integral = KI * (through([1], [1, 0], error) + error[0] * TIME)
    rate = KD * through([BANDWIDTH, 0], [1, BANDWIDTH], c * r - y)
    expected = KP * (b * r - y) + integral + rate
    np.testing.assert_allclose(commands(pid, r, y), expected, rtol=1e-10, atol=1e-10)


def test_a_setpoint_brings_its_own_rate_and_acceleration():
    pid = PID([KP], [KI], [KD], filter=[BANDWIDTH], feedforward=[0.7], dt=DT)
    r = np.where(TIME < 2, 0.2 * TIME**2, 0.8 * TIME - 0.8)  # parabola, then straight
    rate = np.where(TIME < 2, 0.4 * TIME, 0.8)
    acceleration = np.where(TIME < 2, 0.4, 0.0)
    setpoint = Setpoint(*map(jnp.asarray, (r, rate, acceleration)))
    # An angle on the reference leaves no error: of the rate neither, to half a sample of a corner.
    found = commands(pid, setpoint, r)
    corner = np.abs(TIME - 2) < 10 / BANDWIDTH
    np.testing.assert_allclose((found - 0.7 * acceleration)[~corner], 0, atol=1e-3 * KD)
    before = TIME < 1.99
    np.testing.assert_allclose((found - 0.7 * acceleration)[before], 0, atol=1e-12)


def test_a_flight_that_starts_off_level_gives_no_derivative_kick():
    off = np.full(len(TIME), 0.2)
    for smooth in (None, SMOOTH):
        pid = PID([KP], [0.0], [KD], measurement_filter=smooth, dt=DT)
        found = commands(pid, np.zeros(len(TIME)), off)
        np.testing.assert_allclose(found, -0.2 * KP, rtol=1e-13)


SMOOTH = 35.0  # rad/s, of the measurement


def behind_scipys_filter(y):
    """Filtered angle and rate of a measurement that is held over the sample before it."""
    w = SMOOTH
    system = ([[0, 1], [-(w**2), -np.sqrt(2) * w]], [[0], [w**2]], np.eye(2), np.zeros((2, 1)))
    held = np.append(y[1:], y[-1]) - y[0]
    found = signal.lsim(system, held, TIME, interp=False)[1]
    return found[:, 0] + y[0], found[:, 1]


def test_a_filtered_measurement_and_its_rate_are_scipys():
    r, y = broken_lines(2)
    zero = np.zeros(len(TIME))
    smooth: dict[str, Any] = dict(measurement_filter=[SMOOTH], filter=[BANDWIDTH], dt=DT)
    angle, rate = behind_scipys_filter(y)
    assert commands(PID([1.0], [0.0], [0.0], **smooth), zero, y) == pytest.approx(-angle, abs=1e-12)
    assert commands(PID([0.0], [0.0], [1.0], **smooth), zero, y) == pytest.approx(-rate, abs=1e-10)
    weighted = PID([KP], [KI], [KD], proportional_weight=0.3, derivative_weight=0.6, **smooth)
    error = r - angle
    integral = KI * DT * np.cumsum(error)
    ahead = KD * through([BANDWIDTH, 0], [1, BANDWIDTH], 0.6 * r)  # of the reference alone
    expected = KP * (0.3 * r - angle) + integral + ahead - KD * rate
    assert commands(weighted, r, y) == pytest.approx(expected, rel=1e-10, abs=1e-10)


def test_a_filter_of_the_measurement_is_second_order_for_noise():
    """At ten times its bandwidth the command is a hundredth of that to slow signals."""
    pid = PID([KP], [0.0], [0.0], measurement_filter=[3.0], dt=DT)
    law = jax.tree.map(np.asarray, pid.linear(0))
    z = np.exp(1j * 30.0 * DT)
    gain = law.C @ np.linalg.solve(z * np.eye(4) - law.A, law.measurement_in)
    found = np.abs(gain + law.measurement_through) / KP
    assert found == pytest.approx(0.01, rel=0.03)  # sampling: (w dt)^2 / 4


GAIN = 0.848  # rad/s^2 per V
PLACED = PID([27 / GAIN], [27 / GAIN], [9 / GAIN], filter=300.0, limit=2.0, anti_windup=None)


def step_response(anti_windup, samples=5000):
    """To 20 deg, on gain/s^2 with its input held, behind 2 V."""
    pid = PID(PLACED.kp, PLACED.ki, PLACED.kd, filter=300.0, limit=2.0, anti_windup=anti_windup)
    aim, dt = jnp.full(1, np.deg2rad(20.0)), pid.dt

    def sample(carry, _):
        angle, rate, memory = carry
        memory, command = pid.step(memory, aim, angle)
        push = dt * GAIN * command
        return (angle + dt * (rate + push / 2), rate + push, memory), (angle, command)

    start = (jnp.zeros(1), jnp.zeros(1), pid.init(aim))
    angle, command = jax.jit(lambda: jax.lax.scan(sample, start, None, samples)[1])()
    return np.asarray(angle)[:, 0] / np.deg2rad(20.0), np.asarray(command)[:, 0]


def overshoot(anti_windup):
    angle, command = step_response(anti_windup)
    assert np.abs(command).max() == 2.0
    return angle.max() - 1, np.abs(angle[-1] - 1)


def test_anti_windup_cuts_the_overshoot_of_a_saturated_step():
    wound, _ = overshoot(None)
    for anti_windup in (Clamping(), BackCalculation(0.5)):
        found, left = overshoot(anti_windup)
        assert found < 0.6 * wound and left < 1e-3


@pytest.mark.parametrize("smooth", [None, [50.0, 20.0]])
def test_its_linear_form_gives_the_same_commands(smooth):
    pid = PID(
        [1.0, KP],
        [2.0, KI],
        [3.0, KD],
        filter=[9.0, BANDWIDTH],
        proportional_weight=[0.4, 0.8],
        derivative_weight=[0.2, 0.5],
        measurement_filter=smooth,
        dt=DT,
    )
    r, y = broken_lines(1)
    r[0] = y[0] = 0.0  # the linear form knows no first sample
    both = lambda x: jnp.asarray(np.stack([x, x], axis=1))
    step = lambda state, now: pid.step(state, *now)
    found = jax.lax.scan(step, pid.init(jnp.zeros(2)), (both(r), both(y)))[1]
    for axis in (0, 1):
        linear = jax.tree.map(np.asarray, pid.linear(axis))
        state, expected = np.zeros(len(linear.C)), []
        for now in zip(r, y, strict=True):
            expected.append(
                linear.C @ state
                + np.dot((linear.reference_through, linear.measurement_through), now)
            )
            into = np.stack([linear.reference_in, linear.measurement_in], axis=1)
            state = linear.A @ state + into @ now
        np.testing.assert_allclose(np.asarray(found)[:, axis], expected, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize(
    "wrong, message",
    [
        (dict(filter=0.0), "filter is 0.0, but it must be above 0"),
        (dict(limit=-1.0), "limit is -1.0, but it must be above 0"),
        (dict(dt=0.0), "dt is 0.0 s"),
        (dict(measurement_filter=-1.0), "measurement_filter is -1.0, but it must be above 0"),
        (dict(measurement_filter=600.0), "at dt = 0.002 s it must be below 500 rad/s"),
        (dict(ki=np.nan), "ki is nan, but it must be finite"),
        (dict(kd=[1.0, 2.0]), "different numbers of axes"),
    ],
)
def test_what_makes_no_pid_is_refused_with_its_value(wrong, message):
    with pytest.raises(ValueError, match=message):
        PID(**(dict(kp=[1.0, 1.0, 1.0], ki=0.0, kd=0.0) | wrong))


def test_a_tracking_time_must_be_positive():
    with pytest.raises(ValueError, match="usually kd/kp to kp/ki"):
        BackCalculation(0.0)
