"""A gain that changes, and a clock that drifts, while a sweep lasts."""

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


def swept(change, seed, times=TIMES, late=0.0):
    """The response to a sweep during which the gain changes by a share, and the output's stamps
    come later by `late` (s)."""
    frf = response_of(TRUTH, error=0.01, seed=seed)
    share = times[:, :, None] / LENGTH
    factor = (1 + change * share) * np.exp(-1j * OMEGA[:, None, None] * late * share)
    response = jnp.asarray(np.asarray(frf.response) * factor)
    return dataclasses.replace(frf, response=response, swept_at=times)


def drifts(fit, kind="drift"):
    return [remark for remark in fit.remarks if remark.kind == kind]


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
    for seed in range(40):
        fit = jq.fit(START, swept(0.0, seed))
        assert not drifts(fit) and not drifts(fit, "clock")
    assert not drifts(jq.fit(START, dataclasses.replace(swept(-0.15, 0), swept_at=None)))


@pytest.mark.parametrize("late", [-0.02, 0.02])
def test_a_clock_that_drifts_is_remarked_with_its_size(late):
    for seed in range(5):
        fit = jq.fit(START, swept(0.0, seed, late=late))
        (text,) = drifts(fit, "clock")
        shown, error = (float(text.split(x)[1].split(" ms")[0]) for x in ("drifted by ", "error "))
        assert abs(shown - 1e3 * late) < 3.5 * error < 8 and not drifts(fit)


@pytest.mark.slow
def test_explain_offers_the_clock_and_the_fit_with_it_holds_the_truth():
    for seed in range(3):
        found = jq.fit(START, swept(0.0, seed, late=0.02)).explain()
        assert found.candidates[0].title == "a clock that drifts", str(found)
        errors = np.asarray(found.best.standard_errors)
        truth = np.array([80.0, 0.06, 0.03, 0.02])
        assert np.all(np.abs(np.asarray(found.best.values) - truth) < 3.5 * errors)
        assert errors[3] < 0.003


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
