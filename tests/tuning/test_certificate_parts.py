"""What certificates are made of: bounds, peers, and linear loops of all members."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom

import jaxquad as jq
from jaxquad.tuning import paper_designs, peers, upper_bound
from jaxquad.tuning._certificate import lag_remark
from jaxquad.tuning._loop_numbers import _linear, loop_numbers


RIG = jq.DecoupledAxes([0.0468], [0.0552])


@pytest.mark.parametrize("count, draws", [(0, 256), (3, 256), (255, 256), (0, 1), (7, 24)])
def test_the_bound_is_the_share_at_which_so_few_are_seen_once_in_twenty(count, draws):
    assert binom.cdf(count, draws, upper_bound(count, draws)) == pytest.approx(0.05, rel=1e-9)


def test_none_of_256_proves_1_2_per_cent_and_no_more():
    assert upper_bound(0, 256) == pytest.approx(0.01163, rel=1e-3)
    assert upper_bound(256, 256) == 1.0
    with pytest.raises(ValueError, match="5 of 4 members"):
        upper_bound(5, 4)
    with pytest.raises(ValueError, match="level is 95"):
        upper_bound(0, 4, level=95.0)


def test_the_papers_gains_are_3_and_1_6_on_the_rig_and_in_proportion_elsewhere():
    designs = paper_designs(RIG)
    assert list(designs) == ["paper b0 = 3", "paper b0 = 1.6"]
    assert [float(x.b0[0]) for x in designs.values()] == [3.0, 1.6]
    elsewhere = paper_designs(jq.DecoupledAxes([8.48, 0.848], [1.0, 1.0]))
    assert list(elsewhere) == ["paper b0 = 3.54 b", "paper b0 = 1.89 b"]
    np.testing.assert_allclose(elsewhere["paper b0 = 3.54 b"].b0, [30.0, 3.0], rtol=1e-4)
    with pytest.raises(ValueError, match="an ensemble of \\(2,\\)"):
        peers(jq.DecoupledAxes([[1.0, 2.0]], [1.0]))


def test_certainty_equivalence_is_the_gain_over_the_inertia_told():
    law = peers(RIG)["CE 10/30"].scheduled_at(jnp.array([[0.01, 0.0552, 0.5]]))
    np.testing.assert_allclose(law.b0, 0.0468 / np.array([[0.01, 0.0552, 0.5]]), rtol=1e-12)


def test_three_axes_are_analysed_as_each_alone():
    """8 members of 3 axes and 24 of one: the same loops, in one compile."""
    gains, wo, b0 = np.array([1.0, 2.0, 0.5]), np.array([24.0, 40.0, 60.0]), np.array([1, 2, 3.0])
    inertia = np.geomspace(0.5, 2, 8)
    plant = jq.DecoupledAxes(gains, inertia[None])
    together = loop_numbers(plant, jq.LADRC(8.0, wo, b0), jnp.zeros(8), longest=0.0, axes=3)
    row = lambda x: np.repeat(x, 8)[None]
    flat = jq.DecoupledAxes(row(gains), np.tile(inertia, 3)[None])
    law = jq.LADRC(8.0, row(wo), row(b0))
    alone = loop_numbers(flat, law, jnp.zeros(24), longest=0.0, axes=1)
    for a, b in zip(together, alone, strict=True):
        np.testing.assert_array_equal(a.reshape(1, 24), b)
    assert 0 < np.sum(together.stable) < together.stable.size
    assert np.isnan(together.phase_margin[~together.stable]).all()


@pytest.mark.parametrize(
    "design", [jq.LADRC([10.0, 8.0], 30.0, 0.8), jq.PID([[5.0], [2.0]], [[3.0]] * 2, [[1.0]] * 2)]
)
def test_padded_controllers_are_the_same_filters(design):
    z = np.exp(1j * np.geomspace(1e-3, 3, 20))[:, None, None]
    laws = _linear(design, 2, 3)
    for place, (axis, member) in enumerate([(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)]):
        given = design.linear(axis, (member,) if design.ensemble else None)
        mine = jax.tree.map(lambda x, k=place: np.asarray(x[k]), laws)
        found = [
            law.C @ np.linalg.solve(z * np.eye(len(law.C)) - law.A, law.measurement_in[:, None])
            + law.measurement_through
            for law in (mine, jax.tree.map(np.asarray, given))
        ]
        np.testing.assert_allclose(found[0], found[1], rtol=1e-11)
        assert len(mine.C) == 5


def test_a_loop_too_fast_for_its_lag_is_told_so():
    lag, delay = np.array([[0.02, 0.05]]), np.array([0.004, 0.004])
    text = str(lag_remark(jq.LADRC(10.0, 30.0, 0.848), delay, lag))
    assert "50 ms x 10 rad/s = 0.5, 0.54 with the delay of 4 ms: too large, no b0" in text
    assert "beyond about 0.48 at wo/wc = 3; wc below 9.6 rad/s is necessary" in text
    slower = str(lag_remark(peers(RIG)["CE 10/30"], delay, lag / 5))
    assert "= 0.1" in slower and "too large" not in slower
    assert lag_remark(jq.PID(1.0, 1.0, 1.0), delay, lag) is None
    assert lag_remark(jq.LADRC(10.0, 30.0, 0.848), delay, None) is None
