"""Loops that run away: held and flagged, with finite values and gradients."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.control import LADRC
from jaxquad.loops import Loop
from jaxquad.models import Allocation, Attitude, DecoupledAxes, MotorLag, Multirotor
from jaxquad.simulation import Scenario, simulate


SAMPLES, KT = 1000, 0.0234
INERTIA = 0.0552 * np.array([[1.0, 5.0, 0.5]] * 3)  # b/b0 = 8.5, 1.7, 17: one is stable
STABLE = np.array([False, True, False])
LAW = LADRC([20.0] * 3, [60.0] * 3, [0.05] * 3)


def step(size=0.07, shape=(SAMPLES, 3)) -> Scenario:
    still = jnp.zeros(shape)
    return Scenario(jnp.full(shape, size), still, still, still)


def axes(inertia=INERTIA):
    return DecoupledAxes([KT] * 3, inertia)


def floats(tree):
    return [np.asarray(x) for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]


def trajectories(found):
    return found.time, found.angle, found.measurement, found.command, found.signals


def cost(found):
    estimates = sum(jnp.sum(x**2) for x in found.signals.values())
    return jnp.sum(found.angle**2) + jnp.sum(found.command**2) + estimates


def gradients(plant, law, case, **options):
    """Of a cost with respect to every parameter of the plant and of the law."""
    free, fixed = eqx.partition((plant, law), eqx.is_inexact_array)

    @jax.jit
    @jax.grad
    def slope(free):
        plant, law = eqx.combine(free, fixed)
        return cost(simulate(Loop(plant, law, **options), case))

    return floats(slope(free))


def test_an_unstable_member_is_held_and_flagged_and_all_stays_finite():
    found = simulate(Loop(axes(), LAW, bound=5.0), step())
    np.testing.assert_array_equal(found.diverged, ~STABLE)
    assert all(np.all(np.isfinite(x)) for x in floats(trajectories(found)))
    assert np.max(np.abs(found.angle)) == 5.0
    np.testing.assert_array_equal(found.command[-1][:, ~STABLE], 0.0)
    np.testing.assert_array_equal(found.angle[-1][:, ~STABLE], found.angle[-2][:, ~STABLE])
    assert np.max(np.abs(found.angle[-1][:, STABLE] - 0.07)) < 1e-3


@pytest.mark.slow
def test_what_a_neighbour_does_changes_neither_a_member_nor_its_gradient():
    likes = axes(INERTIA[:, [1, 1, 1]])
    together, among_likes = (simulate(Loop(p, LAW, bound=5.0), step()) for p in (axes(), likes))
    np.testing.assert_allclose(
        together.angle[..., 1], among_likes.angle[..., 1], rtol=0, atol=1e-13
    )
    both, own = (gradients(p, LAW, step(), bound=5.0) for p in (axes(), likes))
    of_inertia = [next(x for x in given if x.shape == INERTIA.shape) for given in (both, own)]
    np.testing.assert_allclose(of_inertia[0][:, 1], of_inertia[1][:, 1], rtol=1e-9)
    assert all(np.all(np.isfinite(x)) for x in both)


class Free(eqx.Module):
    """A drive without limits."""

    allocation: Allocation

    def inputs(self, command):
        return self.allocation.from_differences(command, 2.0)

    def achieved(self, inputs):
        return self.allocation.differences(inputs)


class Kinematic(eqx.Module):
    """Euler angles, which are singular at a pitch of 90 degrees."""

    inertia: jax.Array

    def init(self, euler=None, *, ensemble=()):
        return jnp.zeros((3, *ensemble)), jnp.zeros((3, *ensemble))

    def derivative(self, state, inputs, disturbance):
        (roll, pitch, _), (p, q, r) = state
        turn = q * jnp.sin(roll) + r * jnp.cos(roll)
        across = q * jnp.cos(roll) - r * jnp.sin(roll)
        angles = jnp.stack([p + turn * jnp.tan(pitch), across, turn / jnp.cos(pitch)])
        return angles, (KT * inputs + disturbance) / self.inertia

    def measure(self, state):
        return state[0]


class Root(eqx.Module):
    """A plant that is not a number beyond 0.05 rad, nor is its slope there finite."""

    inertia: jax.Array

    def init(self, euler=None, *, ensemble=()):
        return jnp.zeros((3, *ensemble)), jnp.zeros((3, *ensemble))

    def derivative(self, state, inputs, disturbance):
        return state[1], (KT * inputs - jnp.sqrt(1 - state[0] / 0.05)) / self.inertia

    def measure(self, state):
        return state[0]


class Failing(eqx.Module):
    """A controller whose gain is the root of something that turns negative."""

    gain: jax.Array

    def init(self, like):
        return jnp.zeros_like(like)

    def step(self, state, reference, measurement):
        return state + 1e-3, self.gain * jnp.sqrt(0.5 - state) * (reference - measurement)


def tumbling():
    rig = Multirotor(Attitude([0.06] * 3), Allocation(0.2, 0.12, 0.02), MotorLag(0.02))
    return rig, LAW, {"drive": Free(rig.allocation)}


RUNAWAYS = {
    "a free multirotor": tumbling(),
    "a singular attitude": (Kinematic(jnp.full(3, 0.05)), LAW, {}),
    "a plant without an answer": (Root(jnp.full(3, 0.05)), LAW, {}),
    "a controller without one": (axes(INERTIA[:, 1]), Failing(jnp.asarray(1.0)), {}),
}


LONG = ("a free multirotor", "a singular attitude", "a plant without an answer")


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=[pytest.mark.slow] * (x in LONG)) for x in RUNAWAYS]
)
def test_no_runaway_makes_values_or_gradients_infinite(name):
    plant, law, options = RUNAWAYS[name]
    found = simulate(Loop(plant, law, **options), step())
    assert bool(found.diverged)
    assert all(np.all(np.isfinite(x)) for x in floats(trajectories(found)))
    assert all(np.all(np.isfinite(x)) for x in gradients(plant, law, step(), **options))


@pytest.mark.slow
def test_under_vmap_and_jit_nothing_is_raised():
    run = lambda b0: simulate(
        Loop(axes(INERTIA[:, 0]), eqx.tree_at(lambda c: c.b0, LAW, b0)), step()
    )
    found = jax.jit(jax.vmap(run))(jnp.asarray([[0.4] * 3, [0.2] * 3, [0.03] * 3]))
    np.testing.assert_array_equal(found.diverged, [False, False, True])
    assert np.all(np.isfinite(found.angle))


def test_a_parameter_that_is_nan_is_flagged_from_the_start():
    broken = eqx.tree_at(lambda p: p.inertia, axes(INERTIA[:, 1]), jnp.full(3, jnp.nan))
    found = simulate(Loop(broken, LAW), step())
    assert bool(found.diverged) and np.all(np.isfinite(found.angle))


def test_a_diverged_member_gives_no_record():
    found = simulate(Loop(axes(), LAW), step())
    assert found.record("roll", member=1).dt == pytest.approx(0.002, rel=1e-9)
    with pytest.raises(ValueError, match="the loop diverged"):
        found.record("roll", member=2)
