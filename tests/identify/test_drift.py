"""A gain that changes while a sweep lasts."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import OMEGA, response_of

import jaxquad as jq


TRUTH = jq.LaggedIntegrator(80.0, 0.06, 0.03)
START = jq.LaggedIntegrator(60.0, 0.04, 0.04)
LENGTH = 60.0  # s
TIMES = (LENGTH * np.linspace(-0.5, 0.5, OMEGA.size))[:, None]  # of a logarithmic sweep


def swept(change, seed, times=TIMES):
    """The response to a sweep during which the gain changes by a share."""
    frf = response_of(TRUTH, error=0.01, seed=seed)
    factor = 1 + change * times[:, :, None] / LENGTH
    response = jnp.asarray(np.asarray(frf.response) * factor)
    return dataclasses.replace(frf, response=response, swept_at=times)


def drifts(fit):
    return [remark for remark in fit.remarks if remark.kind == "drift"]


def test_a_sweep_has_each_frequency_at_its_time():
    time, growth = 0.01 * np.arange(6000), np.log(60.0) / LENGTH
    u = np.sin(0.5 * np.expm1(growth * time) / growth)
    y = np.roll(u, 1) + 0.1 * np.random.default_rng(0).standard_normal(u.size)
    omega = np.geomspace(1.0, 20.0, 12)
    frf = jq.frequency_response(jq.Record(time, u, y), omega)
    expected = np.log(omega / 0.5) / growth - LENGTH / 2
    assert frf.swept_at is not None
    np.testing.assert_allclose(frf.swept_at[:, 0], expected, atol=0.02 * LENGTH)


def test_other_excitation_has_its_frequencies_all_the_time():
    rng = np.random.default_rng(0)
    u = rng.standard_normal(3000)
    record = jq.Record(0.01 * np.arange(3000), u, np.roll(u, 1) + 0.1 * rng.standard_normal(3000))
    assert jq.frequency_response(record, np.geomspace(2.0, 20.0, 12)).swept_at is None


@pytest.mark.parametrize("change", [-0.15, 0.2])
def test_a_drift_of_the_gain_is_remarked_with_its_size(change):
    for seed in range(5):
        (text,) = drifts(jq.fit(START, swept(change, seed)))
        shown = float(text.split("changed by ")[1].split(" %")[0]) / 100
        error = float(text.split("standard error ")[1].split(" %")[0]) / 100
        assert abs(shown - change) < 3.5 * error < 0.2


def test_a_steady_gain_and_a_response_without_a_sweep_are_not():
    assert not any(drifts(jq.fit(START, swept(0.0, seed))) for seed in range(40))
    assert not drifts(jq.fit(START, dataclasses.replace(swept(-0.15, 0), swept_at=None)))


@pytest.mark.slow
def test_explain_offers_the_drift_and_the_fit_with_it_holds_the_truth():
    held = []
    for seed in range(6):
        found = jq.fit(START, swept(-0.15, seed)).explain()
        assert found.candidates[0].title == "a gain that drifts", str(found)
        names = ("model.gain", "model.lag", "model.delay", "extra[0]")
        ends = [found.best.interval(name) for name in names]
        truth = zip((80.0, 0.06, 0.03, -0.15), ends, strict=True)
        held.append([low < value < high for value, (low, high) in truth])
    assert np.mean(held) > 0.85


@pytest.mark.slow
def test_sweeps_in_both_directions_share_one_drift():
    frfs = swept(-0.15, 1), swept(-0.15, 2, times=-TIMES)
    found = jq.fit(START, frfs).explain()
    (term,) = (one for one in found.candidates if one.title == "a gain that drifts")
    assert term.fit.interval("extra[0]")[1] < -0.1
    conditions = (None, jq.identify.Changed("gain", times=1.5))
    louder = dataclasses.replace(frfs[1], response=jnp.asarray(1.5 * np.asarray(frfs[1].response)))
    both = jq.fit(START, (frfs[0], louder), conditions=conditions).explain()
    (again,) = (one for one in both.candidates if one.title == "a gain that drifts")
    np.testing.assert_allclose(again.fit.values, term.fit.values, rtol=1e-3)
