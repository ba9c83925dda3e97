"""Loops judged while they run: the same numbers as from their records, and the paper's."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.control import AdaptiveLADRC, certainty_equivalence, LADRC, LockInInertia, PD
from jaxquad.loops import Loop
from jaxquad.models import DecoupledAxes, quanser_hover
from jaxquad.simulation import (
    authority,
    AuthorityWarning,
    evaluate,
    Gust,
    Metrics,
    metrics,
    MotorDrive,
    Pulse,
    Saturation,
    scenario,
    simulate,
    Sine,
    Step,
    WhiteNoise,
)


GAIN, INERTIA = 0.0468, 0.0552  # N m/V, kg m^2: the rig in roll, +u and -u on two motors
PLANT = DecoupledAxes([GAIN], [INERTIA])
LIMITS = (6.0, 6.0, 6.0, 1.0)  # V
KEY = jax.random.key(11)
pytestmark = pytest.mark.filterwarnings("ignore::jaxquad.simulation.AuthorityWarning")
NUMBERS = list(Metrics.__dataclass_fields__)


def ladrc(b0):
    return LADRC([10.0], [30.0], jnp.asarray(b0)[None])


class Silent(eqx.Module):
    """A plant that does not say its torque per unit of command."""

    def init(self, euler=None, *, ensemble=()):
        return jnp.zeros((1, *ensemble))

    def derivative(self, state, inputs, disturbance):
        return inputs

    def measure(self, state):
        return state


@pytest.fixture(scope="module")
def ensemble():
    """Four values of b0 in gusts and noise, the last with too little voltage for the pulse."""
    happens = scenario(
        duration=10.0,
        axes=1,
        reference={0: Step(np.radians(4.0), at=1.0)},
        disturbance={0: Pulse(0.2, period=5.0, width=1.0, at=5.0) + Gust(0.01)},
        noise=WhiteNoise(np.radians(0.02)),
        ensemble=4,
        key=KEY,
    )
    controller, drive = ladrc([3.0, 1.6, GAIN / INERTIA, 1.0]), Saturation([LIMITS])
    return Loop(PLANT, controller, drive=drive, delay=0.003, bound=3.0), happens


@pytest.fixture(scope="module")
def running(ensemble):
    return evaluate(*ensemble, start=1.0, load_start=5.0)


@pytest.fixture(scope="module")
def stored(ensemble):
    return simulate(*ensemble)


@pytest.mark.slow
def test_a_loop_is_judged_alike_while_it_runs_and_from_its_record(running, stored):
    recorded = metrics(stored, start=1.0, load_start=5.0)
    for name in NUMBERS:
        found, expected = getattr(running, name), getattr(recorded, name)
        np.testing.assert_allclose(found, expected, rtol=1e-12, err_msg=name)


@pytest.mark.slow
def test_a_diverged_member_is_finite_flagged_and_counted(running):
    assert running.diverged.tolist() == [False, False, False, True]
    assert np.isfinite(running.itae).all() and np.isfinite(running.activity).all()
    summary = running.summary()
    assert summary.diverged_share == 0.25 and summary.itae.worst[0] == running.itae[0, 3]
    assert summary.itae.mean[0] == pytest.approx(np.mean(np.asarray(running.itae)), rel=1e-12)
    assert running.itae[0, 3] > 10 * running.itae[0, :3].max()
    assert np.isnan(running.settling_time[0, 3]) and np.isinf(summary.settling_time.mean[0])
    assert "1 of 4 members (25.0%) diverged" in str(running)


@pytest.mark.slow
def test_saturation_is_counted_from_the_record(running, stored):
    limits = np.array(LIMITS) * (1 - 1e-5)
    share = np.mean(np.abs(np.asarray(stored.command)[500:]) >= limits, axis=0)
    np.testing.assert_allclose(running.saturation_share, share, rtol=1e-12)


def three(reference, disturbance=None):
    """What happens to three members, in arrays of one shape, so that compiles are shared."""
    nothing = Step([0.0, 0.0, 0.0])
    return scenario(
        duration=10.0,
        axes=1,
        reference={0: reference + nothing},
        disturbance={0: (disturbance or nothing) + nothing},
    )


@pytest.fixture(scope="module")
def paper():
    """A unit step by the paper's controllers: b0 = 3, 1.6 and b."""
    return evaluate(Loop(PLANT, ladrc([3.0, 1.6, GAIN / INERTIA])), three(Step(1.0)))


@pytest.mark.slow
def test_steps_have_the_numbers_of_an_independent_simulation(paper):
    """Figures of an independent prototype, known to three digits."""
    np.testing.assert_allclose(paper.itae[0], [1.380, 0.051, 0.030], rtol=5e-3)
    np.testing.assert_allclose(paper.overshoot[0], [34.1, 6.9, 0.0], atol=0.05)
    np.testing.assert_allclose(paper.settling_time[0], [6.53, 0.96, 0.58], atol=5e-3)


def test_without_a_mismatch_the_step_is_the_critically_damped_one(paper):
    """(1 + wc t) e^(-wc t) integrates to 2 / wc, and with t to 3 / wc^2."""
    assert paper.iae[0, 2] == pytest.approx(0.2, rel=1e-4)
    assert paper.itae[0, 2] == pytest.approx(0.03, rel=1e-4)
    assert paper.ise[0, 2] == pytest.approx(5 / 40, rel=1e-4)


def test_a_linear_loop_has_the_same_normalised_numbers_for_every_step(paper):
    happens = three(Step([0.01, 0.1, -0.3]))
    found = evaluate(Loop(PLANT, ladrc([3.0, 1.6, GAIN / INERTIA])), happens).normalised()
    for name in ("itae", "iae", "ise", "overshoot", "settling_time", "rise_time"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(paper, name), rtol=1e-9, atol=1e-9, err_msg=name
        )


def test_the_estimate_of_a_matched_controller_is_the_torque_but_for_its_lag():
    """The observer's f is (wo / (s + wo))^3 of the torque: the error of a 5 s sine is 3 w / wo."""
    happens = three(Step(0.0), Sine(0.3, period=5.0))
    found = evaluate(Loop(PLANT, ladrc([GAIN / INERTIA] * 3)), happens, load_start=5.0)
    lag = 3 * (2 * np.pi / 5) / 30
    assert found.disturbance_rmse[0, 0] == pytest.approx(0.3 / np.sqrt(2) * lag, rel=0.02)


@pytest.mark.slow
def test_the_gradient_is_that_of_central_differences(ensemble):
    loop, happens = ensemble

    def cost(wc):
        controller = LADRC([wc], [30.0], jnp.asarray([[3.0, 1.6, GAIN / INERTIA, 1.0]]))
        found = evaluate(loop.with_controller(controller), happens, start=1.0)
        return jnp.sum(jnp.log(found.itae)) + jnp.sum(found.rms) + jnp.sum(found.disturbance_rmse)

    exact, h = jax.grad(cost)(10.0), 1e-5
    numeric = (cost(10.0 + h) - cost(10.0 - h)) / (2 * h)
    assert float(exact) == pytest.approx(float(numeric), rel=1e-6)


@pytest.mark.slow
def test_evaluate_runs_under_jit_and_vmap(paper):
    happens = scenario(duration=10.0, axes=1, reference={0: Step(1.0)})

    @jax.jit
    def itae(b0):
        return evaluate(Loop(PLANT, LADRC([10.0], [30.0], b0[None])), happens).itae[0]

    together = jax.vmap(itae)(jnp.asarray([3.0, 1.6, GAIN / INERTIA]))
    np.testing.assert_allclose(together, paper.itae[0], rtol=1e-12)


@pytest.mark.slow
def test_the_gradient_of_a_mean_over_vmap_is_that_of_central_differences():
    """Here over inertias, by a bandwidth that they share."""
    loads = {"reference": {0: Step(0.1)}, "disturbance": {0: Pulse(0.1, width=0.1, at=0.1)}}
    happens = scenario(duration=0.2, axes=1, **loads)

    def cost(wc, inertia):
        loop = Loop(DecoupledAxes([GAIN], inertia[None]), LADRC(wc[None], [30.0], [0.85]))
        found = evaluate(loop, happens)
        return jnp.mean(found.itae) + jnp.mean(found.disturbance_rmse)

    inertias, wc, h = INERTIA * jnp.asarray([0.7, 1.0, 1.5]), jnp.asarray(10.0), 1e-4
    mean = jax.jit(lambda wc: jnp.mean(jax.vmap(cost, in_axes=(None, 0))(wc, inertias)))
    numeric = (mean(wc + h) - mean(wc - h)) / (2 * h)
    assert float(jax.grad(mean)(wc)) == pytest.approx(float(numeric), rel=1e-6)


@pytest.mark.slow
def test_what_happens_at_some_samples_only_stays_so_under_vmap():
    """Such as the lock-in's solution at the end of a window, which has a gradient, too."""
    happens = scenario(duration=0.1, axes=1, reference={0: Step(0.1)})
    map_ = certainty_equivalence(GAIN, INERTIA, span=(0.5, 3.0), knots=3)

    def cost(wc, inertia):
        law = LADRC(wc[None], [30.0], [0.85])
        law = AdaptiveLADRC(law, LockInInertia([GAIN], [INERTIA]), map_)
        return jnp.mean(evaluate(Loop(DecoupledAxes([GAIN], inertia[None]), law), happens).itae)

    inertias = INERTIA * jnp.asarray([0.7, 1.5])
    mean = lambda wc: jnp.mean(jax.vmap(cost, in_axes=(None, 0))(wc, inertias))
    assert "cond[" in str(jax.make_jaxpr(jax.grad(mean))(jnp.asarray(10.0)))


@pytest.mark.slow
def test_float32_loops_are_judged_in_float32(paper):
    single = lambda tree: jax.tree.map(
        lambda x: x.astype(jnp.float32) if eqx.is_array(x) else x, tree
    )
    happens = scenario(duration=10.0, axes=1, reference={0: Step(1.0)})
    controller = ladrc([3.0, 1.6, GAIN / INERTIA])
    found = evaluate(Loop(single(PLANT), single(controller)), single(happens))
    assert found.itae.dtype == jnp.float32
    np.testing.assert_allclose(found.itae, paper.itae, rtol=2e-3)


def test_the_rig_has_the_authority_of_its_bias():
    rig = quanser_hover()
    found = authority(rig, MotorDrive(rig.allocation))
    # 2 V up and 2 V down about the bias; beyond it motors turn backwards, up to 24 V either way.
    np.testing.assert_allclose(found.forward, [0.0936, 0.0936, 0.0288], rtol=1e-3)
    np.testing.assert_allclose(found.torque, [48 * 0.0234, 48 * 0.0234, 96 * 0.0036], rtol=1e-3)
    assert "0.09361 N m without a motor turning backwards" in str(found)


def test_the_authority_of_members_follows_whichever_coefficient_they_differ_in():
    rig, factors = quanser_hover(), jnp.array([0.5, 1.0, 2.0])
    alone = authority(rig, MotorDrive(rig.allocation))
    for name in ("arm", "thrust_coefficient"):
        where = lambda plant, name=name: getattr(plant.allocation, name)
        members = eqx.tree_at(where, rig, where(rig) * factors)
        found = authority(members, MotorDrive(rig.allocation))
        expected = np.asarray(alone.torque)[:, None] * np.stack([factors, factors, factors**0])
        np.testing.assert_allclose(found.torque, expected, rtol=1e-12)


def test_the_authority_of_axes_is_that_of_the_nearest_limit():
    assert authority(PLANT, Saturation(2.0)).torque == pytest.approx(0.0936)
    assert np.isinf(authority(PLANT).torque).all() and np.isinf(authority(PLANT).forward).all()
    apart = authority(PLANT, Saturation([2.0, 1.0, 4.0])).torque
    np.testing.assert_allclose(apart, [0.0936, 0.0468, 0.1872])
    told = LADRC([10.0], [30.0], [1.0], limit=1.0)
    assert authority(PLANT, Saturation(2.0), told).torque == pytest.approx(0.0468)
    with pytest.raises(ValueError, match="Silent has no torque_gain"):
        authority(Silent())


@pytest.mark.slow
@pytest.mark.parametrize(("torque", "share"), [(0.2, 0.5), (0.3, 0.5), (0.09, 0.0)])
def test_a_disturbance_beyond_the_authority_is_reported(torque, share):
    happens = three(Step(0.0), Pulse(torque, period=5.0, share=0.5))
    loop = Loop(PLANT, ladrc([GAIN / INERTIA] * 3), drive=Saturation(2.0))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = evaluate(loop, happens)
    assert np.array_equal(found.beyond_authority, np.full((1, 3), share))
    told = [str(w.message) for w in caught if issubclass(w.category, AuthorityWarning)]
    assert len(told) == (share > 0)
    if share:
        assert f"roll reaches {torque} N m: 50.0% of the samples exceed the 0.0936 N m" in told[0]
        assert "exceed the torque of the drive: samples 50.0% on roll" in str(found)


@pytest.mark.slow
def test_the_warning_counts_the_members_of_a_plant():
    happens = scenario(duration=10.0, axes=1, disturbance={0: Step(0.2)})
    plant = DecoupledAxes([[0.0468, 0.0936, 0.14]], [INERTIA])
    loop = Loop(plant, ladrc([GAIN / INERTIA] * 3), drive=Saturation(2.0))
    with pytest.warns(AuthorityWarning, match="66.7% of the samples exceed the 0.0936 .. 0.28 N m"):
        evaluate(loop, happens)


@pytest.mark.slow
def test_parts_of_one_loop_may_be_narrower_than_its_ensemble(ensemble, running):
    loop, happens = ensemble
    wide = jax.tree.map(
        lambda x: jnp.broadcast_to(x.reshape(*x.shape[:2], -1), (*x.shape[:2], 4)), happens
    )
    assert happens.reference.ndim == 2 and happens.noise.ndim == 3
    found = evaluate(loop, wide, start=1.0, load_start=5.0)
    np.testing.assert_allclose(found.itae, running.itae, rtol=1e-12)


def test_a_payload_doubles_the_inertia_and_halves_the_answer():
    happens = scenario(
        duration=4.0,
        axes=1,
        injection={0: Pulse(1.0, period=2.0, width=0.1)},
        payload={0: Pulse(INERTIA, at=2.0, width=2.0)},
    )
    still = PD([1e-9], [1e-9])
    rate = np.diff(np.asarray(simulate(Loop(PLANT, still), happens).angle)[:, 0]) / 0.002
    assert rate[60] == pytest.approx(0.1 * GAIN / INERTIA, rel=1e-6)
    assert rate[1060] - rate[990] == pytest.approx(0.05 * GAIN / INERTIA, rel=1e-6)
