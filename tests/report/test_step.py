"""The measured step response of a page, beside what the model makes of the same step."""

import numpy as np
import pytest
from synthetic import response_of

import jaxquad as jq
from jaxquad.report._loop import predict_step, step_section
from jaxquad.spectra import estimate_step


DT, GAIN, LAG = 0.004, 280.0, 0.03


@pytest.fixture(scope="module")
def record():
    """A lagged integrator under proportional feedback, flown by steps, in weak gusts."""
    random, samples = np.random.default_rng(2), 15000
    r = np.repeat(random.standard_normal(samples // 150), 150)
    u, y = np.zeros((2, samples))
    rate = moment = 0.0
    for k in range(samples):
        y[k] = rate + 0.001 * random.standard_normal()
        u[k] = 0.04 * (r[k] - y[k])
        stay = np.exp(-DT / LAG)
        mean = u[k] + (moment - u[k]) * (1 - stay) * LAG / DT
        rate += DT * GAIN * mean + 0.001 * random.standard_normal()
        moment = u[k] + (moment - u[k]) * stay
    return jq.Record(
        np.arange(samples) * DT, u, y, r, input_names="u0", output_names="y0",
        output_units="rad/s", reference_units="rad/s", hold="dt",
    )  # fmt: skip


def fit_of(gain):
    model = jq.LaggedIntegrator(gain, LAG, 0.0)
    frf = response_of(model, error=0.01, seed=0)
    return jq.fit(model, frf, free=("gain", "lag")), frf


def test_the_right_model_predicts_the_measured_step_and_a_wrong_one_does_not(record):
    found = estimate_step(record)
    inside = {}
    for gain in (GAIN, 0.6 * GAIN):
        fit, frf = fit_of(gain)
        predicted = predict_step(fit, frf, record)
        assert predicted is not None
        assert predicted.error is not None
        error = np.hypot(predicted.error, found.standard_error)
        early = (found.time > 0.05) & (found.time < 0.5)
        inside[gain] = np.abs(predicted.mean - found.mean)[early] < 3 * error[early] + 0.02
    assert np.mean(inside[GAIN]) > 0.95 and np.mean(inside[0.6 * GAIN]) < 0.3


def test_the_section_says_that_the_data_suffice_and_shows_both(record):
    fit, frf = fit_of(GAIN)
    section = step_section(fit, frf, record)
    assert section is not None
    assert not section["doubts"] and "The data suffice" in section["notes"][0]
    assert section["table"].heads == ("", "measured", "model")
    assert "prediction of the model" in section["image"].alt


def test_no_reference_gives_no_section_and_a_poor_one_no_figure(record):
    fit, frf = fit_of(GAIN)
    bare = jq.Record(record.time, record.inputs, record.outputs, output_names="y0")
    assert step_section(fit, frf, bare) is None
    quiet = np.zeros_like(record.time)
    quiet[5000:5200] = 1.0
    poor = jq.Record(
        record.time, record.inputs, record.outputs, quiet, input_names="u0", output_names="y0"
    )
    section = step_section(fit, frf, poor)
    assert section is not None and section["doubts"] and section["image"] is None
