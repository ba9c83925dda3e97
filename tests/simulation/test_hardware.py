"""Sensor, actuator and noise of a simulated loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.control import LADRC
from jaxquad.loops import Loop
from jaxquad.models import Allocation, CRAZYFLIE, crazyflie, QUANSER_HOVER, quanser_hover
from jaxquad.simulation import authority, Encoder, excite, gauss_markov, MotorDrive, RotorDrive


SHEET = QUANSER_HOVER
ALLOCATION = Allocation(SHEET.arm, SHEET.thrust_coefficient, SHEET.torque_coefficient)
DRIVE = MotorDrive(ALLOCATION)
COMMANDS = np.random.default_rng(0).uniform(-8, 8, (3, 50))


def test_an_encoder_counts_whole_steps_and_is_off_by_half_of_one_at_most():
    angle = jnp.linspace(-7.0, 7.0, 4001)
    counted = Encoder(1000)(angle)
    counts = np.asarray(counted) * 1000 / (2 * np.pi)
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    assert np.max(np.abs(counted - angle)) <= np.pi / 1000 * (1 + 1e-9)


def test_the_gradient_passes_through_an_encoder():
    slope = jax.vmap(jax.grad(Encoder(16)))(jnp.linspace(-1.0, 1.0, 11))
    np.testing.assert_array_equal(slope, 1.0)


def test_an_encoder_without_counts_is_refused():
    with pytest.raises(ValueError, match="counts is 0"):
        Encoder(0)


def test_within_the_limits_a_drive_achieves_the_command():
    volts = DRIVE.inputs(jnp.asarray(COMMANDS))
    np.testing.assert_allclose(DRIVE.achieved(volts), COMMANDS, rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.mean(volts, axis=0), SHEET.bias_voltage, rtol=1e-13)


def test_the_bias_makes_no_difference_to_what_is_achieved():
    drives = [MotorDrive(ALLOCATION, bias=bias) for bias in (0.0, 6.0)]
    low, high = (drive.achieved(drive.inputs(jnp.asarray(COMMANDS))) for drive in drives)
    np.testing.assert_allclose(low, high, rtol=0, atol=1e-13)


def test_a_drive_clips_at_its_limit_and_owns_up_to_it():
    drive = MotorDrive(ALLOCATION, bias=2.0, limit=10.0)
    volts = drive.inputs(jnp.array([30.0, 0.0, 0.0]))
    # Roll is V4 - V2, 15 V to either side of the bias: 17 and -13 V become 10 and -10 V.
    np.testing.assert_allclose(volts, [2.0, -10.0, 2.0, 10.0])
    # The clipped pair has lost 4 V of its sum, which the yaw axis feels.
    np.testing.assert_allclose(drive.achieved(volts), [20.0, 0.0, 4.0])


def test_a_bias_beyond_the_limit_is_refused():
    with pytest.raises(ValueError, match="bias is 12.0 V.*within the limit of 10.0 V"):
        MotorDrive(ALLOCATION, bias=12.0, limit=10.0)


ROTORS = RotorDrive(crazyflie().allocation, CRAZYFLIE.hover_input, CRAZYFLIE.top_speed)
TOP = CRAZYFLIE.top_speed**2


def test_rotors_achieve_a_command_between_standstill_and_top_speed():
    wanted = 0.1 * TOP * COMMANDS / 8
    squares = np.asarray(ROTORS.inputs(jnp.asarray(wanted)))
    np.testing.assert_allclose(ROTORS.achieved(jnp.asarray(squares)), wanted, atol=1e-9 * TOP)
    np.testing.assert_allclose(squares.mean(axis=0), CRAZYFLIE.hover_input, rtol=1e-12)
    assert squares.min() > 0 and squares.max() < TOP
    squares = np.asarray(ROTORS.inputs(jnp.array([10 * TOP, 0.0, 0.0])))
    np.testing.assert_allclose(squares, [0, 0, TOP, TOP])


def test_the_authority_of_rotors_is_that_of_two_at_the_top_and_two_at_rest():
    found, plant = authority(crazyflie(), ROTORS), crazyflie()
    np.testing.assert_allclose(found.torque[0], plant.torque_gain[0] * 2 * TOP, rtol=1e-12)


def test_a_drive_refuses_a_vehicle_of_the_other_kind_and_names_the_right_one():
    with pytest.raises(ValueError, match="squared rotor speeds.*give drive=.*RotorDrive"):
        MotorDrive(crazyflie().allocation)
    with pytest.raises(ValueError, match="takes voltages.*give drive=.*MotorDrive"):
        RotorDrive(ALLOCATION, CRAZYFLIE.hover_input, CRAZYFLIE.top_speed)
    for vehicle, drive in ((crazyflie(), "RotorDrive"), (quanser_hover(), "MotorDrive")):
        with pytest.raises(ValueError, match=f"drive is None.*{drive}"):
            Loop(vehicle, LADRC(10.0, 30.0, 1.0))


def test_a_hover_beyond_the_top_speed_is_refused():
    with pytest.raises(ValueError, match="hover is 9900000.* between 0 and top_speed"):
        RotorDrive(crazyflie().allocation, 9.9e6, CRAZYFLIE.top_speed)


CORNER, DT = 4.0, 0.01


@pytest.fixture(scope="module")
def gusts():
    key = jax.random.key(0)
    return np.asarray(gauss_markov(key, (400, 2000), deviation=0.3, corner=CORNER, dt=DT))


@pytest.mark.parametrize("sample", [0, 1, 399])
def test_gusts_have_their_deviation_from_the_first_sample_on(sample, gusts):
    # 2000 members leave 1.6 % of doubt.
    assert np.std(gusts[sample]) == pytest.approx(0.3, rel=0.06)


@pytest.mark.parametrize("start", [0, 200])
@pytest.mark.parametrize("lag", [1, 10, 50])
def test_the_correlation_of_gusts_decays_at_their_corner(start, lag, gusts):
    found = np.corrcoef(gusts[start], gusts[start + lag])[0, 1]
    expected = np.exp(-CORNER * DT * lag)
    assert found == pytest.approx(expected, abs=4 * (1 - expected**2) / np.sqrt(2000))


def test_an_experiment_excites_one_axis_only():
    swept = np.sin(np.arange(200) * 0.1)
    case = excite(swept, key=jax.random.key(1), dt=DT, axis="pitch", torque_noise=0.1)
    np.testing.assert_array_equal(case.injection[:, 1], swept)
    for part in (case.injection, case.disturbance):
        assert np.all(np.asarray(part)[:, [0, 2]] == 0)
    assert np.all(np.asarray(case.noise) == 0) and np.std(case.disturbance[:, 1]) > 0.01


def test_every_member_of_an_experiment_has_noise_of_its_own():
    key = jax.random.key(1)
    case = excite(np.ones((500, 2)), key=key, dt=DT, torque_noise=0.1, sensor_noise=0.2)
    assert case.noise.shape == (500, 3, 2)
    for part in (case.noise, case.disturbance):
        assert abs(np.corrcoef(np.asarray(part)[:, 0].T)[0, 1]) < 0.5
    assert np.std(case.noise[:, 0]) == pytest.approx(0.2, rel=0.1)


def test_an_experiment_on_an_unknown_axis_is_refused():
    with pytest.raises(ValueError, match="axis 'heave'"):
        excite(np.ones(20), key=jax.random.key(0), dt=DT, axis="heave")
