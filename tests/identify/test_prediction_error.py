"""Refinement under noise models: prediction errors."""

import functools as ft

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import cholesky, toeplitz
from scipy.signal import lfilter

import jaxquad as jq
from jaxquad.identify import ARMA, AutoRegressive, refine
from jaxquad.identify.output_error._noise import (
    estimate_noise,
    make_whitener,
    NoiseModel,
    shock_slopes,
    shocks_of,
)


DT, SAMPLES = 0.02, 1000
TIME = DT * np.arange(SAMPLES)
TRUTH = jq.TransferFunction([8.0], [1.0, 3.0, 20.0], 0.03)
FREE = ("numerator[0]", "denominator[1]", "denominator[2]", "delay")
VALUES = np.array([8.0, 3.0, 20.0, 0.03])
U = np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], SAMPLES // 25), 25)
POLES, ZEROS = [1, -1.6, 0.68], [1, 0.5]


@ft.cache
def clean():
    return np.asarray(jq.models.simulate_linear(TRUTH, U - U[0], DT))


def noise(seed, numerator, denominator, samples=SAMPLES):
    white = np.random.default_rng(seed).standard_normal(samples + 500)
    return np.asarray(lfilter(numerator, denominator, white))[500:]


def record(seed, pole=0.9):
    return jq.Record(TIME, U, clean() + 0.02 * noise(seed, [1.0], [1, -pole]), hold=DT)


def test_the_whitener_of_a_problem_gives_the_shocks():
    rng = np.random.default_rng(1)
    models = [
        NoiseModel(np.ones(1), np.array(POLES), 1.0),
        NoiseModel(np.array(ZEROS), np.array([1, -0.98]), 1.0),
        NoiseModel(np.ones(1), np.poly(0.9 * np.ones(12)), 1.0),
    ]
    x = rng.standard_normal((200, 3, 2))
    found = make_whitener(models, 200)(jnp.asarray(x))
    expected = np.stack([shocks_of(x[:, k], model) for k, model in enumerate(models)], axis=1)
    scale = np.max(np.abs(expected))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * scale)


def test_slopes_of_the_shocks_are_their_differences():
    v, step = noise(2, ZEROS, POLES), 1e-6
    model = NoiseModel(np.array(ZEROS), np.array(POLES), 1.0)
    there = NoiseModel(np.array([1, 0.5 + step]), np.array([1, -1.6, 0.68 + step]), 1.0)
    change = (shocks_of(v, there) - shocks_of(v, model)) / step
    np.testing.assert_allclose(shock_slopes(v, model) @ [0, 1, 1], change, atol=1e-3)


def test_noise_models_are_those_that_made_the_noise():
    v = 0.3 * noise(3, ZEROS, POLES, 20_000)
    found = estimate_noise(v, ARMA(2, 1))
    # Standard errors are below 0.01.
    np.testing.assert_allclose(found.denominator, POLES, atol=0.03)
    np.testing.assert_allclose(found.numerator, ZEROS, atol=0.03)
    assert found.deviation == pytest.approx(0.3, rel=0.03)
    assert estimate_noise(v, "auto").deviation < 1.005 * found.deviation
    outside = estimate_noise(noise(4, [1, -2.0], [1.0], 20_000), ARMA(0, 1))
    np.testing.assert_allclose(outside.numerator, [1, -0.5], atol=0.03)
    several = estimate_noise(noise(5, [1.0], POLES, 20_000), AutoRegressive(2))
    np.testing.assert_allclose(several.denominator, POLES, atol=0.03)


@pytest.mark.slow
def test_a_coloured_residual_is_whitened_and_the_estimate_is_that_of_the_known_noise():
    pole, start = 0.9, jq.TransferFunction([8.2], [1.0, 2.9, 20.5], 0.029)
    flight = record(6, pole)
    first = refine(start, flight, free=FREE, noise=AutoRegressive(1))
    fit = refine(first, flight, noise=AutoRegressive(1))
    assert fit.names == first.names and fit.parameters.logarithmic == first.parameters.logarithmic
    np.testing.assert_array_less(np.abs(fit.values - first.values), 0.05 * fit.standard_errors)
    [[model]] = fit.noise_models
    assert model.denominator[1] == pytest.approx(-pole, abs=0.04)
    assert model.deviation == pytest.approx(0.02, rel=0.1)
    assert not any("coloured" in remark for remark in fit.remarks)
    # Generalised least squares with the true covariance; slopes by central differences.
    inverse = np.linalg.inv(cholesky(toeplitz(pole ** np.arange(SAMPLES)), lower=True))
    y = flight.outputs[:, 0] - clean()
    slopes = []
    for k, value in enumerate(VALUES):
        ends = [VALUES.copy(), VALUES.copy()]
        ends[0][k] += 1e-4 * value
        ends[1][k] -= 1e-4 * value
        plus, minus = (
            np.asarray(jq.models.simulate_linear(
                jq.TransferFunction(x[:1], [1.0, x[1], x[2]], x[3]), U - U[0], DT
            ))
            for x in ends
        )  # fmt: skip
        slopes.append((plus - minus) / (2e-4 * value))
    unknown = [np.ones(SAMPLES)] + [
        np.asarray(lfilter([1.0], np.poly(np.exp(DT * TRUTH.poles)).real, np.eye(1, SAMPLES, k)[0]))
        for k in (0, 1)
    ]
    columns = inverse @ np.stack([*slopes, *unknown], axis=1)
    expected = VALUES + np.linalg.lstsq(columns, inverse @ y, rcond=None)[0][:4]
    np.testing.assert_array_less(np.abs(fit.values - expected), 0.15 * fit.standard_errors)
    size = 0.02 / np.sqrt(1 - pole**2)
    errors = size * np.sqrt(np.diag(np.linalg.inv(columns.T @ columns)))[:4]
    np.testing.assert_allclose(fit.standard_errors, errors, rtol=0.15)


@pytest.mark.slow
def test_a_fit_is_refined_with_its_own_ties():
    tied = {"denominator[2]": lambda m: 2.5 * m.numerator[0]}
    free = ("numerator[0]", jq.identify.Real("denominator[1]"))
    fit = refine(TRUTH, record(7), free=free, tied=tied, noise="auto")
    again = refine(fit, record(7), noise="auto")
    assert again.names == fit.names == ("numerator[0]", "denominator[1]")
    assert again.parameters.logarithmic[:2] == (True, False)
    assert again.model.denominator[2] == pytest.approx(2.5 * again.values[0])
    np.testing.assert_array_less(np.abs(again.values - fit.values), 0.1 * fit.standard_errors)


@pytest.mark.slow
def test_noise_that_cannot_be_modelled_is_refused():
    with pytest.raises(ValueError, match="and a noise model exclude each other"):
        refine(TRUTH, record(8), noise="auto", band=(1.0, 10.0))
    with pytest.raises(ValueError, match="the order of the noise is -1"):
        AutoRegressive(-1)
    with pytest.raises(ValueError, match="give 0 to 8 poles"):
        ARMA(1, 9)
    with pytest.raises(ValueError, match="a noise of order 900 cannot be estimated from 1000"):
        refine(TRUTH, record(8), free=FREE, noise=AutoRegressive(900))


@pytest.mark.slow
def test_standard_errors_are_the_scatter_in_coloured_noise():
    fits = [refine(TRUTH, record(seed), free=FREE, noise="auto") for seed in range(100, 200)]
    errors = np.array([fit.values for fit in fits]) - VALUES
    predicted = np.array([fit.standard_errors for fit in fits])
    # Of 100 draws: a scatter is known to 7 %, a coverage of 95 % to 2.2 %; three times that.
    ratio = errors.std(axis=0) / np.sqrt(np.mean(predicted**2, axis=0))
    np.testing.assert_array_less(np.abs(ratio - 1), 0.21)
    assert np.all(np.mean(np.abs(errors) < 1.96 * predicted, axis=0) > 0.88)
    assert not any("coloured" in remark for fit in fits for remark in fit.remarks)


@pytest.mark.slow
def test_each_output_of_each_record_has_its_own_noise():
    F, G = np.array([[-1.0, 2.0], [-4.0, -1.5]]), np.array([[1.0, 0.0], [0.5, 2.0]])
    truth = jq.StateSpace(F=F, G=G, H0=np.eye(2))
    rng = np.random.default_rng(9)
    flights = []
    for pole in (0.95, 0.5):
        u = np.repeat(rng.choice([-1.0, 1.0], (SAMPLES // 20, 2)), 20, axis=0)
        clean = np.asarray(jq.models.simulate_linear(truth, u - u[0], DT))
        shocks = rng.standard_normal((SAMPLES, 2)) * [0.02, 0.1]
        coloured = np.asarray(lfilter([1.0], [1, -pole], shocks[:, 0]))
        flights.append(jq.Record(TIME, u, clean + np.stack([coloured, shocks[:, 1]], 1), hold=DT))
    start = jq.StateSpace(F=1.1 * F, G=0.9 * G, H0=np.eye(2))
    free = ("F", "G[0][0]", "G[1][0]", "G[1][1]")
    fit = refine(start, flights, free=free, noise=AutoRegressive(1))
    expected = np.array([*F.reshape(-1), 1.0, 0.5, 2.0])
    np.testing.assert_array_less(np.abs(fit.values - expected), 3.5 * fit.standard_errors)
    found = np.array([[model.denominator[1] for model in each] for each in fit.noise_models])
    np.testing.assert_allclose(found, [[-0.95, 0], [-0.5, 0]], atol=0.1)
    sizes = np.array([[model.deviation for model in each] for each in fit.noise_models])
    np.testing.assert_allclose(sizes, [[0.02, 0.1]] * 2, rtol=0.1)
    white = refine(start, flights, free=free)
    # The first output's slow noise is no longer taken for information.
    assert np.all(fit.standard_errors < 1.02 * white.standard_errors)
    assert fit.standard_errors[0] < 0.9 * white.standard_errors[0]
