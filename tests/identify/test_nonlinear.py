"""A nonlinear model in the time domain: quadratic drag and a battery that sags, on made flights."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxquad as jq


class Airspeed(eqx.Module):
    """Airspeed in m/s by throttle (0 to 1) and battery voltage (V)."""

    thrust: float  # m/s^2 at full throttle and 16.8 V
    sag: float  # exponent of the voltage
    drag: float  # 1/m
    lag: float  # of the motor, s

    def init(self):
        return {"speed": jnp.array(15.0), "motor": jnp.array(0.5)}

    def derivative(self, state, inputs, disturbance):
        throttle, volts = inputs
        push = self.thrust * (volts / 16.8) ** self.sag * state["motor"]
        drag = self.drag * state["speed"] * jnp.abs(state["speed"])
        return {"speed": push - drag, "motor": (throttle - state["motor"]) / self.lag}

    def measure(self, state):
        return state["speed"][None]


TRUE = {"thrust": 8.0, "sag": 1.6, "drag": 0.018, "lag": 0.3}
TIME = np.arange(0.0, 80.0, 0.1)
THROTTLE = np.repeat(np.random.default_rng(20).uniform(0.2, 0.9, 40), 20)
CONTROLS = np.stack([THROTTLE, 16.8 - 0.03 * TIME - 0.8 * THROTTLE], axis=1)
NOISE, FLIGHTS = 0.2, 8  # m/s


@pytest.fixture(autouse=True)
def usual_promotion():
    """JAX as a user has it."""
    with jax.numpy_dtype_promotion("standard"):
        yield


def by_scipy(speed0=14.0, motor0=0.4):
    """The speed from another initial state than the model's, sample by sample."""
    K, n, c, T = TRUE.values()

    def slope(t, state, first, change):
        throttle, volts = first + t / 0.1 * change
        push = K * (volts / 16.8) ** n * state[1]
        return [push - c * state[0] * abs(state[0]), (throttle - state[1]) / T]

    states = [np.array([speed0, motor0])]
    for first, after in zip(CONTROLS, CONTROLS[1:], strict=False):
        step = solve_ivp(
            slope, (0.0, 0.1), states[-1], args=(first, after - first), rtol=1e-8, atol=1e-9
        )
        states.append(step.y[:, -1])
    return np.array(states)[:, 0]


def record_of(speed):
    names = {"input_names": ("throttle", "volts"), "output_names": "speed"}
    return jq.Record(TIME, CONTROLS, speed, **names)


@pytest.mark.slow
def test_drag_and_sag_are_found_within_their_errors_from_whole_numbers_as_start():
    speed, distances = by_scipy(), []
    for seed in range(FLIGHTS):
        noise = np.random.default_rng(seed).normal(0.0, NOISE, TIME.size)
        fit = jq.refine(Airspeed(5, 1, 0.03, 0.5), record_of(speed + noise))
        assert fit.names == tuple(TRUE)
        distances.append((fit.values - np.array(list(TRUE.values()))) / fit.standard_errors)
    scatter = np.sqrt(np.mean(np.square(distances), axis=0))
    # Of 8 normal draws, 99.9 % of the root mean squares lie within 0.30 and 1.87.
    assert np.all((0.30 < scatter) & (scatter < 1.87)), scatter


@pytest.mark.slow
def test_without_noise_the_truth_is_found_to_the_accuracy_of_the_integrator():
    fit = jq.refine(Airspeed(5, 1, 0.03, 0.5), record_of(by_scipy()))
    np.testing.assert_allclose(fit.values, list(TRUE.values()), rtol=1e-4)
