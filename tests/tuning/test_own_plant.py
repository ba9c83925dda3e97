"""A plant of a user's own is drawn, tuned and certified as the library's."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tuning_case as case
from own_plants import Spring, TwoMotorPoles

import jaxquad as jq
from jaxquad.tuning import LBFGS


pytestmark = pytest.mark.usefixtures("compiled_quickly")


@pytest.fixture(autouse=True)
def usual_promotion():
    """JAX as a user has it, where shapes are promoted."""
    with jax.numpy_rank_promotion("allow"):
        yield


KEY = jax.random.key(0)
SPREAD = {
    "inertia": jq.ensembles.LogUniform(0.5, 3.0), "torque_gain": jq.ensembles.Normal(0.05),
    "lag": jq.ensembles.Uniform(0.01, 0.04), "assumed_inertia": jq.ensembles.Normal(0.1),
}  # fmt: skip
EQUAL = jq.DecoupledAxes([case.KT], [case.J0], lag=[0.02], stiffness=[0.05])
OWN = Spring(*(np.array([x]) for x in (case.KT, case.J0, 0.02, 0.05, 0.0)))


def loop(plant, controller=None):
    controller = case.equivalent(3.0, 30.0) if controller is None else controller
    return jq.Loop(plant, controller, drive=jq.simulation.Saturation(10.0), delay=0.004)


def flight():
    push = jq.Pulse(0.1, width=0.3, at=0.8)
    return jq.scenario(duration=1.5, axes=1, reference=jq.Step(np.radians(4.0)), disturbance=push)


def tuned(plant, **others):
    given = {"members": 4, "fresh": 8, "progress": False, "method": LBFGS(evaluations=12)}
    return jq.tune(loop(plant), jq.Ensemble(**SPREAD), flight(), **(given | others))


def test_the_same_members_are_drawn_of_it():
    mine, same = (jq.Ensemble(**SPREAD).draw(loop(x), 6, KEY) for x in (OWN, EQUAL))
    plant: Any = mine.plant
    for name in ("torque_gain", "inertia", "lag"):
        np.testing.assert_allclose(getattr(plant, name), getattr(same.plant, name), rtol=1e-12)
    np.testing.assert_array_equal(plant.stiffness, OWN.stiffness)
    np.testing.assert_allclose(mine.assumed_inertia, same.assumed_inertia, rtol=1e-12)
    some: Any = mine.take([1, 4]).plant
    assert some.inertia.shape == (1, 2)


@pytest.mark.slow
def test_its_gains_and_its_certificate_are_those_of_the_equal_plant():
    mine, same = tuned(OWN), tuned(EQUAL)
    assert mine.stabilised
    for name, value in same.values.items():
        assert mine.values[name] == pytest.approx(value, rel=1e-5)
    mine, same = mine.certificate, same.certificate
    assert mine is not None and same is not None and mine.holds is same.holds
    for name, values in same.design.by_axis.items():
        np.testing.assert_allclose(mine.design.by_axis[name], values, rtol=1e-5, err_msg=name)
    assert mine.attainable is not None and same.attainable is not None
    for one, other in zip(mine.attainable, same.attainable, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5)
    assert any("Spring" in remark for remark in mine.remarks)


@pytest.mark.slow
def test_what_it_has_more_is_tuned_for():
    """Motors of two poles have no equal in the library; fields of other names are the user's."""
    plant = TwoMotorPoles(np.array([case.KT]), np.array([case.J0]), np.array([0.02]))
    ensemble = jq.Ensemble(inertia=jq.ensembles.LogUniform(0.7, 1.5))
    members: Any = ensemble.draw(loop(plant), 4, KEY)
    faster = np.array([[0.01, 0.015, 0.02, 0.03]])
    members = eqx.tree_at(lambda x: x.plant.time, members, jnp.asarray(faster))
    found = jq.tune(
        loop(plant, case.ladrc(3.0, 30.0)), members, flight(), fresh=None, progress=False,
        method=LBFGS(evaluations=8),
    )  # fmt: skip
    assert found.stabilised
    numbers = jq.loops.loop_numbers(members.loop(found.controller), [0])
    for k, lag in enumerate(faster[0]):
        alone = TwoMotorPoles(
            np.array([case.KT]), np.asarray(members.plant.inertia)[:, k], np.array([lag])
        )
        abscissa = jq.analyse(loop(alone, found.controller)).abscissa
        assert float(numbers.abscissa[0, k]) == pytest.approx(float(abscissa), rel=1e-3)


class Bare(eqx.Module):
    """Without a linear form, and without fields that an ensemble could vary."""

    gain: jax.Array

    def init(self, euler=None, *, ensemble=()):
        angle = jnp.zeros(1) if euler is None else jnp.asarray(euler)
        shape = jnp.broadcast_shapes(angle.shape[1:], ensemble)
        return jnp.zeros((2, 1, *shape)).at[0].set(jnp.broadcast_to(angle[0], shape))

    def derivative(self, state, inputs, disturbance):
        return jnp.stack([state[1], self.gain * inputs + disturbance])

    def measure(self, state):
        return state[0]


def test_what_it_lacks_is_named():
    bare = loop(Bare(jnp.ones(1)))
    with pytest.raises(ValueError, match="Bare has no inertia"):
        jq.Ensemble().draw(bare, 4, KEY)
    with pytest.raises(ValueError, match="lag varies, but Bare has no field of this name"):
        jq.Ensemble(lag=jq.ensembles.Uniform(0.01, 0.04)).draw(bare, 4, KEY)
    with pytest.raises(ValueError, match="Bare has no method linearise"):
        jq.certify(bare, jq.Ensemble(), flight())
    carried = jq.Ensemble(payload=jq.ensembles.Payload(0.5, at=0.5))
    with pytest.raises(ValueError, match=r"Spring has no with_added_inertia"):
        jq.tune(loop(OWN), carried, flight(), members=2, fresh=None, progress=False)
