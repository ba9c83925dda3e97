"""LADRC against closed forms and against pyadrc."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pyadrc import StateSpace
from scipy.linalg import solve_discrete_lyapunov

from jaxquad.control import CurrentObserver, EulerObserver, LADRC, PredictiveObserver


WC, WO = 10.0, 30.0  # rad/s
OBSERVERS = {"current": CurrentObserver(), "predictive": PredictiveObserver()}


def held(b, dt, order):
    """b/s^order with its input held."""
    if order == 1:
        return np.ones((1, 1)), np.array([b * dt])
    return np.array([[1, dt], [0, 1]]), b * np.array([dt**2 / 2, dt])


def closed_loop(controller, b=1.0):
    """State matrix, noise input, command row and noise-to-command gain, of the plant b/s^order."""
    linear = controller.linear()
    A, into, C, through = (
        np.asarray(x)
        for x in (linear.A, linear.measurement_in, linear.C, linear.measurement_through)
    )
    plant, drive = held(b, controller.dt, controller.order)
    angle = np.eye(1, len(plant))[0]
    state = np.block(
        [
            [plant + through * np.outer(drive, angle), np.outer(drive, C)],
            [np.outer(into, angle), A],
        ]
    )
    noise = np.concatenate([drive * through, into])
    return state, noise, np.concatenate([through * angle, C]), through


def abscissa(controller):
    state = closed_loop(controller)[0]
    return np.log(np.abs(np.linalg.eigvals(state)).max()) / controller.dt


@pytest.mark.parametrize("dt", [0.002, 0.01, 0.02])
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("name", OBSERVERS)
def test_the_loop_has_its_poles_exactly_where_it_was_told(name, order, dt):
    controller = LADRC([WC], [WO], [3.0], order=order, observer=OBSERVERS[name], dt=dt)
    poles = np.exp(-dt * np.array([WC] * order + [WO] * (order + 1)))
    # Of a triple pole only the polynomial is well conditioned: 1e-10 in it.
    np.testing.assert_allclose(
        np.poly(closed_loop(controller, 3.0)[0]), np.poly(poles), rtol=0, atol=1e-10
    )


@pytest.mark.parametrize("dt", [0.002, 0.01, 0.02])
def test_gains_are_herbsts_closed_forms(dt):
    zo, zc = np.exp(-np.longdouble(WO) * dt), np.exp(-np.longdouble(WC) * dt)
    l1, l2, l3 = 1 - zo**3, 3 * (1 - zo) ** 2 * (1 + zo) / (2 * dt), (1 - zo) ** 3 / dt**2
    wo = jnp.asarray(WO)
    found = CurrentObserver().gains(wo, dt, 2)
    np.testing.assert_allclose(found, np.array([l1, l2, l3], float), rtol=1e-12)
    found = PredictiveObserver().gains(wo, dt, 2)
    second = (1 - zo) ** 2 * (5 + zo) / (2 * dt)
    np.testing.assert_allclose(found, np.array([3 * (1 - zo), second, l3], float), rtol=1e-12)
    gains = LADRC(WC, WO, 1.0, dt=dt).gains
    kp, kd = gains.proportional, gains.derivative
    assert kd is not None
    assert float(kp) == pytest.approx(float((1 - zc) ** 2 / dt**2), rel=1e-12)
    assert float(kd) == pytest.approx(float((1 - zc) * (3 + zc) / (2 * dt)), rel=1e-12)
    np.testing.assert_allclose(
        CurrentObserver().gains(wo, dt, 1),
        np.array([1 - zo**2, (1 - zo) ** 2 / dt], float),
        rtol=1e-12,
    )


def test_eulers_rule_misplaces_the_poles():
    loop = LADRC([WC], [WO], [1.0], observer=EulerObserver(), placement="continuous", dt=0.02)
    poles = np.log(np.linalg.eigvals(closed_loop(loop)[0])) / 0.02
    fastest = poles[np.argmax(poles.imag)]
    assert fastest == pytest.approx(-14.5 + 69.1j, abs=0.1)  # and not -30
    assert np.abs(np.linalg.eigvals(closed_loop(loop, 1.8)[0])).max() < 1
    assert np.abs(np.linalg.eigvals(closed_loop(loop, 1.9)[0])).max() > 1  # exact form: 3.5


@pytest.mark.parametrize(
    "factors, pole, noise",
    [((1, 1), -10, 310), ((0.5, 1), -5, 206), ((1, 0.5), -10, 224), ((0.5, 0.5), -5, 153)],
)
def test_half_gains_trade_the_abscissa_for_less_noise(factors, pole, noise):
    loop = LADRC([WC], [WO], [1.0], feedback_factor=factors[0], observer_factor=factors[1])
    state, into, row, through = closed_loop(loop)
    # White noise of 1 rad rms per sample to the rms of b0 u.
    rms = np.sqrt(row @ solve_discrete_lyapunov(state, np.outer(into, into)) @ row + through**2)
    assert abscissa(loop) == pytest.approx(pole, rel=0.011)  # -4.95: held over 2 ms
    assert rms == pytest.approx(noise, abs=0.6)


def random_flight(controller, samples=300, seed=0):
    """Commands, last state and the two inputs of a run on random references and angles."""
    reference, angle = 0.05 * np.random.default_rng(seed).standard_normal((2, samples, 1))
    step = lambda state, now: controller.step(state, *now)
    state, commands = jax.lax.scan(
        step, controller.init(jnp.zeros(1)), (jnp.asarray(reference), jnp.asarray(angle))
    )
    return np.asarray(commands)[:, 0], state, reference[:, 0], angle[:, 0]


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("limit", [0.2, np.inf])
def test_it_is_pyadrc_step_by_step(order, limit):
    ours = LADRC([WC], [WO], [3.0], order=order, placement="continuous", limit=limit)
    theirs = StateSpace(order, 0.002, 3.0, WC, WO / WC, m_lim=(-limit, limit))
    commands, _, reference, angle = random_flight(ours)
    expected = [0.0]
    for r, y in zip(reference, angle, strict=True):
        expected.append(theirs(y, expected[-1], r))
    assert np.isinf(limit) or np.mean(np.abs(commands) == limit) > 0.1  # some are saturated
    # Rounding, over rates of change of 1/dt^2.
    np.testing.assert_allclose(commands, expected[1:], rtol=1e-10, atol=1e-11)


def rest_under_a_constant_reference(command_of, b=3.0, samples=3000):
    plant, drive = held(b, 0.002, 2)
    state, command = np.zeros(2), 0.0
    for _ in range(samples):
        command = command_of(state[0], command)
        state = plant @ state + drive * command
    return state[0]


def test_half_feedback_gain_reaches_the_reference_which_pyadrcs_does_not():
    """pyadrc halves 1/b0 on the disturbance and kp on the angle, but not kp on the reference."""
    ours = LADRC([WC], [WO], [3.0], placement="continuous", feedback_factor=0.5)
    step = jax.jit(lambda memory, angle: ours.step(memory, jnp.full(1, 0.1), angle))
    memory = [ours.init(jnp.zeros(1))]

    def command_of(angle, _):
        memory[0], command = step(memory[0], jnp.full(1, angle))
        return float(command[0])

    theirs = StateSpace(2, 0.002, 3.0, WC, WO / WC, half_gain=(True, False))
    half = lambda angle, last: theirs(angle, last, 0.1)
    assert rest_under_a_constant_reference(command_of) == pytest.approx(0.1, rel=1e-6)
    assert rest_under_a_constant_reference(half) == pytest.approx(0.2, rel=1e-3)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("observer", [CurrentObserver(), PredictiveObserver(), EulerObserver()])
def test_its_linear_form_gives_the_same_commands(observer, order):
    loop = LADRC(
        [WC], [WO], [3.0], order=order, observer=observer, feedback_factor=0.7, observer_factor=0.6
    )
    commands, _, reference, angle = random_flight(loop)
    linear = jax.tree.map(np.asarray, loop.linear())
    state, expected = np.zeros(order + 1), []
    for r, y in zip(reference, angle, strict=True):
        through = linear.reference_through * r + linear.measurement_through * y
        expected.append(linear.C @ state + through)
        state = linear.A @ state + linear.reference_in * r + linear.measurement_in * y
    np.testing.assert_allclose(commands, expected, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("order", [1, 2])
def test_its_transfer_functions_are_those_of_a_fast_sampled_loop(order):
    loop = LADRC([WC], [WO], [3.0], order=order, feedback_factor=0.5, dt=1e-5)
    linear, s = jax.tree.map(np.asarray, loop.linear()), 20j
    states = np.exp(s * 1e-5) * np.eye(order + 1) - linear.A
    for k, (into, through) in enumerate(
        [
            (-linear.measurement_in, -linear.measurement_through),
            (linear.reference_in, linear.reference_through),
        ]
    ):
        sampled = linear.C @ np.linalg.solve(states, into) + through
        continuous = complex(loop.transfer_functions()[k](jnp.asarray(s)))
        assert sampled == pytest.approx(continuous, rel=2e-3)  # of 1e-5 s at up to 110 rad/s


def test_its_feedback_is_the_published_two_degree_of_freedom_pid():
    feedback, forward = LADRC(WC, WO, 2.0).transfer_functions()
    np.testing.assert_allclose(feedback.numerator, np.array([90000, 810000, 2.7e6]) / 2, rtol=1e-13)
    np.testing.assert_allclose(feedback.denominator, [1, 110, 4600, 0], rtol=1e-13)
    np.testing.assert_allclose(forward.numerator, 50 * np.array([1, 90, 2700, 27000.0]), rtol=1e-13)
