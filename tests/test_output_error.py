"""Output-error estimates in the time domain."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares
from scipy.signal import cont2discrete, dlsim, lfilter

import jaxquad as jq
from jaxquad.identify import refine


DT, SAMPLES = 0.02, 1000
TIME = DT * np.arange(SAMPLES)
TRUTH = jq.TransferFunction([8.0], [1.0, 3.0, 20.0], 0.03)
START = jq.TransferFunction([10.0], [1.0, 2.0, 26.0], 0.02)
FREE = ("numerator[0]", "denominator[1]", "denominator[2]", "delay")
VALUES = np.array([8.0, 3.0, 20.0, 0.03])
U = np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], SAMPLES // 25), 25)
CLEAN = np.asarray(jq.simulate_linear(TRUTH, U, DT))


def noise(seed, pole=0.0, samples=SAMPLES):
    """First-order coloured, of standard deviation 1."""
    white = np.random.default_rng(seed).standard_normal(samples + 500)
    return lfilter([np.sqrt(1 - pole**2)], [1, -pole], white)[500:]  # pyright: ignore


def refined(y, u=U, start=START, **options):
    return refine(start, jq.Record(TIME, u, y), free=FREE, hold="zero", **options)


def test_the_estimate_is_that_of_scipy():
    """Without delay: scipy's discretisation and its lm, over the same unknowns."""
    system = jq.TransferFunction([8.0], [1.0, 3.0, 20.0])
    y = np.asarray(jq.simulate_linear(system, U - U[0], DT)) + 0.05 * noise(1) + 0.3

    def residual(x):
        A, B, C, D, _ = cont2discrete(([x[0]], [1.0, x[1], x[2]]), DT)[:2] + (0,) * 3 if False else (
            *discrete(x), None)
        return y - dlsim((A, B, C, D, DT), U - U[0], x0=x[3:5])[1][:, 0] - x[5]

    def discrete(x):
        continuous = (np.array([[0, 1], [-x[2], -x[1]]]), np.array([[0.0], [x[0]]]))
        return cont2discrete((*continuous, np.array([[1.0, 0]]), np.zeros((1, 1))), DT)[:4]

    expected = least_squares(residual, [10.0, 2.0, 26.0, 0, 0, 0], x_scale="jac", xtol=1e-12)
    fit = refined(y, start=eqx.tree_at(lambda m: m.delay, START, jnp.zeros(())))
    np.testing.assert_allclose(fit.values, expected.x[:3], rtol=1e-5)
