"""An integrating plant behind a window, from record to fit."""

import functools as ft

import jax.numpy as jnp
import numpy as np
import pytest

import jaxquad as jq


TRUTH = jq.LaggedIntegrator(gain=80.0, lag=0.03, delay=0.02)
SWEEP = jq.sweep(0.5, 30.0, duration=60.0, sample_rate=100.0, amplitude=1.0)


@ft.cache
def fit(integrators):
    rate = np.asarray(jq.models.simulate_linear(TRUTH.transfer_function(), SWEEP.signal, 0.01))
    rate = rate + 0.01 * np.std(rate) * np.random.default_rng(0).standard_normal(rate.size)
    record = jq.Record(SWEEP.time, SWEEP.signal, rate)
    welch = jq.spectra.Welch(integrators=integrators, delay=0.05)
    # From one cycle to a window: the default starts at three, where little leaks.
    frf = jq.frequency_response(record, np.geomspace(0.5, 60.0, 100), estimator=welch)
    exact = np.asarray(TRUTH.frequency_response(jnp.asarray(frf.omega)))
    error = np.abs(np.asarray(frf.response / exact)[0, 0, 0] - 1)
    start = jq.LaggedIntegrator(gain=20.0, lag=0.1, delay=0.01)
    return error, jq.fit(start, frf, cost=jq.identify.MaximumLikelihood())


@pytest.mark.slow
def test_leakage_of_an_integrator_is_remarked_with_its_remedy():
    error, leaking = fit(integrators=0)
    (remark,) = [remark for remark in leaking.remarks if "leakage biases it" in remark]
    assert "falls as 1/s^1" in remark and "jq.spectra.Welch(integrators=1)" in remark
    assert error > 0.05


@pytest.mark.slow
def test_without_leakage_the_error_bars_are_ten_times_smaller_and_hold():
    leaking, clean = fit(integrators=0)[1], fit(integrators=1)[1]
    assert not any("leakage" in remark for remark in clean.remarks)
    assert clean.standard_errors[0] < 0.1 * leaking.standard_errors[0]
    # The held input is half a sample of 10 ms late.
    for fitted in (leaking, clean):
        errors = np.abs(fitted.values - [80.0, 0.03, 0.025])
        assert errors[0] < 3 * fitted.standard_errors[0]
    late = clean.derived(lambda model: model.lag + model.delay)
    assert late.value == pytest.approx(0.055, abs=3 * late.standard_error)
