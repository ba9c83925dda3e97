"""Limits on the tail of an ensemble: what a tune finds there, and what it leaves."""

import dataclasses

import jax
import numpy as np
import pytest
from html_pages import tuned_by_hand
from tuning_case import ensemble, equivalent, flight, loop, objective

from jaxquad.loops import loop_numbers
from jaxquad.models import DecoupledAxes
from jaxquad.simulation import scenario
from jaxquad.tuning import LBFGS, Limit, Tail, tune
from jaxquad.tuning._cost import take_members
from jaxquad.tuning._problem import linear_loops


pytestmark = pytest.mark.usefixtures("compiled_quickly")


def test_the_worst_take_the_places_of_others():
    drawn = [ensemble().draw(loop(), 6, jax.random.key(seed)) for seed in range(3)]
    worst = take_members(drawn[1:], [(1, 4), (0, 0), (1, 2)])
    assert worst is not None
    mine, first, second = (linear_loops(members, None) for members in drawn)
    found = mine.replaced(np.array([5, 1, 0]), linear_loops(worst, None))
    for pick in (lambda x: x.assumed_inertia[0], lambda x: x.axes.lag[0], lambda x: x.delay):
        a, b, c = map(pick, (mine, first, second))
        np.testing.assert_array_equal(pick(found), [c[2], b[0], a[2], a[3], a[4], c[4]])


@pytest.mark.slow
def test_members_are_taken_from_several_draws_with_the_noise_that_is_theirs():
    drawn = [ensemble().draw(loop(), 6, jax.random.key(seed)) for seed in range(3)]
    places = [(2, 1), (0, 5), (2, 0), (0, 2)]
    found = take_members(drawn, places)
    assert found is not None and take_members(drawn, []) is None
    still = scenario(duration=0.1, axes=1)
    flown = found.flight(still).noise
    for k, (s, place) in enumerate(places):
        plants = found.plant, drawn[s].plant
        assert all(isinstance(plant, DecoupledAxes) for plant in plants)
        mine, its = (jax.tree.leaves(plant) for plant in plants)
        for a, b in zip(mine, its, strict=True):
            np.testing.assert_array_equal(a[..., k], b[..., place])
        own = drawn[s].take([place]).flight(still).noise
        np.testing.assert_array_equal(flown[..., k], own[..., 0])


def test_one_certificate_of_several_claims_less():
    """By Bonferroni: the claims of n certificates hold together with 1 - 0.05 n at least."""
    tails = Tail(searches=3, searched=24576, added=4, certificates=2), Tail(1, 8192, certificates=1)
    several, one = (str(dataclasses.replace(tuned_by_hand(), tail=tail)) for tail in tails)
    assert "24576 further linear loops searched, 4 of the worst added" in several
    assert "this is certificate 2" in several and "read its 95 % as 90 %" in several
    assert "this is certificate" not in one


@pytest.mark.slow
def test_members_of_the_tail_are_tuned_on_where_they_are_beyond_a_limit():
    """Of 20,000 members that no tuner saw fewer are beyond the limit than without the search."""
    drawn = ensemble().draw(loop(), 16, jax.random.key(0))
    given = {"objective": objective(), "fresh": None, "progress": False}
    limits = [Limit("sensitivity_peak", at_most=3.0)]
    brief = {"limits": limits, "method": LBFGS(evaluations=25)} | given
    start = loop(equivalent(4.0, 50.0, 1.8))
    blind = tune(start, drawn, flight(), **brief)
    found = tune(start, ensemble(), flight(), members=16, **brief)
    assert blind.tail.searched == 0 and found.tail.searched >= 8192
    assert 0 < found.tail.added <= 320 and found.limits[0].met
    assert f"{found.tail.added} of the worst added" in str(found)
    beyond = []
    for controller in (blind.controller, found.controller):
        members = ensemble().fresh(loop(), 4000, jax.random.key(9))
        around = members.loop(controller)
        numbers = loop_numbers(around, [0])
        beyond.append(int(np.sum(~(numbers.sensitivity_peak <= 3.0))))
    assert beyond[1] <= 4 and beyond[1] < 0.2 * beyond[0]
