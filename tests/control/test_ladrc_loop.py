"""LADRC in closed loop, and what a loop may ask of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.control import LADRC, Setpoint


DT = 0.002


def euler_rates(state, torque, inertia, damping, lag, disturbance):
    """A plant as a user writes it: Euler angles, body rates and lagged torques."""
    (roll, pitch, _), (p, q, r), acting = state
    push = acting + jnp.stack([disturbance, 0.0, 0.0]) - damping * jnp.stack([p, q, r])
    x, y, z = inertia
    turned = q * jnp.sin(roll) + r * jnp.cos(roll)
    angles = jnp.stack(
        [
            p + turned * jnp.tan(pitch),
            q * jnp.cos(roll) - r * jnp.sin(roll),
            turned / jnp.cos(pitch),
        ]
    )
    spin = (push + jnp.stack([(y - z) * q * r, (z - x) * p * r, (x - y) * p * q])) / inertia
    return jnp.stack([angles, spin, (torque - acting) / lag])


def test_three_axes_follow_the_baseline_written_in_c():
    """`baselines/ladrc_loop`: its figures after 5000 samples, to 1e-10."""
    inertia = jnp.asarray([0.0552, 0.0552, 0.1104])
    loop = LADRC([10, 10, 6], [30, 30, 18], 1 / inertia, placement="continuous", limit=1.5)
    reference = jnp.full(3, jnp.deg2rad(4.0))
    damp = 0.3 * jnp.sin(2 * jnp.pi / 5 * DT * jnp.arange(5000.0))

    def sample(carry, disturbance):
        state, memory, cost = carry
        angle = state[0]
        memory, torque = loop.step(memory, reference, angle)
        cost = cost + DT * jnp.sum((reference - angle) ** 2 + 1e-4 * torque**2)
        slope = lambda x: euler_rates(x, torque, inertia, 0.01, 0.02, disturbance)
        k1 = slope(state)
        k2 = slope(state + DT / 2 * k1)
        k3 = slope(state + DT / 2 * k2)
        k4 = slope(state + DT * k3)
        return (state + DT / 6 * (k1 + 2 * k2 + 2 * k3 + k4), memory, cost), None

    start = (jnp.zeros((3, 3)), loop.init(jnp.zeros(3)), jnp.zeros(()))
    (state, _, cost), _ = jax.jit(lambda: jax.lax.scan(sample, start, damp))()
    expected = [0.080522003175, 0.06981317008, 0.06981317008]
    np.testing.assert_allclose(state[0], expected, rtol=0, atol=1e-10)
    assert float(cost) == pytest.approx(0.00282841904151, abs=1e-10)


def fly(loop, reference, gain, *, limit=np.inf, tells=True, b0=None, disturbance=0.0):
    """Angle, command and disturbance on gain/s^2 (order 1: gain/s); the drive ends at `limit`."""

    def sample(carry, now):
        (angle, rate), memory = carry
        if b0 is None:
            memory, command = loop.step(memory, now[0], angle)
        else:
            memory, command = loop.step_with(memory, now[0], angle, now[1])
        achieved = jnp.clip(command, -limit, limit)
        memory = loop.applied(memory, achieved) if tells else memory
        push = gain * achieved + disturbance
        if loop.order == 1:
            after = angle + DT * push, rate
        else:
            after = angle + DT * rate + DT**2 / 2 * push, rate + DT * push
        return (after, memory), (angle, command, loop.signals(memory)["disturbance"])

    zero = jnp.zeros(1)
    steps = jnp.zeros(len(jax.tree.leaves(reference)[0])) if b0 is None else b0
    run = jax.jit(lambda: jax.lax.scan(sample, ((zero, zero), loop.init(zero)), (reference, steps)))
    return tuple(np.asarray(x)[:, 0] for x in run()[1])


GAIN = 0.848  # rad/s^2 per V of the rig, motors driven in opposition
TUNED = LADRC([10.0], [30.0], [GAIN])
STEP = jnp.full((3000, 1), jnp.deg2rad(20.0))


@pytest.mark.parametrize("limit", [5.0, np.inf], ids=["by its limit", "by the drive"])
def test_an_observer_that_knows_the_saturation_does_not_wind_up(limit):
    loop = LADRC([10.0], [30.0], [GAIN], limit=limit)
    angle, command, _ = fly(loop, STEP, GAIN, limit=5.0, tells=np.isinf(limit))
    aim = np.deg2rad(20.0)
    outside = np.abs(angle - aim) > 0.02 * aim
    assert np.abs(command).max() == 5.0 or np.isinf(limit)
    assert angle.max() < 1.0001 * aim
    assert DT * np.flatnonzero(outside)[-1] == pytest.approx(0.71, abs=0.01)


def test_an_observer_that_is_not_told_of_the_saturation_diverges():
    angle, _, _ = fly(TUNED, STEP, GAIN, limit=5.0, tells=False)
    swings = [np.abs(part).max() for part in np.split(angle, 3)]
    assert swings[2] > 10 * np.deg2rad(20.0) and np.all(np.diff(swings) > 0)  # and growing


def test_a_constant_torque_is_rejected_and_seen_in_units_of_the_command():
    """(KT/b0) f is the torque, whatever b0: here KT = 1 and b0 is twice the plant's gain."""
    loop = LADRC([10.0], [30.0], [2 * GAIN])
    angle, command, seen = fly(loop, jnp.zeros((3000, 1)), GAIN, disturbance=0.3 * GAIN)
    assert angle[-1] == pytest.approx(0, abs=1e-7)
    assert command[-1] == pytest.approx(-0.3, rel=1e-6)
    assert seen[-1] == pytest.approx(0.3, rel=1e-6)


def test_a_change_of_b0_leaves_an_unsaturated_command_where_it_is():
    """In steady state against a torque, so that f and u are far from 0."""
    b0 = jnp.full(4000, 1.5 * GAIN).at[3000:].set(0.75 * GAIN)
    angle, command, _ = fly(TUNED, jnp.zeros((4000, 1)), GAIN, b0=b0, disturbance=0.3 * GAIN)
    np.testing.assert_allclose(command[2990:], -0.3, rtol=1e-6)
    np.testing.assert_allclose(angle[2990:], 0, atol=1e-8)


def test_a_change_of_b0_during_a_step_keeps_the_predicted_acceleration():
    state = TUNED.init(jnp.zeros(1))
    for angle in (0.0, 0.01, 0.03):
        state, _ = TUNED.step(state, jnp.full(1, 0.1), jnp.full(1, angle))
    kept, _ = TUNED.step_with(state, jnp.full(1, 0.1), jnp.full(1, 0.05), TUNED.b0)
    moved, _ = TUNED.step_with(state, jnp.full(1, 0.1), jnp.full(1, 0.05), 3 * TUNED.b0)
    np.testing.assert_allclose(moved.estimate[:2], kept.estimate[:2], rtol=1e-14)
    shift = (moved.estimate - kept.estimate)[2]
    np.testing.assert_allclose(shift, -2 * TUNED.b0 * state.command, rtol=1e-12)


def smooth(samples=2500, rise=2.0):
    """A reference from rest to 0.3 rad in `rise` s, and its derivatives."""
    t = np.clip(DT * np.arange(samples) / rise, 0, 1)
    angle = 10 * t**3 - 15 * t**4 + 6 * t**5
    rate = (30 * t**2 - 60 * t**3 + 30 * t**4) / rise
    acceleration = (60 * t - 180 * t**2 + 120 * t**3) / rise**2
    return Setpoint(*(jnp.asarray(0.3 * x)[:, None] for x in (angle, rate, acceleration)))


@pytest.mark.parametrize("order", [1, 2])
def test_feedforward_follows_a_smooth_reference(order):
    loop, setpoint = LADRC([10.0], [30.0], [GAIN], order=order), smooth()
    blind, ahead = (
        np.abs(fly(loop, r, GAIN)[0] - np.asarray(setpoint.angle)[:, 0]).max()
        for r in (setpoint.angle, setpoint)
    )
    assert ahead < blind / 200  # what is left: half a sample of hold


def test_first_order_settles_an_integrator_like_its_placed_pole():
    loop = LADRC([4.0], [40.0], [2.0], order=1)
    angle, command, seen = fly(loop, jnp.ones((1500, 1)), 2.0)
    np.testing.assert_allclose(angle, 1 - np.exp(-4 * DT * np.arange(1500)), atol=1e-12)
    np.testing.assert_allclose(seen, 0, atol=1e-12)
    _, command, seen = fly(loop, jnp.ones((1500, 1)), 2.0, disturbance=0.5)
    assert (command[-1], seen[-1]) == pytest.approx((-0.25, 0.25), rel=1e-4)
