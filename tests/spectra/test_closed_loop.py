"""The bias by feedback towards -1/C, and the plant out of a known loop."""

import numpy as np
import pytest
from scipy import signal
from synthetic import response_of

import jaxquad as jq


RATE, SAMPLES = 50.0, 6000
OMEGA = np.geomspace(2.0, 60.0, 25)
WELCH = jq.spectra.Welch(8.0)
GAIN = 0.5  # of the controller


def filtered(numerator, denominator, x):
    return np.asarray(signal.lfilter(numerator, denominator, x))


def flight(deviation, seed=0):
    """y = 0.4 / (z - 0.8) u + e under u = r - y / 2."""
    r, e = np.random.default_rng(seed).standard_normal((2, SAMPLES)) * np.array([[1], [deviation]])
    fed_back = r - GAIN * e
    u = filtered([1.0, -0.8], [1.0, -0.6], fed_back)
    y = filtered([0.0, 0.4], [1.0, -0.6], fed_back) + e
    return jq.Record(np.arange(SAMPLES) / RATE, u, y, r)


def plant():
    return 0.4 / (np.exp(1j * OMEGA / RATE) - 0.8)


def test_the_direct_estimate_lies_between_the_plant_and_minus_one_over_the_controller():
    found = jq.spectra.feedback_bias(flight(2.0), OMEGA, welch=WELCH)
    mixed = (1 - found.noise_share) * found.joint + found.noise_share * found.inverse
    np.testing.assert_allclose(found.direct, mixed, rtol=1e-9)


def test_what_the_reference_does_not_explain_shows_the_controller():
    found = jq.spectra.feedback_bias(flight(2.0), OMEGA, welch=WELCH)
    # 15 independent windows leave some 15 % of random error.
    assert np.median(np.abs(GAIN * found.inverse + 1)) < 0.2
    assert np.median(np.abs(found.joint / plant() - 1)) < 0.4
    assert np.median(np.abs(found.joint + 1 / GAIN)) > 0.5 / GAIN


def test_the_pull_is_the_share_of_the_input_that_noise_makes():
    found = jq.spectra.feedback_bias(flight(2.0), OMEGA, welch=WELCH)
    # u = (r - e / 2) (1 - 0.8 / z) / (1 - 0.6 / z): 1 of noise to 1 of the reference.
    assert np.mean(found.noise_share) == pytest.approx(0.5, abs=0.1)
    assert "use the joint estimate" in str(found)


def test_without_noise_there_is_no_pull():
    found = jq.spectra.feedback_bias(flight(1e-4), OMEGA, welch=WELCH)
    assert np.max(found.noise_share) < 1e-2
    assert np.max(np.abs(found.bias)) < 1e-2
    assert "use the joint estimate" not in str(found)


def test_the_bias_needs_one_input_one_output_and_a_reference():
    record = flight(1.0)
    with pytest.raises(ValueError, match="needs one external reference"):
        jq.spectra.feedback_bias(jq.Record(record.time, record.inputs, record.outputs), OMEGA)
    two = np.hstack([record.outputs, 2 * record.outputs + record.inputs])
    with pytest.raises(ValueError, match="needs one input and one output"):
        jq.spectra.feedback_bias(
            jq.Record(record.time, record.inputs, two, record.references), OMEGA
        )


G = jq.TransferFunction([18.0], [0.05, 1.0, 0.0], 0.02)
C = jq.TransferFunction([0.1, 0.5], [0.02, 1.0])


class Loop:
    """The closed loop as a model, by `entry` of the signal."""

    def __init__(self, entry):
        self.entry = entry

    def frequency_response(self, omega):
        g, c = G.frequency_response(omega), C.frequency_response(omega)
        return (g * c if self.entry == "set-point" else g) / (1 + g * c)


@pytest.mark.parametrize("entry", ["set-point", "plant input"])
def test_the_plant_comes_out_of_its_loop(entry):
    found = jq.spectra.deembed(response_of(Loop(entry)), C, entry=entry)
    np.testing.assert_allclose(found.response, G.frequency_response(found.omega), rtol=1e-10)


@pytest.mark.parametrize("entry", ["set-point", "plant input"])
def test_the_errors_of_the_plant_are_its_scatter(entry):
    loop = Loop(entry)
    found = [
        jq.spectra.deembed(response_of(loop, error=0.01, seed=k), C, entry=entry)
        for k in range(150)
    ]
    responses = np.stack([np.asarray(f.response)[:, 0, 0] for f in found])
    error = np.std(responses / responses.mean(axis=0), axis=0) / np.sqrt(2)
    predicted = np.mean([np.asarray(f.random_error)[:, 0, 0] for f in found], axis=0)
    np.testing.assert_allclose(predicted / error, 1.0, atol=0.25)
    exact = jq.spectra.deembed(response_of(loop, error=0.01), C, entry=entry)
    twice = 2 * np.asarray(exact.random_error)[:, 0, 0] ** 2
    np.testing.assert_allclose(np.diag(exact.relative_covariance()), twice, rtol=1e-9)


def test_where_the_loop_hides_the_plant_a_remark_says_so():
    stiff = jq.TransferFunction([40.0], [1.0])

    class Tight:
        def frequency_response(self, omega):
            g, c = G.frequency_response(omega), stiff.frequency_response(omega)
            return g * c / (1 + g * c)

    found = jq.spectra.deembed(response_of(Tight(), error=0.01), stiff)
    assert any("hardly depends on the plant at" in remark for remark in found.remarks)


def test_several_channels_are_refused():
    two = jq.StateSpace(F=[[-1.0]], G=[[1.0]], H0=[[1.0], [2.0]])
    with pytest.raises(ValueError, match=r"shape \(30, 2, 1\) .* controller's \(30, 1, 1\)"):
        jq.spectra.deembed(response_of(two), C)
