"""The search for the order of a global model, and the noise by which its bins count."""

import functools as ft

import numpy as np

from jaxquad.spectra._global_model import noise_left, rough_noise, running_power
from jaxquad.spectra._rational_fit import (
    descend,
    Equations,
    make_basis,
    next_order,
    refine_orders,
    search_orders,
)


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
    again = descend(given, make_basis(given, start.size), start, np.inf)
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
