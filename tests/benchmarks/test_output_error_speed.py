"""One output-error estimate beside scipy's, in one run.

    python -m pytest tests/benchmarks/test_output_error_speed.py -o addopts= \
        --benchmark-columns=min,median

22 500 samples, four parameters of a discrete second-order model for scipy (lfilter and lm, no
delay, start at rest), of the continuous model with its delay, initial state, biases and shift for
ours, which also gives covariance under coloured residuals, identifiability and remarks.
"""

import jax
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import cont2discrete, lfilter

import jaxquad as jq
from jaxquad.identify import refine


jax.config.update("jax_enable_x64", True)

DT, SAMPLES = 0.004, 22500
FREE = ("numerator[0]", "denominator[1]", "denominator[2]", "delay")
START = jq.TransferFunction([10.0], [1.0, 2.0, 25.0], 0.02)


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], SAMPLES // 50), 50)
    truth = jq.TransferFunction([8.0], [1.0, 3.0, 20.0], 0.03)
    y = np.asarray(jq.models.simulate_linear(truth, u - u[0], DT))
    return jq.Record(DT * np.arange(SAMPLES), u, y + 0.02 * rng.standard_normal(SAMPLES))


@pytest.mark.benchmark(group="output error")
def test_scipy_lfilter_and_lm(benchmark, record):
    u, y = record.inputs[:, 0] - record.inputs[0, 0], record.outputs[:, 0]
    late = np.concatenate([np.zeros(7), u])[:SAMPLES]  # the delay, given to it

    def residual(x):
        return lfilter([0, x[0], x[1]], [1, x[2], x[3]], late) - y

    above, below = cont2discrete(([10.0], [1.0, 2.0, 25.0]), DT)[:2]  # pyright: ignore
    start = [*np.ravel(above)[1:], *np.ravel(below)[1:]]
    found = benchmark(lambda: least_squares(residual, start, method="lm", x_scale=np.abs(start)))
    assert np.std(found.fun) == pytest.approx(0.02, rel=0.02)


@pytest.mark.benchmark(group="output error")
def test_refine_with_all_its_doubts(benchmark, record):
    fit = benchmark(lambda: refine(START, record, free=FREE, hold="zero"))
    errors = fit.values - [8.0, 3.0, 20.0, 0.03]
    np.testing.assert_array_less(np.abs(errors), 4 * fit.standard_errors)
