"""Several starts, stops that are no minima, and many fits at once."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import OMEGA, response_of

import jaxquad as jq
from jaxquad.models import imaginary


class Lag(eqx.Module):
    """K exp(-delay s) / (lag s + 1)."""

    gain: jax.Array
    lag: jax.Array
    delay: jax.Array

    def frequency_response(self, omega):
        s = imaginary(omega)
        gain, lag, delay = (x.astype(s.dtype) for x in (self.gain, self.lag, self.delay))
        return (gain / (lag * s + 1) * jnp.exp(-delay * s))[:, None, None]


def lag(*values):
    return Lag(*map(jnp.asarray, values))


TRUTH, FAR = lag(3.0, 0.1, 0.05), lag(3.0, 0.1, 0.6)
ML = jq.identify.MaximumLikelihood()


@pytest.fixture(scope="module")
def many():
    return jq.fit(FAR, response_of(TRUTH, seed=0), cost=ML, starts=24)


@pytest.mark.slow
def test_one_start_a_turn_of_phase_away_stays_in_its_minimum():
    fit = jq.fit(FAR, response_of(TRUTH, seed=0), cost=ML)
    assert fit.chi_squared > 100
    assert fit.minima == ()


@pytest.mark.slow
def test_several_starts_find_the_truth(many):
    assert np.all(np.abs(many.values - [3.0, 0.1, 0.05]) < 4 * many.standard_errors)
    assert many.chi_squared < 2


@pytest.mark.slow
def test_all_stops_are_listed_by_cost_and_say_what_they_are(many):
    costs = [point.cost for point in many.minima]
    assert costs == sorted(costs) and len(costs) > 1
    assert sum(len(point.starts) for point in many.minima) == 24
    assert many.minima[0].is_minimum
    assert f"24 starts, {len(costs)} optima:" in str(many)


class Even(eqx.Module):
    """A response that depends on the square of a number: stationary at 0 whatever the data."""

    root: jax.Array

    def frequency_response(self, omega):
        s = imaginary(omega)
        return ((1 + self.root.astype(s.dtype) ** 2) / (0.1 * s + 1))[:, None, None]


@pytest.mark.slow
def test_a_stationary_point_that_is_no_minimum_says_so():
    frf = response_of(Even(jnp.asarray(1.0)), seed=0)
    stuck = jq.fit(Even(jnp.asarray(0.0)), frf, free=[jq.identify.Real("root", 1.0)], cost=ML)
    assert any("stationary, but no minimum" in remark for remark in stuck.remarks)
    free = jq.fit(Even(jnp.asarray(0.5)), frf, free=[jq.identify.Real("root", 1.0)], cost=ML)
    assert not any("no minimum" in remark for remark in free.remarks)


@pytest.mark.slow
def test_two_minima_of_the_same_cost_are_called_rivals():
    frf = response_of(Even(jnp.asarray(1.0)), seed=0)
    start = Even(jnp.asarray(0.3))
    fit = jq.fit(start, frf, free=[jq.identify.Real("root", 1.0)], cost=ML, starts=12)
    assert any("other minima cost less than 1.5 times the best" in r for r in fit.remarks)


@pytest.fixture(scope="module")
def fleet():
    rng = np.random.default_rng(0)
    truths = [lag(3.0 * g, 0.1 * t, 0.05) for g, t in np.exp(0.3 * rng.standard_normal((6, 2)))]
    frfs = [response_of(truth, seed=k) for k, truth in enumerate(truths)]
    return frfs, jq.identify.fit_batch(TRUTH, frfs, cost=ML)


def test_a_batch_finds_what_single_fits_find(fleet):
    frfs, batch = fleet
    assert np.all(batch.converged)
    for k, frf in enumerate(frfs):
        one = jq.fit(TRUTH, frf, cost=ML)
        np.testing.assert_allclose(batch.values[k], one.values, rtol=1e-6)
        assert batch.costs[k] == pytest.approx(one.cost, rel=1e-8)
        np.testing.assert_allclose(batch.fit(k).values, batch.values[k], rtol=1e-9)


def test_a_member_of_a_batch_has_all_its_doubts(fleet):
    frfs, batch = fleet
    member, one = batch.fit(2), jq.fit(TRUTH, frfs[2], cost=ML)
    np.testing.assert_allclose(member.standard_errors, one.standard_errors, rtol=1e-5)
    assert member.names == one.names == ("gain", "lag", "delay")
    assert "6 fits; 0 of them reached no minimum" in str(batch)


def test_a_batch_refuses_other_frequencies_and_names_the_response():
    other = response_of(TRUTH, omega=OMEGA * 1.1)
    with pytest.raises(ValueError, match="response 1 has shape"):
        jq.identify.fit_batch(TRUTH, [response_of(TRUTH), other])
    with pytest.raises(ValueError, match="fit_batch needs a list of jq.spectra.FrequencyResponse"):
        jq.identify.fit_batch(TRUTH, [])
