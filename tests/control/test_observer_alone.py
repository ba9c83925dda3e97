"""An observer by itself, as it runs while the command saturates; and maps that stay falling."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.control import certainty_equivalence, Falling, LADRC, ScheduledLADRC


DT = 0.002  # s


def halved(wc, wo, factor, **options):
    return LADRC(wc, wo, 1.0, observer_factor=factor, dt=DT, **options)


def test_gains_of_use_are_fine():
    for ladrc in (halved(10.0, 30.0, 1.0), halved(10.0, 300.0, 0.5)):
        assert ladrc.observer_instability() == "" and ladrc.observer_slowness() == ""


@pytest.mark.parametrize(("wo", "factor"), [(428.0, 0.034), (200.0, 0.01), (300.0, 0.5)])
def test_an_observer_is_unstable_by_itself_where_the_roots_of_its_error_say_so(wo, factor):
    # Herbst's gains times a factor; by hand, the roots of the error's polynomial.
    pole = np.exp(-wo * DT)
    l1 = factor * (1 - pole**3)
    l2 = factor * 1.5 * (1 - pole) ** 2 * (1 + pole) / DT
    l3 = factor * (1 - pole) ** 3 / DT**2
    ahead = np.array([[1, DT, DT**2 / 2], [0, 1, DT], [0, 0, 1]])
    error = (np.eye(3) - np.outer([l1, l2, l3], [1, 0, 0])) @ ahead
    unstable = np.abs(np.linalg.eigvals(error)).max() >= 1
    why = halved(10.0, wo, factor).observer_instability()
    assert unstable == ("observer alone is unstable" in why) and unstable == (factor < 0.1)


@pytest.mark.parametrize(("ratio", "slow"), [(5.0, False), (2.1, False), (1.9, True)])
def test_an_observer_by_itself_must_not_be_slower_than_the_feedback(ratio, slow):
    # s^3 + 1.5 s^2 + 1.5 s + 0.5 = (s + 0.5) (s^2 + s + 1): its slowest pole is at half of wo.
    found = halved(4.0, 4.0 * ratio, 0.5).observer_slowness()
    assert ("slower than the feedback" in found) == slow
    assert halved(4.0, 4.0 * ratio, 1.0).observer_slowness() == ""


def test_observers_of_several_axes_are_compared_each_with_its_own_wc():
    wo = [20.0, 20.0]
    assert halved([4.0, 9.0], wo, 0.5, order=1).observer_slowness() == ""
    assert "decays at 0.7" in halved([4.0, 12.5], wo, 0.5).observer_slowness()


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_the_barrier_ends_where_an_observer_is_as_slow_as_the_feedback(order):
    rng = np.random.default_rng(order)
    wc, wo = rng.uniform(2.0, 30.0, 60), rng.uniform(5.0, 400.0, 60)
    for gains in zip(wc, wo, np.exp(rng.uniform(-4.0, 0.0, 60)), strict=True):
        ladrc = halved(*gains, order=order)
        room = float(ladrc.observer_barrier(["observer_factor"]))
        assert np.isfinite(room) == (ladrc.observer_slowness() == "") and not room < 0


def test_the_barrier_counts_only_where_the_factor_is_free():
    ladrc = halved(4.0, 10.0, 0.5)
    law = ScheduledLADRC(ladrc, certainty_equivalence(0.05, 0.06))
    assert float(ladrc.observer_barrier(["wc", "wo"])) == 0.0
    assert float(law.observer_barrier(["ladrc.wo"])) == 0.0
    whole = float(ladrc.observer_barrier(["observer_factor"]))
    assert float(law.observer_barrier(["ladrc.observer_factor"])) == whole > 0


def test_maps_stay_falling_wherever_their_coordinates_go():
    rng, falling = np.random.default_rng(0), Falling()
    map = certainty_equivalence(0.05, 0.06, knots=6)
    start = falling.inverse(np.asarray(map.values))
    for z in start + rng.normal(size=(20, *start.shape)):
        assert dataclasses.replace(map, values=falling.forward(jnp.asarray(z))).falls
    rows = np.cumsum(rng.uniform(-1.0, -0.1, (6, 2)), axis=0)
    found = falling.forward(jnp.asarray(falling.inverse(rows)))
    np.testing.assert_allclose(found, rows, rtol=1e-12)
