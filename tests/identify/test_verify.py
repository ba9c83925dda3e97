"""Time-domain verification against signals made by scipy."""

import functools as ft

import equinox as eqx
import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim, tf2ss

import jaxquad as jq
from jaxquad.models import StateSpace
from jaxquad.plot import compare, headless


pytestmark = pytest.mark.slow


DT = 0.01
MODEL = jq.LaggedIntegrator(30.0, 0.05, 0.03)  # the delay is three samples
TIME = np.arange(1500) * DT


def flight(seed=0, noise=0.0):
    """The model's own output under held inputs, by scipy's discretisation."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], 50), 30)
    discrete = cont2discrete(tf2ss([30.0], [0.05, 1.0, 0.0]), DT, method="zoh")
    late = np.concatenate([np.full(3, u[0]), u[:-3]])
    y = dlsim(discrete, late, t=TIME)[1][:, 0]
    return u, y + noise * rng.standard_normal(TIME.size)


def test_a_true_model_fits_entirely():
    u, y = flight()
    check = jq.verify(MODEL, jq.Record(TIME, u, y), hold="zero")
    assert check.fit_percent == pytest.approx(100, abs=1e-6)
    assert check.tic < 1e-8 and check.rms < 1e-8


def test_input_bias_and_reference_shift_are_estimated():
    """A bias of the input drifts through the integrator; the output starts anywhere."""
    u, y = flight()
    check = jq.verify(MODEL, jq.Record(TIME, u + 0.2, y + 5.0), hold="zero")
    assert check.fit_percent == pytest.approx(100, abs=1e-5)
    assert np.any(np.abs(check.bias) > 0)


def test_the_measures_are_those_of_the_textbook():
    u, y = flight(noise=0.3)
    check = jq.verify(MODEL, jq.Record(TIME, u, y), hold="zero")
    error = check.measured - check.simulated
    rms = np.sqrt(np.mean(error**2))
    sizes = np.sqrt(np.mean(check.measured**2)) + np.sqrt(np.mean(check.simulated**2))
    spread = np.linalg.norm(check.measured - check.measured.mean())
    assert check.rms == pytest.approx(rms, rel=1e-12)
    assert check.tic == pytest.approx(rms / sizes, rel=1e-12)
    assert check.fit_percent == pytest.approx(100 * (1 - np.linalg.norm(error) / spread), rel=1e-9)
    assert check.variance_percent == pytest.approx(
        100 * (1 - np.sum(error**2) / spread**2), rel=1e-9
    )
    # Only the noise is left: 0.3, less the few estimated numbers.
    assert check.rms == pytest.approx(0.3, rel=0.05)


def test_a_wrong_gain_shows():
    u, y = flight()
    wrong = jq.LaggedIntegrator(36.0, 0.05, 0.03)
    check = jq.verify(wrong, jq.Record(TIME, u, y), hold="zero")
    assert 70 < check.fit_percent < 90 and check.tic > 0.05


def test_a_band_leaves_drift_out():
    u, y = flight()
    drift = 8 * np.sin(0.4 * TIME)
    record = jq.Record(TIME, u, y + drift, output_names="q", output_units="rad/s")
    whole, band = jq.verify(MODEL, record), jq.verify(MODEL, record, band=(3.0, 60.0))
    assert band.fit_percent > 90 > whole.fit_percent
    assert "3..60 rad/s" in str(band) and "whole band" in str(whole)
    assert "rad/s" in str(band).rsplit("J_rms", 1)[1]


def test_the_half_sample_of_a_held_input_is_counted_once():
    """An identified delay contains it: straight inputs, the default, do not add it again."""
    u, y = flight()
    identified = jq.LaggedIntegrator(30.0, 0.05, 0.03 + DT / 2)
    record = jq.Record(TIME, u, y)
    default, held = jq.verify(identified, record), jq.verify(identified, record, hold="zero")
    assert default.fit_percent > 99.8 > held.fit_percent


def test_models_and_bands_that_cannot_be_verified_are_refused():
    u, y = flight()
    record = jq.Record(TIME, u, y)
    with pytest.raises(ValueError, match="has no transfer_function"):
        jq.verify(object(), record)
    with pytest.raises(ValueError, match=r"1 \.\. 400 .* frequency 314.2 rad/s \(50 Hz\)"):
        jq.verify(MODEL, record, band=(1.0, 400.0))
    two = jq.Record(TIME, np.stack([u, u + 1], axis=1), y)
    with pytest.raises(ValueError, match="one input and one output"):
        jq.verify(MODEL, two)


def test_the_antx_model_verifies_on_the_other_flight(data):
    """Fitted on the PRBS flight, verified on the sweep flight, between 0.7 and 12 Hz."""
    band = (2 * np.pi * 0.7, 2 * np.pi * 12)
    read = ft.partial(jq.read, inputs="M", outputs="q", references="x0", sample_rate=250.0)
    prbs = read(data / "antx_pitch/antx_log3_prbs.npz", start=50.0, stop=76.0)
    sweep = read(data / "antx_pitch/antx_log2_sweep.npz", start=132.8, stop=158.0)
    estimator = jq.spectra.JointInputOutput(jq.spectra.Welch(integrators=1, delay=0.024))
    frf = jq.frequency_response(prbs, np.geomspace(*band, 80), estimator=estimator)
    fit = jq.fit(jq.LaggedIntegrator(200.0, 0.02, 0.01), frf)
    late = fit.derived(lambda m: m.lag + m.delay)
    assert 270 < fit.values[0] < 295 and 0.024 < late.value < 0.029
    check = jq.verify(fit.model, sweep, band=band)
    # 75 % of the variance; by the norm of the error that is 50 %.
    assert check.variance_percent > 75 and check.tic < 0.25


def aircraft():
    """Two inputs, three outputs: a fast lag, a resonance and an integrator."""
    F = np.array([[-25.0, 0, 0, 0], [4, -1, 6, 0], [0, -6, -1, 0], [0, 1, 0, 0]])
    G = np.array([[25.0, 0], [0, 2], [0, 0], [0, 0]])
    H0 = np.array([[0, 1.0, 0, 0], [0, 0, 0, 1], [0, 0, 1, 0]])
    return StateSpace(F=F, G=G, H0=H0, input_delay=(0.03, 0.02))


def flown(noise=(0.0, 0.0, 0.0), trim=0.0):
    """Under held inputs that stand `trim` beside the record's, by scipy, from a state in motion."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.choice([-1.0, 1.0], (50, 2)), 30, axis=0)
    model = aircraft()
    system = tuple(np.asarray(part) for part in (model.F, model.G, model.H0, np.zeros((3, 2))))
    late = [np.concatenate([np.full(n, x[0]), x[:-n]]) for n, x in zip((3, 2), u.T, strict=True)]
    x0 = np.array([0.5, -0.3, 0.2, 1.0])
    y = dlsim(cont2discrete(system, DT), np.stack(late, axis=1) + trim, x0=x0)[1]
    y = y + noise * rng.standard_normal(y.shape)
    names, units = ("p", "phi", "a_y"), ("rad/s", "rad", "m/s^2")
    return jq.Record(TIME, u, y, output_names=names, output_units=units)


def test_several_inputs_and_outputs_share_their_biases():
    check = jq.verify(aircraft(), flown(trim=0.1), hold="zero")
    assert check.fit_percent == pytest.approx(100, abs=1e-5)
    assert check.measured.shape == check.simulated.shape == (TIME.size, 3)
    assert check.bias.shape == check.initial.shape == (4,) and check.omitted == 0


def test_each_output_has_its_measures_and_weights_join_them():
    size, weights = np.array([0.02, 0.1, 0.05]), np.array([1.0, 0.25, 4.0])
    check = jq.verify(aircraft(), flown(noise=size), hold="zero", weights=weights.tolist())
    found = [one.rms for one in check.outputs]
    np.testing.assert_allclose(found, size, rtol=0.05)  # 1500 samples
    assert check.rms == pytest.approx(np.sqrt(np.mean(weights * np.square(found))), rel=1e-12)
    assert [one.name for one in check.outputs] == ["p", "phi", "a_y"] and check.output_unit == ""
    assert str(check).count("TIC") == 4
    with headless():
        assert len(compare(check)) == 6
    with pytest.raises(ValueError, match="one positive number for each output"):
        jq.verify(aircraft(), flown(), weights=(1.0, 2.0))


class Aircraft(eqx.Module):
    damping: float

    def state_space(self):
        return aircraft()


def test_a_model_with_a_state_space_is_simulated_as_that():
    record = flown(noise=(0.02, 0.1, 0.05))
    direct, by_method = jq.verify(aircraft(), record), jq.verify(Aircraft(1.0), record)
    np.testing.assert_allclose(direct.simulated, by_method.simulated, rtol=0, atol=1e-12)


def test_a_drift_does_not_pass_for_a_fast_transient_at_the_start():
    """A random walk is as far off at the start as elsewhere: no spike of a motor's lag mends it."""
    u = flight()[0]
    y = np.asarray(jq.models.simulate_linear(MODEL.transfer_function(), u - u[0], DT))
    walk = np.cumsum(np.random.default_rng(3).standard_normal(TIME.size)) * 0.2
    check = jq.verify(MODEL, jq.Record(TIME, u, y + walk + 2.0), hold="zero")
    assert check.omitted == 1
    wander = (check.simulated - y)[:15]  # three lags
    assert np.ptp(wander) < 0.1 * np.std(check.measured - check.simulated)


def test_a_fit_is_verified_in_the_band_that_it_used():
    u, y = flight(noise=0.02)
    fit = jq.fit(MODEL, jq.frequency_response(jq.Record(TIME, u, y, hold=DT)), band=(1.0, 30.0))
    other, answer = flight(seed=1)
    drift = jq.Record(TIME, other, answer + 10.0 * np.sin(0.3 * TIME), hold=DT)
    assert fit.used_band is not None
    low, high = fit.used_band
    assert 1.0 <= low < 2.0 and 25.0 < high <= 30.0
    check = jq.verify(fit, drift)
    assert check.band == fit.used_band and check.fit_percent > 95
    assert check.rms == fit(drift).rms == jq.verify(fit.model, drift, band=fit.used_band).rms
    assert jq.verify(fit.model, drift).fit_percent < check.fit_percent - 5


def test_a_fit_that_fitted_nothing_is_not_verified():
    rng = np.random.default_rng(0)
    still = jq.Record(TIME, rng.standard_normal(TIME.size), rng.standard_normal(TIME.size))
    fit = jq.fit(MODEL, jq.frequency_response(still))
    assert not fit.verdict.fitted
    with pytest.raises(jq.identify.UndeterminedError, match="a verification needs a model"):
        jq.verify(fit, still)
