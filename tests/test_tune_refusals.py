"""A tune takes no step to gains that the controller itself refuses."""

import dataclasses

import numpy as np
import pytest
import tuning_case as case

from jaxquad.tune._allowed import refusal
from jaxquad.tune._parameters import coordinates


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
