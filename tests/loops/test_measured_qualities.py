"""Handling qualities of measured responses, and their standard errors."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from ratios import delayed_integrator, ratio
from synthetic import OMEGA, response_of

from jaxquad.loops import attitude_bandwidth, disturbance_rejection, margins


pytestmark = pytest.mark.usefixtures("compiled_quickly")
MEASURED = ratio([4.0], [0.05, 1.0, 0.0], 0.12)
BAND = np.geomspace(0.5, 40.0, 30)


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


def test_frequencies_without_a_number_are_left_out_and_others_can_be():
    frf = response_of(MEASURED)
    holes = eqx.tree_at(lambda f: f.response, frf, frf.response.at[3].set(jnp.nan))
    assert "1 measured frequencies without a number" in str(margins(holes))
    some = margins(frf, omega=OMEGA[1:])
    assert some.basis.band[0] == OMEGA[1]
    with pytest.raises(ValueError, match="nothing was measured"):
        margins(frf, omega=np.array([1.0, 2.0, 3.0]))


@pytest.mark.slow
def test_bad_input_is_refused_by_name():
    model = delayed_integrator(1.0, 0.1)
    with pytest.raises(ValueError, match="quantity is 'angle'"):
        attitude_bandwidth(model, quantity="angle")
    with pytest.raises(ValueError, match="quantity is 'T'"):
        disturbance_rejection(model, quantity="T")
    with pytest.raises(ValueError, match="rising"):
        margins(model, omega=np.array([3.0, 2.0, 1.0]))
    with pytest.raises(ValueError, match="output is 'p'"):
        margins(response_of(model), output="p")
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
