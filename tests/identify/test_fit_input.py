"""Bad input to a fit: one clear error each, that names the value and what to do."""

import dataclasses
import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import response_of

import jaxquad as jq


START = jq.LaggedIntegrator(150.0, 0.03, 0.02)
untyped_fit = inspect.unwrap(jq.fit)  # as without the test suite's check of types


@pytest.fixture(scope="module")
def frf():
    return response_of(jq.LaggedIntegrator(280.0, 0.016, 0.011))


def refuse(match, frf, error=ValueError, model=START, **options):
    with pytest.raises(error, match=match):
        jq.fit(model, frf, **options)


def test_an_unknown_parameter_is_named_beside_those_that_exist(frf):
    refuse("no parameter 'gian' in the model; it has: gain, lag, delay", frf, free=("gian",))


def test_a_start_at_zero_asks_for_a_sign(frf):
    refuse(
        r"lag starts at 0.*jq.identify.Real\('lag', scale=",
        frf,
        model=jq.LaggedIntegrator(1.0),
        free=("lag",),
    )
    refuse(
        r"lag starts at 0: give its typical size",
        frf,
        model=jq.LaggedIntegrator(1.0),
        free=(jq.identify.Real("lag"),),
    )


def test_nothing_free_or_the_same_twice_is_refused(frf):
    refuse("name each free parameter once", frf, free=())
    refuse("name each free parameter once", frf, free=("gain", "gain"))


def test_an_empty_band_says_where_the_response_is(frf):
    refuse("band .* holds none .* from 0.5 to 20 rad/s", frf, band=(100.0, 200.0))
    refuse("band .* holds none", frf, band=(5.0, 1.0))


def test_zero_coherence_is_not_identifiable(frf):
    silent = eqx.tree_at(lambda f: f.coherence, frf, jnp.zeros_like(frf.coherence))
    fit = jq.fit(START, silent)
    assert fit.verdict.kind == "too few points" and not fit.identifiable
    assert "coherence reaches 0.6, with a random error below 30 %, at 0 of 30" in str(fit)
    direct = dataclasses.replace(silent, method="direct")
    assert "coherence reaches 0.6" in str(jq.fit(START, direct))
    by_14 = jq.fit(START, direct, cost=jq.identify.CoherenceWeighted())
    assert "coherence reaches 0.6" in str(by_14)
    np.testing.assert_allclose(fit.values, [150.0, 0.03, 0.02], rtol=1e-12)
    assert np.isinf(fit.standard_errors).all() and not fit.determined.any()
    with pytest.raises(jq.identify.UndeterminedError, match="gain has no value"):
        fit.derived(lambda m: m.gain, "gain")
    with pytest.raises(jq.identify.UndeterminedError, match="nothing to draw from"):
        fit.ensemble(3, jax.random.key(0), hold_undetermined=True)


def test_a_prior_needs_a_cost_with_noise(frf):
    refuse(
        "a prior needs a cost that knows the noise",
        frf,
        priors=[jq.identify.Prior("lag", 0.02, 0.001)],
        cost=jq.identify.CoherenceWeighted(),
    )
    refuse(
        "no parameter 'lagg' for a prior",
        frf,
        priors=[jq.identify.Prior("lagg", 0.02, 0.001)],
    )
    with pytest.raises(ValueError, match="positive standard error"):
        jq.identify.Prior("lag", 0.02, 0.0)


def test_every_response_needs_a_condition_and_counts_once(frf):
    other = response_of(jq.LaggedIntegrator(280.0, 0.016, 0.011), seed=1)
    refuse("1 conditions for 2 responses", (frf, other), conditions=(None,))
    refuse("response 1 of 2 is given twice", (frf, frf))


def test_what_is_no_response_is_named():
    with pytest.raises(ValueError, match="a list of them, not nothing"):
        untyped_fit(START, [])
    with pytest.raises(ValueError, match="not LaggedIntegrator.*jq.fit"):
        untyped_fit(START, START)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"cost": jq.identify.MaximumLikelihood}, "pass an object, jq.identify.MaximumL"),
        ({"cost": "ml"}, "cost='ml': pass an object"),
        ({"band": 5.0}, "band=5.0: give two frequencies"),
        ({"min_coherence": 2.0}, "min_coherence is 2.0"),
        ({"max_steps": 0}, "max_steps is 0"),
    ],
)
def test_options_that_make_no_sense_are_refused(frf, options, match):
    with pytest.raises(ValueError, match=match):
        untyped_fit(START, frf, **options)


def test_a_prior_on_what_is_not_free_is_refused(frf):
    refuse(
        "prior 1 is on a quantity that no free parameter changes",
        frf,
        free=("gain",),
        priors=[jq.identify.Prior("lag", 0.02, 0.001)],
    )


def test_a_model_of_another_shape_is_refused(frf):
    two = eqx.tree_at(lambda f: f.response, frf, jnp.tile(frf.response, (1, 2, 1)))
    two = eqx.tree_at(lambda f: f.coherence, two, jnp.tile(frf.coherence, (1, 2, 1)))
    two = eqx.tree_at(lambda f: f.random_error, two, jnp.tile(frf.random_error, (1, 2, 1)))
    errors = jq.spectra.independent_errors(frf.omega, jnp.abs(two.response) ** 2)
    two = eqx.tree_at(lambda f: f.errors, two, errors)
    refuse(r"response has shape \(30, 1, 1\), the measured one \(30, 2, 1\)", two)


def test_float32_is_refused_with_the_way_out(frf):
    with jax.enable_x64(False):
        refuse("JAX_ENABLE_X64=1", frf, error=jq._core.PrecisionError)
    single = eqx.tree_at(lambda m: m.lag, START, np.float32(0.03) * jnp.ones((), jnp.float32))
    refuse("parameter lag is float32", frf, error=jq._core.PrecisionError, model=single)
