"""Held inputs: what the samples of a record show, against an exact simulation; and silent pairs."""

import dataclasses
from typing import cast

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import cont2discrete
from synthetic import response_of

import jaxquad as jq


DT = 0.02
TIME = DT * np.arange(3250)
SWEEP = np.where(TIME < 60, np.sin(0.3 * TIME + 29.7 * TIME**2 / 120), 0.0)
OMEGA = np.geomspace(1.0, 40.0, 40)
TRUTH = jq.TransferFunction([400.0], [1.0, 1.2, 400.0], delay=0.031)
START = jq.TransferFunction([300.0], [1.0, 1.0, 300.0], delay=0.02)
FREE = ("numerator[0]", "denominator[1]", "denominator[2]", "delay")


def held_output(delay: float) -> np.ndarray:
    """By scipy's exact discretisation, on a grid so fine that the delay is a whole step of it."""
    fine = DT / 20
    found = cont2discrete(([400.0], [1.0, 1.2, 400.0]), fine, "zoh")
    step = cast(tuple[np.ndarray, np.ndarray, float], found)
    late = round(delay / fine)
    driven = np.concatenate([np.zeros(late), np.repeat(SWEEP, 20)])[: 20 * SWEEP.size]
    from scipy.signal import lfilter

    return np.asarray(lfilter(np.ravel(step[0]), step[1], driven))[::20]


@pytest.fixture(scope="module")
def said():
    return jq.Record(TIME, SWEEP, held_output(0.031), hold="dt")


@pytest.fixture(scope="module")
def response(said):
    return jq.frequency_response(said, OMEGA)


@pytest.mark.slow
def test_a_held_input_is_fitted_exactly_with_the_plants_own_delay(response):
    fit = jq.fit(START, response, free=FREE)
    np.testing.assert_allclose(fit.values, [400.0, 1.2, 400.0, 0.031], rtol=1e-6)
    assert not any("keeps each value" in remark for remark in fit.remarks)


@pytest.mark.slow
@pytest.mark.parametrize("samples", [3.03, 3.98])
def test_a_delay_of_nearly_whole_samples_is_found_from_others(samples):
    """Of a first-order lag, whose aliases decay slowly and hardly turn: sampled in closed form."""
    lag, late, omega = 0.02, samples * DT, np.geomspace(1.0, 60.0, 60)
    z, early = np.exp(1j * omega * DT), 4 * DT - late
    ends, newer = np.exp(-DT / lag), 1 - np.exp(-early / lag)
    exact = ((1 - newer - ends) * z**-4 + newer * z**-3) / (z - ends)
    frf = response_of(jq.TransferFunction([1.0], [lag, 1.0], late), error=1e-4, omega=omega)
    response = jnp.asarray(exact[:, None, None])
    frf = dataclasses.replace(frf, response=response, hold=DT, dt=DT)
    start = jq.TransferFunction([1.5], [0.03, 1.0], delay=3.5 * DT)
    fit = jq.fit(start, frf, free=("numerator[0]", "denominator[0]", "delay"))
    off = (fit.values - [1.0, lag, late]) / fit.noise_standard_errors
    assert np.max(np.abs(off)) < 0.5
    rough = dataclasses.replace(frf, random_error=jnp.full((60, 1, 1), 0.1))
    batch = jq.identify.fit_batch(start, [rough, frf], free=fit.names)
    np.testing.assert_allclose(batch.values[1], fit.values, rtol=1e-6)


@pytest.mark.slow
def test_where_the_hold_is_unknown_the_fit_says_what_to_give(response):
    unsaid = dataclasses.replace(response, hold=None)
    fit = jq.fit(START, unsaid, free=FREE)
    assert fit.values[3] == pytest.approx(0.031 + DT / 2, rel=0.01)
    assert abs(fit.values[2] / 400 - 1) > 1e-4
    assert sum("give hold=" in remark for remark in fit.remarks) == 1


@pytest.mark.slow
def test_a_measured_input_has_no_hold(response):
    fit = jq.fit(START, dataclasses.replace(response, hold=0.0), free=FREE)
    assert fit.values[3] == pytest.approx(0.031 + DT / 2, rel=0.01)
    assert not any("hold=" in remark for remark in fit.remarks)


@pytest.mark.slow
def test_many_fits_at_once_see_the_hold_as_one_does(response):
    batch = jq.identify.fit_batch(START, [response, response], free=FREE)
    np.testing.assert_allclose(batch.values[1], [400.0, 1.2, 400.0, 0.031], rtol=1e-4)


def test_a_simulation_runs_its_inputs_as_the_record_says(said):
    assert jq.verify(TRUTH, said).fit_percent > 99.99
    unsaid = jq.Record(TIME, SWEEP, said.outputs)
    assert jq.verify(TRUTH, unsaid).fit_percent < 95 < jq.verify(TRUTH, said).fit_percent


def test_a_hold_stays_with_the_inputs_that_it_is_of(said):
    assert jq.records.trim(said, 5.0).hold == said.hold == pytest.approx(DT)
    assert jq.records.select(said, inputs="y", outputs="u").hold is None
    with pytest.raises(jq.records.RecordError, match="hold is -1"):
        jq.Record(TIME, SWEEP, SWEEP, hold=-1)


TWO = jq.StateSpace(F=[[-1.0]], G=[[2.0, 3.0]], H0=[[1.0]])
NO_SECOND = jq.StateSpace(F=[[-1.0]], G=[[2.0, 0.0]], H0=[[1.0]])


@pytest.mark.slow
@pytest.mark.parametrize("band", [None, {("y0", "u1"): None}])
def test_a_response_that_the_model_has_none_of_is_left_out_and_said(band):
    """`G[0][1]` is 0 and fixed: the second input has no response in the model, but in the data."""
    frf = response_of(TWO, seed=0)
    if band is not None:
        band = {(frf.output_names[0], frf.input_names[1]): None}
    fit = jq.fit(NO_SECOND, frf, free=("F[0][0]", "G[0][0]"), band=band)
    assert fit.identifiable
    np.testing.assert_array_less(np.abs(fit.values - [-1.0, 2.0]), 4 * fit.standard_errors)
    assert any("model's response is zero" in remark for remark in fit.remarks) == (band is None)
