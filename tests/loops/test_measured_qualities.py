"""Handling qualities of measured responses, their standard errors, and rms values."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from ratios import delayed_integrator, ratio
from scipy.integrate import quad
from scipy.linalg import solve_continuous_lyapunov
from scipy.signal import tf2ss
from synthetic import OMEGA, response_of

from jaxquad.loops import attitude_bandwidth, disturbance_rejection, margins, rms_response


pytestmark = pytest.mark.usefixtures("compiled_quickly")
MEASURED = ratio([4.0], [0.05, 1.0, 0.0], 0.12)
BAND = np.geomspace(0.5, 40.0, 30)


def white_rms(frf):
    return rms_response(frf, 1.0)


@pytest.mark.slow
def test_a_measured_response_without_noise_gives_the_model_s_numbers():
    frf, model = response_of(MEASURED, error=1e-3, omega=BAND), MEASURED
    for name in ("phase_bandwidth", "gain_bandwidth", "omega_180", "phase_delay"):
        measured = float(getattr(attitude_bandwidth(frf), name))
        # Straight lines over steps of 16 % in frequency.
        assert measured == pytest.approx(float(getattr(attitude_bandwidth(model), name)), rel=0.02)
    assert margins(frf).phase_margin == pytest.approx(float(margins(model).phase_margin), abs=0.01)


SCATTERED = {
    attitude_bandwidth: (
        *("phase_bandwidth", "gain_bandwidth", "omega_180"),
        *("phase_delay", "phase_delay_fit"),
    ),
    margins: ("phase_margin", "crossover", "delay_margin", "gain_margin"),
    disturbance_rejection: ("bandwidth", "peak"),
    white_rms: ("rms",),
}


@pytest.mark.slow
@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_standard_errors_are_the_scatter(correlation):
    noise = {"error": 0.01, "correlation": correlation, "omega": BAND}
    draws = [response_of(MEASURED, seed=seed, **noise) for seed in range(200)]
    for estimate, names in SCATTERED.items():
        results = [estimate(draw) for draw in draws]
        for name in names:
            values = np.array([float(getattr(result, name)) for result in results])
            errors = np.array([float(result.standard_errors[name]) for result in results])
            stated = np.sqrt(np.mean(errors**2))
            # Of 200 draws, one sigma is 5 %.
            assert stated == pytest.approx(np.std(values), rel=0.2), name


@pytest.mark.slow
def test_poor_coherence_at_a_crossing_is_remarked():
    frf = response_of(MEASURED)
    assert "coherence" not in str(attitude_bandwidth(frf))
    poor = jnp.where(jnp.asarray(OMEGA)[:, None, None] > 4.0, 0.3, 0.95)
    poor = eqx.tree_at(lambda f: f.coherence, frf, poor)
    assert "coherence at the omega_180 is 0.30" in str(attitude_bandwidth(poor))
    assert "coherence at the phase_crossover is 0.30" in str(margins(poor))
    assert "below 0.6" in str(rms_response(poor, lambda omega: omega**3))


def test_frequencies_without_a_number_are_left_out_and_others_can_be():
    frf = response_of(MEASURED)
    holes = eqx.tree_at(lambda f: f.response, frf, frf.response.at[3].set(jnp.nan))
    assert "1 measured frequencies without a number" in str(white_rms(holes))
    some = rms_response(frf, 1.0, omega=OMEGA[1:])
    assert some.basis.band[0] == OMEGA[1]
    with pytest.raises(ValueError, match="nothing was measured"):
        margins(frf, omega=np.array([1.0, 2.0, 3.0]))


def test_rms_under_white_noise_is_the_h2_norm():
    b, a = [3.0, 1.0], np.polymul([1.0, 0.4, 4.0], [0.2, 1.0])
    A, B, C, _ = tf2ss(b, a)
    norm = np.sqrt((C @ solve_continuous_lyapunov(A, -B @ B.T) @ C.T).item())
    grid = np.geomspace(1e-5, 1e7, 2000)
    two = rms_response(ratio(b, a), 1.0, sides="two", omega=grid)
    assert two.rms == pytest.approx(norm, rel=1e-6)  # the band leaves out 1e-5 of the frequencies
    assert two.integration_error < 1e-9 and two.remarks == ()
    one = rms_response(ratio(b, a), 2.0, omega=grid)
    assert one.rms == pytest.approx(float(two.rms), rel=1e-12)


def test_rms_under_a_shaped_spectrum_is_quadrature():
    model = ratio([2.0], [1.0, 0.6, 4.0])
    power = quad(
        lambda w: 4 / ((4 - w**2) ** 2 + (0.6 * w) ** 2) / (1 + w**2), 0.01, 1000, limit=500
    )
    expected = np.sqrt(power[0] / (2 * np.pi))
    found = rms_response(model, lambda omega: 1 / (1 + omega**2))
    assert found.rms == pytest.approx(expected, rel=1e-9)
    listed = rms_response(model, 1 / (1 + np.geomspace(0.01, 1000, 2000) ** 2))
    assert listed.rms == pytest.approx(expected, rel=1e-5)  # a power law between its points


@pytest.mark.slow
def test_measured_rms_is_free_of_what_noise_adds():
    truth = float(rms_response(response_of(MEASURED, error=0.0), 1.0).rms)
    draws = [rms_response(response_of(MEASURED, error=0.25, seed=k), 1.0).rms for k in range(200)]
    power = np.mean(np.square(draws))
    scatter = np.std(np.square(draws)) / np.sqrt(200)
    assert power == pytest.approx(truth**2, abs=4 * scatter)
    assert scatter < 0.03 * truth**2  # the noise adds 12 %


@pytest.mark.slow
def test_bad_input_is_refused_by_name():
    model = delayed_integrator(1.0, 0.1)
    with pytest.raises(ValueError, match="quantity is 'angle'"):
        attitude_bandwidth(model, quantity="angle")
    with pytest.raises(ValueError, match="quantity is 'T'"):
        disturbance_rejection(model, quantity="T")
    with pytest.raises(ValueError, match="sides is 'both'"):
        rms_response(model, 1.0, sides="both")
    with pytest.raises(ValueError, match="rising"):
        margins(model, omega=np.array([3.0, 2.0, 1.0]))
    with pytest.raises(ValueError, match="output is 'p'"):
        margins(response_of(model), output="p")
    with pytest.raises(ValueError, match="goes down to -1"):
        rms_response(model, -1.0)
    with pytest.raises(ValueError, match="not finite at 1 rad/s"):
        margins(ratio([1.0], [1.0, 0.0, 1.0]), omega=np.array([0.5, 1.0, 2.0]))


@pytest.mark.slow
def test_a_model_that_is_no_pytree_is_evaluated_anew():
    class Plain:
        gain = 1.0

        def frequency_response(self, omega):
            return delayed_integrator(self.gain, 0.1).frequency_response(omega)

    plain = Plain()
    before = float(margins(plain).crossover)
    plain.gain = 2.0
    assert float(margins(plain).crossover) == pytest.approx(2 * before, rel=1e-12)
