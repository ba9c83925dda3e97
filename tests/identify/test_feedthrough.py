"""What passes directly from a held input shows in whole samples, whatever its delay is."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import response_of

import jaxquad as jq


HOLD = 0.01  # s
OMEGA = np.geomspace(0.5, 60.0, 60)
FREE = ("numerator[0]", "numerator[1]", "denominator[1]", "delay")


class HeldLead(NamedTuple):
    """(s + 5) / (s + 2) e^(-delay s) behind a hold, by the exact step of its one state."""

    delay: float

    def frequency_response(self, omega):
        whole, z = np.ceil(self.delay / HOLD), np.exp(1j * OMEGA * HOLD)
        early = whole * HOLD - self.delay  # in which the newest value acts
        new, old = 1.5 * (1 - np.exp(-2 * early)), 1.5 * (1 - np.exp(-2 * (HOLD - early)))
        driven = new * z ** (1 - whole) + np.exp(-2 * early) * old * z**-whole
        return (driven / (z - np.exp(-2 * HOLD)) + z**-whole)[:, None, None]


def held(model, seed=None, error=0.005):
    frf = response_of(model, error=error, seed=seed, omega=OMEGA)
    return dataclasses.replace(frf, hold=HOLD, dt=HOLD)


@pytest.mark.parametrize("delay", [0.043, 0.0401])
def test_a_delay_of_the_direct_part_is_known_to_its_sample(delay):
    start = jq.TransferFunction([0.8, 4.0], [1.0, 3.0], delay=0.022)
    fit = jq.fit(start, held(HeldLead(delay), seed=3), free=FREE)
    off = (fit.values - [1.0, 5.0, 2.0, delay]) / fit.standard_errors
    assert np.all(np.abs(off) < 3)
    low, high = fit.interval("delay")
    assert 0.039 < low < delay < high < 0.051
    # The gain of the direct part has the spread that the sample leaves it.
    assert 0.004 < fit.standard_errors[0] < 0.02
    assert [remark.kind for remark in fit.remarks] == ["sampled delay"]
    assert "the interval is that sample" in fit.remarks[0]
    assert fit.chi_squared < 1.5**2


def test_what_the_rest_of_the_response_tells_of_such_a_delay_narrows_its_interval():
    start = jq.TransferFunction([1.0, 5.0], [1.0, 2.0], delay=0.042)
    fit = jq.fit(start, held(HeldLead(0.043), seed=3, error=0.1), free=("delay",))
    assert fit.standard_errors[0] < 0.9 * HOLD / np.sqrt(12)
    assert "the rest of the response narrows the interval;" in fit.remarks[0]


def test_the_response_at_known_values_is_exact():
    exact = HeldLead(0.043).frequency_response(OMEGA)
    model = jq.TransferFunction([1.0, 5.0], [1.0, 2.0], delay=0.043)
    sampled = jq.identify.as_sampled(model, held(HeldLead(0.043)))
    response = sampled.frequency_response(jnp.asarray(OMEGA))
    np.testing.assert_allclose(response, exact, rtol=1e-5)


class Lead(eqx.Module):
    """The same as somebody else may write it, who says nothing of its direct part."""

    gain: jax.Array
    zero: jax.Array
    pole: jax.Array
    delay: jax.Array

    def frequency_response(self, omega):
        above = jnp.stack([self.gain, self.gain * self.zero])
        below = jnp.stack([jnp.ones_like(self.pole), self.pole])
        return jq.TransferFunction(above, below, self.delay).frequency_response(omega)


def test_a_direct_part_that_nobody_tells_is_remarked():
    fit = jq.fit(Lead(*map(jnp.asarray, (1.0, 5.0, 2.0, 0.043))), held(HeldLead(0.043), seed=3))
    assert any("transfer_function()" in remark for remark in fit.remarks)


@pytest.mark.slow
def test_a_fit_in_time_keeps_the_sample():
    sweep = jq.sweep(1.5, 60.0, duration=25.0, sample_rate=1 / HOLD, amplitude=1.0)
    u, delay = sweep.signal, 0.043
    truth = jq.TransferFunction([1.0, 5.0], [1.0, 2.0], delay=delay)
    clean = np.asarray(jq.models.simulate_linear(truth, u, HOLD))
    noise = np.random.default_rng(7).normal(0, 0.02, u.size)
    record = jq.Record(HOLD * np.arange(u.size), u, clean + noise, hold=HOLD)
    start = jq.TransferFunction([0.9, 4.5], [1.0, 2.5], delay=0.035)
    for model in (start, dataclasses.replace(start, delay=0.052)):
        fit = jq.identify.refine(model, record, free=FREE)
        off = (fit.values - [1.0, 5.0, 2.0, delay]) / fit.standard_errors
        assert np.all(np.abs(off) < 3)
        assert 0.002 < fit.standard_errors[3] < 0.004
        assert [remark.kind for remark in fit.remarks] == ["sampled delay"]


@pytest.mark.slow
def test_many_fits_at_once_refuse_a_free_delay_of_the_direct_part():
    start = jq.TransferFunction([0.8, 4.0], [1.0, 3.0], delay=0.043)
    responses = [held(HeldLead(0.043), seed=k) for k in range(2)]
    with pytest.raises(ValueError, match="one by one with jq.fit"):
        jq.identify.fit_batch(start, responses, free=FREE)
    batch = jq.identify.fit_batch(start, responses, free=FREE[:3])
    np.testing.assert_allclose(batch.values, [[1.0, 5.0, 2.0]] * 2, rtol=0.02)


@pytest.mark.slow
def test_delays_of_a_state_space_are_found_from_other_samples():
    # Heave and pitch at 20 m/s: pitch rate and vertical acceleration by collective and cyclic.
    def helicopter(F, G, delays):
        H0, H1 = [[0.0, 1.0], [0.0, -20.0]], [[0.0, 0.0], [1.0, 0.0]]
        return jq.StateSpace(F=F, G=G, H0=H0, H1=H1, input_delay=delays)

    truth = helicopter([[-0.8, 20.0], [-0.1, -2.5]], [[-9.0, 2.0], [0.4, 6.0]], [0.043, 0.027])
    start = helicopter([[-1.0, 20.0], [-0.2, -2.0]], [[-8.0, 3.0], [0.3, 7.0]], [0.025, 0.045])
    sampled = jq.identify.as_sampled(truth, held(truth))
    free = ["F[0][0]", "F[1][0]", "F[1][1]", "G[0][0]", "G[0][1]", "G[1][0]", "G[1][1]"]
    free += ["input_delay[0]", "input_delay[1]"]
    fit = jq.fit(start, held(sampled, seed=4), free=free)
    values = [-0.8, -0.1, -2.5, -9.0, 2.0, 0.4, 6.0, 0.043, 0.027]
    assert np.all(np.abs(fit.values - values) < 4 * fit.standard_errors)
    assert np.all(fit.standard_errors[-2:] < 0.003)
