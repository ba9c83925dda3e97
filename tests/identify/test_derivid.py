"""State spaces identified from the responses of many pairs (DERIVID)."""

import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import response_of

import jaxquad as jq


ML = jq.identify.MaximumLikelihood()
OMEGA = np.geomspace(0.3, 30.0, 24)


def recovered(truth, free, factor=1.3, error=0.01, omega=OMEGA, **options):
    """Fit from values that are off by a factor, up or down in turn."""
    frf = response_of(truth, error=error, seed=0, omega=omega)
    exact = jq.fit(truth, response_of(truth, error=error, omega=omega), free=free, cost=ML).values
    start = truth
    for k, (name, value) in enumerate(zip(free, exact, strict=True)):
        start = written(start, name, value * factor ** (1 if k % 2 else -1))
    fit = jq.fit(start, frf, free=free, cost=ML, **options)
    apart = np.abs(fit.values - exact) / fit.standard_errors
    return fit, apart


def written(model, name, value):
    """The model with one named number replaced."""
    leaf, *index = name.replace("]", "").split("[")
    array = np.array(getattr(model, leaf))
    array[tuple(int(i) for i in index)] = value
    parts: dict[str, np.ndarray] = {key: getattr(model, key) for key in ("F", "G", "H0", "H1", "M")}
    parts |= {key: getattr(model, key) for key in ("input_delay", "output_delay")}
    return jq.StateSpace(**(parts | {leaf: array}))  # pyright: ignore


@pytest.mark.slow
def test_32_parameters_are_identified_from_54_pairs():
    rng = np.random.default_rng(0)
    # A chain of modes of their own, which all inputs push and all outputs see.
    F = np.diag([-1.0, -2.0, -4.0, -8.0, -12.0, -0.5]) + np.diag([1.5, -2.0, 2.5, 3.0, 0.7], 1)
    F += np.diag([-1.2, 1.8, -2.2, 1.1, -0.4], -1)
    G = rng.uniform(0.5, 2.0, (6, 6)) * rng.choice([-1, 1], (6, 6))
    H0 = np.vstack([np.eye(6), rng.uniform(0.5, 1.5, (3, 6))])
    truth = jq.StateSpace(F=F, G=G, H0=H0, input_delay=np.full(6, 0.02))
    free = [f"F[{i}][{i}]" for i in range(6)]
    free += [f"F[{i}][{i + 1}]" for i in range(5)] + [f"F[{i + 1}][{i}]" for i in range(5)]
    free += [f"G[{i}][{j}]" for i in range(2) for j in range(6)]
    free += [f"input_delay[{j}]" for j in range(4)]
    fit, apart = recovered(truth, free, factor=1.15)
    assert len(fit.names) == 32 and fit.points == 54 * OMEGA.size
    assert fit.identifiable and apart.max() < 4 and np.mean(apart) < 1.2
    assert fit.chi_squared == pytest.approx(1, abs=0.15)


@pytest.mark.slow
def test_an_unstable_plant_with_zeros_on_the_diagonal_is_identified():
    # Hovering: speed, pitch rate, pitch angle; an unstable oscillation.
    truth = jq.StateSpace(
        F=[[-0.02, 0.0, -9.81], [0.05, -1.0, 0.0], [0.0, 1.0, 0.0]],
        G=[[0.0], [8.0], [0.0]],
        H0=np.eye(3),
        input_delay=[0.05],
    )
    assert np.max(np.real(truth.poles)) > 0.1
    free = ("F[0][0]", "F[1][0]", "F[1][1]", "G[1][0]", "input_delay[0]")
    fit, apart = recovered(truth, free)
    assert fit.identifiable and apart.max() < 4


@pytest.mark.slow
def test_the_units_of_the_states_change_no_estimate():
    F, G = np.array([[-1.0, 2.0], [-3.0, -0.5]]), np.array([[1.0], [4.0]])
    scale = np.diag([1e6, 1e-6])
    free = ("F[0][0]", "F[0][1]", "F[1][0]", "F[1][1]")
    plain = jq.StateSpace(F=F, G=G, H0=np.eye(2))
    inverse = np.linalg.inv(scale)
    scaled = jq.StateSpace(F=scale @ F @ inverse, G=scale @ G, H0=inverse)
    one, other = (recovered(model, free)[0] for model in (plain, scaled))
    ratio = np.array([1.0, 1e12, 1e-12, 1.0])
    np.testing.assert_allclose(other.values / ratio, one.values, rtol=1e-5)
    np.testing.assert_allclose(other.standard_errors / ratio, one.standard_errors, rtol=1e-4)


@pytest.mark.slow
def test_responses_that_span_six_decades_are_fitted():
    truth = jq.StateSpace(
        F=[[0.0, 1.0, 0.0], [0.0, -0.2, 5.0], [0.0, 0.0, -4.0]],
        G=[[0.0], [0.0], [2.0]],
        H0=[[1.0, 0.0, 0.0]],
    )
    omega = np.geomspace(0.1, 60.0, 40)
    response = np.abs(np.asarray(truth.frequency_response(jnp.asarray(omega))))
    assert response.max() / response.min() > 1e6
    fit, apart = recovered(truth, ("F[1][1]", "F[1][2]", "F[2][2]"), omega=omega)
    assert apart.max() < 4


@pytest.mark.slow
def test_a_mass_matrix_and_accelerations_are_identified():
    truth = jq.StateSpace(
        M=[[2.0, 0.1], [0.1, 0.5]],
        F=[[-1.0, 0.3], [-2.0, -1.5]],
        G=[[1.0, 0.2], [0.3, 2.0]],
        H0=np.vstack([np.eye(2), np.zeros((1, 2))]),
        H1=[[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]],
        output_delay=[0.0, 0.01, 0.03],
    )
    free = ("M[0][0]", "M[1][1]", "F[0][0]", "F[1][0]", "output_delay[1]", "output_delay[2]")
    fit, apart = recovered(truth, free)
    assert fit.identifiable and apart.max() < 4


@pytest.mark.slow
def test_gain_and_mass_together_are_refused_as_a_ratio():
    truth = jq.StateSpace(M=[[2.0]], F=[[-1.0]], G=[[3.0]], H0=[[1.0]])
    frf = response_of(truth, error=0.01, seed=0, omega=OMEGA)
    fit = jq.fit(truth, frf, free=("M[0][0]", "F[0][0]", "G[0][0]"), cost=ML)
    assert not fit.identifiable
    assert set(fit.verdict.undetermined) == {"M[0][0]", "F[0][0]", "G[0][0]"}
