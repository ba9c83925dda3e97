"""What every controller owes a loop: ensembles, precision, gradients, plain refusals."""

import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.control import (
    as_setpoint,
    BackCalculation,
    CurrentObserver,
    EulerObserver,
    LADRC,
    PID,
    PredictiveObserver,
    Setpoint,
)


DT = 0.002
CONTROLLERS = {
    "current": LADRC([8.0, 9, 10], [30.0, 30, 25], [2.0, 3, 4], limit=3.0),
    "predictive": LADRC(8.0, 25.0, 2.0, order=1, observer=PredictiveObserver(), limit=[3.0, 4, 5]),
    "clamped": PID([9.0, 8, 7], 2.0, 1.0, limit=3.0),
    "following": PID(9.0, [2.0, 3, 4], 1.0, limit=3.0, anti_windup=BackCalculation(0.3)),
}


def loop_cost(controller, reference, gain):
    """Of three axes gain/s^2, on samples of `reference` [samples, 3, *ensemble]."""
    rest = jnp.zeros_like(reference[0] + gain)

    def sample(carry, aim):
        angle, rate, memory = carry
        memory, command = controller.step(memory, aim + rest, angle)
        push = DT * gain * command
        cost = jnp.mean((angle - aim) ** 2 + 1e-4 * command**2, axis=0)
        return (angle + DT * (rate + push / 2), rate + push, memory), cost

    start = (rest, rest, controller.init(rest))
    return jnp.sum(jax.lax.scan(sample, start, reference)[1], axis=0)


STEP = jnp.asarray(0.3 + 0.02 * np.sin(np.arange(150.0)))[:, None] * jnp.asarray([[1.0, -1, 0.5]])
GAIN = jnp.asarray([2.5, 2.5, 3.0])
cost = eqx.filter_jit(loop_cost)
value_and_slope = eqx.filter_jit(
    lambda controller: eqx.filter_value_and_grad(loop_cost)(controller, STEP, GAIN)
)


slow = ft.partial(pytest.param, marks=pytest.mark.slow)


@pytest.mark.parametrize("name", ["current", slow("predictive"), "clamped", slow("following")])
def test_the_slope_of_a_saturated_loop_agrees_with_central_differences(name):
    controller = CONTROLLERS[name]
    _, slopes = value_and_slope(controller)
    felt = 0
    for k, (leaf, slope) in enumerate(
        zip(jax.tree.leaves(controller), jax.tree.leaves(slopes), strict=True)
    ):
        if not np.all(np.isfinite(leaf)):
            continue
        push = 1e-5 * np.maximum(np.abs(leaf), 0.1)
        costs = []
        for sign in (1, -1):
            leaves = jax.tree.leaves(controller)
            leaves[k] = leaf + sign * push
            other = jax.tree.unflatten(jax.tree.structure(controller), leaves)
            costs.append(value_and_slope(other)[0])
        # The third derivative times 1e-10, and rounding over 1e-5.
        expected = (costs[0] - costs[1]) / 2
        felt += bool(expected != 0)
        assert float(jnp.sum(slope * push)) == pytest.approx(float(expected), rel=1e-6, abs=1e-13)
    assert felt >= 5  # the limit too, but not a feedforward of no acceleration


@pytest.mark.slow
@pytest.mark.parametrize("name", ["current", "clamped"])
def test_an_ensemble_of_gains_is_a_controller_per_member(name):
    single = CONTROLLERS[name]
    spread = jnp.asarray([0.7, 1.0, 1.4])
    where = (lambda c: c.b0) if name == "current" else (lambda c: c.kd)
    gains = where(single).reshape(-1, 1) * spread[None]
    gains = jnp.broadcast_to(gains, (3, 3))
    many = eqx.tree_at(where, single, gains)
    assert many.ensemble == (3,) and single.ensemble == ()
    wide = STEP[..., None] + jnp.zeros(3)[None, None]
    together = cost(many, wide, GAIN[:, None])
    for member in range(3):
        alone = eqx.tree_at(where, single, gains[:, member])
        assert float(together[member]) == pytest.approx(float(cost(alone, STEP, GAIN)), rel=1e-12)
    mine, its = many.linear(1, member=2), alone.linear(1)
    for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(its), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14)


@pytest.mark.parametrize("name", ["current", "clamped"])
def test_single_precision_stays_single_and_close(name):
    exact = cost(CONTROLLERS[name], STEP, GAIN)
    found = cost(CONTROLLERS[name], STEP.astype("float32"), GAIN.astype("float32"))
    assert found.dtype == jnp.float32
    assert float(found) == pytest.approx(float(exact), rel=2e-4)


def test_the_prepared_law_is_the_same():
    controller = CONTROLLERS["current"]
    prepared = cost(controller.prepared(), STEP, GAIN)
    assert float(prepared) == pytest.approx(float(cost(controller, STEP, GAIN)), rel=1e-14)


def test_an_observer_may_start_at_the_measurement():
    angle = jnp.asarray([0.2, -0.1, 0.3])
    loop = CONTROLLERS["current"]
    state, command = loop.step(loop.init(angle, angle), angle, angle)
    np.testing.assert_allclose(command, 0, atol=1e-13)
    np.testing.assert_allclose(state.estimate[0], angle, rtol=1e-15)


def test_an_array_is_a_setpoint_at_rest():
    bare, rest = jnp.asarray([0.2, -0.1, 0.3]), jnp.zeros(3)
    given = as_setpoint(bare)
    assert as_setpoint(given) is given
    loop = CONTROLLERS["current"]
    start = loop.init(rest)
    np.testing.assert_array_equal(loop.step(start, given, rest)[1], loop.step(start, bare, rest)[1])
    assert isinstance(given, Setpoint)


@pytest.mark.parametrize("name", ["current", "clamped"])
def test_a_measurement_of_another_shape_than_at_the_start_is_refused(name):
    controller, three = CONTROLLERS[name], jnp.zeros(3)
    with pytest.raises(ValueError, match=r"shape \(3,\), but .* for \(3, 4\)"):
        controller.step(controller.init(jnp.zeros((3, 4))), three, three)


@pytest.mark.parametrize(
    "wrong, message",
    [
        (dict(wc=0.0), "wc is 0.0, but it must be above 0"),
        (dict(wo=[30.0, -1.0, 30.0]), "wo is .*-1.* but it must be above 0"),
        (dict(b0=0.0), "b0 is 0.0.* reverse the sign of the command"),
        (dict(b0=[1.0, np.nan, 1.0]), "b0 is .*nan"),
        (dict(wo=2000.0), r"wo is 2000 rad/s, but at dt = 0.002 s it must be below 1571 rad/s"),
        (dict(wo=1100.0, observer=EulerObserver()), "below 1000 rad/s"),
        (dict(wc=600.0, placement="continuous"), "wc is 600 rad/s, .*below 500 rad/s"),
        (dict(order=3), "order is 3, but it must be 1 or 2"),
        (dict(limit=-2.0), "limit is -2.0, but it must be above 0"),
        (dict(limit=np.nan), "limit is nan"),
        (dict(dt=0.0), "dt is 0.0 s"),
        (dict(feedback_factor=0.0), "feedback_factor is 0.0.* 0.5 halves"),
        (dict(b0=[1.0, 2.0]), r"different numbers of axes.*b0 \(2,\)"),
        (dict(wo=np.full((3, 4), 30.0), b0=np.ones((3, 5))), "different ensembles"),
    ],
)
def test_what_makes_no_ladrc_is_refused_with_its_value(wrong, message):
    with pytest.raises(ValueError, match=message):
        LADRC(**(dict(wc=[10.0, 10.0, 10.0], wo=30.0, b0=1.0) | wrong))


def test_gains_are_checked_for_values_only_where_there_are_any():
    build = lambda b0: LADRC(10.0, 30.0, b0).prepared().b0
    np.testing.assert_array_equal(jax.jit(build)(jnp.full(3, 2.0)), 2.0)
    with pytest.raises(ValueError, match="different numbers of axes"):
        jax.jit(lambda b0: LADRC([10.0, 10.0], 30.0, b0).b0)(jnp.full(3, 2.0))


@pytest.mark.parametrize(
    "place, message",
    [
        (dict(axis=3), "axis is 3, but the gains are for axes 0 to 2"),
        (dict(axis=0), "pick one, as member=0"),
        (dict(axis=0, member=4), "member is 4, but the ensemble's are 0 to 3"),
        (dict(axis=0, member=(0, 1)), "one index each"),
    ],
)
def test_a_linear_form_is_of_one_axis_of_one_member(place, message):
    with pytest.raises(ValueError, match=message):
        LADRC(10.0, 30.0, np.ones((3, 4)), observer=CurrentObserver()).linear(**place)
