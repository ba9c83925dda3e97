import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxquad.models import (
    Allocation,
    Attitude,
    AttitudeAxis,
    MotorLag,
    Multirotor,
    MultirotorState,
    QUANSER_HOVER,
    quanser_hover,
)


pytestmark = pytest.mark.slow


ARM, THRUST, TORQUE = 0.2, 0.12, 0.004
FORWARD, LEFT, UP = np.eye(3)
RIGHT = -LEFT
# Position of each rotor and its sense of turning about the upward axis (+ is anticlockwise).
ROTORS = {"front": (FORWARD, 1), "right": (RIGHT, -1), "back": (-FORWARD, 1), "left": (LEFT, -1)}
ORDER = {"frd-frbl": "front right back left", "quanser": "front back right left"}
AXES = {"frd-frbl": (FORWARD, RIGHT, -UP), "quanser": (-FORWARD, RIGHT, UP)}
CONVENTIONS = sorted(ORDER)
INPUTS = jax.random.uniform(jax.random.key(0), (4, 5), minval=1.0, maxval=3.0)


def allocation(convention="frd-frbl", **options):
    return Allocation(ARM, THRUST, TORQUE, convention=convention, **options)


def mechanics(convention):
    """Lever arm times thrust, plus the reaction to each propeller's drag, in body axes."""
    axes = np.stack(AXES[convention])
    assert np.linalg.det(axes) > 0  # right-handed
    columns = []
    for name in ORDER[convention].split():
        place, sense = ROTORS[name]
        lever = np.cross(axes @ (ARM * place), axes @ (THRUST * UP))
        columns.append(lever - sense * TORQUE * (axes @ UP))
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_the_matrix_is_the_mechanics_of_four_rotors(convention):
    np.testing.assert_allclose(allocation(convention).matrix, mechanics(convention), atol=1e-17)


def test_the_matrix_is_eq_10_as_printed():
    lk = ARM * THRUST
    printed = [[0, -lk, 0, lk], [lk, 0, -lk, 0], [TORQUE, -TORQUE, TORQUE, -TORQUE]]
    np.testing.assert_allclose(allocation().matrix, printed, rtol=1e-15)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_torque_is_the_matrix_times_the_inputs(convention):
    model = allocation(convention)
    np.testing.assert_allclose(model.torque(INPUTS), model.matrix @ INPUTS, atol=1e-16)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_inputs_undo_torque_and_their_mean_is_the_collective(convention):
    model = allocation(convention)
    back = model.inputs(model.torque(INPUTS), jnp.mean(INPUTS, axis=0))
    np.testing.assert_allclose(back, INPUTS, rtol=1e-14)
    about_bias = model.inputs(model.torque(INPUTS), 2.0)
    np.testing.assert_allclose(np.mean(about_bias, axis=0), 2.0, rtol=1e-14)
    np.testing.assert_allclose(model.torque(about_bias), model.torque(INPUTS), atol=1e-15)


def test_the_two_conventions_describe_one_vehicle():
    paper, quanser = allocation("frd-frbl"), allocation("quanser")
    front_right_back_left = INPUTS
    front_back_right_left = INPUTS[jnp.array([0, 2, 1, 3])]
    turned = np.array([-1, 1, -1])[:, None]  # half a turn about the pitch axis
    expected = turned * np.asarray(paper.torque(front_right_back_left))
    np.testing.assert_allclose(quanser.torque(front_back_right_left), expected, atol=1e-16)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_spin_is_minus_the_rotors_speed_about_the_third_axis(convention):
    model = allocation(convention, input="omega2")
    third = AXES[convention][2] @ UP
    senses = np.array([ROTORS[name][1] for name in ORDER[convention].split()])
    expected = -third * senses @ np.sqrt(INPUTS)
    np.testing.assert_allclose(model.spin(INPUTS), expected, rtol=1e-13)
    assert np.all(np.isfinite(jax.grad(model.spin)(jnp.zeros(4))))  # at stopped rotors


def test_an_ensemble_of_allocations_equals_the_single_ones():
    arm = jnp.linspace(0.1, 0.3, 5)
    many = Allocation(arm, THRUST, TORQUE)
    back = many.inputs(many.torque(INPUTS), jnp.mean(INPUTS, axis=0))
    np.testing.assert_allclose(back, INPUTS, rtol=1e-14)
    for i in range(5):
        one = Allocation(arm[i], THRUST, TORQUE)
        np.testing.assert_allclose(many.torque(INPUTS)[:, i], one.torque(INPUTS[:, i]), atol=1e-17)
        np.testing.assert_array_equal(many.matrix[..., i], one.matrix)


def test_unknown_conventions_and_inputs_are_refused_with_those_that_exist():
    with pytest.raises(ValueError, match="'flu'.*frd-frbl.*quanser"):
        allocation("flu")
    with pytest.raises(ValueError, match="'rpm'.*voltage.*omega2"):
        allocation(input="rpm")
    with pytest.raises(ValueError, match="thrust_coefficient is -0.12"):
        Allocation(ARM, -THRUST, TORQUE)


def test_a_motor_without_lag_is_refused_with_the_way_out():
    with pytest.raises(ValueError, match="time_constant is 0.0.*leave the lag out"):
        quanser_hover(lag=0.0)
    plant = quanser_hover(lag=None)
    assert plant.motor is None and plant.init().motor is None


def test_a_motor_step_solves_its_differential_equation():
    motor, start, command = MotorLag(0.05), jnp.arange(4.0), jnp.full(4, 2.0)
    after, slope = jax.jvp(lambda t: motor.step(start, command, t), (0.03,), (1.0,))
    np.testing.assert_allclose(slope, motor.derivative(after, command), rtol=1e-13)
    np.testing.assert_array_equal(motor.step(start, command, 0.0), start)


def test_the_hover_answers_with_the_gains_of_its_data_sheet():
    plant = quanser_hover(lag=None)
    still = jnp.zeros(3)
    volts = lambda u: plant.derivative(plant.init(), u, still).rate
    gains = np.asarray(jax.jacobian(volts)(jnp.full(4, QUANSER_HOVER.bias_voltage)))
    assert gains[0, 3] == pytest.approx(0.424, abs=5e-4)  # rad/s^2 per volt of V4 - V2
    np.testing.assert_allclose(gains[0], gains[0, 3] * np.array([0, -1, 0, 1]), atol=1e-16)
    np.testing.assert_allclose(gains[2], 0.0036 / 0.110 * np.array([1, -1, 1, -1]), atol=1e-16)


def test_the_plant_near_level_is_the_single_axis_of_eq_28():
    plant = quanser_hover(lag=0.02, damping=[0.004] * 3)
    level = plant.init()
    leaves, rebuild = ravel_pytree(level)
    flat = lambda x, u: ravel_pytree(
        plant.derivative(rebuild(x), u * jnp.array([0.0, -0.5, 0.0, 0.5]), jnp.zeros(3))
    )[0]
    A, B = map(np.asarray, jax.jit(jax.jacobian(flat, (0, 1)))(leaves, jnp.array(0.0)))
    C = np.asarray(jax.jit(jax.jacobian(lambda x: plant.measure(rebuild(x))[0]))(leaves))
    omega = np.array([0.3, 1.0, 12.0, 50.0])
    found = [C @ np.linalg.solve(1j * w * np.eye(len(A)) - A, B) for w in omega]
    axis = AttitudeAxis(0.197, 0.1188, 0.0552, lag=0.02, K_af=0.004)
    expected = axis.frequency_response(jnp.array(omega))[:, 0, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_a_disturbance_is_a_torque_and_a_stiffness_pulls_back():
    plant = quanser_hover(lag=None, stiffness=[0.05, 0.04, 0.0])
    tilted = plant.init([0.1, -0.2, 0.3])
    slope = plant.derivative(tilted, jnp.full(4, 2.0), jnp.array([0.3, 0.0, 0.0]))
    expected = np.array([0.3 - 0.05 * 0.1, 0.04 * 0.2, 0.0]) / QUANSER_HOVER.inertia
    np.testing.assert_allclose(slope.rate, expected, atol=1e-14)


def test_the_measured_angles_do_not_depend_on_the_length_of_the_quaternion():
    plant = quanser_hover()
    state = plant.init([0.1, -0.2, 0.3])
    longer = eqx.tree_at(lambda s: s.quaternion, state, 1.5 * state.quaternion)
    np.testing.assert_allclose(plant.measure(longer), [0.1, -0.2, 0.3], atol=1e-15)


def test_an_ensemble_of_plants_equals_the_single_ones():
    inertia = jnp.outer(jnp.array(QUANSER_HOVER.inertia), jnp.linspace(0.5, 3.0, 5))
    lag = jnp.linspace(0.01, 0.04, 5)
    build = lambda J, T: Multirotor(
        Attitude(J, rotor_inertia=1e-5), Allocation(ARM, 1e-5, 1e-7, input="omega2"), MotorLag(T)
    )
    plant = build(inertia, lag)
    state = eqx.tree_at(lambda s: s.motor, plant.init([0.1, 0.2, 0.3]), 1e5 * INPUTS)
    torque = 0.01 * INPUTS[:3]
    assert plant.ensemble == (5,) and state.rate.shape == (3, 5)
    many = plant.derivative(state, INPUTS, torque)
    for i in range(5):
        take = lambda tree: jax.tree.map(lambda x: x[..., i], tree)  # noqa: B023
        one = build(inertia[:, i], lag[i])
        alone = one.derivative(take(state), INPUTS[:, i], torque[:, i])
        assert isinstance(alone, MultirotorState)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-13), take(many), alone)


def test_one_vehicle_serves_an_ensemble_of_states_under_jit():
    plant = quanser_hover()
    state = plant.init(ensemble=(5,))
    many = eqx.filter_jit(plant.derivative)(state, INPUTS, jnp.zeros((3, 5)))
    assert many.rate.shape == (3, 5) and plant.measure(state).shape == (3, 5)


def test_spinning_rotors_need_inputs_that_tell_their_speed():
    attitude = Attitude([0.05, 0.05, 0.1], rotor_inertia=1e-4)
    with pytest.raises(ValueError, match='rotor_inertia is 0.0001.*input="omega2"'):
        Multirotor(attitude, allocation())


def test_models_build_under_jit_and_vmap_where_values_cannot_be_checked():
    def gain(inertia):
        plant = Multirotor(Attitude(inertia), allocation(), MotorLag(inertia[0]))
        return plant.derivative(plant.init(), INPUTS[:, 0], inertia).rate[0]

    inertia = jnp.ones((2, 3))
    np.testing.assert_allclose(jax.jit(jax.vmap(gain))(inertia), jax.vmap(gain)(inertia))
