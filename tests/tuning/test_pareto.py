"""Fronts between tracking and what it costs."""

import json

import jax
import numpy as np
import pytest
from certificates_by_hand import front, judged

import jaxquad as jq
from jaxquad.ensembles import Ensemble, LogUniform
from jaxquad.report import write_json
from jaxquad.tuning import LBFGS, Objective, paper_designs, pareto, Penalty


pytestmark = pytest.mark.usefixtures("compiled_quickly")
MEMBERS = 24  # as many as in test_certificate.py, whose compiles are shared
RIG = jq.DecoupledAxes([0.0468], [0.0552])
OPEN = Ensemble(inertia=LogUniform(0.7, 1.5), noise=np.radians(0.02))
LOOP = jq.Loop(RIG, jq.LADRC(5.0, 30.0, 1.2), drive=jq.simulation.Saturation(10.0))
FLIGHT = jq.scenario(duration=2.0, axes=1, reference={0: jq.Step(np.radians(4))})
LEVELS = (2.0, 10.0, 50.0)


PLAIN = Objective(penalties=(Penalty("abscissa", -0.5, 5.0),))  # no Ms: it compiles faster


def swept(levels=LEVELS, **options):
    options = {"objective": PLAIN, "members": MEMBERS, "fresh": MEMBERS} | options
    return pareto(
        LOOP, OPEN, FLIGHT, levels=levels, key=jax.random.key(1),
        progress=False, method=LBFGS(evaluations=12), **options,
    )  # fmt: skip


@pytest.fixture(scope="module")
def found():
    return swept(peers=paper_designs(RIG))


@pytest.mark.slow
def test_more_activity_buys_better_tracking_on_members_that_were_not_tuned_on(found):
    assert np.all(np.diff(found.effort) > 0) and np.all(np.diff(found.tracking) < 0)
    assert found.front.all() and all(c.stable for c in found.certificates)
    # A soft bound: each point stays below the level about which it was held.
    assert np.all(found.effort < 1.05 * np.array(LEVELS))


@pytest.mark.slow
def test_a_point_does_not_depend_on_those_that_descend_beside_it(found):
    others = swept((4.0, 10.0, 30.0))
    for a, b in zip(
        jax.tree.leaves(found.controllers[1]), jax.tree.leaves(others.controllers[1]), strict=True
    ):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_all_points_and_peers_fly_the_same_fresh_members(found):
    inertias = [c.facts["inertia"] for c in found.certificates]
    for other in inertias[1:]:
        np.testing.assert_array_equal(inertias[0], other)
    trained = np.asarray(OPEN.draw(LOOP, MEMBERS, jax.random.key(1)).assumed_inertia)
    assert not np.isin(inertias[0], trained).any()
    assert list(found.peers) == ["paper b0 = 3", "paper b0 = 1.6"]
    assert list(found.certificates[0].designs) == ["tuned"]


@pytest.mark.slow
def test_a_front_is_printed_and_written(tmp_path, found):
    head, titles, *rows = str(found).splitlines()
    assert head.startswith("3 of 3 points are on the front of ITAE over activity, u^2/s, on 24")
    assert "ITAE, deg s^2" in titles and len(rows) == 5
    content = json.loads(write_json(tmp_path / "front.json", found.content()).read_text())
    assert content["tracking"] == found.tracking.tolist() and content["front"] == [True] * 3
    assert content["points"][0]["statistics"]["itae"]["mean"] == found.tracking[0]


def test_the_front_is_what_no_stable_point_beats_in_both_numbers():
    rng = np.random.default_rng(0)
    activity, itae = rng.uniform(1, 10, (2, 30))
    shaky = rng.random(30) < 0.3
    points = [
        judged(y, 2.0, x, unstable=(3,) if bad else ())
        for x, y, bad in zip(activity, itae, shaky, strict=True)
    ]
    expected = [
        not bad and not any(
            x2 <= x and y2 <= y and (x2 < x or y2 < y) and not bad2
            for x2, y2, bad2 in zip(activity, itae, shaky, strict=True)
        )
        for x, y, bad in zip(activity, itae, shaky, strict=True)
    ]  # fmt: skip
    np.testing.assert_array_equal(front(points).front, expected)
    assert 2 < sum(expected) < 20


def test_over_ms_a_design_with_an_unstable_member_has_no_place():
    points = [judged(2.0, 3.0), judged(1.0, 3.0, unstable=(0, 5)), judged(1.5, 4.0)]
    found = front(points, over="sensitivity_peak")
    np.testing.assert_array_equal(found.effort, [3.0, np.inf, 4.0])
    np.testing.assert_array_equal(found.front, [True, False, True])


@pytest.mark.parametrize(
    "options, message",
    [
        ({"over": "mass"}, "no front over 'mass': choose one of activity"),
        ({"levels": (3.0, 2.0)}, "levels are \\(3.0, 2.0\\): give 2 or more above 0 that rise"),
        ({"levels": (0.0, 2.0)}, "above 0"),
        ({"levels": None, "points": 1, "objective": Objective()}, "points is 1"),
        (
            {"levels": None, "objective": Objective(penalties=(Penalty("overshoot", 5.0),))},
            "has 0 penalties on activity_rate: for a front give",
        ),
    ],
)
def test_what_makes_no_front_says_what_to_give(options, message):
    with pytest.raises(ValueError, match=message):
        swept(**options)
