"""Predictions some samples ahead against filters that numpy and scipy compute by themselves."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter

import jaxquad as jq
from jaxquad.identify import CONTRADICTS, NoiseModel, WhiteNoise
from jaxquad.models import realise, simulate_linear, StateSpace


pytestmark = pytest.mark.slow

DT = 0.02


def how(check):
    """Of a verification that is a prediction."""
    assert check.prediction is not None
    return check.prediction


def fly(model, process, measurement, seed, *, late=0, samples=1000):
    """A plant in noise under LQG feedback of the sampled plant, with a reference of steps."""
    A, B, C = (np.asarray(part) for part in realise(model)[:3])
    Ad, Bd = held(A, B)
    Q, R = covariance(A, process), measurement**2
    K = riccati(Ad.T, C.T, Q, np.array([[R]])).T
    L = riccati(Ad, Bd, C.T @ C, 0.01 * np.eye(1))
    rng, root = np.random.default_rng(seed), np.linalg.cholesky(Q)
    reference = np.repeat(rng.choice([-1.0, 1.0], samples // 20), 20)
    x, guess = np.zeros(len(A)), np.zeros(len(A))
    u, y = np.zeros(samples + late), np.zeros(samples)
    for k in range(samples):
        y[k] = C[0] @ x + measurement * rng.standard_normal()
        if k >= late:  # the input that acts now; it is recorded `late` samples before
            u[k] = reference[k] - L[0] @ guess
        guess = Ad @ guess + Bd[:, 0] * u[k] + K[:, 0] * (y[k] - C[0] @ guess)
        x = Ad @ x + Bd[:, 0] * u[k] + root @ rng.standard_normal(len(A))
    return jq.Record(DT * np.arange(samples), u[late:], y, hold=DT)


def held(A, B):
    """The plant over a sample of held input."""
    block = np.vstack([np.hstack([A, B]), np.zeros((B.shape[1], len(A) + B.shape[1]))])
    step = np.asarray(expm(DT * block))[: len(A)]
    return step[:, : len(A)], step[:, len(A) :]


def covariance(A, process):
    """Of the state after a sample of noise, by a fine sum."""
    step, over, parts = expm(A * DT / 200), expm(A * DT / 400), []
    for _ in range(200):
        parts.append(over @ np.diag(process**2) @ over.T)
        over = step @ over
    return np.mean(parts, axis=0) * DT


def riccati(A, B, Q, R):
    """The gain on the state, by iteration."""
    P = np.eye(len(A))
    for _ in range(600):
        gain = np.linalg.solve(B.T @ P @ B + R, B.T @ P @ A)
        P = Q + A.T @ P @ (A - B @ gain)
    return gain


UNSTABLE = jq.TransferFunction([40.0], [1.0, 8.0, -20.0])  # poles at 2 and -10 rad/s
NOISE = WhiteNoise(np.array([2.0, 0.2]), np.array([0.05]))


@pytest.fixture(scope="module")
def record():
    return fly(UNSTABLE, NOISE.process, 0.05, 0)


@pytest.mark.parametrize("horizon", [1, 5])
@pytest.mark.parametrize("late", [0, 3])
def test_predictions_are_those_of_a_kalman_filter_that_runs_sample_by_sample(horizon, late):
    flown = fly(UNSTABLE, NOISE.process, 0.05, 1, late=late, samples=300)
    model = jq.TransferFunction([40.0], [1.0, 8.0, -20.0], late * DT)
    check = jq.predict(model, flown, horizon=horizon, noise=NOISE)
    A, B, C = (np.asarray(part) for part in realise(model)[:3])
    Ad, Bd = held(A, np.hstack([B, np.eye(2)]))
    K = riccati(Ad.T, C.T, covariance(A, NOISE.process), np.array([[0.05**2]])).T
    u = np.concatenate([np.zeros(late), flown.inputs[:, 0] - flown.inputs[0, 0]])
    push = Bd[:, :1] @ u[None, :300] + (Bd[:, 1:] @ check.bias)[:, None]
    states, y = [check.initial], flown.outputs[:, 0] - check.shift[0]
    for k in range(300):
        states.append(Ad @ states[k] + push[:, k] + K[:, 0] * (y[k] - C[0] @ states[k]))
    for k in range(horizon, 300):
        x = states[k - horizon + 1]
        for j in range(k - horizon + 1, k):
            x = Ad @ x + push[:, j]
        # The sums of the covariance leave 1e-5 of it.
        assert C[0] @ x + check.shift[0] == pytest.approx(check.simulated[k], abs=2e-4)


@pytest.mark.parametrize("horizon", [1, 5, 20])
def test_a_noise_model_predicts_its_shocks_and_the_error_is_its_first_terms(horizon):
    model, rng = jq.TransferFunction([8.0], [1.0, 3.0, 20.0], 0.03), np.random.default_rng(2)
    above, below, size = np.array([1.0, 0.5]), np.array([1.0, -1.6, 0.68]), 0.02
    shocks = size * rng.standard_normal(3000)
    u = np.repeat(rng.choice([-1.0, 1.0], 120), 25)
    y = np.asarray(simulate_linear(model, u, DT)) + lfilter(above, below, shocks)
    flown = jq.Record(DT * np.arange(3000), u, y, hold=DT)
    noise = [NoiseModel(above, below, size)]
    check = jq.predict(model, flown, horizon=horizon, noise=noise)
    terms = lfilter(above, below, np.eye(horizon, 1)[:, 0])
    expected = lfilter(terms, 1.0, shocks)
    # Start, bias and shift are estimated from 3000 samples.
    assert np.std(check.residuals - expected) < 0.1 * np.std(expected)
    assert how(check).deviation[0] == pytest.approx(size * np.linalg.norm(terms), rel=1e-6)
    assert how(check).whiteness[0] > 0.01 and how(check).origin.kind == "as stated"


def test_one_step_errors_of_the_true_unstable_model_are_white_and_of_a_wrong_one_are_not(record):
    right = jq.predict(UNSTABLE, record)
    wrong = jq.predict(jq.TransferFunction([120.0], [1.0, 8.0, -20.0]), record)
    e = right.residuals - np.mean(right.residuals)
    correlations = np.array([e[k:] @ e[:-k] for k in range(1, 21)]) / (e @ e)
    assert np.mean(np.abs(correlations) < 1.96 / np.sqrt(e.size)) >= 0.85
    assert how(right).whiteness[0] > 0.01 > how(wrong).whiteness[0]
    assert how(right).origin.kind == "estimated" and "maximum likelihood" in str(right)


def test_without_noise_several_late_outputs_are_predicted_exactly_at_any_horizon():
    rng = np.random.default_rng(3)
    model = StateSpace(
        F=np.array([[-2.0, 1.0], [-1.0, -3.0]]), G=rng.standard_normal((2, 2)), H0=np.eye(2),
        H1=0.1 * rng.standard_normal((2, 2)), input_delay=[0.013, 0.0], output_delay=[0.0, 0.05],
    )  # fmt: skip
    u = np.repeat(rng.standard_normal((40, 2)), 10, axis=0)
    y = np.asarray(simulate_linear(model, u - u[0], DT, hold="first"))
    flown = jq.Record(DT * np.arange(400), u, y)
    noise = WhiteNoise(np.array([0.1, 0.1]), np.array([0.01, 0.01]))
    for horizon in (1, 7, np.inf):
        check = jq.predict(model, flown, horizon=horizon, noise=noise)
        assert check.fit_percent == pytest.approx(100, abs=1e-4)
        np.testing.assert_allclose(how(check).factor, 1, atol=1e-5)


def test_verification_predicts_where_the_simulation_diverges_and_says_so(record):
    check = jq.verify(UNSTABLE, record)
    assert check.prediction is not None and how(check).seconds == pytest.approx(0.5)
    assert "predicted 25 samples (0.5 s) ahead" in str(check)
    assert check.verdict.kind != CONTRADICTS
    assert abs(how(check).factor[0] - 1) < 3 * how(check).factor_error[0]
    backwards = jq.verify(jq.TransferFunction([-40.0], [1.0, 8.0, -20.0]), record)
    assert backwards.verdict.kind == CONTRADICTS
    stable = jq.TransferFunction([40.0], [1.0, 8.0, 20.0])
    assert jq.verify(stable, record).prediction is None
    both = jq.compare({"true": UNSTABLE, "stable": stable}, record)
    assert both.diverging == ("true",) and both.best == "true"
    assert {how(one).horizon for one in both.checks.values()} == {1}
    assert "the simulation of true diverges" in str(both)


def test_an_integrator_that_no_noise_drives_is_followed(record):
    model, rng = jq.TransferFunction([2.0], [1.0, 4.0, 0.0]), np.random.default_rng(4)
    u = np.repeat(rng.choice([-1.0, 1.0], 50), 20)
    y = np.asarray(simulate_linear(model, u - u[0], DT)) + 0.01 * rng.standard_normal(1000)
    white = [NoiseModel(np.ones(1), np.ones(1), 0.01)]
    check = jq.predict(model, jq.Record(DT * np.arange(1000), u, y, hold=DT), noise=white)
    assert check.rms == pytest.approx(0.01, rel=0.1)
    assert 0.92 < how(check).coverage[0] < 0.98


def test_horizons_and_noise_that_do_not_fit_are_refused(record):
    for horizon in (0, 2.5):
        with pytest.raises(ValueError, match="give the samples ahead"):
            jq.predict(UNSTABLE, record, horizon=horizon)
    with pytest.raises(ValueError, match=r"grows by e\^40 within 20 s"):
        jq.predict(UNSTABLE, record, horizon=np.inf)
    with pytest.raises(ValueError, match="2 noise models for 1 output"):
        jq.predict(UNSTABLE, record, noise=[NoiseModel(np.ones(1), np.ones(1), 1.0)] * 2)
    with pytest.raises(ValueError, match="give 2 numbers of 0 or more"):
        jq.predict(UNSTABLE, record, noise=WhiteNoise(np.ones(3), np.ones(1)))


def coverages(draws, sign, estimated):
    """Mean coverage 1, 5 and 20 samples ahead over plants and noise that are drawn at random, in a
    closed loop; the noise is the true one, or that estimated on another flight of the plant."""
    rows = []
    for seed in range(draws):
        rng = np.random.default_rng([seed, sign + 1])
        slow, fast = sign * rng.uniform(0.5, 4.0), rng.uniform(5.0, 15.0)
        model = jq.TransferFunction([rng.uniform(5, 40)], np.poly([slow, -fast]))
        process = 10 ** rng.uniform(-0.5, 0.5, 2) * np.array([2.0, 0.1])
        size = 10 ** rng.uniform(-2, -1)
        first, second = (fly(model, process, size, [seed, k], samples=600) for k in (0, 1))
        noise = WhiteNoise(process, np.array([size]))
        if estimated:
            noise = how(jq.predict(model, first)).noise
        checks = [jq.predict(model, second, horizon=k, noise=noise) for k in (1, 5, 20)]
        rows.append([how(check).coverage[0] for check in checks])
    return np.mean(rows, axis=0)


@pytest.mark.parametrize("sign", [-1, 1], ids=["stable", "unstable"])
def test_95_percent_bands_hold_95_percent_of_the_errors(sign):
    means = coverages(100, sign, estimated=False)
    assert np.all((means > 0.93) & (means < 0.97)), means


@pytest.mark.parametrize("sign", [-1, 1], ids=["stable", "unstable"])
def test_bands_of_noise_that_was_estimated_in_12_s_hold_little_less(sign):
    """The band does not count the error of the estimated noise, which is largest far ahead."""
    means = coverages(30, sign, estimated=True)
    assert np.all((means > [0.93, 0.92, 0.89]) & (means < 0.97)), means
