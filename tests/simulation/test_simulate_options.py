"""What a loop is given beyond plant, law and scenario: payloads, set-points, drives, ensembles."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.control import LADRC, PD, Setpoint
from jaxquad.loops import Loop, per_member
from jaxquad.models import Allocation, Attitude, DecoupledAxes, Multirotor
from jaxquad.simulation import Saturation, Scenario, simulate


DT, SAMPLES, KT, J = 0.002, 100, 0.02, 0.05
TIME = DT * np.arange(SAMPLES)
STILL = jnp.zeros((SAMPLES, 2))
LAW = LADRC([8.0, 8.0], [40.0, 40.0], [KT / J] * 2, dt=DT)


def axes(inertia: Any = J):
    return DecoupledAxes([KT] * 2, inertia)


def scenario(**parts) -> Scenario:
    given = dict.fromkeys(("reference", "injection", "disturbance", "noise"), STILL)
    given |= {name: STILL + jnp.asarray(x) for name, x in parts.items()}
    return Scenario(**given, dt=None)


class Spy(eqx.Module):
    """Asks for a constant command and shows what it is told."""

    command: float = 1.0

    def init(self, like):
        return {"achieved": jnp.zeros_like(like), "rate": jnp.zeros_like(like)}

    def step(self, state, reference, measurement):
        rate = reference.rate if isinstance(reference, Setpoint) else jnp.zeros_like(measurement)
        return state | {"rate": rate}, jnp.full_like(measurement, self.command)

    def applied(self, state, achieved):
        return state | {"achieved": achieved}

    def signals(self, state):
        return state


def test_a_payload_weighs_from_the_sample_at_which_it_is_there():
    extra = jnp.asarray(np.where(TIME < 0.1, 0.0, J)[:, None] * np.ones(2))
    angle = np.asarray(simulate(Loop(axes(), Spy()), scenario(payload=extra)).angle)
    curvature = np.diff(angle, 2, axis=0) / DT**2  # half of each of two samples' acceleration
    np.testing.assert_allclose(curvature[:48], KT / J, rtol=1e-6)
    np.testing.assert_allclose(curvature[51:], KT / (2 * J), rtol=1e-6)


def test_a_reference_with_a_rate_reaches_the_controller_as_a_set_point():
    found = simulate(Loop(axes(), Spy()), scenario(rate=0.3))
    np.testing.assert_array_equal(found.signals["rate"], 0.3)
    np.testing.assert_array_equal(simulate(Loop(axes(), Spy()), scenario()).signals["rate"], 0.0)


def test_feed_forward_makes_a_ramp_followed_without_lag():
    ramp = 0.2 * TIME[:, None]
    lag = {}
    for name, given in (("ahead", {"rate": 0.2}), ("behind", {})):
        case = scenario(reference=ramp, **given)
        lag[name] = np.abs(simulate(Loop(axes(), LAW), case).angle[-1] - ramp[-1])
    assert np.all(lag["ahead"] < 0.3 * lag["behind"])


def test_the_controller_is_told_what_the_drive_gave_and_so_is_the_user():
    found = simulate(Loop(axes(), Spy(), drive=Saturation([1.2, 2.0])), scenario(injection=0.5))
    np.testing.assert_array_equal(found.command, np.broadcast_to([1.2, 1.5], (SAMPLES, 2)))
    np.testing.assert_array_equal(found.signals["achieved"], found.command)
    np.testing.assert_array_equal(found.saturated.all(axis=0), [True, False])


def test_the_disturbance_estimate_is_recorded_in_units_of_the_command():
    case = scenario(disturbance=0.004)
    case = eqx.tree_at(lambda s: s.reference, case, STILL)
    found = simulate(Loop(axes(), LADRC([8.0] * 2, [200.0] * 2, [KT / J] * 2, dt=DT)), case)
    np.testing.assert_allclose(found.signals["disturbance"][-1] * KT, 0.004, rtol=1e-3)


@pytest.mark.slow
def test_ensembles_of_plants_laws_scenarios_and_delays_meet():
    b0 = KT / J * np.array([[0.8, 1.0, 1.5]] * 2)
    inertia = J * np.array([[1.0, 1.2, 0.9]] * 2)
    step, delays = np.array([0.1, -0.1, 0.05]), np.array([0.0, 0.003, 0.004])
    law = lambda gain: eqx.tree_at(lambda c: c.b0, LAW, jnp.asarray(gain))
    wide = Scenario(jnp.asarray(np.ones((SAMPLES, 2, 1)) * step), STILL, STILL, STILL)
    together = simulate(Loop(axes(inertia), law(b0), delay=delays), wide)
    assert together.reference.shape == together.angle.shape == (SAMPLES, 2, 3)
    for k in range(3):
        alone = simulate(
            Loop(axes(inertia[:, k]), law(b0[:, k]), delay=delays[k]), scenario(reference=step[k])
        )
        np.testing.assert_allclose(together.angle[..., k], alone.angle, rtol=0, atol=1e-13)


def test_gains_that_couple_the_axes_are_no_ensemble_and_declared_ones_are():
    class Coupled(eqx.Module):
        gain: jnp.ndarray

        def init(self, like):
            return None

        def step(self, state, reference, measurement):
            return None, jnp.sum(self.gain * (reference - measurement)[None], axis=1)

    class PerMember(eqx.Module):
        gain: jnp.ndarray = per_member(rank=1)

        def init(self, like):
            return None

        def step(self, state, reference, measurement):
            return state, self.gain * (reference - measurement)

    gain = jnp.asarray([[1.0, 0.2], [0.1, 2.0]])
    assert simulate(Loop(axes(), Coupled(gain)), scenario(reference=0.1)).angle.shape == (
        SAMPLES,
        2,
    )
    wide = simulate(Loop(axes(), PerMember(jnp.ones((2, 4)))), scenario(reference=0.1))
    assert wide.angle.shape == (SAMPLES, 2, 4)


def rotors():
    return Multirotor(Attitude([J] * 3), Allocation(0.2, 0.1, 0.01))


@pytest.mark.parametrize(
    "change, message",
    [
        ({"substeps": 0}, "substeps is 0"),
        ({"bound": -1.0}, "bound is -1.0 rad"),
        ({"plant": rotors()}, "drive is None, but a Multirotor takes four motor inputs"),
        ({"controller": PD([1.0] * 2, [1.0] * 2), "scenario": scenario(rate=0.1)}, "a PD feeds"),
        ({"scenario": scenario(noise=jnp.nan)}, "noise is not finite at sample 0"),
        ({"scenario": scenario(payload=-J)}, "must be above 0"),
        (
            {"plant": axes(np.full((2, 3), J)), "delay": np.full(4, 0.001)},
            r"Loop.plant.inertia \(3,\), Loop.delay \(4,\)",
        ),
        ({"plant": DecoupledAxes([KT] * 4, J)}, "for 2 axes, but the plant has 4: .*axes=4"),
        ({"plant": DecoupledAxes([KT], [J])}, "for 2 axes, but the plant has 1: .*axes=1"),
        (
            {"scenario": dataclasses.replace(scenario(), dt=0.01)},
            r"sampled every 0.01 s, but the loop runs every 0.002 s: give .*dt=0.002",
        ),
    ],
    ids=lambda x: next(iter(x)) if isinstance(x, dict) else "",
)
def test_parts_that_do_not_go_together_are_refused(change, message):
    given = {"plant": axes(), "controller": LAW, "scenario": scenario()} | change
    happens = given.pop("scenario")
    with pytest.raises(ValueError, match=message):
        simulate(Loop(**given), happens)


def test_a_limit_that_is_none_is_refused():
    with pytest.raises(ValueError, match="limit is .* must be above 0"):
        Saturation(0.0)
