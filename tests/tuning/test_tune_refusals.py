"""A tune takes no step to gains that the controller itself refuses."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tuning_case as case
from certificates_by_hand import certificate, judged

from jaxquad._core import as_float
from jaxquad.control import LinearController
from jaxquad.simulation import scenario, Step
from jaxquad.tuning import LBFGS, Limit, Objective, tune


pytestmark = pytest.mark.usefixtures("compiled_quickly")


def halved(wc, wo, factor):
    start = case.equivalent(wc, wo)
    return dataclasses.replace(
        start, ladrc=dataclasses.replace(start.ladrc, observer_factor=factor)
    )


class Servo(eqx.Module):
    """A controller of a user's own, which feeds back the angle and its difference."""

    kp: jax.Array = eqx.field(converter=as_float)
    kd: jax.Array = eqx.field(converter=as_float)
    dt: float = eqx.field(static=True, default=case.DT)

    def __check_init__(self):
        if self.kp > 15.0:
            raise ValueError(f"kp is {self.kp:.4g}: this servo takes 15 at most")

    def init(self, like):
        return jnp.zeros_like(like)

    def step(self, state, reference, measurement):
        slope = (measurement - state) / self.dt
        return measurement, self.kp * (reference - measurement) - self.kd * slope

    def linear(self, axis=0, member=None):
        slope, one = self.kd / self.dt, jnp.ones(1)
        through = {"reference_through": self.kp, "measurement_through": -self.kp - slope}
        return LinearController(
            A=jnp.zeros((1, 1)), reference_in=0 * one, measurement_in=one, C=slope * one,
            dt=self.dt, **through,
        )  # fmt: skip

    def tunable(self):
        return {"kp": None, "kd": None}


@pytest.mark.slow
def test_a_controller_of_ones_own_is_tuned_up_to_the_gains_that_it_refuses():
    found = brief(Servo(10.0, 5.0), Objective({"itae": 1.0}, ()), free=None)
    assert found.stabilised and set(found.values) == {"kp", "kd"}
    assert 14.0 < found.values["kp"] <= 15.0
    assert "this servo takes 15 at most" in str(found.convergence)


def brief(controller, objective, free, *, evaluations=15, limits=()):
    happens = scenario(duration=1.0, axes=1, dt=case.DT, reference=Step(np.radians(4.0)))
    return tune(
        case.loop(controller), case.ensemble().draw(case.loop(), 4, jax.random.key(0)), happens,
        objective=objective, progress=False, fresh=None, free=free, limits=limits,
        method=LBFGS(evaluations=evaluations),
    )  # fmt: skip


@pytest.mark.slow
def test_a_tune_that_is_stopped_has_not_converged_and_says_so():
    found = brief(case.ladrc(3.0, 30.0), Objective(), None, evaluations=2).convergence
    assert found.holds is False and "ended where the cost still falls" in found.text
    assert "more evaluations" in found.remedy


@pytest.mark.slow
def test_a_limit_that_cannot_be_met_ends_the_rounds_nearest_to_it_and_says_so():
    limits = [Limit("itae", at_most=1e-6)]
    found = brief(case.ladrc(3.0, 30.0), Objective(), None, limits=limits, evaluations=60)
    [missed] = found.limits
    assert not missed.met and missed.reached > 1e-6
    assert found.convergence.holds is False and "the limit on " in found.convergence.text
    assert "Relax the limits" in found.convergence.remedy


@pytest.mark.slow
def test_a_tune_ends_at_the_bound_and_says_so():
    free = ["ladrc.observer_factor", "ladrc.wo"]
    found = brief(halved(4.0, 40.0, 0.3), Objective(), free)
    assert not found.converged
    assert found.controller.observer_slowness() == ""
    assert found.convergence.holds is False and "observer alone" in found.convergence.text


def test_a_certificate_fails_on_an_observer_that_would_run_away_in_saturation():
    by_hand = judged()
    assert certificate({"tuned": by_hand}).holds
    bad = halved(4.0, 428.0, 0.034).observer_instability()
    found = certificate({"tuned": dataclasses.replace(by_hand, observer_instability=bad)})
    assert not found.holds
    assert "FAILS" in str(found).splitlines()[0] and "observer alone" in str(found.stability)
