"""Fits are solved through optimistix: the same minimum by three solvers, and derivatives of it."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.optimize import least_squares
from synthetic import OMEGA, response_of

import jaxquad as jq
from jaxquad._core import STALLED
from jaxquad.identify import least_squares as minimum_of


TRUTH = jq.LaggedIntegrator(280.0, 0.016, 0.011)
START = jq.LaggedIntegrator(150.0, 0.03, 0.02)


def equation_14(log_values, response):
    """The residuals of Eq. (14), written out with numpy."""
    gain, lag, delay = np.exp(log_values)
    s = 1j * OMEGA
    log = np.log(gain * np.exp(-delay * s) / (s * (lag * s + 1)) / response)
    weight = np.sqrt(20 / OMEGA.size) * 1.58 * (1 - np.exp(-0.95))
    decibels, degrees = np.real(log) * 20 / np.log(10), np.degrees(np.imag(log))
    return weight * np.concatenate([decibels, np.sqrt(0.01745) * degrees])


@pytest.mark.parametrize(
    "solver", [None, optx.GaussNewton(rtol=1e-10, atol=1e-10)], ids=["default", "gn"]
)
def test_the_minimum_of_equation_14_is_that_of_scipy(solver):
    frf = response_of(TRUTH, seed=0)
    fit = jq.fit(START, frf, solver=solver, cost=jq.identify.CoherenceWeighted())
    response = np.asarray(frf.response)[:, 0, 0]
    start = np.log([150.0, 0.03, 0.02])
    peer = least_squares(equation_14, start, args=(response,), method="lm", xtol=1e-12, ftol=1e-12)
    # MINPACK differentiates numerically: its minimum has seven digits or so.
    np.testing.assert_allclose(fit.values, np.exp(peer.x), rtol=1e-6)
    assert fit.cost == pytest.approx(2 * peer.cost, rel=1e-9)


def decay(z, data):
    """Residuals of an exponential; the data do not follow it, so their minimum is not zero."""
    time = jnp.linspace(0.0, 2.0, data.size)
    return z[0] * jnp.exp(-z[1] * time) - data


DATA = 2 * np.exp(-0.7 * np.linspace(0.0, 2.0, 8)) + 0.05 * np.cos(9 * np.arange(8))


@pytest.mark.slow
def test_a_fit_to_one_record_is_one_program_and_it_mixes_what_shares_noise():
    omega, compiled = OMEGA[::2], []

    def listen(event: str, duration_secs: float, **facts: str | int):
        if "backend_compile" in event:
            compiled.append(facts.get("fun_name"))

    precise = {"error": 0.005, "seed": 0, "omega": omega}  # no parameter is near zero
    frfs = [response_of(TRUTH, correlation=c, **precise) for c in (0.0, 0.6)]
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        fits = [jq.fit(START, frf) for frf in frfs]
    finally:
        jax.monitoring.clear_event_listeners()
    assert len(compiled) == 1
    # NumPy, which mixes for itself, sees nothing left to save where the program stopped.
    assert all(fit.newton_decrement < 1e-10 * fit.cost for fit in fits)
    assert fits[1].cost != pytest.approx(fits[0].cost, rel=0.1)


@pytest.mark.slow
def test_the_minimum_has_the_derivatives_of_finite_differences():
    def found(data):
        return minimum_of(decay, jnp.ones(2), data, max_steps=256, tolerance=1e-12).z

    slopes = jax.jit(jax.jacrev(found))(jnp.asarray(DATA))
    moved = DATA + 1e-3 * np.concatenate([np.eye(8), -np.eye(8)])
    above, below = np.split(np.asarray(jax.jit(jax.vmap(found))(moved)), 2)
    # Rounding of the cost leaves the minimum open by 1e-9, and the step's square is 1e-6.
    np.testing.assert_allclose(slopes, (above - below).T / 2e-3, atol=1e-5)


def test_a_wall_of_nan_is_divergence_and_a_start_in_it_ends_there():
    def walled(z, _):
        # falls towards the wall at 1, behind which there is nothing
        return jnp.where(z < 1, 3 - z, jnp.nan)

    for start in (0.0, 2.0):
        found = minimum_of(walled, jnp.asarray([start]), None, max_steps=256, tolerance=1e-8)
        assert not found.converged and int(found.reason) == STALLED
        # the best point that it reached, just before the wall, or the start itself
        assert found.z[0] == pytest.approx(start if start > 1 else 1.0, abs=1e-6)


def test_too_few_steps_are_told_apart_from_a_minimum():
    stop = minimum_of(decay, jnp.ones(2), jnp.asarray(DATA), max_steps=1)
    assert not stop.converged and int(stop.steps) == 1
    assert minimum_of(decay, jnp.ones(2), jnp.asarray(DATA), max_steps=64).converged
