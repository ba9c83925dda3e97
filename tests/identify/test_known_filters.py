"""Known filters of an output divided out of a response: the plant before them, and its errors."""

import dataclasses

import numpy as np
from synthetic import response_of

import jaxquad as jq
from jaxquad.control.autopilots import FilterChain, PT1, PT2
from jaxquad.identify import filter_response, without_filters


OMEGA = np.geomspace(2.0, 120.0, 30)
CHAINS = [FilterChain((PT1(20.0),), 8000.0), FilterChain((PT2(90.0),), 4000.0)]


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
