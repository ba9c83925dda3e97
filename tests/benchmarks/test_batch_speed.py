"""A thousand fits of one transfer function in one call, beside scipy and numba, in one run.

    python -m pytest tests/benchmarks/test_batch_speed.py -o addopts= --benchmark-columns=min,median

Gain, lag, damping, natural frequency and delay as logarithms, 60 frequencies, truths spread by
30 % around the common start, noise after the coherence. scipy and numba minimise the linear
misfit over its random error, which is cheaper than our logarithm of the ratio and has nearly the
same minimum: each is only held to the truth. numba is timed where it is installed.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from airframe import Airframe
from scipy.optimize import least_squares

import jaxquad as jq


jax.config.update("jax_enable_x64", True)

OMEGA = np.geomspace(0.6, 40.0, 60)
START = np.array([18.0, 0.045, 0.55, 7.0, 0.018])
FITS = 1000


def _response(values):
    K, tau, zeta, wn, delay = values
    s = 1j * OMEGA
    return K * wn**2 / (s * s + 2 * zeta * wn * s + wn**2) / (tau * s + 1) * np.exp(-delay * s)


@pytest.fixture(scope="module")
def case():
    rng = np.random.default_rng(1)
    truth = START * np.exp(rng.uniform(-0.3, 0.3, (FITS, 5)))
    exact = np.array([_response(values) for values in truth])
    coherence = np.clip(0.995 * np.exp(-((OMEGA / 60) ** 2)), 0.3, 0.999)
    error = np.broadcast_to(np.sqrt((1 - coherence) / (36 * coherence)), exact.shape)
    white = rng.standard_normal((2, *exact.shape))
    return truth, exact * (1 + error * (white[0] + 1j * white[1])), error


def frf_of(measured, error):
    response, one = jnp.asarray(measured)[:, None, None], jnp.ones((OMEGA.size, 1, 1))
    errors = 2 * jnp.asarray(error)[:, None, None] ** 2 * jnp.abs(response) ** 2
    return jq.spectra.FrequencyResponse(
        omega=jnp.asarray(OMEGA),
        response=response,
        coherence=0.95 * one,
        random_error=jnp.asarray(error)[:, None, None],
        errors=jq.spectra.independent_errors(jnp.asarray(OMEGA), errors),
        direct_coherence=0.95 * one,
        multiple_coherence=0.95 * one[:, 0],
        method="joint",
        input_names=("u",),
        output_names=("y",),
    )


def _good(values, truth):
    return np.mean(np.max(np.abs(values / truth - 1), axis=1) < 0.25)


@pytest.mark.benchmark(group="1000 fits")
def test_ours(benchmark, case):
    truth, measured, error = case
    model = Airframe(*(jnp.asarray(value) for value in START))
    frfs = [frf_of(*each) for each in zip(measured, error, strict=True)]
    found = benchmark(lambda: jq.identify.fit_batch(model, frfs))
    benchmark.extra_info["steps"] = float(np.mean(found.steps))
    assert np.all(found.converged)
    assert _good(np.asarray(found.values), truth) > 0.99


@pytest.mark.benchmark(group="1000 fits")
def test_ours_with_all_their_doubts(benchmark, case):
    truth, measured, error = case
    model = Airframe(*(jnp.asarray(value) for value in START))
    frfs = [frf_of(*each) for each in zip(measured, error, strict=True)]
    intervals = benchmark(lambda: jq.identify.fit_batch(model, frfs).intervals)
    one = jq.fit(model, frfs[3])
    np.testing.assert_allclose(intervals[3], [one.interval(name) for name in one.names], rtol=1e-6)
    assert np.all(np.mean((intervals[..., 0] <= truth) & (truth <= intervals[..., 1])) > 0.9)


@pytest.mark.benchmark(group="1000 fits")
def test_scipy(benchmark, case):
    truth, measured, error = case

    def fit(k):
        def residual(z):
            misfit = (_response(np.exp(z)) - measured[k]) / (error[k] * np.abs(measured[k]))
            return np.concatenate([misfit.real, misfit.imag])

        return np.exp(least_squares(residual, np.log(START), method="lm").x)

    run = lambda: np.array([fit(k) for k in range(FITS)])
    found = benchmark.pedantic(run, rounds=2)
    assert _good(found, truth) > 0.98


def _compiled(numba):
    """One damped Gauss-Newton descent after the other, with an analytic Jacobian."""

    @numba.njit(fastmath=True, error_model="numpy")
    def normal(z, omega, measured, scale, matrix, gradient):
        K, tau, zeta, wn, delay = np.exp(z)
        matrix[:], gradient[:] = 0.0, 0.0
        cost, slope = 0.0, np.empty(5, np.complex128)
        for k in range(omega.size):
            s = 1j * omega[k]
            quadratic, lag = s * s + 2 * zeta * wn * s + wn * wn, tau * s + 1
            turn = complex(np.cos(delay * omega[k]), -np.sin(delay * omega[k]))
            here = K * wn * wn / (quadratic * lag) * turn * scale[k]
            misfit = here - measured[k] * scale[k]
            slope[0], slope[1] = here, -here * tau * s / lag
            slope[2] = -here * 2 * zeta * wn * s / quadratic
            slope[3] = here * (2 - (2 * wn * wn + 2 * zeta * wn * s) / quadratic)
            slope[4] = -here * delay * s
            cost += misfit.real**2 + misfit.imag**2
            for i in range(5):
                gradient[i] += slope[i].real * misfit.real + slope[i].imag * misfit.imag
                for j in range(i + 1):
                    matrix[i, j] += slope[i].real * slope[j].real + slope[i].imag * slope[j].imag
        for i in range(5):
            for j in range(i):
                matrix[j, i] = matrix[i, j]
        return cost

    @numba.njit(error_model="numpy")
    def fit_all(start, omega, measured, scale):
        found = np.empty((measured.shape[0], 5))
        matrix, gradient = np.empty((5, 5)), np.empty(5)
        trial_matrix, trial_gradient = np.empty((5, 5)), np.empty(5)
        for k in range(measured.shape[0]):
            z, damping = start.copy(), 1e-3
            cost = normal(z, omega, measured[k], scale[k], matrix, gradient)
            for _ in range(60):
                damped = matrix.copy()
                for i in range(5):
                    damped[i, i] *= 1 + damping
                trial = z - np.linalg.solve(damped, gradient)
                trial_cost = normal(
                    trial, omega, measured[k], scale[k], trial_matrix, trial_gradient
                )
                if trial_cost <= cost:
                    done = cost - trial_cost < 1e-10 * cost
                    z, cost, damping = trial, trial_cost, damping * 0.2
                    matrix[:], gradient[:] = trial_matrix, trial_gradient
                    if done:
                        break
                else:
                    damping *= 8
                    if damping > 1e12:
                        break
            found[k] = z
        return found

    return fit_all


@pytest.mark.benchmark(group="1000 fits")
def test_numba(benchmark, case):
    numba = pytest.importorskip("numba")
    truth, measured, error = case
    fit_all = _compiled(numba)
    scale = 1 / (error * np.abs(measured))
    fit_all(np.log(START), OMEGA, measured[:2], scale[:2])
    found = benchmark(lambda: np.exp(fit_all(np.log(START), OMEGA, measured, scale)))
    assert _good(found, truth) > 0.98
