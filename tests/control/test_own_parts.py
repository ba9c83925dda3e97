"""An estimator, an observer, a controller and a map of a user's own work by having the methods."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxquad as jq
from jaxquad.control import (
    CurrentObserver,
    InertiaEstimate,
    InertiaEstimator,
    LADRC,
    LinearController,
    Observer,
    schedule_for_analysis,
    schedule_for_flight,
    ScheduledController,
    ScheduledLADRC,
    Transform,
    Tunable,
)


pytestmark = pytest.mark.usefixtures("compiled_quickly")


@pytest.fixture(autouse=True)
def usual_promotion():
    """JAX as a user has it, where shapes and types are promoted."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield


KT, J, DT = 0.047, 0.055, 0.002
PLANT = jq.DecoupledAxes([KT], [J])
STEP = jq.scenario(duration=2.0, reference={"roll": jq.Step(0.1, at=0.1)}, axes=1)


class PositionFeedback(eqx.Module):
    """u = kp (r - y) - kd (y - y of the sample before) / dt."""

    kp: jax.Array
    kd: jax.Array
    dt: float = eqx.field(static=True, default=DT)

    def init(self, like):
        return jnp.zeros_like(like)

    def step(self, state, reference, measurement):
        angle = reference.angle if isinstance(reference, jq.control.Setpoint) else reference
        slope = (measurement - state) / self.dt
        return measurement, self.kp * (angle - measurement) - self.kd * slope

    def linear(self, axis=0, member=None):
        slope = self.kd / self.dt
        one, zero = jnp.ones(()), jnp.zeros(())
        return LinearController(
            zero[None, None], zero[None], one[None], slope[None], self.kp, -self.kp - slope, self.dt
        )

    def tunable(self):
        return {"kp": None, "kd": None}


class TextbookObserver(eqx.Module):
    """The zero-order-hold observer by its matrices: Phi, Gamma and Ackermann's formula."""

    current = True
    fastest = float(np.pi)

    def gains(self, wo, dt, order):
        return self.correction(wo, dt, order)

    def correction(self, wo, dt, order):
        phi, _ = self._matrices(dt)
        pole = jnp.exp(-wo * dt)
        shifted = phi - pole[..., None, None] * jnp.eye(3)
        sought = shifted @ shifted @ shifted
        row = jnp.array([[1.0, 0.0, 0.0]])
        seen = jnp.concatenate([row @ phi, row @ phi @ phi, row @ phi @ phi @ phi])
        return jnp.moveaxis(sought @ jnp.linalg.solve(seen, jnp.eye(3))[:, 2], -1, 0)

    def predict(self, estimate, drive, dt):
        phi, gamma = self._matrices(dt)
        rows = [sum(phi[i, j] * x for j, x in enumerate(estimate)) for i in range(3)]
        return [row + gamma[i] * drive for i, row in enumerate(rows)]

    def _matrices(self, dt):
        phi = jnp.array([[1.0, dt, dt**2 / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
        return phi, jnp.array([dt**2 / 2, dt, 0.0])


class RatioState(NamedTuple):
    angle: jax.Array
    change: jax.Array
    command: jax.Array
    torque: jax.Array
    acceleration: jax.Array
    samples: jax.Array


class RatioEstimator(eqx.Module):
    """Torque over acceleration, least squares over all samples; no test signal, no dt."""

    def init(self, like):
        zero = jnp.zeros_like(like)
        return RatioState(zero, zero, zero, zero, zero, jnp.zeros((), int))

    def update(self, state, command, measurement):
        change = measurement - state.angle
        known = state.samples >= 2
        acceleration = jnp.where(known, (change - state.change) / DT**2, 0)
        torque = KT * (command + state.command) / 2
        return RatioState(
            measurement,
            change,
            command,
            state.torque + acceleration * torque,
            state.acceleration + acceleration**2,
            state.samples + 1,
        )

    def estimate(self, state):
        excited = state.acceleration > 1.0
        inertia = state.torque / jnp.where(excited, state.acceleration, 1)
        return InertiaEstimate(
            jnp.where(excited, inertia, J), 0.01 * inertia, excited.astype(inertia.dtype)
        )


class PowerMap(eqx.Module):
    """b0 = KT / J to a power that is tuned between 0 and 2."""

    exponent: jax.Array

    def __call__(self, inertia):
        return (KT / inertia) ** self.exponent

    def tunable(self):
        return {"exponent": UpToTwo()}


class UpToTwo(eqx.Module):
    def forward(self, z):
        return 2 * jax.nn.sigmoid(z)

    def inverse(self, values):
        return np.log(values / (2 - values))


def test_they_have_the_methods_and_are_no_classes_of_the_package():
    feedback = PositionFeedback(jnp.ones(()), jnp.ones(()))
    parts = [(Observer, TextbookObserver()), (InertiaEstimator, RatioEstimator())]
    for protocol, part in [*parts, (Tunable, feedback), (Transform, UpToTwo())]:
        assert isinstance(part, protocol) and type(part).__mro__[1] is eqx.Module


def run(controller, measurements):
    """The commands that a controller answers a record of measurements with."""
    step = lambda state, y: controller.step(state, jnp.zeros_like(y), y)
    return jax.lax.scan(step, controller.init(measurements[0]), measurements)[1]


def test_a_linear_form_gives_the_commands_of_the_controller():
    law = PositionFeedback(jnp.asarray(4.0), jnp.asarray(1.0))
    angle = np.sin(np.arange(50.0))
    commands = np.asarray(run(law, jnp.asarray(angle)[:, None]))[:, 0]
    linear, state, expected = law.linear(), np.zeros(1), []
    for y in angle:
        expected.append(np.asarray(linear.C) @ state + float(linear.measurement_through) * y)
        state = np.asarray(linear.A) @ state + np.asarray(linear.measurement_in) * y
    np.testing.assert_allclose(commands, expected, rtol=1e-9)


@pytest.mark.slow
def test_a_controller_flies_as_its_linear_form_says():
    loop = jq.Loop(PLANT, PositionFeedback(jnp.asarray(4.0), jnp.asarray(1.0)), delay=0.003)
    flight, found = jq.simulate(loop, STEP), jq.analyse(loop)
    left = np.abs(np.asarray(flight.angle)[-1, 0, ...] - 0.1)
    assert bool(found.stable) and left < 0.1 * np.exp(1.7 * float(found.abscissa))
    unstable = loop.with_controller(PositionFeedback(jnp.asarray(4.0), jnp.asarray(-0.1)))
    assert not bool(jq.analyse(unstable).stable)


class TwoSlopes(eqx.Module):
    """u = kp f(e) - kd y', where f has half the slope beyond 0.03 rad."""

    kp: jax.Array
    branches: bool = eqx.field(static=True, default=True)

    def init(self, like):
        return jnp.zeros_like(like)

    def step(self, state, reference, measurement):
        error, rate = reference - measurement, (measurement - state) / DT
        far = lambda e: 0.5 * e + 0.015 * jnp.sign(e)
        if self.branches:
            near = jnp.vectorize(lambda e: jax.lax.cond(jnp.abs(e) > 0.03, far, lambda e: e, e))
            return measurement, self.kp * near(error) - 4.0 * rate
        slopes = jnp.where(jnp.abs(error) > 0.03, far(error), error)
        return measurement, self.kp * slopes - 4.0 * rate


@pytest.mark.slow
@pytest.mark.parametrize("members", [3, 70])  # computed as a few, and as many
def test_a_controller_may_branch_otherwise_for_each_member(members):
    loop = jq.Loop(PLANT, TwoSlopes(jnp.asarray(20.0)), drive=jq.simulation.Saturation(10.0))
    spread = jq.Ensemble(inertia=jq.ensembles.LogUniform(0.5, 3.0))
    drawn = spread.draw(loop, members, jax.random.key(0))
    brief = jq.scenario(duration=0.6, axes=1, reference=jq.Step(0.1))
    angle = np.asarray(jq.simulate(drawn.loop(loop.controller), drawn.flight(brief)).angle)
    far = np.abs(0.1 - angle) > 0.03
    assert np.any(far.any(axis=-1) & ~far.all(axis=-1))  # at the same sample

    def cost(kp, branches):
        controller = TwoSlopes(kp, branches)
        flown = jq.evaluate(drawn.loop(controller), drawn.flight(brief))
        return jnp.mean(flown.itae), flown.itae

    gradient = lambda branches: jax.value_and_grad(cost, has_aux=True)(jnp.asarray(20.0), branches)
    mine, same = gradient(True), gradient(False)
    for one, other in zip(jax.tree.leaves(mine), jax.tree.leaves(same), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9)


@pytest.mark.slow
def test_an_observer_of_the_same_matrices_flies_and_is_linearised_as_the_librarys():
    own, same = (
        LADRC(10.0, 30.0, KT / J, observer=x) for x in (TextbookObserver(), CurrentObserver())
    )
    np.testing.assert_allclose(own.gains.correction, same.gains.correction, rtol=1e-9)
    angle = jnp.asarray(0.1 * np.sin(np.arange(100.0)))[:, None]
    commands = jax.jit(lambda: [run(controller, angle) for controller in (own, same)])()
    np.testing.assert_allclose(*commands, rtol=1e-6, atol=1e-9)
    for one, other in zip(*(jax.tree.leaves(x.linear()) for x in (own, same)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_an_estimator_without_a_test_signal_or_a_sample_interval_adapts_b0():
    chart = jq.control.certainty_equivalence(KT, J)
    law = jq.AdaptiveLADRC(LADRC(10.0, 30.0, 1.6), RatioEstimator(), chart, settling=0.05)
    heavy = jq.DecoupledAxes([KT], [1.7 * J])
    flight = jq.simulate(jq.Loop(heavy, law), STEP)
    assert float(flight.signals["b0"][-1, 0]) == pytest.approx(KT / (1.7 * J), rel=1e-6)
    with pytest.raises(ValueError, match="RatioEstimator has no test signal"):
        law.excite(law.init(jnp.zeros(1)))


def test_a_map_schedules_and_says_in_which_coordinates_it_is_tuned():
    law = ScheduledLADRC(LADRC(10.0, 30.0, 1.0), PowerMap(jnp.asarray(1.0)))
    assert isinstance(law, ScheduledController)
    for schedule in (schedule_for_flight, schedule_for_analysis):
        assert float(schedule(law, np.array([2 * J])).b0[0]) == pytest.approx(KT / (2 * J))
    assert list(law.tunable()) == ["ladrc.wc", "ladrc.wo", "map.exponent"]
    transform = jq.control.find_transform(law, "map.exponent")
    assert transform is not None
    coordinates = jnp.asarray(transform.inverse(np.asarray(1.3)))
    assert transform.forward(coordinates) == pytest.approx(1.3)
    assert jq.control.find_transform(law, "ladrc.wc") is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("controller", "names"),
    [
        (PositionFeedback(jnp.asarray(2.0), jnp.asarray(0.5)), ("kp", "kd")),
        (
            ScheduledLADRC(
                LADRC(3.0, 15.0, 1.0, observer=TextbookObserver()), PowerMap(jnp.asarray(1.0))
            ),
            ("ladrc.wc", "ladrc.wo", "map.exponent"),
        ),
    ],
    ids=["feedback", "scheduled"],
)
def test_they_are_tuned_and_certified(controller, names):
    loop = jq.Loop(PLANT, controller, drive=jq.simulation.Saturation(10.0), delay=0.004)
    ensemble = jq.Ensemble(inertia=jq.ensembles.LogUniform(0.7, 1.5))
    tuned = jq.tune(loop, ensemble, STEP, members=4, fresh=8, progress=False)
    assert tuple(tuned.values) == names
    before = jq.evaluate(loop.with_controller(schedule_for_flight(controller, np.array([J]))), STEP)
    after = jq.evaluate(
        loop.with_controller(schedule_for_flight(tuned.controller, np.array([J]))), STEP
    )
    assert np.all(np.asarray(after.itae) < np.asarray(before.itae))
    assert tuned.certificate is not None and tuned.certificate.stable
    assert not bool(np.any(np.asarray(after.diverged)))
