"""The adaptive controller in the loop that jq.simulate closes around the rig's roll axis."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.control import (
    AdaptiveLADRC,
    certainty_equivalence,
    LADRC,
    LockInInertia,
    printed_map,
    ProbeTones,
    RecursiveInertia,
)
from jaxquad.loops import Loop
from jaxquad.models import DecoupledAxes
from jaxquad.simulation import Saturation, Scenario, simulate


GAIN, INERTIA, DT = 0.0468, 0.0552, 0.002
SAMPLES = 10001
TIME = DT * np.arange(SAMPLES)
SPREAD = np.array([0.6, 1.0, 2.0])  # of the inertia


def adaptive(b0=1.6, *, limit=jnp.inf):
    estimator = LockInInertia(GAIN, INERTIA, tones=ProbeTones(above=0.0))
    chart = certainty_equivalence(GAIN, INERTIA)
    return AdaptiveLADRC(LADRC(10.0, 30.0, b0, limit=limit), estimator, chart)


def fly(controller, *, inertia=SPREAD, drive=1e3, **parts):
    """Three members with a reference, a disturbance and a payload [samples]; the rest is 0."""
    plant = DecoupledAxes(GAIN, INERTIA * inertia[None])
    column = lambda name: jnp.asarray(parts.get(name, np.zeros(SAMPLES)))[:, None]
    zero = jnp.zeros((SAMPLES, 1))
    scenario = Scenario(
        column("reference"), zero, column("disturbance"), zero, payload=column("payload")
    )
    return simulate(Loop(plant, controller, drive=Saturation(drive)), scenario)


@pytest.fixture(scope="module")
def stepped():
    step = np.where(TIME >= 12.0, np.radians(3.0), 0.0)
    return {
        b0: fly(adaptive(b0) if b0 == 1.6 else LADRC(10.0, 30.0, 3.0), reference=step, inertia=s)
        for b0, s in ((1.6, SPREAD), (3.0, np.array([0.6, 1.0, 1.1])))
    }


@pytest.mark.slow
def test_b0_is_the_ladrcs_until_the_inertia_is_known_then_follows_it(stepped):
    b0 = np.asarray(stepped[1.6].signals["b0"])[:, 0]
    np.testing.assert_array_equal(b0[: round(4.99 / DT)], 1.6)
    np.testing.assert_allclose(b0[-1], GAIN / (INERTIA * SPREAD), rtol=1e-4)


@pytest.mark.slow
def test_a_step_after_that_is_the_same_for_all_inertias_and_hardly_overshoots(stepped):
    """The probe is still on; with b0 = 3 the paper's 34 % at the nominal inertia."""
    after = slice(round(12.0 / DT), round(14.0 / DT))
    peaks = {
        b0: np.asarray(run.angle[after, 0]).max(axis=0) / np.radians(3.0) - 1
        for b0, run in stepped.items()
    }
    assert np.all(peaks[1.6] < 0.08)
    assert peaks[3.0][1] == pytest.approx(0.341, abs=0.02)


@pytest.mark.slow
def test_signals_are_recorded_for_every_member_and_sample(stepped):
    signals = stepped[1.6].signals
    assert set(signals) == {"disturbance", "b0", "inertia", "inertia_deviation"}
    assert all(x.shape == (SAMPLES, 1, 3) for x in signals.values())
    assert all(np.all(np.isfinite(x)) for x in signals.values())
    np.testing.assert_allclose(signals["inertia"][-1, 0], INERTIA * SPREAD, rtol=1e-4)


def test_the_disturbance_times_the_torque_gain_is_in_newton_metres_at_any_b0():
    run = fly(adaptive(), disturbance=np.full(SAMPLES, 0.1))
    torque, b0 = (np.asarray(run.signals[name])[:, 0] for name in ("disturbance", "b0"))
    early, late = round(4.9 / DT), -1
    np.testing.assert_array_equal(b0[early], 1.6)
    np.testing.assert_allclose(GAIN * torque[early, 0], 0.1, rtol=0.02)  # the others ring still
    np.testing.assert_allclose(GAIN * torque[late], 0.1, rtol=0.02)


@pytest.mark.slow
def test_the_probe_stays_within_the_controllers_limit():
    run = fly(adaptive(limit=0.2), reference=np.where(TIME >= 1.0, 0.5, 0.0))
    assert np.abs(run.command).max() == pytest.approx(0.2, rel=1e-12)


@pytest.mark.slow
def test_the_estimator_hears_what_the_drive_really_gave():
    """A drive that the controller does not know of saturates; the estimate stays exact."""
    step = np.where((TIME >= 6.0) & (TIME < 9.0), np.radians(4.0), 0.0)
    run = fly(adaptive(), reference=step, drive=1.0)
    share = np.mean(np.asarray(run.saturated)[round(5.0 / DT) : round(10.0 / DT)])
    assert share > 0.005
    np.testing.assert_allclose(run.signals["inertia"][-1, 0], INERTIA * SPREAD, rtol=1e-4)


def test_b0_follows_a_payload_taken_up_in_flight():
    payload = np.where(TIME >= 7.0, INERTIA, 0.0)
    run = fly(adaptive(0.8), payload=payload, inertia=np.array([0.9, 1.0, 1.1]))
    b0 = np.asarray(run.signals["b0"])[:, 0]
    heavy = INERTIA * np.array([1.9, 2.0, 2.1])
    np.testing.assert_allclose(b0[round(17.5 / DT)], GAIN / heavy, rtol=0.02)


@pytest.mark.slow
def test_without_trust_it_is_the_ladrc_alone():
    """An inertia 100 times below the nominal one is not believed; the probe is silent."""
    step = np.where(TIME >= 1.0, 0.05, 0.0)
    places = lambda c: (c.estimator.nominal, c.estimator.tones.amplitude)
    doubtful = eqx.tree_at(places, adaptive(), (jnp.asarray(100 * INERTIA), jnp.asarray(0.0)))
    runs = [fly(c, reference=step) for c in (doubtful, LADRC(10.0, 30.0, 1.6))]
    np.testing.assert_allclose(runs[0].command, runs[1].command, atol=1e-12)


@pytest.mark.slow
def test_what_the_printed_map_does():
    """At delta = 1.875, where 1.6 is right, b0 = 4: past the loop's limit of b / 0.217 = 3.9."""
    step = np.where(TIME >= 0.0, np.radians(3.0), 0.0)
    b0 = [3.0, *np.asarray(printed_map(INERTIA)(INERTIA * jnp.array([1.875, 22.0])))]
    run = fly(LADRC(10.0, 30.0, jnp.asarray(b0)[None]), reference=step, inertia=np.ones(3))
    error = np.abs(np.asarray(run.angle)[:, 0] / np.radians(3.0) - 1)
    ten_seconds = slice(0, round(10 / DT))
    itae = DT * np.sum((TIME[:, None] * error)[ten_seconds], axis=0)
    assert itae[0] == pytest.approx(1.38, abs=0.01) and itae[1] == pytest.approx(20.7, abs=0.2)
    assert error[-2000:, 1].max() > 1.1 * error[5000:7000, 1].max()
    assert run.diverged[2] or error[-1, 2] > 100


@pytest.mark.slow
def test_gradients_to_the_maps_values_agree_with_differences():
    """Of the squared error over 2 s, in which the recursion learns and b0 moves."""
    estimator = RecursiveInertia(GAIN, INERTIA, memory=0.4, tones=ProbeTones(above=0.0))
    chart = certainty_equivalence(GAIN, INERTIA)
    reference = jnp.asarray(0.05 * np.sin(2 * TIME[:1000]))[:, None, None] * jnp.ones((1, 1, 3))
    gain = GAIN / INERTIA / jnp.asarray(SPREAD)[None]

    def cost(values):
        moved = eqx.tree_at(lambda m: m.values, chart, values)
        controller = AdaptiveLADRC(LADRC(10.0, 30.0, 1.6), estimator, moved, settling=0.2)

        def sample(carry, wanted):
            memory, angle, rate = carry
            memory, u = controller.step(memory, wanted, angle)
            now = angle + DT * rate + DT**2 / 2 * gain * u, rate + DT * gain * u
            return (memory, *now), angle - wanted

        zero = jnp.zeros((1, 3))
        (memory, *_), error = jax.lax.scan(sample, (controller.init(zero), zero, zero), reference)
        return 1e3 * jnp.mean(error**2), memory.ladrc.b0

    evaluate = eqx.filter_jit(cost)
    slope, b0 = eqx.filter_jit(jax.grad(cost, has_aux=True))(chart.values)
    assert np.all(np.abs(np.asarray(b0)[0] / 1.6 - 1) > 0.05)
    for k in (2, 3):
        nudge = 1e-5 * np.eye(6)[k]
        ends = [float(evaluate(chart.values + sign * nudge)[0]) for sign in (1, -1)]
        assert slope[k] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-6)


def test_it_prepares_to_the_same_controller():
    controller = adaptive()
    ready = controller.prepared()
    assert ready.prepared() is ready and ready.dt == controller.dt
    like = jnp.full((1, 3), 0.02)
    both = lambda: [c.step(c.init(like), like, 2 * like)[1] for c in (controller, ready)]
    np.testing.assert_allclose(*eqx.filter_jit(both)(), rtol=1e-12)


def test_the_ensemble_is_that_of_any_part():
    estimator = RecursiveInertia(GAIN, INERTIA * SPREAD[None])
    chart = certainty_equivalence(GAIN, INERTIA)
    controller = AdaptiveLADRC(LADRC(10.0, 30.0, 1.6), estimator, chart)
    assert controller.ensemble == (3,)
    assert controller.init(jnp.zeros(1)).ladrc.command.shape == (1, 3)


def test_parts_that_do_not_fit_are_refused():
    chart = certainty_equivalence(GAIN, INERTIA)
    ladrc, slow = LADRC(10.0, 30.0, 1.6), LockInInertia(GAIN, INERTIA, dt=0.004)
    with pytest.raises(ValueError, match="samples of 0.004 s"):
        AdaptiveLADRC(ladrc, slow, chart)
    with pytest.raises(ValueError, match="of order 1"):
        AdaptiveLADRC(LADRC(10.0, 30.0, 1.6, order=1), LockInInertia(GAIN, INERTIA), chart)
    with pytest.raises(ValueError, match="settling is 0.0"):
        AdaptiveLADRC(ladrc, LockInInertia(GAIN, INERTIA), chart, settling=0.0)
