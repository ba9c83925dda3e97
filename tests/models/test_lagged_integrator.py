"""An axis with the damping of its rate: one more number, of which 0 changes nothing."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import response_of

import jaxquad as jq
from jaxquad.models import evaluate_response, imaginary, parameter_units
from jaxquad.workflows import Identification


OMEGA = jnp.geomspace(0.3, 300.0, 50)
TRUTH = jq.LaggedIntegrator(280.0, 0.03, 0.002, damping=2.1)


@pytest.mark.parametrize("integrators", [1, 2, 3])
@pytest.mark.parametrize("lag", [0.0, 0.03])
def test_damping_stands_in_the_place_of_one_integrator(integrators, lag):
    model = jq.LaggedIntegrator(28.0, lag, 0.01, integrators, 2.1)
    s = 1j * np.asarray(OMEGA)
    wanted = 28 * np.exp(-0.01 * s) / (s ** (integrators - 1) * (s + 2.1) * (lag * s + 1))
    for one in (model, model.transfer_function()):
        np.testing.assert_allclose(evaluate_response(one, OMEGA)[:, 0, 0], wanted, rtol=1e-12)


@pytest.mark.parametrize("integrators", [0, 1, 2, 3])
def test_without_damping_not_one_bit_differs(integrators):
    model = jq.LaggedIntegrator(28.0, 0.03, 0.01, integrators)
    s = imaginary(OMEGA)
    gain, lag, delay = (x.astype(s.dtype) for x in (model.gain, model.lag, model.delay))
    wanted = gain * jnp.exp(-delay * s) / ((lag * s + 1) * s**integrators)
    np.testing.assert_array_equal(evaluate_response(model, OMEGA)[:, 0, 0], wanted)
    denominator = [0.03, 1.0, *[0.0] * integrators]
    assert np.asarray(model.transfer_function().denominator).tolist() == denominator


def test_damping_needs_an_integrator_and_a_sign():
    with pytest.raises(ValueError, match=r"damping is 2.1 1/s, but integrators is 0"):
        jq.LaggedIntegrator(28.0, integrators=0, damping=2.1)
    with pytest.raises(ValueError, match="damping"):
        jq.LaggedIntegrator(28.0, damping=-0.1)
    assert parameter_units(TRUTH, ["damping"]) == ("1/s",)


@pytest.mark.slow
def test_a_fit_names_damping_and_leaves_one_of_zero_alone():
    frf = response_of(TRUTH, error=0.01, seed=0, omega=np.asarray(OMEGA))
    start = jq.LaggedIntegrator(200.0, 0.05, 0.01, damping=1.0)
    fit = jq.fit(start, frf, free=["gain", "damping", "lag", "delay"])
    truth = [280.0, 2.1, 0.03, 0.002]
    assert fit.identifiable
    np.testing.assert_array_less(np.abs(fit.values - truth), 3 * fit.standard_errors)
    assert "damping" in jq.fit(start, frf).names
    assert jq.fit(jq.LaggedIntegrator(200.0, 0.05, 0.01), frf).names == ("gain", "lag", "delay")


@pytest.mark.slow
def test_what_a_held_input_shows_of_it_is_the_exact_sampled_plant():
    """By its partial fractions, one held; 16 aliases leave 4e-6 at 100 rad/s."""
    dt = 0.01
    plant = jq.LaggedIntegrator(28.0, 0.03, damping=2.1)
    frf = response_of(plant, omega=np.geomspace(0.5, 100, 20))
    frf = type(frf)(**{**vars(frf), "hold": dt, "dt": dt})
    sampled = jq.identify.as_sampled(plant, frf)
    z, poles = np.exp(1j * np.asarray(frf.omega) * dt), (2.1, 1 / 0.03)
    slow, fast = ((1 - np.exp(-p * dt)) / p / (z - np.exp(-p * dt)) for p in poles)
    wanted = 28 / 0.03 * (slow - fast) / (poles[1] - poles[0])
    np.testing.assert_allclose(
        evaluate_response(sampled, jnp.asarray(frf.omega))[:, 0, 0], wanted, rtol=1e-5
    )


@pytest.mark.slow
def test_plants_drawn_from_a_fit_are_damped():
    frf = response_of(TRUTH, error=0.01, seed=0, omega=np.asarray(OMEGA))
    fit = jq.fit(TRUTH, frf, free=["gain", "damping", "lag", "delay"])
    posterior = jq.ensembles.Posterior(fit, believed=0.05, recorded_dt=None)
    assert float(posterior.plant.damping[0]) == pytest.approx(0.05 * fit["damping"])
    drawn = posterior.draw(np.random.default_rng(0).normal(size=(4, 400)), 0.01)[0]
    spread = np.std(np.asarray(drawn.damping)) / 0.05
    assert spread == pytest.approx(fit.standard_errors[1], rel=0.15)


@pytest.mark.slow
def test_the_formula_of_a_page_has_it():
    settings = jq.workflows.IdentifySettings(input="M", output="q")
    frf, formulas = response_of(TRUTH, error=0.01, seed=0, omega=np.asarray(OMEGA)), []
    for start in (TRUTH, jq.LaggedIntegrator(280.0, 0.03, 0.002)):
        fits = {"direct": jq.fit(start, frf)}
        found = Identification((Path("log.csv"),), settings, (), {"direct": frf}, fits, {})
        formulas.append(found.formula)
    assert "/ ((s + damping) (lag s + 1))" in formulas[0] and "damping" not in formulas[1]
