"""One transfer-function fit beside scipy's, in one run.

    python -m pytest tests/benchmarks/test_fit_speed.py -o addopts= --benchmark-columns=min,median

Both start from the same values on the same response, fit logarithms of five parameters (gain,
lag, damping, natural frequency, delay) and must agree within a fifth of a standard error. Ours is
`jq.fit` as it is called: it solves again with the model's own weights, and gives covariance,
identifiability and remarks.
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
TRUTH = np.array([18.0, 0.045, 0.55, 7.0, 0.018])
ERROR = 0.02


def _numpy_response(values):
    K, tau, zeta, wn, delay = values
    s = 1j * OMEGA
    rigid = K * wn**2 / (s * s + 2 * zeta * wn * s + wn**2)
    return rigid / (tau * s + 1) * np.exp(-delay * s)


@pytest.fixture(scope="module")
def frf():
    rng = np.random.default_rng(0)
    noise = ERROR * (rng.standard_normal(60) + 1j * rng.standard_normal(60))
    shape = (60, 1, 1)
    response = _numpy_response(TRUTH) * (1 + noise)
    return jq.spectra.FrequencyResponse(
        omega=jnp.asarray(OMEGA),
        response=jnp.asarray(response)[:, None, None],
        coherence=jnp.full(shape, 0.95),
        random_error=jnp.full(shape, ERROR),
        errors=jq.spectra.independent_errors(
            jnp.asarray(OMEGA), 2 * ERROR**2 * jnp.abs(jnp.asarray(response))[:, None, None] ** 2
        ),
        direct_coherence=jnp.full(shape, 0.95),
        multiple_coherence=jnp.full((60, 1), 0.95),
        method="joint",
        input_names=("u",),
        output_names=("y",),
    )


START = TRUTH * 1.3


def _peer(frf):
    measured = np.asarray(frf.response)[:, 0, 0]

    def residual(z):
        log = np.log(_numpy_response(np.exp(z)) / measured) / ERROR
        return np.concatenate([log.real, log.imag])

    return np.exp(least_squares(residual, np.log(START), method="lm").x)


def _model():
    return Airframe(*(jnp.asarray(value) for value in START))


@pytest.mark.benchmark(group="fit")
def test_scipy_least_squares(benchmark, frf):
    benchmark(_peer, frf)


@pytest.mark.benchmark(group="fit")
def test_fit_with_all_its_doubts(benchmark, frf):
    fit = benchmark(lambda: jq.fit(_model(), frf))
    assert np.all(np.abs(fit.values - _peer(frf)) < 0.2 * fit.standard_errors)
