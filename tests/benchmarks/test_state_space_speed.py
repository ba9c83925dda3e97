"""A state-space fit of 20 parameters beside scipy's, in one run.

    python -m pytest tests/benchmarks/test_state_space_speed.py -o addopts=

Eight states of a helicopter near hover, six outputs, three inputs, 40 frequencies. The peer solves
all frequencies in one call of `numpy.linalg.solve` and differentiates numerically, as MINPACK does.
Ours is `jq.fit` as it is called: it solves again with the model's own weights, and gives
covariance, identifiability and remarks, for which it takes the slopes by all parameters.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

import jaxquad as jq
from jaxquad.models import simulate_linear, StateSpace


jax.config.update("jax_enable_x64", True)

OMEGA, ERROR = np.geomspace(0.3, 20.0, 40), 0.02
# u, v, p, q, w, r, phi, theta; longitudinal, lateral and collective or pedal inputs.
F = np.zeros((8, 8))
F[0, [0, 3, 4, 7]] = -0.05, 1.2, 0.1, -9.81
F[1, [1, 2, 4, 6]] = -0.12, -1.1, 0.2, 9.81
F[2, [0, 1, 2, 3, 4]] = 0.02, -0.06, -4.5, 0.9, 0.2
F[3, [0, 1, 2, 3, 4]] = 0.03, 0.02, -0.7, -2.1, 0.3
F[4, [1, 2, 4]] = 0.05, -0.3, -0.6
F[5, [1, 2, 5]] = 0.1, -0.2, -0.8
F[6, 2] = F[7, 3] = 1
G = np.zeros((8, 3))
G[:6] = [[0, 0.4, 0.3], [0.5, 0, 0.3], [20, 3, 0.2], [-2, 9, 0.4], [0.6, 0.2, 5], [0.3, 0.1, 4]]
H0, DELAY = np.eye(6, 8), np.array([0.03, 0.03, 0.02])
ROWS, COLUMNS = (
    np.array([0, 0, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4]),
    np.array([0, 3, 1, 0, 1, 2, 3, 0, 1, 2, 3, 1, 4]),
)
PUSHED, PUSHES = np.array([2, 2, 3, 3, 4]), np.array([0, 1, 0, 1, 2])
TRUTH = np.concatenate([F[ROWS, COLUMNS], G[PUSHED, PUSHES], DELAY[:2]])
NAMES = [f"F[{i}][{j}]" for i, j in zip(ROWS, COLUMNS, strict=True)]
NAMES += [f"G[{i}][{j}]" for i, j in zip(PUSHED, PUSHES, strict=True)]
NAMES += ["input_delay[0]", "input_delay[1]"]
START = TRUTH * np.exp(0.15 * np.random.default_rng(0).choice([-1, 1], TRUTH.size))
TURNED = 1j * OMEGA[:, None, None] * np.eye(8)


def matrices(values):
    f, g, late = F.copy(), G.copy(), DELAY.copy()
    f[ROWS, COLUMNS], g[PUSHED, PUSHES], late[:2] = values[:13], values[13:18], values[18:]
    return f, g, late


def numpy_response(values):
    f, g, late = matrices(values)
    states = np.linalg.solve(TURNED - f, g[None].astype(complex))
    return H0 @ states * np.exp(-1j * OMEGA[:, None] * late)[:, None, :]


def measured():
    rng = np.random.default_rng(1)
    truth = numpy_response(TRUTH)
    noise = rng.standard_normal((2, *truth.shape))
    return truth * (1 + ERROR * (noise[0] + 1j * noise[1]))


MEASURED = measured()


def peer_residual(z):
    log = np.log(numpy_response(np.sign(TRUTH) * np.exp(z)) / MEASURED) / ERROR
    return np.concatenate([log.real.ravel(), log.imag.ravel()])


def peer():
    z = least_squares(peer_residual, np.log(np.abs(START)), method="lm").x
    return np.sign(TRUTH) * np.exp(z)


def model(values):
    f, g, late = matrices(values)
    return StateSpace(F=f, G=g, H0=H0, input_delay=late)


def frf_of(measured):
    shape = measured.shape
    omega, variance = jnp.asarray(OMEGA), 2 * ERROR**2 * np.abs(measured) ** 2
    return jq.spectra.FrequencyResponse(
        omega=omega,
        response=jnp.asarray(measured),
        coherence=jnp.full(shape, 0.95),
        random_error=jnp.full(shape, ERROR),
        errors=jq.spectra.independent_errors(omega, jnp.asarray(variance)),
        direct_coherence=jnp.full(shape, 0.95),
        multiple_coherence=jnp.full(shape[:2], 0.95),
        method="joint",
        input_names=("lon", "lat", "col"),
        output_names=("u", "v", "p", "q", "w", "r"),
    )


@pytest.mark.benchmark(group="state-space fit")
def test_scipy_least_squares(benchmark):
    benchmark(peer)


@pytest.mark.benchmark(group="state-space fit")
def test_fit_with_all_its_doubts(benchmark):
    frf = frf_of(MEASURED)
    fit = benchmark(lambda: jq.fit(model(START), frf, free=NAMES))
    # The model's weights in place of the measurement's move each by less than half its error.
    assert np.all(np.abs(fit.values - peer()) < 0.5 * fit.standard_errors)


FITS = 200


@pytest.mark.benchmark(group="200 state-space fits")
def test_200_by_scipy(benchmark):
    benchmark.pedantic(lambda: [peer() for _ in range(FITS)], rounds=1)


@pytest.mark.benchmark(group="200 state-space fits")
def test_batch_of_200(benchmark):
    rng = np.random.default_rng(5)
    truth = numpy_response(TRUTH)
    noise = rng.standard_normal((2, FITS, *truth.shape))
    responses = truth * (1 + ERROR * (noise[0] + 1j * noise[1]))
    responses[0] = MEASURED
    frfs = [frf_of(each) for each in responses]
    found = benchmark(lambda: jq.identify.fit_batch(model(START), frfs, free=NAMES))
    np.testing.assert_allclose(found.values[0], peer(), rtol=0.01, atol=1e-3)
    assert np.all(found.converged)


@jax.jit
def response(z):
    at = model(START)
    values = jnp.asarray(np.sign(TRUTH)) * jnp.exp(z)
    late = jnp.concatenate([values[18:], jnp.asarray(DELAY[2:])])
    f = at.F.at[ROWS, COLUMNS].set(values[:13])
    return StateSpace(
        F=f, G=at.G.at[PUSHED, PUSHES].set(values[13:18]), H0=at.H0, input_delay=late
    ).frequency_response(jnp.asarray(OMEGA))


Z = np.log(np.abs(START))


@pytest.mark.benchmark(group="response")
def test_numpy_response(benchmark):
    benchmark(numpy_response, START)


@pytest.mark.benchmark(group="response")
def test_response(benchmark):
    found = benchmark(lambda: response(Z).block_until_ready())
    np.testing.assert_allclose(found, numpy_response(START), rtol=1e-11)


@pytest.mark.benchmark(group="Jacobian")
def test_numpy_differences(benchmark):
    step = 1e-7 * np.eye(TRUTH.size)
    benchmark(lambda: [numpy_response(START * (1 + each)) for each in (*step, 0 * step[0])])


@pytest.mark.benchmark(group="Jacobian")
def test_jacobian(benchmark):
    jacobian = jax.jit(jax.jacfwd(response))
    benchmark(lambda: jacobian(Z).block_until_ready())


@pytest.mark.benchmark(group="20 000 samples, 10 states")
def test_simulate_a_long_record(benchmark):
    rng = np.random.default_rng(2)
    plant = StateSpace(
        F=rng.standard_normal((10, 10)) - 6 * np.eye(10),
        G=rng.standard_normal((10, 3)),
        H0=rng.standard_normal((6, 10)),
        input_delay=[0.013, 0.02, 0.031],
    )
    u = jnp.asarray(rng.standard_normal((20_000, 3)))
    benchmark(lambda: simulate_linear(plant, u, 0.01).block_until_ready())
