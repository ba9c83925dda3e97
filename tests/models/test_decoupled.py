import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxquad.models import crazyflie, DecoupledAxes, QUANSER_HOVER, quanser_hover


GAIN, INERTIA = [0.0234, 0.0234, 0.0036], [0.0552, 0.0552, 0.110]
FRICTION = {"damping": [0.004, 0.005, 0.006], "stiffness": [0.1, 0.2, 0.0], "coulomb": 0.002}
MEMBERS = jnp.linspace(0.5, 3.0, 4)


def equation(time, x, command, torque):
    """The second axis with all its terms, in NumPy."""
    angle, rate, motor = x
    friction = 0.005 * rate + 0.2 * angle + 0.002 * np.tanh(rate / 0.01)
    return [rate, (0.0234 * motor - friction + torque) / 0.0552, (command - motor) / 0.02]


def flat(state):
    return np.concatenate([state.angle, state.rate, state.motor])


def test_the_axes_follow_their_differential_equation():
    plant = DecoupledAxes(GAIN, INERTIA, lag=0.02, **FRICTION)
    run = eqx.filter_jit(lambda s, u, d: plant.derivative(s, u, d))
    state = plant.init([0.3, -0.2, 0.1])
    slope = run(state, jnp.array([1.0, -2.0, 0.5]), jnp.array([0.01, 0.02, 0.03]))
    np.testing.assert_allclose(flat(slope)[1::3], equation(0, [-0.2, 0, 0], -2.0, 0.02), rtol=1e-14)
    moving = eqx.tree_at(lambda s: (s.rate, s.motor), state, (state.angle + 0.31, 2 * state.angle))
    slope = run(moving, jnp.array([1.0, -2.0, 0.5]), jnp.array([0.01, 0.02, 0.03]))
    expected = equation(0, [-0.2, 0.11, -0.4], -2.0, 0.02)
    np.testing.assert_allclose(flat(slope)[1::3], expected, rtol=1e-14)
    np.testing.assert_array_equal(plant.measure(moving), moving.angle)


def test_dry_friction_stops_a_free_axis_after_the_time_that_its_momentum_lasts():
    plant = DecoupledAxes([1.0], [0.05], coulomb=0.01)
    still = jnp.zeros(1)

    def slope(_, x):
        state = eqx.tree_at(lambda s: (s.angle, s.rate), plant.init(), (x[:1], x[1:]))
        change = plant.derivative(state, still, still)
        return jnp.concatenate([change.angle, change.rate])

    end = solve_ivp(jax.jit(slope), (0, 6), [0, 1.0], method="LSODA", rtol=1e-8).y[:, -1]
    assert end[0] == pytest.approx(0.5 * 1.0**2 * 0.05 / 0.01, rel=1e-3)  # work = kinetic energy
    assert abs(end[1]) < 1e-6  # it creeps on with a time constant of 50 ms
    push = jax.grad(lambda c: jnp.sum(DecoupledAxes(1.0, 0.05, coulomb=c).derivative(
        plant.init(), still, still).rate))(0.01)  # fmt: skip
    assert push == 0  # at rest, and finite


@pytest.mark.parametrize(
    "vehicle", [quanser_hover(damping=[0.004] * 3, stiffness=[0.05, 0.04, 0.0]), crazyflie()]
)
def test_decoupled_axes_are_a_multirotor_near_level_flight(vehicle):
    axes = vehicle.decoupled()
    allocation, still = vehicle.allocation, jnp.zeros(3)
    bias = 2.0 if allocation.input == "voltage" else 5e6
    tiny = jnp.array([1e-6, -2e-6, 3e-6])

    def answers(plant, inputs):
        state = plant.init(tiny)
        state = eqx.tree_at(lambda s: (s.rate, s.motor), state, (-tiny, inputs))
        change = plant.derivative(state, inputs, tiny * axes.inertia)
        return change.rate

    command = 0.01 * bias * jnp.array([1.0, -1.0, 0.5])
    turned = answers(vehicle, allocation.from_differences(command, bias))
    np.testing.assert_allclose(turned, answers(axes, command), rtol=1e-9)  # products of 1e-6
    lagging = axes.derivative(axes.init(), command, still).motor
    np.testing.assert_allclose(lagging, command / vehicle.motor.time_constant, rtol=1e-14)


def test_the_gain_is_that_of_the_rig_and_falls_with_added_inertia():
    sheet, plant = QUANSER_HOVER, quanser_hover().decoupled()
    assert plant.gain[0] == pytest.approx(0.424, abs=5e-4)  # rad/s^2 per volt of V4 - V2
    doubled = plant.with_added_inertia(np.array(sheet.inertia))
    np.testing.assert_allclose(doubled.gain, plant.gain / 2, rtol=1e-15)
    many = plant.with_added_inertia(jnp.outer(plant.inertia, MEMBERS))
    assert many.shape == (3, 4) and many.gain.shape == (3, 4)
    np.testing.assert_allclose(many.gain, np.outer(plant.gain, 1 / (1 + MEMBERS)), rtol=1e-15)
    rotor = quanser_hover().with_added_inertia(0.01)
    np.testing.assert_allclose(rotor.attitude.inertia, np.array(sheet.inertia) + 0.01)
    with pytest.raises(ValueError, match="inertia with what was added is .* above 0"):
        plant.with_added_inertia(-0.06)


def test_an_ensemble_of_axes_equals_the_single_ones():
    build = lambda m: DecoupledAxes(
        GAIN, jnp.multiply.outer(jnp.array(INERTIA), m), lag=(0.02 * m)[None], **FRICTION
    )
    plant = build(MEMBERS)
    state = plant.init([0.1, 0.2, 0.3])
    command = jax.random.normal(jax.random.key(0), (3, 4))
    assert plant.shape == (3, 4) and plant.measure(state).shape == (3, 4)
    run = eqx.filter_jit(lambda p, s, u: p.derivative(s, u, 0.1 * u))
    many = run(plant, state, command)
    for k in range(4):
        take = lambda tree: jax.tree.map(lambda x: x[..., k], tree)  # noqa: B023
        one = run(build(MEMBERS[k]), take(state), command[:, k])
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-14), take(many), one)


def test_one_set_of_parameters_serves_an_ensemble_of_states_in_any_precision():
    plant = jax.tree.map(lambda x: x.astype(jnp.float32), DecoupledAxes(GAIN, INERTIA, coulomb=0.1))
    plant = plant.with_added_inertia(0.01)
    state = plant.init(ensemble=(5,))
    slope = plant.derivative(state, jnp.ones((3, 5), jnp.float32), jnp.ones((3, 5), jnp.float32))
    assert state.motor is None and slope.rate.shape == (3, 5)
    assert {x.dtype for x in jax.tree.leaves((state, slope))} == {jnp.dtype("float32")}


def test_parameters_that_cannot_be_are_refused_with_a_remedy():
    with pytest.raises(ValueError, match=r"torque_gain \(2,\), inertia \(3,\).*one value per axis"):
        DecoupledAxes([1.0, 1.0], [1.0, 1.0, 1.0])
    with pytest.raises(ValueError, match=r"lag is \[0.\].*lag=None"):
        DecoupledAxes(1.0, 1.0, lag=0.0)
    with pytest.raises(ValueError, match=r"torque_gain is \[-1.\].*above 0"):
        DecoupledAxes(-1.0, 1.0)
    with pytest.raises(ValueError, match=r"coulomb is \[-0.1\].*0 or above"):
        DecoupledAxes(1.0, 1.0, coulomb=-0.1)
