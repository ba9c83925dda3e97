"""A plant, a controller, a drive and a sensor of a user's own: they need the methods alone."""

import control
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxquad as jq
from jaxquad.control import LinearController
from jaxquad.loops import align, per_member
from jaxquad.models import LinearAxis


pytestmark = pytest.mark.usefixtures("compiled_quickly")
DT, REST = 0.004, {"duration": 1.0, "dt": 0.004, "axes": 1}


class Pendulum(eqx.Module):
    """A beam on a pivot with a servo of second order: a = gain (s - sin(angle)), s'' = ..."""

    gain: jax.Array = per_member(rank=1)  # rad/s^2 per unit of command
    servo: float = 60.0  # rad/s

    def init(self, euler=None, *, ensemble=()):
        still = jnp.zeros((1, *ensemble))
        return {"angle": still, "rate": still, "servo": still, "speed": still}

    def derivative(self, state, inputs, disturbance):
        w = self.servo
        gain = align(self.gain, inputs)
        pull = w**2 * (inputs - state["servo"]) - 2 * w * state["speed"]
        turn = gain * (state["servo"] - jnp.sin(state["angle"])) + disturbance
        return {
            "angle": state["rate"], "rate": turn, "servo": state["speed"], "speed": pull,
        }  # fmt: skip

    def measure(self, state):
        return state["angle"]

    def linearise(self, axis):
        w, g = self.servo, self.gain[axis]
        one, zero = jnp.ones_like(g), jnp.zeros_like(g)
        rows = [
            [zero, one, zero, zero],
            [-g, zero, g, zero],
            [zero, zero, zero, one],
            [zero, zero, -(w**2) * one, -2 * w * one],
        ]
        command, torque = [zero, zero, zero, w**2 * one], [zero, one, zero, zero]
        return LinearAxis(jnp.array(rows), jnp.array(command), jnp.array(torque), g)


class Lead(eqx.Module):
    """u = k (r - y) - d (y[k] - y[k-1]) / dt: what to hold is told nowhere but here."""

    k: jax.Array = per_member(rank=1)
    d: jax.Array = per_member(rank=1)
    dt: float = eqx.field(static=True, default=DT)

    def init(self, like):
        return jnp.zeros_like(like)

    def step(self, state, reference, measurement):
        k, d = align(self.k, measurement), align(self.d, measurement)
        return measurement, k * (reference - measurement) - d * (measurement - state) / self.dt

    def linear(self, axis=0, member=None):
        at = lambda x: x[axis] if x.ndim == 1 else x[axis][member]
        k, slope = at(self.k), at(self.d) / self.dt
        return LinearController(
            A=jnp.zeros((1, 1)),
            reference_in=jnp.zeros(1),
            measurement_in=jnp.ones(1),
            C=slope[None],
            reference_through=k,
            measurement_through=-k - slope,
            dt=self.dt,
        )

    def tunable(self):
        return {"k": None, "d": None}


class Fan(eqx.Module):
    """A drive that gives its command on one side only."""

    most: float = 2.0

    def inputs(self, command):
        return jnp.clip(command, -0.1, self.most)

    def achieved(self, inputs):
        return inputs


class Coarse(eqx.Module):
    """A sensor of whole milliradians."""

    def __call__(self, angle):
        return jnp.round(angle * 1e3) / 1e3


def loop(gain=(40.0,), **parts):
    controller = Lead(jnp.array([1.5]), jnp.array([0.12]))
    return jq.Loop(Pendulum(jnp.asarray(gain)), controller, delay=0.006, **parts)


@pytest.fixture(scope="module")
def step():
    return jq.scenario(reference={0: jq.Step(0.02)}, **REST)


def plain(step, gain=40.0, drive=None, encoder=None, substeps=20):
    """The same loop in numpy: fourth order, many steps, inputs held for 6 ms more."""
    state, last, commands, angles = np.zeros(4), 0.0, [0.0, 0.0], []
    parts = DT / substeps

    def slope(x, u):
        return np.array([x[1], gain * (x[2] - np.sin(x[0])), x[3], 3600 * (u - x[2]) - 120 * x[3]])

    for reference in np.asarray(step.reference)[:, 0]:
        angles.append(state[0])
        y = state[0] if encoder is None else float(encoder(state[0]))
        command = 1.5 * (reference - y) - 0.12 * (y - last) / DT
        last = y
        commands.append(command if drive is None else float(drive.inputs(command)))
        for k in range(substeps):
            u = commands[-3] if k < substeps // 2 else commands[-2]
            k1 = slope(state, u)
            k2 = slope(state + parts / 2 * k1, u)
            k3 = slope(state + parts / 2 * k2, u)
            k4 = slope(state + parts * k3, u)
            state = state + parts / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return np.array(angles)


def test_all_four_fly_as_a_loop_written_by_hand_does(step):
    parts = {"drive": Fan(0.025), "encoder": Coarse()}
    flight = jq.simulate(loop(substeps=4, **parts), step)
    expected = plain(step, **parts)
    np.testing.assert_allclose(np.asarray(flight.angle)[:, 0], expected, atol=1e-7)
    assert np.ptp(expected) > 0.01 and bool(flight.saturated.any())


def test_members_of_a_declared_field_are_judged_as_each_alone(step):
    gains = [[30.0, 40.0, 55.0]]
    together = jq.evaluate(loop(gains, substeps=4), step)
    error = np.asarray(step.reference) - plain(step)[:, None]
    weight = np.r_[0.5, np.ones(len(error) - 2), 0.5] * DT
    assert together.iae[0, 1] == pytest.approx(weight @ np.abs(error[:, 0]), rel=1e-6)
    assert together.itae.shape == (1, 3) and not together.diverged.any()


@pytest.mark.slow
def test_a_user_s_plant_and_controller_are_analysed_as_python_control_does():
    found = jq.analyse(loop())
    w = 60.0
    denominator = np.polymul([1, 0, 40], [1, 2 * w, w**2])
    plant = control.ss(control.TransferFunction([40 * w**2], denominator))
    # The inputs that a delay of 1.5 samples holds: half of each interval the one before.
    half = control.c2d(plant, DT / 2)
    a, b = np.asarray(half.A), np.asarray(half.B)
    z = np.exp(1j * 10.0 * DT)
    state = np.linalg.solve(z * np.eye(4) - a @ a, (a @ b / z + b) / z)
    law = -1.5 - 0.12 / DT * (1 - 1 / z)
    expected = -law * (np.asarray(half.C) @ state).item()
    got = found.loop.frequency_response(jnp.array([10.0]))[0, 0, 0]
    np.testing.assert_allclose(got, expected, rtol=1e-6)
    assert bool(found.stable) and np.isfinite(found.phase_margin)


@pytest.mark.slow
def test_a_user_s_controller_is_tuned():
    step = jq.scenario(reference={0: jq.Step(0.02)}, duration=1.0, dt=DT, axes=1)
    nominal = jq.DecoupledAxes([40.0], [1.0], lag=[0.03])
    around = jq.Loop(nominal, Lead(jnp.array([0.4]), jnp.array([0.06])))
    ensemble = jq.Ensemble(inertia=jq.ensembles.LogUniform(0.8, 1.25))
    tuned = jq.tune(around, ensemble, step, members=4, fresh=None, progress=False)
    before = jq.evaluate(around, step).itae
    assert jq.evaluate(around.with_controller(tuned.controller), step).itae[0] < before[0]


def test_what_a_loop_lacks_is_named_with_the_method_to_add(step):
    class Wall(eqx.Module):
        def init(self, euler=None, *, ensemble=()):
            return jnp.zeros((1, *ensemble))

        def derivative(self, state, inputs, disturbance):
            return inputs

        def measure(self, state):
            return state

    class Hidden(Wall):
        inertia: jax.Array  # of each member, which nothing says

        def init(self, euler=None, *, ensemble=()):
            return jnp.zeros((1, 3))

    with pytest.raises(ValueError, match="Wall has no method linearise"):
        jq.analyse(loop().with_plant(Wall()))
    with pytest.raises(ValueError, match="LinearController cannot be run: a controller needs init"):
        jq.simulate(loop().with_controller(Lead(jnp.ones(1), jnp.ones(1)).linear()), step)
    with pytest.raises(ValueError, match="angles have the shape .1, 3., .*jq.loops.per_member"):
        jq.simulate(jq.Loop(Hidden(jnp.ones(3)), Lead(jnp.ones(1), jnp.ones(1))), step)
