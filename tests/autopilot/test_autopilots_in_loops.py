"""The firmwares' attitude loops in `jq.Loop`: simulated, over members, differentiated, analysed."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxquad as jq
from jaxquad.autopilot import (
    Butterworth,
    FilterChain,
    hold_response,
    PX4Attitude,
    PX4Rate,
)


RATE = PX4Rate([0.15], [0.2], [0.003], gyro=FilterChain((Butterworth(40.0),), 2000.0))
LAW = PX4Attitude(RATE, [4.0])
FLIGHT = jq.scenario(duration=1.0, axes=1, dt=LAW.dt, reference=jq.Step(0.2))


def loop(gain, law=LAW):
    plant = jq.DecoupledAxes(torque_gain=gain, inertia=[1.0], lag=0.03)
    return jq.Loop(plant, law, drive=jq.simulation.Saturation(1.0), delay=0.004)


@pytest.mark.slow
def test_members_fly_as_they_do_alone_and_gains_have_slopes():
    together = jq.simulate(loop([[40.0, 60.0, 80.0]]), FLIGHT).angle
    alone = jq.simulate(loop([60.0]), FLIGHT).angle
    np.testing.assert_allclose(together[..., 1], alone, rtol=1e-9, atol=1e-12)

    def end(p):
        rate = dataclasses.replace(RATE, p=jnp.stack([p]))
        flown = jq.simulate(loop([60.0], dataclasses.replace(LAW, rate=rate)), FLIGHT)
        return flown.angle[200, 0]

    p, h = jnp.asarray(0.15), 1e-5
    difference = (end(p + h) - end(p - h)) / (2 * h)
    assert float(jax.grad(end)(p)) == pytest.approx(float(difference), rel=1e-6)


@pytest.mark.slow
def test_the_peak_of_the_sensitivity_is_that_of_law_and_plant():
    numbers, law = jq.analyse(loop([60.0]), axis="roll"), jax.tree.map(np.asarray, LAW.linear(0))
    omega = np.linspace(5.0, 25.0, 400)
    z, s = np.exp(1j * omega * LAW.dt), 1j * omega
    back = law.measurement_through + np.array(
        [law.C @ np.linalg.solve(x * np.eye(len(law.A)) - law.A, law.measurement_in) for x in z]
    )
    plant = 60 / (s**2 * (0.03 * s + 1)) * np.exp(-0.004 * s) * hold_response(omega, LAW.dt)
    peak = np.max(np.abs(1 / (1 - plant * back)))
    assert float(numbers.sensitivity_peak) == pytest.approx(peak, rel=1e-3)
