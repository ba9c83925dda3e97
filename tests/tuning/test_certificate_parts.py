"""What certificates are made of: bounds, peers, and linear loops of all members."""

import json
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tuning_case
from conftest import ROOT
from scipy.stats import binom

import jaxquad as jq
from jaxquad._core import map_in_threads
from jaxquad.control import schedule_for_analysis
from jaxquad.loops import loop_numbers
from jaxquad.tuning import paper_designs, peers, upper_bound


pytestmark = pytest.mark.usefixtures("compiled_quickly")
RIG = jq.DecoupledAxes([0.0468], [0.0552])


@pytest.mark.parametrize("count, draws", [(0, 256), (3, 256), (255, 256), (0, 1), (7, 24)])
def test_the_bound_is_the_share_at_which_so_few_are_seen_once_in_twenty(count, draws):
    assert binom.cdf(count, draws, upper_bound(count, draws)) == pytest.approx(0.05, rel=1e-9)


def test_the_shares_that_the_documents_print_are_those_of_the_study():
    study = json.loads((ROOT / "tests" / "studies" / "results" / "tuned.json").read_text())
    shares = {row[0]: row[1] for row in study["rows"]}
    page = " ".join((ROOT / "docs" / "tuning.md").read_text().split())
    for name in ("paper, b0 = 3", "paper, b0 = 1.6", "10/30, CE"):
        assert f"{shares[name]} %" in page


@pytest.mark.slow
def test_shares_agree_with_those_of_the_study():
    """2000 members here, by the exact poles, and 2000 there, by code of its own."""
    members = tuning_case.ensemble().fresh(tuning_case.loop(), 2000, jax.random.key(0))
    study = json.loads((ROOT / "tests" / "studies" / "results" / "tuned.json").read_text())
    names = ("paper, b0 = 3", "paper, b0 = 1.6", "10/30, CE")
    shares = {row[0]: float(row[1].split()[0]) for row in study["rows"]}
    for name, design in zip(names, peers(RIG).values(), strict=True):
        scheduled = schedule_for_analysis(design, members.assumed_inertia)
        share = float(np.mean(~loop_numbers(members.loop(scheduled), [0]).stable))
        scatter = np.sqrt(2 * share * (1 - share) / 2000)  # of the difference
        assert abs(0.01 * shares[name] - share) < 3 * scatter


def test_none_of_256_proves_1_2_per_cent_and_no_more():
    assert upper_bound(0, 256) == pytest.approx(0.01163, rel=1e-3)
    assert upper_bound(256, 256) == 1.0
    with pytest.raises(ValueError, match="5 of 4 members"):
        upper_bound(5, 4)


def test_the_papers_gains_are_3_and_1_6_on_the_rig_and_in_proportion_elsewhere():
    designs = paper_designs(RIG)
    assert list(designs) == ["paper b0 = 3", "paper b0 = 1.6"]
    assert [float(x.b0[0]) for x in designs.values()] == [3.0, 1.6]
    elsewhere = paper_designs(jq.DecoupledAxes([8.48, 0.848], [1.0, 1.0]))
    assert list(elsewhere) == ["paper b0 = 3.54 b", "paper b0 = 1.89 b"]
    np.testing.assert_allclose(elsewhere["paper b0 = 3.54 b"].b0, [30.0, 3.0], rtol=1e-4)
    with pytest.raises(ValueError, match="an ensemble of \\(2,\\)"):
        peers(jq.DecoupledAxes([[1.0, 2.0]], [1.0]))


def test_certainty_equivalence_is_the_gain_over_the_inertia_given():
    scheduled = peers(RIG)["b0 = KT/J"].scheduled_at(jnp.array([[0.01, 0.0552, 0.5]]))
    np.testing.assert_allclose(scheduled.b0, 0.0468 / np.array([[0.01, 0.0552, 0.5]]), rtol=1e-12)


def test_what_threads_do_comes_in_order_and_as_jax_is_set_for_their_caller():
    threads = []

    def double(x):
        threads.append(threading.get_ident())
        return 2 * x

    assert map_in_threads(double, iter(range(5))) == [0, 2, 4, 6, 8]
    assert threading.get_ident() not in threads
    threads.clear()
    with jax.default_matmul_precision("float32"):
        assert map_in_threads(double, iter(range(5))) == [0, 2, 4, 6, 8]
    assert threads == 5 * [threading.get_ident()]
