"""Methods of a user's own classes with other arguments are named where the class enters."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxquad as jq


pytestmark = pytest.mark.usefixtures("without_type_checks")

PLANT = jq.DecoupledAxes([0.05], [0.05])
LADRC = jq.LADRC(10.0, 30.0, 1.0)
FLIGHT = jq.scenario(duration=0.2, axes=1, reference={0: jq.Step(0.1)})


class Servo:
    """A plant, a rate that follows its command, with names of its own and further defaults."""

    def init(self, euler=None, *, ensemble=(), rate=0.0):
        return jnp.zeros((2, 1, *ensemble)) + rate

    def derivative(self, x, u, *torque):
        return jnp.stack([x[1], 20.0 * (u - x[1]) + torque[0]])

    def measure(self, x, lever=1.0):
        return lever * x[0]


class SMC:
    """Sliding mode with a boundary layer."""

    def init(self, like, extra=None):
        return ()

    def step(self, *signals):
        state, reference, angle = signals
        return state, jnp.clip(20.0 * (reference - angle), -1.0, 1.0)


class Motor:
    def inputs(self, u, *, scale=1.0):
        return scale * u

    @staticmethod
    def achieved(u):
        return u


class Compass:
    def __call__(self, *angles):
        return angles[0]


class Estimator:
    def init(self, like):
        return ()

    def update(self, *signals):
        return ()

    def estimate(self, state):
        return state


def changed(base: type, **methods) -> Any:
    """An instance of a class of the same name with other methods."""
    return type(base.__name__, (base,), methods)()


def fly(plant: Any = PLANT, controller: Any = LADRC, **parts):
    return jq.simulate(jq.Loop(plant, controller, **parts), FLIGHT)


def test_a_call_by_position_takes_other_names_defaults_and_stars():
    flight = fly(Servo(), SMC(), drive=Motor(), encoder=Compass())
    exact = fly(Servo(), SMC())
    np.testing.assert_array_equal(flight.angle, exact.angle)
    assert not np.any(flight.diverged) and flight.angle[-1] > 0.01


def adaptive(estimator):
    return jq.AdaptiveLADRC(LADRC, estimator, lambda inertia: 1 / inertia)


def analyse(plant: Any = PLANT, controller: Any = LADRC):
    return jq.analyse(jq.Loop(plant, controller))


none = lambda self: ()
two = lambda self, one, other: ()
PAYLOAD = jq.scenario(duration=0.2, axes=1, payload={0: jq.Step(0.01)})
VARIED = jq.Ensemble(inertia=jq.ensembles.Uniform(0.9, 1.1))
WRONG = {
    r"SMC has init\(self\), which .* \(too many positional arguments\): define init\(self, like\), "
    r"as jq.loops.Controller\.": lambda: fly(controller=changed(SMC, init=none)),
    r"SMC has step\(self, one, other\), .* step\(self, state, reference, measurement\)": lambda: (
        fly(controller=changed(SMC, step=two))
    ),
    r"Servo has init\(self\), .* init\(self, euler=None, \*, ensemble=\(\)\), as jq.loops.Plant": (
        lambda: fly(changed(Servo, init=none))
    ),
    r"Servo has derivative\(self, one, other\), .* state, inputs, disturbance": lambda: fly(
        changed(Servo, derivative=two)
    ),
    r"Servo has measure\(self\), .* measure\(self, state\)": lambda: fly(
        changed(Servo, measure=none)
    ),
    r"Motor has inputs\(self\), .* inputs\(self, command\), as jq.loops.Drive": lambda: fly(
        drive=changed(Motor, inputs=none)
    ),
    r"Motor has achieved\(self, one, other\), .*missing a required argument: 'other'": lambda: fly(
        drive=changed(Motor, achieved=two)
    ),
    r"Compass has __call__\(self\), .* __call__\(self, angle\), as jq.loops.Sensor": lambda: fly(
        encoder=changed(Compass, __call__=none)
    ),
    r"Servo has linearise\(self\), .* as jq.loops.LinearisablePlant": lambda: analyse(
        changed(Servo, linearise=none)
    ),
    r"SMC has linear\(self\), .* linear\(self, axis=0, member=None\)": lambda: analyse(
        controller=changed(SMC, linear=none)
    ),
    r"Servo has with_added_inertia\(self\), .* as jq.loops.CarriesPayload": lambda: jq.simulate(
        jq.Loop(changed(Servo, with_added_inertia=none), LADRC), PAYLOAD
    ),
    r"SMC has tunable\(self, one, other\), .* as jq.control.Tunable": lambda: jq.tune(
        jq.Loop(PLANT, changed(SMC, linear=two, tunable=two)), VARIED, FLIGHT
    ),
    r"SMC has scheduled_at\(self\), .* as jq.control.ScheduledController": lambda: jq.certify(
        jq.Loop(PLANT, changed(SMC, scheduled_at=none)), VARIED, FLIGHT
    ),
    r"Estimator has update\(self\), .* update\(self, state, command, measurement\)": lambda: (
        adaptive(changed(Estimator, update=none))
    ),
    r"Estimator has probe\(self\), .* as jq.control.ProbingEstimator": lambda: adaptive(
        changed(Estimator, probe=none, excite=none)
    ),
}


@pytest.mark.parametrize("message", WRONG)
def test_a_method_with_other_arguments_is_refused_with_those_expected(message):
    with pytest.raises(ValueError, match=message):
        WRONG[message]()


def test_what_a_use_does_not_call_may_have_any_arguments():
    odd = dict(linear=none, scheduled_at=two, tunable=two)
    fly(changed(Servo, linearise=none, with_added_inertia=none), changed(SMC, **odd))
    adaptive(changed(Estimator, probe=none))


def test_a_compiled_method_is_as_good():
    class Compiled(eqx.Module):
        init = SMC.init
        step = eqx.filter_jit(SMC.step)

    assert np.all(fly(Servo(), Compiled()).angle == fly(Servo(), SMC()).angle)
