"""A tune takes no step to gains that the controller itself refuses."""

import dataclasses

import jax
import numpy as np
import pytest
import tuning_case as case
from certificates_by_hand import certificate, judged

from jaxquad.control import LADRC
from jaxquad.simulation import scenario, Step
from jaxquad.tuning import LBFGS, Objective, tune
from jaxquad.tuning._observer_alone import barrier, refusal, runaway, sluggish
from jaxquad.tuning._parameters import coordinates


FREE = ["ladrc.wc", "ladrc.wo", "ladrc.observer_factor", "map.values"]


def refused(**gains):
    start = case.equivalent(10.0, 30.0)
    start = dataclasses.replace(start, ladrc=dataclasses.replace(start.ladrc, observer_factor=0.5))
    free_ones = coordinates(start, FREE)
    z = np.array(free_ones.start)
    for name, value in gains.items():
        z[FREE.index(f"ladrc.{name}")] = np.log(value)
    return refusal(free_ones, z)


def test_gains_of_use_are_not_refused():
    assert refused() == ""
    assert refused(wo=300.0, observer_factor=0.5) == ""


def test_an_observer_too_fast_for_the_samples_is_refused_in_the_controllers_words():
    assert "wo is" in refused(wo=4000.0) and "dt = 0.002" in refused(wo=4000.0)


@pytest.mark.parametrize(("wo", "factor"), [(428.0, 0.034), (200.0, 0.01)])
def test_an_observer_that_is_unstable_by_itself_is_refused(wo, factor):
    # Herbst's gains times a factor; by hand, the roots of the error's polynomial.
    pole = np.exp(-wo * case.DT)
    l1 = factor * (1 - pole**3)
    l2 = factor * 1.5 * (1 - pole) ** 2 * (1 + pole) / case.DT
    l3 = factor * (1 - pole) ** 3 / case.DT**2
    ahead = np.array([[1, case.DT, case.DT**2 / 2], [0, 1, case.DT], [0, 0, 1]])
    error = (np.eye(3) - np.outer([l1, l2, l3], [1, 0, 0])) @ ahead
    unstable = np.abs(np.linalg.eigvals(error)).max() >= 1
    assert unstable == ("observer alone" in refused(wo=wo, observer_factor=factor))
    assert unstable


def halved(wc, wo, factor):
    start = case.equivalent(wc, wo)
    return dataclasses.replace(
        start, ladrc=dataclasses.replace(start.ladrc, observer_factor=factor)
    )


@pytest.mark.parametrize(("ratio", "slow"), [(5.0, False), (2.1, False), (1.9, True)])
def test_an_observer_by_itself_must_not_be_slower_than_the_feedback(ratio, slow):
    # s^3 + 1.5 s^2 + 1.5 s + 0.5 = (s + 0.5) (s^2 + s + 1): its slowest pole is at half of wo.
    assert ("slower than the feedback" in sluggish(halved(4.0, 4.0 * ratio, 0.5))) == slow
    assert sluggish(halved(4.0, 4.0 * ratio, 1.0)) == ""


def test_observers_of_several_axes_are_judged_each_beside_its_own_wc():
    assert sluggish(LADRC([4.0, 9.0], [20.0, 20.0], 1.0, observer_factor=0.5, order=1)) == ""
    assert "decays at 0.7" in sluggish(LADRC([4.0, 12.5], [20.0, 20.0], 1.0, observer_factor=0.5))


@pytest.mark.parametrize("order", [1, 2])
def test_the_barrier_ends_where_an_observer_is_as_slow_as_the_feedback(order):
    rng = np.random.default_rng(order)
    wc, wo = rng.uniform(2.0, 30.0, 200), rng.uniform(5.0, 400.0, 200)
    for gains in zip(wc, wo, np.exp(rng.uniform(-4.0, 0.0, 200)), strict=True):
        ladrc = LADRC(*gains[:2], 1.0, order=order, observer_factor=gains[2])
        room = barrier(ladrc)
        assert bool(np.isfinite(room)) == (sluggish(ladrc) == "") and not room < 0


def test_a_tune_ends_at_the_bound_and_says_so():
    brief = scenario(duration=1.0, axes=1, dt=case.DT, reference=Step(np.radians(4.0)))
    members = case.ensemble().draw(4, jax.random.key(0))
    found = tune(
        halved(4.0, 40.0, 0.3), members, brief, objective=Objective(), progress=False, fresh=None,
        free=["ladrc.observer_factor", "ladrc.wo"], method=LBFGS(evaluations=15),
    )  # fmt: skip
    assert not found.converged
    assert sluggish(found.controller) == ""
    assert any("observer alone" in remark for remark in found.remarks)


def test_a_certificate_fails_on_an_observer_that_would_run_away_in_saturation():
    by_hand = judged()
    assert certificate({"tuned": by_hand}).holds
    bad = runaway(halved(4.0, 428.0, 0.034))
    found = certificate({"tuned": dataclasses.replace(by_hand, runaway=bad)})
    assert not found.holds
    assert "FAILS" in str(found).splitlines()[0] and "observer alone" in str(found).splitlines()[0]
