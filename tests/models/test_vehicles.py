import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxquad as jq
from jaxquad.models import Allocation, CRAZYFLIE, crazyflie


ARM, THRUST, TORQUE = 0.2, 0.12, 0.004
FORWARD, LEFT, UP = np.eye(3)
RIGHT, BACK = -LEFT, -FORWARD
# Place of each rotor in the order of its input, and its turn about the upward axis (+ is
# anticlockwise seen from above).
FRAMES = {
    "frd-frbl": ((FORWARD, RIGHT, -UP), [FORWARD, RIGHT, BACK, LEFT], [1, -1, 1, -1]),
    "quanser": ((BACK, RIGHT, UP), [FORWARD, BACK, RIGHT, LEFT], [1, 1, -1, -1]),
    "px4-x": (
        (FORWARD, RIGHT, -UP),
        [FORWARD + RIGHT, BACK + LEFT, FORWARD + LEFT, BACK + RIGHT],
        [1, 1, -1, -1],
    ),
    "crazyflie": (
        (FORWARD, LEFT, UP),
        [FORWARD + RIGHT, BACK + RIGHT, BACK + LEFT, FORWARD + LEFT],
        [1, -1, 1, -1],
    ),
}


@pytest.mark.parametrize("convention", FRAMES)
def test_the_matrix_is_the_mechanics_of_rotors_at_the_ends_of_their_arms(convention):
    axes, places, turns = FRAMES[convention]
    body = np.stack(axes)
    assert np.linalg.det(body) == pytest.approx(1.0)  # right-handed
    columns = []
    for place, turn in zip(places, turns, strict=True):
        lever = np.cross(ARM * place / np.linalg.norm(place), THRUST * UP)
        columns.append(body @ (lever - turn * TORQUE * UP))
    model = Allocation(ARM, THRUST, TORQUE, convention=convention)
    np.testing.assert_allclose(model.matrix, np.stack(columns, axis=1), rtol=1e-15, atol=1e-17)


@pytest.mark.parametrize("convention", FRAMES)
def test_inputs_undo_the_torque_and_spin_is_against_the_third_axis(convention):
    model = Allocation(ARM, THRUST, TORQUE, convention=convention, input="omega2")
    inputs = np.array([1.3, 2.1, 1.7, 2.9])
    back = model.inputs(model.torque(jnp.array(inputs)), float(np.mean(inputs)))
    np.testing.assert_allclose(back, inputs, rtol=1e-14)
    axes, _, turns = FRAMES[convention]
    momentum = np.array(turns) @ np.sqrt(inputs) * (axes[2] @ UP)
    assert model.spin(jnp.array(inputs)) == pytest.approx(-momentum, rel=1e-14)


def test_a_crazyflie_carries_its_weight_at_the_speed_that_bitcraze_measured():
    speed = np.sqrt(CRAZYFLIE.hover_input)
    assert 4 * CRAZYFLIE.thrust_coefficient * speed**2 == pytest.approx(0.028 * 9.81)
    assert 0.5 * CRAZYFLIE.top_speed < speed < 0.8 * CRAZYFLIE.top_speed
    ratio = CRAZYFLIE.torque_coefficient / CRAZYFLIE.thrust_coefficient
    assert ratio == pytest.approx(0.005964552, rel=1e-5)  # m, of the bench


def test_more_of_a_crazyflies_left_rotors_rolls_it_right():
    plant, still = crazyflie(lag=None), jnp.zeros(3)
    hover = CRAZYFLIE.hover_input * jnp.ones(4)
    quiet = plant.derivative(plant.init(), hover, still)
    np.testing.assert_allclose(quiet.rate, 0, atol=1e-12)
    left = plant.derivative(plant.init(), hover * jnp.array([1.0, 1, 1.1, 1.1]), still)
    newtons = 2 * 0.1 * 0.028 * 9.81 / 4
    roll = newtons * 0.046 / np.sqrt(2) / 16.571710e-6
    np.testing.assert_allclose(left.rate, [roll, 0, 0], rtol=1e-12, atol=1e-9)  # about +x, forward


class Seesaw(eqx.Module):
    """A user's own vehicle: a bar on a pivot with a fan at each end, thrust growing as u |u|."""

    inertia: float = 0.02  # kg m^2

    def init(self, euler=None, *, ensemble=()):
        return jnp.zeros((2, 1, *ensemble))

    def derivative(self, state, inputs, disturbance):
        torque = 0.01 * inputs * jnp.abs(inputs) - 0.05 * jnp.sin(state[0])
        return jnp.stack([state[1], (torque + disturbance) / self.inertia])

    def measure(self, state):
        return state[0]


def test_a_users_own_vehicle_takes_a_dozen_lines():
    still = jnp.zeros((2000, 1))
    push = still.at[200:].set(0.01)  # N m
    hold = jq.control.PD(jnp.array([20.0]), jnp.array([4.0]))
    run = jq.simulate(jq.Loop(Seesaw(), hold), jq.simulation.Scenario(still, still, push, still))
    angle = float(run.angle[-1, 0])
    command = -20.0 * angle
    balance = 0.01 * command * abs(command) - 0.05 * np.sin(angle) + 0.01
    assert 0 < angle < 0.1 and abs(balance) < 1e-5  # at rest under a constant push
