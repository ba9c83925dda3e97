"""Known filters of an output divided out of a response: the plant before them, and its errors."""

import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter
from synthetic import response_of

import jaxquad as jq
from jaxquad.autopilot import Butterworth, FilterChain, PT1, PT2
from jaxquad.identify import behind_filters, filter_response, without_filters


OMEGA = np.geomspace(2.0, 120.0, 30)
CHAINS = [FilterChain((PT1(20.0),), 8000.0), FilterChain((PT2(90.0),), 4000.0)]
RATE, SAMPLES = 400.0, 6000
LATE = FilterChain((Butterworth(20.0), PT1(60.0)), RATE)


def responses() -> jq.spectra.FrequencyResponse:
    rng = np.random.default_rng(3)
    u = np.cumsum(rng.standard_normal(8000)) * 0.05
    y = np.convolve(u, np.exp(-np.arange(40) / 8))[: u.size] + 0.1 * rng.standard_normal(u.size)
    record = jq.Record(np.arange(u.size) / 400.0, u, y)
    return jq.frequency_response(record, OMEGA)


def test_what_is_divided_out_is_a_factor_and_relative_errors_stay():
    found = responses()
    left = without_filters(found, CHAINS)
    hertz = OMEGA / (2 * np.pi)
    known = np.asarray(CHAINS[0].response(hertz)) * np.asarray(CHAINS[1].response(hertz))
    np.testing.assert_allclose(filter_response(CHAINS, OMEGA), known, rtol=1e-13)
    np.testing.assert_allclose(left.response[:, 0, 0] * known, found.response[:, 0, 0], rtol=1e-12)
    np.testing.assert_array_equal(left.random_error, found.random_error)
    np.testing.assert_array_equal(left.coherence, found.coherence)
    np.testing.assert_allclose(left.relative_covariance(), found.relative_covariance(), rtol=1e-9)
    assert np.max(np.abs(left.magnitude_db - found.magnitude_db)) > 1.0


def test_without_filters_a_response_is_itself():
    found = responses()
    assert without_filters(found, []) is found


def test_a_fit_is_of_the_plant_before_the_filters():
    plant = jq.models.LaggedIntegrator(60.0, 0.03, 0.004)
    found = response_of(plant, omega=OMEGA)
    behind = dataclasses.replace(
        found, response=found.response * filter_response(CHAINS, OMEGA)[:, None, None]
    )
    fitted = jq.fit(jq.models.LaggedIntegrator(50.0, 0.02, 0.01), without_filters(behind, CHAINS))
    np.testing.assert_allclose(fitted.values, [60.0, 0.03, 0.004], rtol=1e-6)


@pytest.mark.slow
def test_inputs_pass_the_filters_as_the_firmware_computes_them():
    time = np.arange(SAMPLES) / RATE
    u = np.sin(2 * np.pi * 3 * time) * (time > 1) + 2.0
    record = jq.Record(time, u, np.cos(time))
    late = behind_filters(record, [LATE]).inputs[:, 0]
    exact = u - u[0]
    for section in LATE.sections():
        b0, b1, a1, b2, a2 = (0.0 if x is None else float(x) for x in section)
        exact = np.asarray(lfilter([b0, b1, b2], [1.0, a1, a2], exact))
    assert np.allclose(late, exact + u[0], atol=1e-9)
    assert behind_filters(record, []) is record


@pytest.mark.slow
def test_a_model_without_the_filters_verifies_on_what_is_behind_them():
    plant = jq.LaggedIntegrator(30.0, 0.03, 0.0).transfer_function()
    time = np.arange(SAMPLES) / RATE
    u = np.sin(2 * np.pi * 4 * time) + np.sin(2 * np.pi * 9 * time)
    y = np.asarray(jq.models.simulate_linear(plant, u, 1 / RATE))
    for section in LATE.sections():
        b0, b1, a1, b2, a2 = (0.0 if x is None else float(x) for x in section)
        y = np.asarray(lfilter([b0, b1, b2], [1.0, a1, a2], y))
    record = jq.Record(time, u, y, hold="dt")
    band = (2 * np.pi * 2, 2 * np.pi * 15)
    right = jq.verify(plant, behind_filters(record, [LATE]), band=band)
    wrong = jq.verify(plant, record, band=band)
    assert right.fit_percent > 98 and wrong.fit_percent < 70
