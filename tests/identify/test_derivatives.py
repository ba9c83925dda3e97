"""Derivatives through `jq.fit` are those of fitting again, with other data, priors or constants."""

import dataclasses
import re
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT
from synthetic import OMEGA, response_of

import jaxquad as jq


TRUTH = jq.LaggedIntegrator(280.0, 0.016, 0.011)
START = jq.LaggedIntegrator(150.0, 0.03, 0.02)


class Notched(jq.LaggedIntegrator):
    """What the model of the fits does not explain."""

    def frequency_response(self, omega):
        omega = jnp.asarray(omega)
        s = jax.lax.complex(jnp.zeros_like(omega), omega)
        notch = (s**2 + 3 * s + 900) / (s**2 + 12 * s + 900)
        return super().frequency_response(omega) * notch[:, None, None]


def at(frf, **fields):
    names = list(fields)
    return eqx.tree_at(lambda f: [getattr(f, n) for n in names], frf, list(fields.values()))


def logs(fit):
    return jnp.log(jnp.abs(fit.values))


def assert_slopes_of_refits(estimates, x, *, step=1e-4, rtol=1e-5, seeds=2):
    """Both modes give the same, and what a fifth-order difference of fits gives."""
    reverse = jax.jacrev(estimates)(x)
    for seed in range(seeds):
        way = np.abs(np.asarray(x)) * np.random.default_rng(seed).standard_normal(np.shape(x))
        way = jnp.asarray(way, x.dtype)
        forward = jax.jvp(estimates, (x,), (way,))[1]
        along = np.real(np.tensordot(np.asarray(reverse), np.asarray(way), np.ndim(way)))
        np.testing.assert_allclose(forward, along, rtol=1e-9, atol=1e-12)
        one, two = (
            np.asarray(estimates(x + h * way) - estimates(x - h * way)) / (2 * h)
            for h in (step, 2 * step)
        )
        size = np.max(np.abs(forward))
        np.testing.assert_allclose((4 * one - two) / 3, forward, rtol=rtol, atol=rtol * size)


def test_slopes_by_the_response_are_those_of_refits():
    frf, cost = response_of(TRUTH, seed=1), jq.identify.CoherenceWeighted()
    estimates = lambda y: logs(jq.fit(START, at(frf, response=y), cost=cost))
    assert_slopes_of_refits(estimates, frf.response)


def test_what_has_no_derivative_says_so():
    frf = response_of(TRUTH, seed=1)
    gain = lambda y: jq.fit(START, at(frf, response=y)).model.gain
    both = jnp.stack([frf.response, frf.response])
    for call in (lambda: jax.jit(gain)(frf.response), lambda: jax.vmap(gain)(both)):
        with pytest.raises(ValueError, match="jax.jit and jax.vmap hide"):
            call()
    few = at(frf, random_error=jnp.full((30, 1, 1), 0.9))
    with pytest.raises(ValueError, match="without a minimum has no derivative"):
        jax.grad(lambda e: jq.fit(START, at(frf, random_error=e))["gain"])(few.random_error)

    class Own:
        def weights(self, points, ratio):
            return np.stack([np.asarray(ratio)] * 2, axis=-1)

    with pytest.raises(ValueError, match="Own, or another function of this fit, computes"):
        estimates = lambda y: jq.fit(START, at(frf, response=y), cost=Own()).values
        jax.jacrev(estimates)(frf.response)


def test_a_table_takes_what_is_traced():
    def first(y):
        table = jq.spectra.FrequencyResponse.from_table(OMEGA, y, coherence=0.9, averages=1)
        return table.response[0, 0, 0].real

    y = response_of(TRUTH).response[:, 0, 0]
    slope = np.zeros(OMEGA.size)
    slope[0] = 1
    np.testing.assert_array_equal(jax.grad(first)(y), slope)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["coherence", "likelihood", "shared", "unexplained"])
@pytest.mark.parametrize("field", ["response", "random_error", "coherence"])
def test_slopes_by_each_measured_number(kind, field):
    model = Notched(280.0, 0.016, 0.011) if kind == "unexplained" else TRUTH
    correlation = 0.6 if kind in ("shared", "unexplained") else 0.0
    frf = response_of(model, seed=3, correlation=correlation)
    cost = jq.identify.MaximumLikelihood()
    if kind == "coherence":
        cost = jq.identify.CoherenceWeighted()
    if kind == "unexplained":
        discrepancy = jq.fit(START, frf).discrepancy
        assert discrepancy is not None and discrepancy.none < 0.05

    def estimates(x):
        return logs(jq.fit(START, at(frf, **{field: x}), cost=cost))

    assert_slopes_of_refits(estimates, getattr(frf, field), step=1e-5)


@pytest.mark.slow
def test_slopes_by_a_fixed_parameter_and_a_tie():
    frf = response_of(TRUTH, seed=2)
    free, tied = ["gain", "lag"], {"damping": lambda m: 0.1 * m.delay / m.lag}

    def estimates(delay):
        model = jq.LaggedIntegrator(150.0, 0.03, delay, damping=0.1)
        fit = jq.fit(model, frf, free=free, tied=tied)
        return jnp.stack([fit["gain"], fit["lag"], fit.model.delay, fit.model.damping])

    assert_slopes_of_refits(estimates, jnp.asarray(0.012))


@pytest.mark.slow
def test_slopes_by_priors_and_known_changes_of_several_records():
    frfs = [
        response_of(TRUTH, seed=5),
        response_of(jq.LaggedIntegrator(140.0, 0.016, 0.011), seed=6),
    ]

    def estimates(x):
        prior = jq.identify.Prior("delay", 0.01 * x[0], 0.0005 * x[1])
        change = jq.identify.Changed("gain", times=0.5 * x[2])
        return logs(jq.fit(START, frfs, priors=[prior], conditions=[None, change]))

    assert_slopes_of_refits(estimates, jnp.ones(3))


@pytest.mark.slow
def test_second_derivatives_are_the_slopes_of_the_first():
    frf, cost = response_of(TRUTH, seed=1), jq.identify.CoherenceWeighted()

    def lag(scale):
        y = frf.response * jnp.exp(scale * jnp.cos(jnp.asarray(OMEGA)))[:, None, None].astype(
            complex
        )
        return jq.fit(START, at(frf, response=y), cost=cost)["lag"]

    slope, here, h = jax.grad(lag), jnp.asarray(0.05), 1e-4
    change = (slope(here + h) - slope(here - h)) / (2 * h)
    np.testing.assert_allclose(jax.hessian(lag)(here), change, rtol=1e-5)


@pytest.mark.slow
def test_a_lag_at_zero_stays_there_and_the_others_move():
    frf = response_of(jq.LaggedIntegrator(280.0, 0.0, 0.011), seed=8)
    assert jq.fit(START, frf).values[1] == 0

    def estimates(y):
        gain, lag, delay = jq.fit(START, at(frf, response=y)).values
        return jnp.stack([jnp.log(gain), lag, jnp.log(delay)])

    # Where the lag is at zero, small steps leave it there.
    assert_slopes_of_refits(estimates, frf.response, step=1e-6, rtol=1e-4)


@pytest.mark.slow
def test_the_guide_says_which_frequency_would_have_helped_the_tuned_loop_most():
    sweep = jq.sweep(0.5, 30.0, duration=60.0, sample_rate=100.0, amplitude=1.0)
    model = jq.LaggedIntegrator(80.0, 0.03, 0.02)
    q = jq.models.simulate_linear(model.transfer_function(), sweep.signal, 0.01)
    q = q + np.random.default_rng(0).normal(0, 0.3, q.shape)
    record = jq.Record(sweep.time, sweep.signal, q, input_names="M", output_names="q", hold="dt")
    response = jq.frequency_response(record)
    page = (ROOT / "docs" / "tuning.md").read_text()
    names = {
        "start": jq.LaggedIntegrator(20.0, 0.1, 0.01),
        "response": response,
        "tuned": SimpleNamespace(controller=jq.LADRC(3.0, 15.0, 80.0)),
        "flight": jq.scenario(duration=4.0, axes=1, reference=jq.Step(np.radians(4.0))),
    } | {module.__name__: module for module in (dataclasses, jax)}
    code = re.search(r"```python\n(def itae.*?)```", page, flags=re.S)
    assert code is not None
    names |= {"jq": jq, "np": np}
    with jax.numpy_dtype_promotion("standard"):
        exec(code[1], names)
    assert_slopes_of_refits(names["itae"], response.response, rtol=1e-5, seeds=1)
