"""Ratios of polynomials fitted to bins as precisely as by numpy; their order; the bins' noise."""

import dataclasses
import functools as ft

import numpy as np
import pytest

from jaxquad.records import read, RecordWarning
from jaxquad.spectra import frequency_response, JointInputOutput, LocalPolynomial
from jaxquad.spectra._global_model import noise_left, rough_noise, running_power
from jaxquad.spectra._rational_fit import (
    Basis,
    descend,
    Equations,
    next_order,
    parts_of,
    refine_orders,
    search_orders,
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
    found = descend(given, orders.solved[4].denominator, 1e-6)[0]
    assert found.cost < 1e-24 * np.sum(np.abs(given.y) ** 2)
    np.testing.assert_allclose(found.denominator / found.denominator[0], POLES, rtol=1e-9)
    np.testing.assert_allclose(found.linear[: ZEROS.size] / found.denominator[0], ZEROS, rtol=1e-9)


@pytest.mark.parametrize("size", (1, 6, ORDER + 1))
def test_normal_equations_leave_what_least_squares_of_the_columns_leave(size):
    """Bins of a tenth of the band count most: the condition of 25 columns is 3e5."""
    place = (np.arange(BINS) / BINS - 0.5) / 0.1
    given = equations(noise=0.01).weighted(np.exp(-0.5 * place**2) + 1e-4)
    basis, denominator = Basis.of(given, size), np.pad(POLES, (0, ORDER))[:size]
    expected = left_by_numpy(given, basis, denominator)
    assert basis.solve(denominator)[0].cost == pytest.approx(expected, rel=1e-10)


def test_columns_that_depend_on_each_other_are_solved_by_their_singular_values():
    given = equations(noise=0.01)
    twice = given._replace(u=np.concatenate([given.u, 2 * given.u]))
    basis, alone = Basis.of(twice, ORDER + 1), Basis.of(given, ORDER + 1)
    denominator = np.pad(POLES, (0, ORDER + 1 - POLES.size))
    found = basis.solve(denominator)[0]
    assert np.all(np.isfinite(found.linear))
    assert found.cost == pytest.approx(left_by_numpy(given, alone, denominator), rel=1e-8)


def test_a_descent_leaves_no_more_than_it_began_with_and_reaches_the_noise():
    given = equations(noise=0.05)
    basis = Basis.of(given, POLES.size)
    start = 1.1 * POLES
    start[0] = POLES[0]
    found = descend(given, start, 1e-6)[0]
    assert found.cost <= basis.solve(start)[0].cost
    truth = basis.solve(POLES)[0].cost
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


MOST = 10
OMEGA = np.geomspace(0.02, 2.0, 400)  # rad/sample
MODES = ((0.1, 0.02, 1.0), (0.6, 0.02, 0.3))  # frequency, damping ratio, gain


def lag(omega):
    return np.exp(-1j * omega) - 1


def denominator_of(frequency, damping):
    """Of rising powers of `lag`, a mode's poles at the samples."""
    pole = np.exp(frequency * (damping + 1j * np.sqrt(1 - damping**2))) - 1
    return np.array([1.0, -2 * np.real(1 / pole), 1 / np.abs(pole) ** 2])


def below(omega, frequency, damping):
    return np.polyval(denominator_of(frequency, damping)[::-1], lag(omega))


def white(count, seed=0):
    rng = np.random.default_rng(seed)
    return (rng.standard_normal(count) + 1j * rng.standard_normal(count)) / np.sqrt(2)


def measured(noise: float | np.ndarray = 0.01, u=None):
    """Two light modes driven by an input like noise."""
    u = white(OMEGA.size, 1) if u is None else u
    y = sum(gain * u / below(OMEGA, *mode) for *mode, gain in MODES)
    return Equations(lag(OMEGA), u[None], np.ones((1, OMEGA.size)), y + noise * white(OMEGA.size))


def test_no_order_leaves_more_than_the_one_below_it():
    """The denominators of high orders reach over 12 decades of these bins."""
    orders = search_orders(measured(), MOST)
    costs = [orders.solved[order].cost for order in sorted(orders.solved)]
    assert len(costs) > 7 and np.all(np.diff(costs) <= 1e-9 * np.array(costs[:-1]))


def test_poles_that_are_added_one_by_one_find_light_modes():
    orders = search_orders(measured(), MOST)
    assert orders.best == 4
    expected = ft.reduce(np.convolve, (denominator_of(w, zeta) for w, zeta, _ in MODES))
    found = orders.solved[4].denominator
    np.testing.assert_allclose(found / found[0], expected, rtol=0.02)


def test_the_order_next_to_the_best_begins_with_the_same_model():
    given = measured()
    orders = search_orders(given, MOST)
    start = next_order(given, orders, MOST)
    assert start.size == 6 and start[-1] == 0
    again = descend(given, start, np.inf)[0]
    assert again.cost <= orders.solved[4].cost * (1 + 1e-9)


def test_refining_in_other_weights_finds_what_a_new_search_finds():
    """Of noise that falls with frequency, which the first search takes for white."""
    shape = OMEGA**-0.3
    given = measured(0.01 * shape)
    first, weighted = search_orders(given, MOST), given.weighted(1 / shape)
    found, anew = refine_orders(weighted, first, MOST), search_orders(weighted, MOST)
    assert found.best == anew.best == 4 and len(found.solved) < len(anew.solved)
    np.testing.assert_allclose(found.solved[4].cost, anew.solved[4].cost, rtol=1e-3)


def test_rough_noise_is_known_without_a_model():
    """Noise of which the power falls by 10^3, under a response that turns slowly."""
    shape = (OMEGA / OMEGA[0]) ** -0.75
    u, own = white(OMEGA.size, 1), np.ones((1, OMEGA.size))
    y = u * np.exp(-0.2j * OMEGA) + 0.01 * shape * white(OMEGA.size)
    ratio = rough_noise(Equations(lag(OMEGA), u[None], own, y), OMEGA) / (0.01 * shape) ** 2
    assert 0.4 < np.min(ratio) and np.max(ratio) < 2.5


def test_rounding_of_an_input_between_its_lines_is_no_input():
    """As of a multisine: what rounding leaves between the lines must not choose a model."""
    lines = np.where(np.arange(OMEGA.size) % 7 == 0, 1.0, 0.0)
    first, other = (
        rough_noise(measured(u=lines + 1e-15 * white(OMEGA.size, seed)), OMEGA) for seed in (2, 3)
    )
    np.testing.assert_allclose(first, other, rtol=1e-6)


def test_noise_that_enters_before_a_light_mode_is_recognised():
    poles = below(OMEGA, *MODES[1][:2])
    gusts = white(OMEGA.size) / poles
    found = noise_left(OMEGA, gusts, poles, np.ones_like(OMEGA))
    ratio = found * np.abs(poles) ** 2
    assert 0.5 < np.min(ratio) and np.max(ratio) < 2.0
    sensed = white(OMEGA.size)
    np.testing.assert_array_equal(
        noise_left(OMEGA, sensed, poles, np.ones_like(OMEGA)),
        running_power(OMEGA, sensed, np.ones_like(OMEGA)),
    )
