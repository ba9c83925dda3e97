"""Delays of whole and of broken numbers of samples between the controller and the plant."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.control import LADRC
from jaxquad.loops import Loop
from jaxquad.models import DecoupledAxes
from jaxquad.simulation import Scenario, simulate


DT, SAMPLES = 0.002, 100
DELAYS = np.array([0.0, 0.0007, 0.002, 0.0053, 0.008])
PLANT = DecoupledAxes([0.5, 1.0], [0.05, 0.02])
TIME = DT * np.arange(SAMPLES)


class Idle(eqx.Module):
    """A controller that asks for nothing, so that the injected command is all there is."""

    def init(self, like):
        return None

    def step(self, state, reference, measurement):
        return None, jnp.zeros_like(measurement)


def pushed(seed=0) -> Scenario:
    command = np.random.default_rng(seed).standard_normal((SAMPLES, 2))
    still = jnp.zeros((SAMPLES, 2))
    return Scenario(still, jnp.asarray(command), still, still)


def double_integral(command, delay):
    """Each held command, `delay` seconds late, turns the plant on its own: b (t - begin)^2 / 2."""
    begins = TIME[:, None] - (TIME + delay)
    grown = lambda since: 0.5 * np.maximum(since, 0.0) ** 2
    each = grown(begins) - grown(begins - DT)
    return each @ (command * np.asarray(PLANT.gain))


def test_a_delay_of_any_length_is_exact_and_each_member_has_its_own():
    case = pushed()
    found = simulate(Loop(PLANT, Idle(), delay=DELAYS), case)
    assert found.angle.shape == (SAMPLES, 2, len(DELAYS))
    for k, delay in enumerate(DELAYS):
        exact = double_integral(np.asarray(case.injection), delay)
        # Runge-Kutta of order 4 integrates a held torque exactly; what is left is rounding.
        np.testing.assert_allclose(found.angle[..., k], exact, rtol=0, atol=1e-13)


@pytest.mark.parametrize("delay", [0.0, 0.0053, 0.008])
def test_one_delay_for_all_is_as_a_member_with_it(delay):
    found = simulate(Loop(PLANT, Idle(), delay=delay), pushed())
    exact = double_integral(np.asarray(pushed().injection), delay)
    np.testing.assert_allclose(found.angle, exact, rtol=0, atol=1e-13)


def ladrc():
    return LADRC([8.0, 8.0], [40.0, 40.0], PLANT.gain)


@eqx.filter_jit
def final(delay):
    case = eqx.tree_at(lambda c: c.reference, pushed(), jnp.full((SAMPLES, 2), 0.1))
    return jnp.sum(
        simulate(Loop(PLANT, ladrc(), delay=delay, longest_delay=0.012), case).angle ** 2
    )


@pytest.mark.slow
def test_a_traced_delay_gives_the_same_and_its_gradient_is_that_of_differences():
    case = eqx.tree_at(lambda c: c.reference, pushed(), jnp.full((SAMPLES, 2), 0.1))
    concrete = simulate(Loop(PLANT, ladrc(), delay=0.0053), case)
    assert float(final(0.0053)) == pytest.approx(float(jnp.sum(concrete.angle**2)), rel=1e-12)
    h, slope = 1e-5, jax.jit(jax.grad(final))
    for delay in (0.0053, 0.0105):
        difference = (final(delay + h) - final(delay - h)) / (2 * h)
        assert float(slope(delay)) == pytest.approx(float(difference), rel=1e-6)


@pytest.mark.slow
def test_the_loop_is_smooth_where_the_delay_passes_a_whole_sample():
    slope = jax.jit(jax.grad(final))
    below, at, above = (float(slope(0.004 + h)) for h in (-1e-9, 0.0, 1e-9))
    assert below == pytest.approx(above, rel=1e-5)
    assert at == pytest.approx(above, rel=1e-5)


def test_delays_under_vmap_are_those_of_an_ensemble():
    together = simulate(Loop(PLANT, Idle(), delay=DELAYS), pushed()).angle
    one = lambda delay: (
        simulate(Loop(PLANT, Idle(), delay=delay, longest_delay=0.01), pushed()).angle
    )
    mapped = jax.vmap(one, out_axes=-1)(jnp.asarray(DELAYS))
    np.testing.assert_allclose(mapped, together, rtol=0, atol=1e-13)


def test_before_the_first_command_arrives_nothing_pushes():
    found = simulate(Loop(PLANT, Idle(), delay=0.008), pushed())
    np.testing.assert_array_equal(found.angle[:5], 0.0)
    assert np.all(np.asarray(found.angle[5]) != 0)


@pytest.mark.parametrize("bad", [-0.001, np.nan, np.inf])
def test_a_delay_that_cannot_be_is_refused(bad):
    with pytest.raises(ValueError, match="delay is .* s, but it must be 0 or above and finite"):
        simulate(Loop(PLANT, Idle(), delay=bad), pushed())


def test_a_traced_delay_needs_to_know_how_long_it_can_become():
    run = lambda delay, **more: simulate(Loop(PLANT, Idle(), delay=delay, **more), pushed()).angle
    with pytest.raises(ValueError, match="longest_delay is None: give longest_delay="):
        jax.jit(run)(0.004)
    with pytest.raises(ValueError, match="above longest_delay = 0.004 s"):
        run(0.005, longest_delay=0.004)
    with pytest.raises(eqx.EquinoxRuntimeError, match="outside 0 to longest_delay = 0.004 s"):
        eqx.filter_jit(run)(jnp.asarray(0.005), longest_delay=0.004).block_until_ready()
