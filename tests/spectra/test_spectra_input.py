"""What a frequency response refuses, and what it says then."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad._core import PrecisionError, require_float64
from jaxquad.records import Record, RecordWarning
from jaxquad.spectra import Composite, frequency_response, JointInputOutput, spectral_density, Welch


RATE, SAMPLES = 50.0, 500
TIME = np.arange(SAMPLES) / RATE
DRAW = np.random.default_rng(0).standard_normal((SAMPLES, 3))
RECORD = Record(TIME, DRAW[:, 0], DRAW[:, 1], DRAW[:, 2])
OMEGA = np.geomspace(4.0, 100.0, 20)


def still(channel):
    """The record with one constant channel, of which records warn."""
    values = [np.full(SAMPLES, 0.1) if k == channel else DRAW[:, k] for k in range(3)]
    with pytest.warns(RecordWarning, match="constant"):
        return Record(TIME, *values)


@pytest.mark.parametrize(
    "omega, message",
    [
        (np.array([]), r"omega has shape \(0,\): give 1 to 1024 frequencies"),
        (np.geomspace(4, 100, 1025), r"omega has shape \(1025,\)"),
        (
            np.array([5.0, 200.0]),
            r"of 157.1 rad/s .25 Hz.; they run from 5 to 200",
        ),
        (np.array([9.0, 5.0]), "the frequencies must increase"),
        (np.array([0.0, 5.0]), "the frequencies must lie above 0"),
        (np.array([np.nan, 5.0]), "the frequencies must increase"),
        (np.array([0.2, 5.0]), "run from 0.2 to 5 rad/s, but the records hold one cycle of 0.6283"),
    ],
)
def test_an_unusable_band_is_refused_with_its_limits(omega, message):
    with pytest.raises(ValueError, match=message):
        frequency_response(RECORD, omega)


def test_a_number_is_one_frequency():
    one, row = (frequency_response(RECORD, omega).response for omega in (8.0, np.array([8.0])))
    np.testing.assert_array_equal(one, row)
    one, row = (spectral_density(RECORD, omega).density for omega in (8.0, np.array([8.0])))
    np.testing.assert_array_equal(one, row)


@pytest.mark.parametrize(
    "estimator, message",
    [
        (
            Welch(2.0),
            r"1.5 rad/s .* resolves, 3.142 rad/s .* a window longer than 4.189 s",
        ),
        (Composite(), r"1.5 rad/s .* resolves, 1.881 rad/s .one cycle."),
    ],
)
def test_a_band_below_what_the_window_resolves_is_refused(estimator, message):
    with pytest.raises(ValueError, match=message):
        frequency_response(RECORD, np.array([1.5, 5.0]), estimator=estimator)


@pytest.mark.parametrize(
    "welch, message",
    [
        (Welch(10.0), "a window of 10 s has 500 samples, and the shortest record 500"),
        (Welch(12.0), "has 600 samples, and the shortest record 500: .* shorter than 5 s"),
        (Welch(0.1), "has 5 samples"),
        (
            Welch(0.2),
            "a window of 10 samples is too short for frequencies up to a tenth",
        ),
        (Welch(2.0, delay=3.0), "delay is 3 s: it must be below the window's 2 s"),
    ],
)
def test_a_window_that_does_not_fit_is_refused(welch, message):
    with pytest.raises(ValueError, match=message):
        frequency_response(RECORD, estimator=welch)


@pytest.mark.parametrize(
    "options, message",
    [
        (
            dict(shape="blackman"),
            "no window 'blackman': use one of hann, hamming, rectangular",
        ),
        (dict(overlap=1.0), r"overlap is 1.0: it must be at least 0 and below 1"),
        (dict(detrend="cubic"), "detrend is 'cubic': use none, constant or linear"),
        (dict(integrators=4), "integrators is 4: use 0 to 3"),
        (dict(delay=-0.1), "delay is -0.1 s: use 0 to 10 s"),
        (dict(window_length=0.0), "window_length is 0.0 s: it must be positive"),
    ],
)
def test_impossible_options_are_refused_with_their_value(options, message):
    with pytest.raises(ValueError, match=message):
        Welch(**options)


def test_too_short_a_record_is_refused():
    with pytest.raises(
        ValueError, match="a window of 0.08 s has 4 samples, and the shortest record 20"
    ):
        frequency_response(Record(TIME[:20], DRAW[:20, 0], DRAW[:20, 1]), estimator=Welch())


@pytest.mark.parametrize("channel, name", [(0, "u"), (1, "y"), (2, "r")])
def test_a_constant_channel_is_no_excitation(channel, name):
    with pytest.raises(ValueError, match=f"no excitation: '{name}' is constant"):
        frequency_response(still(channel), OMEGA)


def test_channels_that_are_the_same_are_refused_also_where_they_rest():
    with pytest.raises(ValueError, match="is the same signal as"):
        frequency_response(Record(TIME, DRAW[:, 0], DRAW[:, 0]), OMEGA)
    with pytest.warns(RecordWarning, match="constant"):
        record = Record(TIME, np.zeros(SAMPLES), np.zeros(SAMPLES))
    with pytest.raises(ValueError, match="are both 0 throughout"):
        frequency_response(record, OMEGA)


def test_a_trend_that_detrending_removes_is_no_excitation():
    ramp = Record(TIME, 1e6 + 3 * TIME, DRAW[:, 1])
    with pytest.raises(
        ValueError, match="no excitation at 4 rad/s .*: the spectrum of 'u' is zero"
    ):
        frequency_response(ramp, OMEGA, estimator=Welch(detrend="linear"))


def test_the_joint_estimate_needs_one_reference():
    with pytest.raises(ValueError, match=r"0 references \[\] for 1 inputs \['u'\]"):
        frequency_response(Record(TIME, DRAW[:, 0], DRAW[:, 1]), estimator=JointInputOutput())
    two = Record(TIME, DRAW[:, 0], DRAW[:, 1], DRAW[:, 1:] + DRAW[:, :1])
    with pytest.raises(ValueError, match=r"2 references \['r1', 'r2'\] for 1 inputs"):
        frequency_response(two)


def test_too_few_windows_for_the_inputs_are_refused():
    two = Record(TIME, DRAW[:, :2], DRAW[:, 2])
    with pytest.raises(ValueError, match="1.2 independent windows are too few for 2 inputs"):
        frequency_response(two, estimator=Welch(8.0))


@pytest.mark.parametrize("estimate", [frequency_response, spectral_density])
def test_records_that_differ_are_not_averaged(estimate):
    faster = Record(TIME / 2, DRAW[:, 0], DRAW[:, 1], DRAW[:, 2])
    renamed = Record(TIME, DRAW[:, 0], DRAW[:, 1], DRAW[:, 2], output_names="q")
    with pytest.raises(ValueError, match="sampled at 50 and 100 Hz: read them with the same"):
        estimate([RECORD, faster])
    with pytest.raises(ValueError, match="different channels"):
        estimate([RECORD, renamed])
    with pytest.raises(ValueError, match="no record is given"):
        estimate([])


def test_single_precision_is_refused_and_the_remedy_named():
    with jax.enable_x64(False):
        with pytest.raises(PrecisionError, match="JAX_ENABLE_X64=1"):
            frequency_response(RECORD)
        narrow = jnp.ones(3)
    with pytest.raises(PrecisionError, match="the inertia is float32: create it after"):
        require_float64("the inertia", narrow)


def test_a_response_in_single_precision_cannot_be_built():
    found = frequency_response(RECORD, OMEGA)
    with pytest.raises(PrecisionError, match="complex64"):
        dataclasses.replace(found, response=found.response.astype(jnp.complex64))


def test_the_reference_decides_which_estimate_is_made():
    assert frequency_response(RECORD, OMEGA).method == "joint"
    assert frequency_response(RECORD, OMEGA, estimator=Welch()).method == "direct"
    alone = Record(TIME, DRAW[:, 0], DRAW[:, 1])
    assert frequency_response(alone, OMEGA).method == "direct"


def test_a_response_prints_its_method_band_and_remarks():
    found = frequency_response(RECORD, OMEGA, estimator=Welch())
    text = str(found)
    assert text.startswith("frequency response, direct estimate (H1, unbiased in open loop; with")
    assert "u -> y: coherence above 0.6 at 0 frequencies" in text
    assert "20 frequencies" in text
    response = 10 ** (found.magnitude_db / 20) * np.exp(1j * np.radians(found.phase_deg))
    np.testing.assert_allclose(response, found.response, rtol=1e-12)
