"""What a fit says of its curves, its poles and other records, by short verbs."""

import json

import jax
import numpy as np
import pytest
from synthetic import response_of

import jaxquad as jq


TRUTH = jq.LaggedIntegrator(280.0, 0.016, 0.011)
START = jq.LaggedIntegrator(250.0, 0.01, 0.011)
TIME = np.linspace(0.0, 0.4, 81)


@pytest.fixture(scope="module")
def fit():
    return jq.fit(START, response_of(TRUTH, error=0.05, seed=0), free=("gain", "lag"))


@pytest.fixture(scope="module")
def record():
    time = np.arange(400) * 0.01
    u = np.sign(np.sin(3 * time))
    y = np.asarray(jq.models.simulate_linear(TRUTH.transfer_function(), u, 0.01))
    return jq.Record(time, u, y, output_names="q", output_units="rad/s", hold="dt")


@pytest.mark.slow
def test_the_band_of_a_gain_alone_is_the_interval_of_the_gain():
    only = jq.fit(START, response_of(TRUTH, error=0.05, seed=0), free=("gain",))
    low, high = only.interval("gain")
    half = (high - low) / (2 * only["gain"])
    band = only.response_band(np.array([1.0, 10.0]))
    np.testing.assert_allclose(band.decibels, 20 / np.log(10) * half, rtol=1e-6)
    np.testing.assert_allclose(band.degrees, 0, atol=1e-8)
    step = only.step_response(TIME)
    np.testing.assert_allclose(step.reach, half * step.value, rtol=1e-6, atol=1e-12)


@pytest.mark.slow
def test_the_band_of_a_step_response_is_that_of_models_drawn_from_the_fit(fit):
    """2000 draws know a standard deviation to 1.6 %; the band is first order in 10 % of the lag."""
    drawn = fit.ensemble(2000, jax.random.key(0))
    gain, lag = np.asarray(drawn.gain), np.asarray(drawn.lag)
    late = np.maximum(TIME - 0.011, 0.0)[:, None]
    exact = gain * (late - lag * (1 - np.exp(-late / lag)))
    found = fit.step_response(TIME)
    reach = found.reach[-1, 0, 0] / np.std(exact[-1])
    assert 1.8 < reach < 2.3  # a 95 % interval with some 20 degrees of freedom
    truth = 280.0 * (late - 0.016 * (1 - np.exp(-late / 0.016)))[:, 0]
    assert np.mean((found.low[:, 0, 0] <= truth) & (truth <= found.high[:, 0, 0])) > 0.9


@pytest.mark.slow
def test_a_step_response_needs_equal_steps_from_0(fit):
    for time in ([0.0, 0.1, 0.3], [0.1, 0.2], [0.0]):
        with pytest.raises(ValueError, match=r"equally spaced from 0.*linspace"):
            fit.step_response(np.array(time))


def test_a_step_response_of_several_channels_is_that_of_each_pair():
    two = jq.StateSpace(F=[[-1.0, 0.0], [0.0, -2.0]], G=[[1.0, 0.0], [0.0, 4.0]], H0=np.eye(2))
    found = jq.identify.step_response(two, TIME)
    assert found.shape == (TIME.size, 2, 2)
    np.testing.assert_allclose(found[:, 0, 0], 1 - np.exp(-TIME), atol=1e-12)
    np.testing.assert_allclose(found[:, 1, 1], 2 * (1 - np.exp(-2 * TIME)), atol=1e-12)
    np.testing.assert_array_equal(found[:, 0, 1], 0.0)


def test_a_parameter_is_found_by_its_name(fit):
    assert fit["gain"] == fit.values[0] and isinstance(fit["gain"], float)
    with pytest.raises(KeyError, match="no free parameter 'delay': this fit has gain, lag"):
        fit["delay"]
    np.testing.assert_allclose(np.sort(fit.poles), [-1 / fit["lag"], 0.0], rtol=1e-12)


def test_a_fit_as_a_mapping_is_json_and_what_a_result_stores(fit, tmp_path):
    path = jq.report.write_results(tmp_path, fit=fit)
    assert json.loads(path.read_text())["fit"] == json.loads(json.dumps(fit.to_dict()))
    assert fit.to_dict()["parameters"][0]["value"] == fit["gain"]


@pytest.mark.slow
def test_a_fit_called_with_a_record_verifies_it(fit, record):
    check, same = fit(record), jq.verify(fit.model, record, band=fit.used_band)
    assert check.fit_percent == same.fit_percent == jq.verify(fit, record).fit_percent > 95
    assert fit(record, band=(1.0, 10.0)).band == (1.0, 10.0)


@pytest.mark.slow
def test_the_true_model_compares_best(fit, record):
    models = {"truth": TRUTH, "fit": fit, "half": jq.LaggedIntegrator(140.0, 0.016, 0.011)}
    found = jq.compare(models, record)
    assert found.best == "truth" and found.fit_percent["truth"] == pytest.approx(100, abs=1)
    assert found.fit_percent["half"] == pytest.approx(50, abs=1)  # of the variation is missing
    table = str(found).splitlines()
    assert [line.split()[0] for line in table[:4]] == ["model", *models]
    assert list(jq.compare([TRUTH, fit], record).checks) == ["model 1", "model 2"]
    with pytest.raises(ValueError, match="no model to compare"):
        jq.compare([], record)
