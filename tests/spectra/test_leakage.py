"""An integrating plant behind a window, from record to fit."""

import functools as ft

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

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
    return error, jq.fit(start, frf)


@pytest.mark.slow
def test_leakage_of_an_integrator_is_remarked_with_its_remedy():
    error, leaking = fit(integrators=0)
    (remark,) = [remark for remark in leaking.remarks if "leakage through the window" in remark]
    assert "jq.spectra.LocalPolynomial()" in remark and "integrators=" in remark
    assert error > 0.05


def named_bias(fitted):
    """In per cent."""
    (remark,) = [remark for remark in fitted.remarks if "leakage through the window" in remark]
    return float(remark.split("by about ")[1].split(" %")[0])


@pytest.mark.slow
def test_integrators_take_the_leakage_out_and_the_error_bars_hold():
    leaking, clean = fit(integrators=0)[1], fit(integrators=1)[1]
    assert named_bias(clean) < 0.1 * named_bias(leaking)
    # The held input is half a sample of 10 ms late.
    assert abs(clean.values[0] - 80.0) < 3 * clean.standard_errors[0]
    late = clean.derived(lambda model: model.lag + model.delay)
    assert late.value == pytest.approx(0.055, abs=3 * late.standard_error)


OMEGA = np.geomspace(1.2, 12.0, 25)
RATE = 50.0


def drive(seconds=60.0):
    t = np.arange(int(seconds * RATE)) / RATE
    growth = np.log(15.0 / 0.6)
    fade = np.clip(t, 0, 1) * np.clip(seconds - t, 0, 1)
    return fade * np.sin(0.6 * seconds / growth * (np.exp(growth * t / seconds) - 1))


def answer(plant, u):
    return np.asarray(signal.lfilter(*signal.bilinear(*plant, fs=RATE), u))


INTEGRATOR = ([5.0], [0.05, 1.0, 0.0])
MODE = ([40.0], [1.0, 2.5, 25.0])


@pytest.mark.slow
@pytest.mark.parametrize("plant", [INTEGRATOR, MODE], ids=["integrator", "mode"])
@pytest.mark.parametrize("deviation", [0.05, 0.3])
@pytest.mark.parametrize("estimator", [jq.spectra.Welch(15.0), jq.spectra.Composite((20.0, 6.0))])
def test_the_random_error_is_the_scatter_of_draws_and_not_the_leakage(plant, deviation, estimator):
    u, draws = drive(), 100
    y, time = answer(plant, u), np.arange(u.size) / RATE
    noise = np.random.default_rng(0).standard_normal((draws, u.size))
    found = [
        jq.frequency_response(jq.Record(time, u, y + deviation * each), OMEGA, estimator=estimator)
        for each in noise
    ]
    responses = np.stack([np.asarray(f.response)[:, 0, 0] for f in found])
    claimed = np.stack([np.asarray(f.random_error)[:, 0, 0] for f in found])
    scatter = np.std(responses, axis=0, ddof=1) / np.sqrt(2) / np.abs(responses.mean(axis=0))
    ratio = np.sqrt(np.mean(claimed**2, axis=0)) / scatter
    # 100 draws know a scatter to 5 %, the median of 25 frequencies that share noise to 3 %.
    assert np.median(ratio) == pytest.approx(1.0, abs=0.1)
    assert 0.8 < ratio.min() and ratio.max() < 1.35


def test_without_noise_little_is_claimed_and_the_bias_is_remarked():
    u = drive()
    record = jq.Record(np.arange(u.size) / RATE, u, answer(MODE, u))
    found = jq.frequency_response(record, OMEGA, estimator=jq.spectra.Welch(15.0))
    (numerator, denominator), z = signal.bilinear(*MODE, fs=RATE), np.exp(1j * OMEGA / RATE)
    exact = np.polyval(np.asarray(numerator), z) / np.polyval(np.asarray(denominator), z)
    bias = np.abs(np.asarray(found.response)[:, 0, 0] / exact - 1)
    assert np.median(found.random_error) < 0.05 * np.median(bias)
    (remark,) = [remark for remark in found.remarks if "leakage" in remark]
    named = float(remark.split("by about ")[1].split(" %")[0]) / 100
    assert named == pytest.approx(np.median(bias), rel=0.3)
