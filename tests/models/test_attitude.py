import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import ArrayLike
from scipy.integrate import solve_ivp

from jaxquad.models import (
    Attitude,
    euler_acceleration,
    euler_from_quaternion,
    euler_rates,
    euler_rates_matrix,
    quaternion_derivative,
    quaternion_from_euler,
)


INERTIA = np.array([0.05, 0.07, 0.11])
RATE = jnp.array([1.0, 2.0, -1.5])
STILL = jnp.zeros(3)
ANGLES = jax.random.uniform(jax.random.key(0), (3, 20), minval=-1.4, maxval=1.4)
RATES = jax.random.normal(jax.random.key(1), (3, 20))


def rotation_matrix(quaternion):
    """Turns body into earth vectors."""
    w, x, y, z = quaternion
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


def flow(attitude, state, torque, spin):
    quaternion, rate = state
    return quaternion_derivative(quaternion, rate), attitude.acceleration(rate, torque, spin)


def tumble(attitude, rate, dt, *, steps=5000, torque=STILL, spin: ArrayLike = 0.0):
    """Quaternions and rates of `steps` RK4 steps from level, under a constant torque and spin."""
    return run(attitude, rate, jnp.array(dt), torque, jnp.asarray(spin), steps)


@eqx.filter_jit
def run(attitude, rate, dt, torque, spin, steps):
    slope = ft.partial(flow, attitude, torque=torque, spin=spin)

    def ahead(state, k, h):
        return jax.tree.map(lambda x, dx: x + h * dx, state, k)

    def step(state, _):
        k1 = slope(state)
        k2 = slope(ahead(state, k1, dt / 2))
        k3 = slope(ahead(state, k2, dt / 2))
        k4 = slope(ahead(state, k3, dt))
        mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
        return ahead(state, mean, dt), state

    level = quaternion_from_euler(jnp.zeros_like(rate))
    return jax.lax.scan(step, (level, rate), length=steps)[1]


def earth_momentum(quaternion, rate, rotors=0.0):
    body = INERTIA * np.asarray(rate) - np.array([0, 0, rotors])
    rotation = np.asarray(rotation_matrix(quaternion.T))
    return np.einsum("ijn,nj->ni", rotation, body)


def drift(values):
    values = values.reshape(len(values), -1)
    return np.max(np.abs(values - values[0])) / np.linalg.norm(values[0])


def energy(rate):
    return 0.5 * np.sum(INERTIA * np.asarray(rate) ** 2, axis=1)


def test_the_euler_rate_matrix_is_the_body_rate_of_the_rotation():
    def turn(direction):
        path = lambda euler: rotation_matrix(quaternion_from_euler(euler))
        rotation, change = jax.jvp(path, (ANGLES,), (direction,))
        spin = np.einsum("jin,jkn->ikn", rotation, change)  # R^T dR/dt
        return np.stack([spin[2, 1], spin[0, 2], spin[1, 0]])

    expected = np.einsum("ijn,jn->in", euler_rates_matrix(ANGLES), RATES)
    np.testing.assert_allclose(turn(RATES), expected, rtol=0, atol=1e-14)  # some rounding of O(1)


def test_euler_rates_undo_the_matrix_and_its_determinant_is_the_cosine_of_pitch():
    matrix = np.asarray(euler_rates_matrix(ANGLES))
    rate = np.einsum("ijn,jn->in", matrix, euler_rates(ANGLES, RATES))
    np.testing.assert_allclose(rate, RATES, atol=1e-13)  # 1 / cos(pitch) is below 6
    np.testing.assert_allclose(np.linalg.det(matrix.T), np.cos(ANGLES[1]), atol=1e-14)


def test_the_euler_acceleration_is_not_the_derivative_of_the_body_rate_as_eq_8_prints():
    euler = jnp.deg2rad(jnp.array([4.0, 4.0, 0.0]))
    found = euler_acceleration(euler, jnp.array([0.2, 0.3, 0.4]), jnp.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(found, [1.12, -0.10, 0.07], atol=0.005)  # to two decimals


def test_the_euler_acceleration_satisfies_the_product_rule():
    rate_derivative = RATES[::-1]
    first = euler_rates(ANGLES, RATES)
    matrix, change = jax.jvp(euler_rates_matrix, (ANGLES,), (first,))
    second = euler_acceleration(ANGLES, RATES, rate_derivative)
    total = np.einsum("ijn,jn->in", matrix, second) + np.einsum("ijn,jn->in", change, first)
    np.testing.assert_allclose(total, rate_derivative, atol=1e-11)  # / cos(pitch)^2


def test_the_quaternion_derivative_turns_the_rotation_matrix_at_the_body_rate():
    quaternion = quaternion_from_euler(ANGLES)
    tangent = quaternion_derivative(quaternion, RATES)
    rotation, change = jax.jvp(rotation_matrix, (quaternion,), (tangent,))
    expected = np.cross(RATES.T[:, None], np.asarray(rotation).transpose(2, 0, 1)) * -1
    np.testing.assert_allclose(change.transpose(2, 0, 1), expected, atol=1e-14)


@pytest.mark.slow
def test_euler_angles_survive_the_quaternion_and_have_a_gradient_everywhere():
    back = euler_from_quaternion(quaternion_from_euler(ANGLES))
    np.testing.assert_allclose(back, ANGLES, atol=1e-14)
    upright = jnp.array([[0.0, 0.0, 0.0], [0.0, jnp.pi / 2, 0.0], [0.0, -jnp.pi / 2, 0.0]]).T
    quaternion = quaternion_from_euler(upright)
    slope = jax.jit(jax.jacobian(lambda q: euler_from_quaternion(q).sum(axis=1)))(quaternion)
    assert np.all(np.isfinite(slope))
    np.testing.assert_allclose(slope[..., 0], 2 * np.eye(3, 4, k=1), atol=1e-15)


@pytest.mark.slow
def test_euler_angles_and_their_slopes_are_those_of_the_arctangent():
    def written(q):
        w, x, y, z = q
        roll = jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        yaw = jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return jnp.stack([roll, jnp.arcsin(2 * (w * y - z * x)), yaw])

    quaternion = jax.random.normal(jax.random.key(2), (4, 1000))
    quaternion = quaternion / jnp.linalg.norm(quaternion, axis=0, keepdims=True)
    slopes = lambda f: jax.jit(jax.jacfwd(lambda s: f(quaternion * s)))(1.0)
    back = lambda f: jax.jit(jax.grad(lambda q: jnp.sum(jnp.sin(f(q)))))(quaternion)
    for of in (lambda f: f(quaternion), slopes, back):
        np.testing.assert_allclose(of(euler_from_quaternion), of(written), rtol=1e-10, atol=1e-14)


def test_a_free_asymmetric_body_keeps_its_angular_momentum_and_energy():
    quaternion, rate = tumble(Attitude(INERTIA), RATE, 0.002)
    assert np.ptp(np.asarray(rate), axis=0).max() > 4  # it does tumble
    assert drift(earth_momentum(quaternion, rate)) < 1e-9
    assert drift(energy(rate)) < 1e-9


def test_spinning_rotors_keep_the_total_momentum_and_do_no_work():
    attitude = Attitude(INERTIA, rotor_inertia=1e-4)
    quaternion, rate = tumble(attitude, RATE, 0.002, spin=300.0)
    assert drift(earth_momentum(quaternion, rate, rotors=0.03)) < 1e-9
    assert drift(energy(rate)) < 1e-9


def test_the_fourfold_sum_printed_in_eq_2_breaks_the_conservation_of_momentum():
    attitude = Attitude(INERTIA, rotor_inertia=1e-4)
    quaternion, rate = tumble(attitude, RATE, 0.002, spin=4 * 300.0)
    assert drift(earth_momentum(quaternion, rate, rotors=0.03)) > 1e-2


def test_the_rotor_torque_printed_in_eq_5_and_6_does_work_on_a_free_body():
    printed = jnp.array([0.03, 0.03, 0.0])  # J_M spin on roll and pitch, whatever the rates
    _, rate = tumble(Attitude(INERTIA), RATE, 0.002, torque=printed)
    assert drift(energy(rate)) > 0.1


def test_the_error_falls_as_the_fourth_power_of_the_step():
    attitude = Attitude(INERTIA)
    after_one_second = lambda n: np.asarray(tumble(attitude, RATE, 1 / n)[1][n])
    exact = after_one_second(400)  # 256 times more exact than the finer of the two
    coarse, fine = (np.linalg.norm(after_one_second(n) - exact) for n in (50, 100))
    assert coarse / fine == pytest.approx(16, rel=0.1)


def test_a_driven_damped_body_agrees_with_scipy():
    attitude = Attitude(INERTIA, damping=[0.01, 0.02, 0.03], rotor_inertia=1e-4)
    torque = jnp.array([0.05, -0.02, 0.01])
    found = tumble(attitude, RATE, 0.001, torque=torque, spin=200.0)[1][1000]

    def derivative(_, rate):  # Eq. (5)-(7) as corrected, written out
        (x, y, z), (p, q, r), w = INERTIA, rate, 1e-4 * 200
        return [
            (0.05 - 0.01 * p + w * q + (y - z) * q * r) / x,
            (-0.02 - 0.02 * q - w * p + (z - x) * p * r) / y,
            (0.01 - 0.03 * r + (x - y) * p * q) / z,
        ]

    solution = solve_ivp(derivative, (0, 1), RATE, "DOP853", rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found, solution.y[:, -1], rtol=1e-9)


@pytest.mark.slow
def test_forward_and_reverse_derivatives_with_respect_to_inertia_agree():
    def final(inertia):
        return tumble(Attitude(inertia), RATE, 0.005, steps=200)[1][-1]

    forward, reverse = (jax.jit(jac(final))(jnp.array(INERTIA)) for jac in (jax.jacfwd, jax.jacrev))
    assert np.linalg.norm(forward) > 1
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-9)


def test_an_ensemble_along_the_last_axis_equals_the_single_runs():
    inertia = jnp.array(INERTIA)[:, None] * jnp.array([0.5, 1.0, 2.0])[None]
    rate, torque = jnp.stack([RATE] * 3, axis=1), 0.01 * jnp.eye(3)
    spin = jnp.array([0.0, 100.0, -100.0])
    together = tumble(
        Attitude(inertia, rotor_inertia=1e-4), rate, 0.005, steps=200, torque=torque, spin=spin
    )
    for i in range(3):
        attitude = Attitude(inertia[:, i], rotor_inertia=1e-4)
        alone = tumble(attitude, RATE, 0.005, steps=200, torque=torque[:, i], spin=spin[i])
        for many, one in zip(together, alone, strict=True):
            np.testing.assert_allclose(many[..., i], one, rtol=0, atol=1e-13)  # 200 roundings


def test_dry_friction_takes_momentum_at_a_constant_rate_and_never_turns_it_round():
    attitude = Attitude(INERTIA, coulomb=[0.01, 0.01, 0.02])
    _, rate = tumble(attitude, jnp.array([0.0, 0.0, 0.5]), 0.002)
    third = np.asarray(rate)[:, 2]
    lasts = 0.5 * INERTIA[2] / 0.02  # s
    before = int(0.8 * lasts / 0.002)
    assert third[before] == pytest.approx(0.5 * 0.2, rel=1e-3)
    assert np.all(third > 0) and third[-1] < 1e-6
    still = attitude.acceleration(STILL, STILL)
    np.testing.assert_array_equal(still, 0)


@pytest.mark.parametrize("inertia", [[0.05, 0.0, 0.1], [0.05, -0.07, 0.1], [0.05, np.nan, 0.1]])
def test_an_inertia_that_is_not_positive_is_refused(inertia):
    with pytest.raises(ValueError, match="inertia is .* above 0"):
        Attitude(inertia)


def test_an_ensemble_of_parameters_refuses_the_state_of_one_vehicle():
    with pytest.raises(ValueError, match="same trailing axis"):
        Attitude(jnp.ones((3, 3))).acceleration(RATE, RATE)
