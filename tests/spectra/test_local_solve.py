"""Local fits beside those of SciPy's least squares, frequency by frequency."""

import numpy as np
import pytest
import scipy.linalg

from jaxquad.spectra._local_fit import solve_polynomial, solve_rational


FREQUENCIES, WINDOW, ORDER = 3, 40, 2


def window(unlike: float, records: int = 1):
    """Two inputs that differ by about `unlike`, and an output with a resonance and noise."""
    rng = np.random.default_rng(3)

    def circular(*shape: int) -> np.ndarray:
        return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)

    place = np.broadcast_to(np.linspace(-1.0, 1.0, WINDOW), (FREQUENCIES, WINDOW))
    first = circular(FREQUENCIES, WINDOW, 1)
    u = np.concatenate([first, first + unlike * circular(FREQUENCIES, WINDOW, 1)], axis=2)
    own = np.arange(WINDOW)[None, :, None] % records == np.arange(records)
    own = np.broadcast_to(own, (FREQUENCIES, WINDOW, records))
    clean = u @ np.array([[2.0], [1.0j]]) / (1 + (0.3 + 0.4j) * place[:, :, None])
    return place, u, clean + 1e-3 * circular(FREQUENCIES, WINDOW, 1), own


def regressors(place: np.ndarray, u: np.ndarray, own: np.ndarray) -> np.ndarray:
    powers = place[:, None] ** np.arange(ORDER + 1)
    return np.einsum("wc,ws->wcs", np.hstack([u, own]), powers).reshape(WINDOW, -1)


@pytest.mark.parametrize(
    "unlike, accuracy", [(1.0, 1e-13), (1e-2, 1e-11), (1e-4, 1e-9), (1e-5, 1e-5)]
)
@pytest.mark.parametrize("records", [1, 2])
def test_a_polynomial_is_that_of_least_squares_however_alike_the_inputs(unlike, accuracy, records):
    place, u, y, own = window(unlike, records)
    found = solve_polynomial(place, u, y, own, ORDER)
    assert np.all(found.fine)
    for f in range(FREQUENCIES):
        columns = regressors(place[f], u[f], own[f])
        inverse = scipy.linalg.pinv(columns, rtol=1e-14)
        effect = inverse[: 2 * (ORDER + 1) : ORDER + 1]
        size = np.max(np.abs(effect))
        assert np.max(np.abs(found.effect[f] - effect)) < accuracy * size
        response = (effect @ y[f])[:, 0]
        scale = size * np.max(np.abs(y))
        assert np.max(np.abs(found.response[f, 0] - response)) < accuracy * scale
        left = y[f] - columns @ (inverse @ y[f])
        assert np.max(np.abs(found.residual[f] - left)) < accuracy * np.max(np.abs(y))
        assert found.freedom[f] == WINDOW - columns.shape[1]


def test_inputs_that_are_the_same_to_a_millionth_determine_nothing():
    assert not np.any(solve_polynomial(*window(1e-8), ORDER).fine)


def test_a_rational_function_leaves_the_noise_alone():
    place, u, y, own = window(1.0)
    found = solve_rational(place, u, y, own, ORDER)
    assert np.all(found.fine)
    assert np.sqrt(np.mean(np.abs(found.residual) ** 2)) < 1.5e-3
    error = found.response[:, 0] - np.array([2.0, 1.0j])
    claimed = np.sqrt(2e-6 * np.sum(np.abs(found.effect) ** 2, axis=2))
    assert np.all(np.abs(error) < 3.5 * claimed)
    polynomial = solve_polynomial(place, u, y, own, ORDER)
    assert np.sqrt(np.mean(np.abs(polynomial.residual) ** 2)) > 0.05
