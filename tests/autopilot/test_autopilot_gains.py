"""The firmwares' parameters against gains in SI units, and what they cannot express."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.autopilot import (
    ArduPilotAttitude,
    ArduPilotRate,
    BetaflightADRC,
    BetaflightAngle,
    BetaflightPID,
    Butterworth,
    Cascade,
    cascade_of,
    cascade_parameters,
    check_ranges,
    CrazyflieAttitude,
    CrazyflieRate,
    FilterChain,
    find_inexpressible,
    find_parameter,
    ladrc_as_pid,
    list_parameters,
    motor_share,
    PARAMETERS,
    pid_of,
    PX4Attitude,
    PX4Rate,
    rate_gains,
    rate_parameters,
    RateGains,
    store_parameters,
    torque_per_unit,
    with_parameters,
)
from jaxquad.control import LADRC, PID


# Differential thrust per motor and rad/s of the defaults, with Ki/Kp in 1/s and Kd/Kp in ms.
DEFAULTS: dict[str, tuple[float, ...]] = {
    "px4": (0.1061, 0.1414, 0.00212, 1.33, 20.0),
    "ardupilot": (0.0675, 0.0675, 0.00180, 1.00, 26.7),
    "betaflight": (0.0826, 1.1202, 0.00091, 13.56, 11.0),
    "crazyflie": (0.1093, 0.2186, 0.00109, 2.00, 10.0),
}
BRUSHLESS = {"pid_rate.roll_kp": 200.0, "pid_rate.roll_ki": 400.0, "pid_rate.roll_kd": 2.5}


def defaults(firmware):
    return {name: row.default for name, row in PARAMETERS[firmware].items()}


def as_printed(firmware, values):
    p, i, d = rate_gains(firmware, "roll", values, torque_per_unit=motor_share(firmware, "roll"))
    return round(p, 4), round(i, 4), round(d, 5), round(i / p, 2), round(1e3 * d / p, 1)


@pytest.mark.parametrize("firmware", DEFAULTS)
def test_the_defaults_are_the_printed_thrust_per_motor(firmware):
    assert as_printed(firmware, defaults(firmware)) == DEFAULTS[firmware]


def test_the_brushless_crazyflies_gains_are_the_printed_ones():
    assert as_printed("crazyflie", BRUSHLESS) == (0.0874, 0.1749, 0.00109, 2.00, 12.5)


@pytest.mark.parametrize("firmware", DEFAULTS)
@pytest.mark.parametrize("axis", ["roll", "pitch", "yaw"])
def test_gains_become_parameters_and_return(firmware, axis):
    gains = RateGains(0.02, 0.03, 4e-4)
    torque = torque_per_unit(firmware, axis, thrust=5.0, arm=0.1, drag=0.012)
    values = rate_parameters(firmware, axis, gains, torque_per_unit=torque)
    assert set(values) <= set(PARAMETERS[firmware])
    found = rate_gains(firmware, axis, values, torque_per_unit=torque)
    np.testing.assert_allclose(found, gains, rtol=1e-14)


@pytest.mark.parametrize(
    ("firmware", "times"), [("px4", 2), ("ardupilot", 2**0.5), ("betaflight", 2 * 2**0.5)]
)
def test_the_torque_per_unit_is_that_of_a_quad_x(firmware, times):
    found = torque_per_unit(firmware, "roll", thrust=3.0, arm=0.2)
    assert found == pytest.approx(times * 0.2 * 3.0)


def test_the_crazyflies_torque_per_unit_is_the_printed_one():
    assert torque_per_unit("crazyflie", "roll", thrust=0.12, arm=0.046) == pytest.approx(
        7.81e-3, abs=5e-6
    )


def test_the_law_itself_has_the_converted_gains():
    """The step of the law to an error of 1 rad/s is P of `rate_gains`, in units of the output."""
    values = rate_gains("betaflight", "roll", defaults("betaflight"))
    law = BetaflightPID(p=[45.0], i=[0.0], d=[0.0], limit=1e6)
    assert float(law.linear(0).reference_through) / 1000 == pytest.approx(values.kp, rel=1e-12)


def test_a_cascade_is_the_angle_pid_and_back():
    random = np.random.default_rng(0)
    a, p, i = random.uniform(1, 10, (3, 50))
    cascade = Cascade(a, p, np.minimum(i, 0.9 * p * a))  # the larger root is the angle's gain
    kp, ki, kd = pid_of(jax.tree.map(jnp.asarray, cascade))
    np.testing.assert_allclose(cascade_of(kp, ki, kd), cascade, rtol=1e-9)
    outers: dict[str, str] = {"px4": "MC_ROLL_P", "ardupilot": "ATC_ANG_RLL_P"}
    for firmware, outer in outers.items():
        found = cascade_parameters(firmware, "roll", PID(5.5, 1.0, 0.5), torque_per_unit=2.0)
        rate = rate_gains(firmware, "roll", found, torque_per_unit=2.0)
        back = pid_of(Cascade(*map(jnp.asarray, (found[outer], rate.kp, rate.ki))))
        np.testing.assert_allclose(back, (5.5, 1.0, 0.5), rtol=1e-12)


@pytest.mark.parametrize("firmware", DEFAULTS)
def test_what_a_firmware_cannot_express_is_refused_in_words(firmware):
    refused = lambda controller: " ".join(find_inexpressible(firmware, controller))
    assert refused(PID(5.0, 1.0, 0.5)) == ""
    assert "integral of the angle" in refused(PID(5.0, 20.0, 0.5))
    assert "measurement alone" in refused(PID(5.0, 1.0, 0.5, derivative_weight=1.0))
    assert "weight of the set-point" in refused(PID(5.0, 1.0, 0.5, proportional_weight=0.6))
    assert "acceleration" in refused(PID(5.0, 1.0, 0.5, feedforward=0.1))
    assert "LADRC" in refused(LADRC(10.0, 30.0, 1.0))
    with pytest.raises(ValueError, match="12.5"):
        cascade_parameters(firmware, "roll", PID(5.0, 20.0, 0.5))


def test_a_ladrc_is_its_pid_behind_a_low_pass():
    wc, wo, b0 = 60.0, 100.0, 3.0
    feedback, _ = LADRC(wc, wo, b0, dt=1e-4).transfer_functions()
    found = jax.tree.map(np.asarray, ladrc_as_pid(wc, wo, b0))
    s = 1j * np.array([1.0, 30.0, 200.0])
    low_pass = s**2 / found.frequency**2 + 2 * found.damping * s / found.frequency + 1
    expected = (found.kd * s**2 + found.kp * s + found.ki) / (s * low_pass)
    feedback = jax.tree.map(np.asarray, feedback)
    value = np.polyval(feedback.numerator, s) / np.polyval(feedback.denominator, s)
    np.testing.assert_allclose(value, expected, rtol=1e-12)
    assert round(float(found.frequency)) == 264 and round(float(found.damping), 2) == 0.8


def test_a_firmware_stores_whole_numbers_or_single_precision():
    stored = store_parameters("betaflight", {"p_roll": 45.6, "f_roll": 120.4})
    assert stored == {"p_roll": 46.0, "f_roll": 120.0}
    stored = store_parameters("px4", {"MC_ROLLRATE_P": 0.15})
    assert stored["MC_ROLLRATE_P"] == np.float32(0.15)
    with pytest.raises(ValueError, match="do you mean"):
        find_parameter("px4", "MC_ROLLRATE_X")


def test_values_beyond_the_documented_range_are_named():
    said = check_ranges("px4", {"MC_ROLLRATE_P": 0.7, "MC_PITCHRATE_P": 0.55, "MC_ROLL_P": 6.0})
    assert len(said) == 1 and "MC_ROLLRATE_P is 0.7" in said[0] and "0.01 to 0.5" in said[0]
    for firmware in DEFAULTS:
        assert not check_ranges(firmware, store_parameters(firmware, defaults(firmware)))


three = lambda x: [x, 1.1 * x, 1.2 * x]
GYRO = FilterChain((Butterworth(40.0),), 2000.0)
LAWS = {
    "Betaflight": BetaflightAngle(BetaflightPID(three(45.0), three(80.0), three(30.0))),
    "ADRC": BetaflightADRC(three(60.0)),
    "PX4": PX4Attitude(PX4Rate(three(0.15), three(0.2), three(0.003), gyro=GYRO), three(4.0)),
    "ArduPilot": ArduPilotAttitude(ArduPilotRate(0.1, 0.1, three(0.003), gyro=GYRO), three(4.0)),
    "Crazyflie": CrazyflieAttitude(CrazyflieRate(three(250.0), 500.0, 2.5), three(6.0)),
}


@pytest.mark.parametrize("name", LAWS)
def test_a_laws_parameters_make_the_same_law(name):
    law = LAWS[name]
    values = list_parameters(law)
    doubled = with_parameters(law, {k: 2 * x for k, x in values.items()})
    assert list_parameters(doubled) == pytest.approx({k: 2 * x for k, x in values.items()})
    back = list_parameters(with_parameters(doubled, values))
    assert back == values and len(values) > 5
    with pytest.raises(ValueError, match="has no place"):
        with_parameters(law, {"THR_MDL_FAC": 0.3})


def test_a_law_of_one_axis_has_the_parameters_of_the_axis_that_it_is_said_to_be():
    law = PX4Attitude(PX4Rate([0.15], [0.2], [0.003], gyro=GYRO), [4.0])
    with pytest.raises(ValueError, match="one axis"):
        list_parameters(law)
    found = list_parameters(law, axes=["pitch"])
    assert found["MC_PITCH_P"] == 4 and found["IMU_GYRO_CUTOFF"] == 40
    assert not any("ROLL" in name or "YAW" in name for name in found)
    changed = with_parameters(law, {"MC_PITCH_P": 5.0})
    assert list_parameters(changed, axes=["pitch"])["MC_PITCH_P"] == 5
    assert changed.p.shape == (1,)
