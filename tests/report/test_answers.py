"""What a page says of a log in plain words, and which flight it asks for."""

import dataclasses
import re
import shlex

import numpy as np
import pytest
from html_pages import record_of, TRUTH
from synthetic import response_of

import jaxquad as jq
from jaxquad.cli import main
from jaxquad.report._answers import answer_section, next_flight, poor_bands


BELOW = np.geomspace(0.5, 6.0, 30)  # rad/s, where neither the lag nor the delay is seen apart


def record():
    return record_of(("M", "q", "r"), ("V", "rad/s", "V"))


def band_of(flight):
    """In rad/s."""
    low, high = re.findall(r"\(([\d.]+) to ([\d.]+) rad/s\)", flight.facts["frequencies"])[0]
    return float(low), float(high)


def fitted(frf):
    return jq.fit(TRUTH, frf)


@pytest.mark.slow
def test_the_flight_that_is_asked_for_makes_a_loose_parameter_known():
    frf = response_of(TRUTH, error=0.02, seed=3, omega=BELOW)
    fit = fitted(frf)
    flight = next_flight(fit, frf, record(), {})
    low, high = band_of(flight)
    assert "lag" in " ".join(flight.why) and high > 1.5 * BELOW[-1]
    wider = response_of(TRUTH, error=0.01, seed=4, omega=np.geomspace(low, high, 30))
    again = fitted(wider)
    before, after = (f.standard_errors[f.names.index("lag")] for f in (fit, again))
    assert after < before / 4


@pytest.mark.slow
def test_the_flight_names_channel_amplitude_and_seconds():
    frf = response_of(TRUTH, error=0.02, seed=3, omega=BELOW)
    flown = record()
    flight = next_flight(fitted(frf), frf, flown, {})
    assert flight.facts["axis"] == "y0, by r" and " V (" in flight.facts["amplitude"]
    seconds = float(flight.facts["seconds"].split()[0])
    assert seconds >= 5 * 2 * np.pi / band_of(flight)[0] and seconds <= 2 * flown.duration + 10


@pytest.mark.slow
def test_a_known_model_is_to_be_verified_and_then_needs_nothing():
    frf = response_of(TRUTH, error=0.005, seed=0)
    fit, flown = fitted(frf), record()
    assert "3-2-1-1" in next_flight(fit, frf, flown, {}).what
    found = answer_section(fit, frf, flown, {"b": jq.verify(TRUTH, flown)})
    assert found["flight"].what.startswith("None")
    assert any(text.startswith("lag: 0.01") for text in found["can"])
    assert "determines every free parameter" in found["plain"]


def test_what_no_flight_tells_apart_asks_for_no_flight():
    axis = jq.models.AttitudeAxis(L=0.2, K_t=0.1, J_x=0.05, lag=0.02, delay=0.0)
    frf = response_of(axis, error=0.01, seed=1)
    fit = jq.fit(axis, frf, free=("J_x", "K_t", "lag"))
    flight = next_flight(fit, frf, None, {})
    assert flight.what.startswith("No further flight of the same kind helps") and not flight.facts
    assert any("J_x" in text for text in answer_section(fit, frf, None, {})["cannot"])


def test_a_log_of_feedback_alone_answers_nothing_about_the_vehicle():
    frf = response_of(TRUTH, error=0.005, seed=0)
    omega = np.asarray(frf.omega)
    said = jq.spectra.Remark("feedback-dominated: {where}", omega, kind=jq.spectra.DOMINATED)
    hover = dataclasses.replace(frf, remarks=(said,))
    found = answer_section(fitted(hover), hover, record(), {})
    assert "the controller, and not the vehicle" in found["plain"]
    assert found["can"] == ["Nothing about this vehicle."]
    assert any("-1/C" in text for text in found["cannot"])
    assert found["flight"].what.startswith("Sweep the channel")
    assert "reference" in " ".join(found["flight"].why)


def feedback_alone(rate: float, peak: float, reference: str | None):
    """A response of the controller up to 1000 rad/s, and its record."""
    frf = response_of(TRUTH, error=0.005, seed=0, omega=np.geomspace(0.5, 1000.0, 40))
    omega = np.asarray(frf.omega)
    said = jq.spectra.Remark("feedback-dominated: {where}", omega, kind=jq.spectra.DOMINATED)
    time = np.arange(4000) / rate
    signal = peak * np.sign(np.sin(3 * time))
    flown = jq.Record(
        time, signal, signal, signal if reference else None, input_names="axisSum[0]",
        output_names="gyroADC[0]", reference_names=reference or (),
    )  # fmt: skip
    frf = dataclasses.replace(frf, remarks=(said,), coherence=frf.coherence.at[omega > 50].set(0.1))
    return frf, flown


@pytest.mark.parametrize(
    ("reference", "peak", "most"),
    [
        ("rcCommand[0]", 450.0, 500.0),  # sticks end there
        ("setpoint[0]", 350.0, 350.0),  # the pilot's rates are not in the record
        ("r", 3.0, 6.0),
    ],
)
def test_the_next_flight_stays_within_sticks_and_sample_rate_and_design_accepts_it(
    tmp_path, reference, peak, most
):
    frf, flown = feedback_alone(1000.0, peak, reference)
    flight = next_flight(fitted(frf), frf, flown, {})
    low, high = band_of(flight)
    assert low <= high / 9.9 and high <= 2 * np.pi * flown.sample_rate / 25 * 1.01
    assert "e+" not in flight.what
    words = shlex.split(flight.facts["signal"])
    assert float(words[words.index("--amplitude") + 1]) == pytest.approx(most)
    assert main([*words[1:], "--out", str(tmp_path / "sweep.csv")]) == 0


def test_the_command_of_an_autopilots_loop_is_not_to_be_swept():
    frf, flown = feedback_alone(1000.0, 50.0, None)
    flight = next_flight(fitted(frf), frf, flown, {})
    assert "chirp of the rate set-point" in flight.what and "Sweep" not in flight.what
    assert not flight.facts and flight.why


def test_an_incoherent_band_is_named():
    frf = response_of(TRUTH, error=0.005, seed=0)
    omega = np.asarray(frf.omega)
    low = omega < 1.5
    quiet = dataclasses.replace(frf, coherence=frf.coherence.at[low].set(0.2))
    [(first, last)] = poor_bands(quiet)
    assert first == pytest.approx(omega[0]) and last == pytest.approx(omega[low][-1])
    found = answer_section(fitted(frf), quiet, None, {})
    assert any("incoherent" in text for text in found["cannot"])
    assert any("Only if you need it" in text for text in found["flight"].why)


def test_a_flight_that_is_not_predicted_is_no_answer():
    frf = response_of(TRUTH, error=0.005, seed=0)
    fit, flown = fitted(frf), record()
    other = dataclasses.replace(flown, outputs=np.roll(flown.outputs, 100, axis=0))
    check = jq.verify(fit, other)
    assert check.tic > 0.25
    found = answer_section(fit, frf, flown, {"b": check})
    assert not any("What happens in b" in text for text in found["can"])
    assert any("What happens in b: the model does not predict it" in x for x in found["cannot"])
    assert "why the model does not predict b" in found["flight"].what
