"""Derivatives of loops against differences, ensembles, and what is refused."""

import functools as ft

import control
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loop_members import analysed, columns, DT, FRICTION, MEMBERS, parts, windows

from jaxquad.control import LADRC
from jaxquad.loops import analyse, gain_window, Loop
from jaxquad.models import DecoupledAxes, quanser_hover
from jaxquad.simulation import MotorDrive


pytestmark = pytest.mark.usefixtures("compiled_quickly")
ss, feedback = (getattr(control, name) for name in ("ss", "feedback"))
POINT = {"wc": 8.0, "wo": 35.0, "b0": 1.1, "lag": 0.02, "delay": 0.0033}  # and gain 0.6
NUMBERS = ("abscissa", "sensitivity_peak", "noise_gain", "delay_margin", "phase_margin")
NUMBERS += ("gain_margin", "gain_reduction")


@ft.cache
def slope_of():
    """The gradient of all numbers, added up with the weights given."""

    def total(x, weights):
        plant = DecoupledAxes([0.6], [1.0], lag=x[3:4], **FRICTION)
        controller = LADRC(x[:1], x[1:2], x[2:3], dt=DT)
        found = analyse(Loop(plant, controller, delay=x[4], longest_delay=0.01))
        return jnp.dot(weights, jnp.stack([getattr(found, name) for name in NUMBERS]))

    return jax.jit(jax.value_and_grad(total))


@pytest.mark.slow
def test_gradients_with_respect_to_every_gain_lag_and_delay_are_those_of_differences():
    step, base = 1e-5, FRICTION | POINT | {"gain": 0.6}
    moved = [
        base | {name: value * (1 + sign * step)}
        for name, value in POINT.items()
        for sign in (1, -1)
    ]
    found = analysed(*moved)
    values = np.stack([np.asarray(getattr(found, name)) for name in NUMBERS])
    differences = (values[:, :10:2] - values[:, 1:10:2]) / (2 * step)  # times the parameter
    weights = 1 / np.max(np.abs(differences), axis=1)
    point = np.array(list(POINT.values()))
    first = np.arange(7) == 0
    # The abscissa's error is its smoothing; a difference of 1e-5 has one of its square, and of the
    # rounding of 1e-11 over it.
    for these, tolerance in ((weights * first, 3e-5), (weights * ~first, 5e-6)):
        exact = slope_of()(point, these)[1]
        np.testing.assert_allclose(exact * point, these @ differences, atol=tolerance)


@pytest.mark.slow
def test_gradients_stay_finite_in_an_unstable_loop():
    weights = np.ones(7)
    slope = slope_of()(np.array([40.0, 90.0, 1.1, 0.03, 0.0033]), weights)[1]
    assert np.all(np.isfinite(slope)) and np.any(np.asarray(slope) != 0)


@pytest.mark.slow
def test_a_traced_delay_needs_its_bound_and_beyond_it_nothing_is_claimed():
    axis, controller = DecoupledAxes(1.0, 1.0), LADRC([10.0], [30.0], [1.0])
    with pytest.raises(ValueError, match="traced.*longest_delay"):
        jax.jit(lambda d: analyse(Loop(axis, controller, delay=d)).abscissa)(0.1)
    far = slope_of()(np.array([8.0, 35.0, 1.1, 0.02, 0.1]), np.eye(7)[0])[0]
    assert np.isnan(far)


def slowest(A, mind):
    axis = ss(A, [[0], [0], [50]], [[1, 0, 0]], 0).sample(DT, "zoh")
    mind = ss(mind.A, mind.measurement_in[:, None], [mind.C], mind.measurement_through, DT)
    poles = feedback(axis * mind, 1, sign=1).poles()
    return np.max(np.log(np.abs(poles))) / DT


@pytest.mark.slow
def test_the_edges_of_the_gain_window_are_where_poles_cross_and_its_gradient_is_exact():
    point, step = {"wc": 10.0, "lag": 0.02}, 1e-5
    moved = [
        {"gain": 0.7} | point | {name: value * (1 + sign * step)}
        for name, value in point.items()
        for sign in (1, -1)
    ]
    found = windows({"gain": 0.7} | point, *moved)
    for edge in found[:, 0]:
        A = [[0, 1, 0], [0, 0, edge], [0, 0, -50]]
        assert slowest(A, LADRC([10.0], [30.0], [1.0], dt=DT).linear()) == pytest.approx(
            0, abs=1e-6
        )
    differences = (found[:, 1::2] - found[:, 2::2]) / (2 * step)

    def edges(x):
        axis = DecoupledAxes([0.7], [1.0], lag=x[1:])
        return jnp.stack(gain_window(Loop(axis, LADRC(x[:1], [30.0], [1.0], dt=DT))))

    place = np.array(list(point.values()))
    exact = np.asarray(jax.jit(jax.jacfwd(edges))(place)) * place
    np.testing.assert_allclose(exact, differences, rtol=1e-4)  # the smoothing, differences


@pytest.mark.slow
def test_ensembles_of_any_shape_keep_their_members():
    c = columns(MEMBERS)
    pick = lambda shape: {name: value[:6].reshape(shape) for name, value in c.items()}
    loop = lambda shape: Loop(*parts(pick(shape)), delay=pick(shape)["delay"])
    one, among_all = analyse(loop((2, 3)), member=(1, 2)), analysed(*MEMBERS).member(5)
    np.testing.assert_allclose(one.abscissa, among_all.abscissa, rtol=1e-9)
    np.testing.assert_allclose(one.phase_margin, among_all.phase_margin, rtol=1e-9)
    shapes = eqx.filter_eval_shape(analyse, loop((2, 3)))
    assert shapes.abscissa.shape == (2, 3) and shapes.closed.matrix.shape[:2] == (2, 3)


class Silent(eqx.Module):
    """A controller without a linear form."""

    def init(self, like):
        return like

    def step(self, state, reference, measurement):
        return state, reference - measurement


def test_parts_that_do_not_fit_are_refused_with_a_remedy():
    axis, controller = parts(columns(MEMBERS))
    drive = MotorDrive(quanser_hover().allocation)
    with pytest.raises(ValueError, match="Silent has no method linear"):
        analyse(Loop(axis, Silent()))
    with pytest.raises(ValueError, match="made for samples of 0.002 s, not 0.01 s"):
        analyse(Loop(axis, controller, dt=0.01))
    with pytest.raises(ValueError, match="axis is 3.*0 to 2"):
        analyse(Loop(quanser_hover(), LADRC(10.0, 30.0, 1.0), drive=drive), axis=3)
    with pytest.raises(ValueError, match="axis is 1, but the plant has one axis only"):
        analyse(Loop(DecoupledAxes([1.0], [1.0]), LADRC(10.0, 30.0, 1.0)), axis="pitch")
    with pytest.raises(ValueError, match=r"member is \(99,\).*\(20,\)"):
        analyse(Loop(axis, controller), member=99)
    with pytest.raises(ValueError, match="for ensembles of different shapes.*Loop.delay .4,"):
        analyse(Loop(axis, controller, delay=jnp.zeros(4)))
    with pytest.raises(ValueError, match="delay is -0.001 s"):
        analyse(Loop(axis, controller, delay=-0.001))
    with pytest.raises(ValueError, match="smoothing is 0.0"):
        analyse(Loop(axis, controller), smoothing=0.0)
