"""Feed-forward of the sticks, beside flights of the law over the vehicle's true plant."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter

from jaxquad.autopilot import with_parameters
from jaxquad.workflows import autopilot, AutopilotSettings


pytestmark = pytest.mark.slow
GAIN, LAG = 37.67 * np.pi / 180, 0.025  # of the vehicle, rad/s^2 per unit of the command, and s
SECONDS = 1.0


@pytest.fixture(scope="module")
def proposal(data):
    """Of a log of sticks, with half of the plants."""
    settings = AutopilotSettings(axis="roll", keep_filters=True, members=32, fresh=128)
    return autopilot(data / "betaflight_firmware" / "A_sticks.BFL", settings)


def quick_stick(dt):
    """A step behind three lags of 15 Hz."""
    kept = np.exp(-2 * np.pi * 15 * dt)
    stick = np.ones(round(SECONDS / dt))
    for _ in range(3):
        stick = np.asarray(lfilter([1 - kept], [1, -kept], stick))
    return stick


@jax.jit
def fly(law, A, B, setpoint):
    """The rate of the plant, whose state holds it and the torque."""

    def sample(carry, aim):
        state, x = carry
        state, command = law.step(state, aim[None], x[:1])
        return (state, A @ x + B * command[0]), x[0]

    return jax.lax.scan(sample, (law.init(jnp.zeros(1)), jnp.zeros(2)), setpoint)[1]


def error_of(proposal, parameters, size=3.5):
    """Rms of set-point less rate after a quick stick to so many rad/s, relative to that."""
    law = with_parameters(proposal.flown.law, parameters)
    law = jax.tree.map(lambda x: x[:1] if x.ndim else x, law)
    held = np.array([[0, 1, 0], [0, -1 / LAG, GAIN / LAG], [0, 0, 0]])  # the last is the command
    step, stick = expm(held * law.dt), size * quick_stick(law.dt)
    rate = np.asarray(fly(law, step[:2, :2], step[:2, 2], stick))
    return np.sqrt(np.mean((stick - rate) ** 2)) / size


def test_the_promised_error_is_that_of_a_flight(proposal):
    """Integral relaxed, D raised, the plant the true one: nothing of it is the design's."""
    verdict, new = proposal.sticks, dict(proposal.new)
    assert verdict.flown == {"f_roll": 120.0} and 150 < new["f_roll"] < 230  # 1/K is 193
    before, after = (error_of(proposal, new | {"f_roll": f}) for f in (120.0, new["f_roll"]))
    np.testing.assert_allclose(after / before, verdict.stages[1].error, atol=0.03)
    assert after < before < error_of(proposal, proposal.old)


def test_a_lower_limit_on_the_peak_lowers_it(proposal):
    tight = proposal.retuned(resonance=1.2)
    assert tight.new["f_roll"] < proposal.new["f_roll"]
    assert tight.sticks.keeps and tight.sticks.stages[-1].peak <= 1.2
    assert f"f_roll: {tight.sticks.reason}" in str(tight)
