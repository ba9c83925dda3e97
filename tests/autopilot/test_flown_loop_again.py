"""The closed loop that law and plant predict, beside simulated flights of it."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from jaxquad.autopilot import (
    Butterworth,
    FilterChain,
    hold_response,
    predict_loop,
    PX4Rate,
)


DT, GAIN, LAG = 1 / 400, 60.0, 0.03  # s, rad/s^2 per unit of u, s
WHOLE = PX4Rate([0.15], [0.2], [0.003], gyro=FilterChain((Butterworth(40.0),), 2000.0))
LAW = WHOLE.without_gyro_filters()
SAMPLES = 4096
OMEGA = 2 * np.pi * np.arange(4, 200, 4) / (SAMPLES * DT)


def sampled(gain):
    """gain / (s (lag s + 1)) behind a hold, and its response at OMEGA."""
    flow, entry = np.array([[0, 1], [0, -1 / LAG]]), np.array([[0], [gain / LAG]])
    found: Any = signal.cont2discrete((flow, entry, np.eye(1, 2), np.zeros((1, 1))), DT)
    a, b, c, *_ = found
    z = np.exp(1j * OMEGA * DT)
    response = np.array([(c @ np.linalg.solve(x * np.eye(2) - a, b))[0, 0] for x in z])
    return a, b[:, 0], response


@eqx.filter_jit
def fly(law, a, b, reference):
    def sample(carry, now):
        state, x = carry
        y = x[:1]
        state, u = law.step(state, now, y)
        return (state, a @ x + b * u), y[0]

    start = law.init(jnp.zeros(1)), jnp.zeros(2)
    return jax.lax.scan(sample, start, reference[:, None])[1]


PERIODS = 4


def measured(gain):
    """The response at OMEGA of a flight with a multisine, over its last period."""
    a, b, _ = sampled(gain)
    phases = np.random.default_rng(4).uniform(0, 2 * np.pi, len(OMEGA))
    time = DT * np.arange(PERIODS * SAMPLES)
    # So small that PX4's integral, which fades with the error, is linear.
    r = 2e-5 * np.sum(np.cos(OMEGA * time[:, None] + phases), axis=1)
    y = np.asarray(fly(LAW, *map(jnp.asarray, (a, b, r))))
    lines = np.round(OMEGA * SAMPLES * DT / (2 * np.pi)).astype(int)
    inputs, outputs = (np.fft.rfft(x[-SAMPLES:])[lines] for x in (r, y))
    return outputs / inputs


def test_the_predicted_loop_is_the_one_that_flies():
    found = predict_loop(LAW.linear(0), sampled(GAIN)[2], OMEGA)
    np.testing.assert_allclose(found, measured(GAIN), rtol=1e-6)


def test_a_hold_makes_the_sampled_plant_of_a_continuous_one_far_below_the_sampling():
    slow = OMEGA < 0.02 * np.pi / DT
    s = 1j * OMEGA[slow]
    continuous = GAIN / (s * (LAG * s + 1)) * hold_response(OMEGA[slow], DT)
    np.testing.assert_allclose(continuous, sampled(GAIN)[2][slow], rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("frequency", [1.0, 5.0, 20.0])
def test_the_filters_belong_either_to_the_law_or_to_the_plant(frequency):
    """Up to the derivative, which is taken at the gyro's rate or at the loop's."""
    omega = 2 * np.pi * np.array([frequency])
    s = 1j * omega
    plant = GAIN / (s * (LAG * s + 1)) * hold_response(omega, DT)
    chain = np.asarray(WHOLE.gyro.response(omega / (2 * np.pi)))
    inner = predict_loop(WHOLE.linear(0), plant, omega)  # from r to the true rate
    outer = predict_loop(LAW.linear(0), plant * chain, omega)  # to the filtered one
    np.testing.assert_allclose(inner * chain, outer, rtol=0.02)
