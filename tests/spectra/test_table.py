"""Responses that were measured elsewhere: their errors are those of the same estimate here."""

import numpy as np
import pytest

import jaxquad as jq


from_table = jq.spectra.FrequencyResponse.from_table
MODEL = jq.LaggedIntegrator(80.0, 0.06, 0.03)
OMEGA = np.geomspace(0.5, 40.0, 40)
EXACT = np.asarray(MODEL.frequency_response(OMEGA))[:, 0, 0]


def noisy(error=0.02, seed=0):
    white = np.random.default_rng(seed).normal(size=(2, OMEGA.size))
    return EXACT * (1 + error * (white[0] + 1j * white[1]))


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["row", "pairs"])
def test_a_fit_to_a_table_finds_the_model_within_its_errors(shape):
    response = noisy()[:, None, None] if shape == "pairs" else noisy()
    frf = from_table(OMEGA, response, random_error=0.02, input_names=["M"], output_names=["q"])
    fit = jq.fit(jq.LaggedIntegrator(60.0, 0.04, 0.04), frf)
    assert fit.identifiable and not fit.remarks
    np.testing.assert_array_less(np.abs(fit.values - [80.0, 0.06, 0.03]), 3 * fit.standard_errors)
    assert 0.7 < np.sqrt(fit.chi_squared) < 1.3
    assert "M -> q" in str(frf) and jq.loops.margins(frf).standard_errors


def test_the_errors_of_a_coherence_are_those_of_as_many_windows():
    error = np.full(OMEGA.size, 0.05)
    frf = from_table(OMEGA, EXACT, random_error=error, averages=12)
    again = from_table(OMEGA, EXACT, coherence=np.asarray(frf.coherence), averages=12)
    np.testing.assert_allclose(again.random_error, frf.random_error, rtol=1e-12)
    np.testing.assert_allclose(frf.coherence, 1 / (1 + 24 * 0.05**2), rtol=1e-12)
    single = from_table(OMEGA, EXACT, coherence=0.9)
    np.testing.assert_allclose(single.random_error, np.sqrt(0.1 / 1.8), rtol=1e-12)
    variance = np.diagonal(np.asarray(frf.relative_covariance()))
    np.testing.assert_allclose(np.real(variance), 2 * 0.05**2, rtol=1e-9)


def test_data_of_python_control_are_a_table(without_type_checks):
    control = pytest.importorskip("control", reason="python-control is not installed")
    data = control.frd(noisy(), OMEGA)
    frf = from_table(data, random_error=0.02)
    np.testing.assert_array_equal(frf.response[:, 0, 0], noisy())
    np.testing.assert_array_equal(frf.omega, OMEGA)
    with pytest.raises(ValueError, match="FrequencyResponse.from_table"):
        jq.models.from_control(data)
    with pytest.raises(ValueError, match="FrequencyResponseData alone"):
        from_table(data, noisy(), random_error=0.02)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, "needs its errors"),
        ({"coherence": 0.9, "random_error": 0.1}, "needs its errors"),
        ({"coherence": 1.2}, "coherence runs from 1.2 to 1.2"),
        ({"random_error": 0.0}, "random error is 0"),
        ({"random_error": [0.1, 0.2]}, "random_error has the shape"),
        ({"coherence": 0.9, "averages": 0.0}, "averages is 0"),
        ({"coherence": 0.9, "omega": OMEGA[::-1]}, "rising"),
        ({"coherence": 0.9, "omega": OMEGA[:-1]}, "omega has the shape"),
        ({"coherence": 0.9, "response": np.where(OMEGA > 3, np.nan, EXACT)}, "not finite at 3"),
        ({"coherence": 0.9, "input_names": ["a", "b"]}, "input_names has 2 names"),
    ],
)
def test_a_table_that_is_none_is_refused(changes, message, without_type_checks):
    with pytest.raises(ValueError, match=message):
        from_table(**{"omega": OMEGA, "response": EXACT} | changes)
