import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from jaxquad.control import PD, place_pd
from jaxquad.loops import Loop
from jaxquad.simulation import Scenario, simulate


GAIN = np.array([0.4, 0.5, 0.03])  # rad/s^2 per unit of command
FREQUENCY, DAMPING, DT = 3.0, 0.7, 1e-3


class Axes:
    """Three double integrators, angle and rate, without any coupling: gain / s^2."""

    def init(self, euler=None, *, ensemble=()):
        return jnp.zeros((3, *ensemble)), jnp.zeros((3, *ensemble))

    def derivative(self, state, inputs, disturbance):
        gain = jnp.asarray(GAIN).reshape(-1, *(1,) * (inputs.ndim - 1))
        return state[1], gain * inputs + disturbance

    def measure(self, state):
        return state[0]


def step_response(bandwidth, dt=DT, axis=0):
    placed = place_pd(GAIN, natural_frequency=FREQUENCY, damping=DAMPING, dt=dt)
    pilot = PD(placed.proportional, placed.derivative, bandwidth=bandwidth, dt=dt)
    samples = round(4.0 / dt)
    nothing = jnp.zeros((samples, 3))
    step = nothing.at[:, axis].set(0.1)
    return simulate(Loop(Axes(), pilot, dt=dt), Scenario(step, nothing, nothing, nothing))


def second_order(time):
    """Of proportional feedback with damping of the output: no zero."""
    system = ([0.1 * FREQUENCY**2], [1.0, 2 * DAMPING * FREQUENCY, FREQUENCY**2])
    return signal.step(system, T=time)[1]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_placed_loop_steps_like_its_second_order_model(axis):
    found = step_response(2e4, axis=axis)
    # Hold and backward difference delay the damping by a sample or so: 1e-3 s of 3 rad/s.
    expected = second_order(np.asarray(found.time))
    np.testing.assert_allclose(found.angle[:, axis], expected, atol=0.1 * 0.003)


def test_other_axes_stay_at_rest():
    assert np.all(np.asarray(step_response(2e4, axis=1).angle)[:, [0, 2]] == 0)


def test_the_error_of_the_placement_falls_with_the_sample_interval():
    errors = []
    for dt in (4e-3, 2e-3):
        found = step_response(2e4, dt)
        errors.append(np.abs(found.angle[:, 0] - second_order(np.asarray(found.time))).max())
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.1)  # a delay, so of first order


def commands(pilot, measurements):
    """Those to a sequence of measurements, at a set-point of zero."""
    step = lambda state, angle: pilot.step(state, jnp.zeros_like(angle), angle)
    return np.asarray(jax.lax.scan(step, pilot.init(measurements[0]), measurements)[1])


PILOT = PD([10.0, 20.0, 30.0], [1.0, 2.0, 3.0], bandwidth=50.0, dt=0.01)


def test_the_derivative_is_scipys_filtered_difference():
    angles = np.random.default_rng(0).standard_normal((40, 3))
    keep = np.exp(-0.5)
    slopes = np.diff(angles, axis=0, prepend=angles[:1]) / 0.01
    rate = signal.lfilter([1 - keep], [1, -keep], slopes, axis=0)
    expected = -np.array([10.0, 20.0, 30.0]) * angles - np.array([1.0, 2.0, 3.0]) * rate
    np.testing.assert_allclose(commands(PILOT, jnp.asarray(angles)), expected, rtol=1e-12)


def test_a_flight_that_starts_off_level_gives_no_derivative_kick():
    found = commands(PILOT, jnp.full((3, 3), 0.2))
    np.testing.assert_allclose(found, np.tile([-2.0, -4.0, -6.0], (3, 1)), rtol=1e-14)


def test_an_ensemble_is_controlled_member_by_member():
    angles = jnp.asarray(np.random.default_rng(1).standard_normal((10, 3, 4)))
    together = commands(PILOT, angles)
    for k in range(4):
        np.testing.assert_allclose(together[..., k], commands(PILOT, angles[..., k]), rtol=1e-13)


def test_gains_are_placed_by_gain_frequency_and_damping():
    pilot = place_pd([2.0, 4.0], natural_frequency=3.0, damping=0.5)
    np.testing.assert_allclose(pilot.proportional, [4.5, 2.25])
    np.testing.assert_allclose(pilot.derivative, [1.5, 0.75])


def test_whole_numbers_make_gains_that_can_be_differentiated():
    pilot = PD([1, 2, 3], [0, 0, 1])
    slope = jax.grad(lambda p: jnp.sum(commands_once(p)))(pilot)
    np.testing.assert_allclose(slope.proportional, -0.1)


def commands_once(pilot):
    angle = jnp.full(3, 0.1)
    return pilot.step(pilot.init(angle), jnp.zeros(3), angle)[1]


@pytest.mark.parametrize("options", [dict(dt=0.0), dict(bandwidth=-1.0)])
def test_an_impossible_filter_is_refused_with_its_values(options):
    with pytest.raises(ValueError, match="must be above 0"):
        PD(np.ones(3), np.ones(3), **options)
