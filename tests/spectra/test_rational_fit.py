"""Ratios of polynomials fitted to bins: as precise as numpy's QR and SVD, at less cost."""

import dataclasses

import numpy as np
import pytest

from jaxquad.records import read, RecordWarning
from jaxquad.spectra import frequency_response, JointInputOutput, LocalPolynomial
from jaxquad.spectra._rational_fit import (
    Basis,
    descend,
    Equations,
    make_basis,
    parts_of,
    search_orders,
    solve_linear,
)


BINS, ORDER = 800, 12
POLES = np.array([1.0, 0.3, 2.0, 0.2, 0.8])  # of rising powers of x
ZEROS = np.array([0.7, -0.2, 0.1, 0.05, 0.02])


def equations(noise: float = 0.0) -> Equations:
    """Bins up to the Nyquist frequency of y = B / A u + C / A."""
    rng = np.random.default_rng(0)
    x = np.exp(-1j * np.pi * (np.arange(BINS) + 1) / BINS) - 1
    u, e = rng.standard_normal((2, BINS)) + 1j * rng.standard_normal((2, BINS))
    powers = x ** np.arange(POLES.size)[:, None]
    y = (ZEROS @ powers * u + np.array([0.1, 0.4, 0.0, 0.2]) @ powers[:-1]) / (POLES @ powers)
    return Equations(x, u[None], np.ones((1, BINS)), y + noise * np.std(y) * e)


def left_by_numpy(given: Equations, basis: Basis, denominator: np.ndarray) -> float:
    rows = parts_of(basis.columns / (denominator @ basis.powers))
    unit = rows.T / np.linalg.norm(rows, axis=1)
    found = np.linalg.lstsq(unit, parts_of(given.y))[0]
    return float(np.sum((parts_of(given.y) - unit @ found) ** 2))


def test_a_search_of_the_order_finds_an_exact_ratio_to_rounding():
    given = equations()
    orders = search_orders(given, ORDER)
    assert orders.best == POLES.size - 1
    found = descend(given, make_basis(given, POLES.size), orders.solved[4].denominator, 1e-6)
    assert found.cost < 1e-24 * np.sum(np.abs(given.y) ** 2)
    np.testing.assert_allclose(found.denominator / found.denominator[0], POLES, rtol=1e-9)
    np.testing.assert_allclose(found.linear[: ZEROS.size] / found.denominator[0], ZEROS, rtol=1e-9)


@pytest.mark.parametrize("size", (1, 6, ORDER + 1))
def test_normal_equations_leave_what_least_squares_of_the_columns_leave(size):
    """Bins of a tenth of the band count most: the condition of 25 columns is 3e5."""
    place = (np.arange(BINS) / BINS - 0.5) / 0.1
    given = equations(noise=0.01).weighted(np.exp(-0.5 * place**2) + 1e-4)
    basis, denominator = make_basis(given, size), np.pad(POLES, (0, ORDER))[:size]
    expected = left_by_numpy(given, basis, denominator)
    assert solve_linear(given, basis, denominator).cost == pytest.approx(expected, rel=1e-10)


def test_columns_that_depend_on_each_other_are_solved_by_their_singular_values():
    given = equations(noise=0.01)
    twice = given._replace(u=np.concatenate([given.u, 2 * given.u]))
    basis, alone = make_basis(twice, ORDER + 1), make_basis(given, ORDER + 1)
    denominator = np.pad(POLES, (0, ORDER + 1 - POLES.size))
    found = solve_linear(twice, basis, denominator)
    assert np.all(np.isfinite(found.linear))
    assert found.cost == pytest.approx(left_by_numpy(given, alone, denominator), rel=1e-8)


def test_a_descent_leaves_no_more_than_it_began_with_and_reaches_the_noise():
    given = equations(noise=0.05)
    basis = make_basis(given, POLES.size)
    start = 1.1 * POLES
    start[0] = POLES[0]
    found = descend(given, basis, start, 1e-6)
    assert found.cost <= solve_linear(given, basis, start).cost
    truth = solve_linear(given, basis, POLES).cost
    parameters = given.parameters(POLES.size - 1)
    assert found.cost < truth < found.cost * (1 + 5 * parameters / (2 * BINS))


@pytest.mark.slow
def test_the_last_digit_of_a_flight_does_not_choose_its_models(data):
    """Of an order above that of the vehicle: poles and zeros that cancel leave directions open."""
    path = data / "antx_pitch" / "antx_log3_prbs.npz"
    with pytest.warns(RecordWarning, match="gaps filled"):
        flown = read(path, inputs="M", outputs="q", references="x0", sample_rate=250.0)
    omega = np.geomspace(3.6, 119.0, 40)
    estimator = JointInputOutput(LocalPolynomial(integrators=1, delay=0.032))
    digit = np.finfo(float).eps * np.random.default_rng(0).integers(-1, 2, flown.outputs.shape)
    moved = dataclasses.replace(flown, outputs=flown.outputs * (1 + digit))
    one, other = (frequency_response(each, omega, estimator=estimator) for each in (flown, moved))
    response, again, error = map(np.asarray, (one.response, other.response, one.random_error))
    known = np.isfinite(response)
    assert np.count_nonzero(known) > 30
    apart = np.abs(response[known] / again[known] - 1) / error[known]
    assert np.max(apart) < 1e-3
