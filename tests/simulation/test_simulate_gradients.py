"""Gradients of a closed loop, through saturation, quantiser and delay, against differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.control import LADRC, PID
from jaxquad.loops import Loop
from jaxquad.models import DecoupledAxes
from jaxquad.simulation import Encoder, Saturation, Scenario, simulate


DT, SAMPLES, LIMIT = 0.002, 600, 0.5
ENCODER = Encoder(8192)
RIG = {"inertia": 0.0552, "lag": 0.02, "damping": 0.01, "limit": LIMIT, "delay": 0.0043}
LAWS = {
    LADRC: {"wc": 5.0, "wo": 25.0, "b0": 0.7, "feedback_factor": 0.9, "observer_factor": 0.8},
    PID: {"kp": 40.0, "ki": 20.0, "kd": 15.0, "filter": 60.0, "proportional_weight": 0.7,
          "derivative_weight": 0.3, "feedforward": 0.6},
}  # fmt: skip
TIME = DT * np.arange(SAMPLES)[:, None]
STEP = 0.05 - 0.05 * np.exp(-40 * TIME)  # rad, with the rate and acceleration of feed-forward


def residue(seed=0):
    """Sensor noise, of a tenth of the encoder's count."""
    count = 2 * np.pi / 8192
    return jnp.asarray(0.1 * count * np.random.default_rng(seed).standard_normal((SAMPLES, 1)))


def run(law, scale, noise, encoder=None):
    """A step under a load, with every parameter of loop and law multiplied by its `scale`."""
    given = {name: value * scale[k] for k, (name, value) in enumerate((RIG | LAWS[law]).items())}
    plant = DecoupledAxes(0.0234, given["inertia"], lag=given["lag"], damping=given["damping"])
    controller = law(**{name: given[name] for name in LAWS[law]}, limit=given["limit"], dt=DT)
    still = jnp.zeros((SAMPLES, 1))
    ahead = [jnp.asarray(part) for part in (2 * np.exp(-40 * TIME), -80 * np.exp(-40 * TIME))]
    load = still.at[200:].set(0.004)
    case = Scenario(jnp.asarray(STEP), still, load, noise, *ahead)  # noise may be wider
    loop = Loop(
        plant,
        controller,
        drive=Saturation(given["limit"]),
        encoder=encoder,
        delay=given["delay"],
        longest_delay=0.006,
    )
    return simulate(loop, case)


@eqx.filter_jit
def cost(law, scale, noise, encoder=None):
    """ITAE in rad s^2, and a little of the command's activity."""
    found = run(law, scale, noise, encoder)
    time, step = (x.reshape(x.shape + (1,) * (found.angle.ndim - 2)) for x in (TIME, STEP))
    itae = DT * jnp.sum(time * jnp.abs(found.angle - step))
    return itae + 1e-6 * jnp.sum(found.command**2)


@eqx.filter_jit
def costs(law, scales, noise):
    return jax.vmap(lambda scale: cost(law, scale, noise))(scales)


def ones(law):
    return jnp.ones(len(RIG) + len(LAWS[law]))


def differences(law, noise):
    h = 1e-5  # its square is the error of a central difference
    scales = [jnp.asarray(1 + sign * h * np.eye(len(ones(law)))) for sign in (1, -1)]
    ends = [costs(law, given, noise) for given in scales]
    return np.asarray((ends[0] - ends[1]) / (2 * h))


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__)
def test_gradients_by_every_gain_and_parameter_are_those_of_differences(law):
    found = run(law, ones(law), residue())
    assert 0.1 < np.mean(np.abs(found.command) > 0.999 * LIMIT) < 0.9
    slope = jax.grad(cost, argnums=1)(law, ones(law), residue())
    scale = np.max(np.abs(slope))
    np.testing.assert_allclose(slope, differences(law, residue()), rtol=1e-6, atol=1e-8 * scale)


@pytest.mark.slow
def test_through_an_encoder_the_gradient_is_that_of_the_loop_with_its_rounding_as_noise():
    found = run(LADRC, ones(LADRC), residue(), ENCODER)
    rounding = found.measurement - found.angle
    straight = jax.grad(cost, argnums=1)(LADRC, ones(LADRC), residue(), ENCODER)
    frozen = jax.grad(cost, argnums=1)(LADRC, ones(LADRC), rounding)
    np.testing.assert_allclose(straight, frozen, rtol=1e-10)


@pytest.mark.slow
def test_where_noise_dithers_the_encoder_its_gradient_is_the_slope_of_the_mean():
    count = 2 * np.pi / 8192
    noise = jnp.asarray(count * np.random.default_rng(1).standard_normal((SAMPLES, 1, 128)))
    mean = lambda scale: cost(LADRC, scale, noise, ENCODER)
    along = jax.jit(lambda way: jax.jvp(mean, (ones(LADRC),), (way,))[1])
    for k in (0, len(RIG), len(RIG) + 2):  # inertia, wc, b0
        way = jnp.zeros_like(ones(LADRC)).at[k].set(1.0)
        high, low = (mean(ones(LADRC) + step * way) for step in (0.02, -0.02))
        # 128 draws leave some per cent of scatter; without straight-through it is off manyfold.
        assert float(high - low) / 0.04 == pytest.approx(float(along(way)), rel=0.05)


@pytest.mark.slow
def test_forward_and_reverse_mode_agree():
    forward = jax.jacfwd(cost, argnums=1)(LADRC, ones(LADRC), residue())
    reverse = jax.grad(cost, argnums=1)(LADRC, ones(LADRC), residue())
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
