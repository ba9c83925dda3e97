"""Discrete transfer functions against scipy.signal, python-control and finer steps of the plant."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

import jaxquad as jq
from jaxquad.models import DiscreteTransferFunction, from_control, modes, simulate_linear


control = pytest.importorskip(
    "control", reason="python-control is not installed: pip install 'jaxquad[interop]'"
)

DT = 0.01
FOUR = np.real(np.poly([-1.0, -5.0, -20.0 + 30.0j, -20.0 - 30.0j]))
PLANTS = {
    "lag": jq.TransferFunction([5.0], [0.03, 1.0]),
    "lagged integrator": jq.TransferFunction([8.0], [0.05, 1.0, 0.0]),
    "light mode": jq.TransferFunction([1.0, 3.0, 200.0], [1.0, 0.2, 100.0]),
    "double pole": jq.TransferFunction([9.0], [1.0, 6.0, 9.0]),
    "four poles": jq.TransferFunction([300.0, 2000.0], FOUR),
    "unstable": jq.TransferFunction([2.0, 1.0], [1.0, -1.0, 30.0]),
    "gain": jq.TransferFunction([3.0], [2.0]),
}
OMEGA = np.linspace(5.0, np.pi / DT, 60)
FILTER = DiscreteTransferFunction([0.2, 0.1], [1.0, -1.2, 0.5], DT, delay=3)


def by_lfilter(model, u):
    above = np.asarray(model.numerator)
    zeros = np.zeros(model.delay + model.denominator.size - above.size)
    return signal.lfilter(np.concatenate([zeros, above]), np.asarray(model.denominator), u)


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("late", [0, 3])
def test_a_held_plant_is_that_of_scipy_and_of_python_control(name, late):
    plant = PLANTS[name]
    above, below = np.asarray(plant.numerator), np.asarray(plant.denominator)
    model = jq.TransferFunction(above, below, delay=late * DT).to_discrete(DT)
    assert model.delay == late and model.dt == DT
    response = np.asarray(model.frequency_response(OMEGA))[:, 0, 0] * np.exp(1j * OMEGA * DT * late)
    num, den, _ = signal.cont2discrete((above, below), DT)  # pyright: ignore
    by_scipy = signal.dfreqresp((np.trim_zeros(np.ravel(num)), den, DT), OMEGA * DT)[1]
    np.testing.assert_allclose(response, by_scipy, rtol=1e-10)
    sampled = control.sample_system(control.tf(above, below), DT, "zoh")
    np.testing.assert_allclose(response, sampled(np.exp(1j * OMEGA * DT)), rtol=1e-10)


@pytest.mark.parametrize("hold", ["zero", "first"])
def test_a_delay_of_part_of_a_sample_is_exact(hold):
    """Against ten times as many samples, of which the delay is a whole number."""
    fine, late = 10, 37
    model = jq.TransferFunction([300.0, 2000.0], FOUR, delay=late * DT / fine)
    states = signal.tf2ss([300.0, 2000.0], FOUR)
    u = np.random.default_rng(0).normal(size=300)
    u[0] = 0.0
    method = "zoh" if hold == "zero" else "foh"
    matrices = signal.cont2discrete(states, DT / fine, method)[:4]  # pyright: ignore
    system = signal.dlti(*matrices, dt=DT / fine)
    times = np.arange(300 * fine) / fine
    held = np.repeat(u, fine) if hold == "zero" else np.interp(times, np.arange(300), u)
    delayed = np.concatenate([np.zeros(late), held])[: 300 * fine]
    reference = signal.dlsim(system, delayed)[1][::fine, 0]
    sampled = by_lfilter(model.to_discrete(DT, hold=hold), u)
    np.testing.assert_allclose(sampled, reference, rtol=0, atol=1e-9 * np.max(np.abs(reference)))


@pytest.mark.parametrize("name", PLANTS)
def test_the_continuous_model_returns(name):
    plant = PLANTS[name]
    plant = jq.TransferFunction(plant.numerator, plant.denominator, delay=4 * DT)
    back = plant.to_discrete(DT).to_continuous()
    assert back.numerator.size == plant.numerator.size
    assert float(back.delay) == pytest.approx(4 * DT, rel=1e-12)
    omega = np.geomspace(0.1, 1000.0, 40)
    wanted = plant.frequency_response(omega)
    np.testing.assert_allclose(back.frequency_response(omega), wanted, rtol=1e-9)


def test_a_double_integrator_keeps_its_response_at_low_frequencies():
    """(T^2 / 2) (z + 1) / (z - 1)^2, where 1 / (z - 1)^2 of a rounded z loses digits."""
    omega = np.array([1e-4, 1e-2, 1.0])
    model = DiscreteTransferFunction([DT**2 / 2, DT**2 / 2], [1.0, -2.0, 1.0], DT)
    closed = DT**2 / 4 * np.cos(omega * DT / 2) / (-1 * np.sin(omega * DT / 2) ** 2)
    closed = closed * np.exp(-0.5j * omega * DT)
    np.testing.assert_allclose(model.frequency_response(omega)[:, 0, 0], closed, rtol=1e-12)


def test_python_control_and_scipy_get_it_and_give_it_back():
    z = np.exp(1j * OMEGA * DT)
    response = np.asarray(FILTER.frequency_response(OMEGA))[:, 0, 0]
    system, of_scipy = FILTER.to_control(), FILTER.to_scipy()
    assert system.dt == of_scipy.dt == DT
    np.testing.assert_allclose(system(z), response, rtol=1e-12)
    by_scipy = signal.dfreqresp(of_scipy, OMEGA * DT)[1]
    np.testing.assert_allclose(by_scipy, response, rtol=1e-12)
    for one in (system, of_scipy):
        back = from_control(one)
        assert isinstance(back, DiscreteTransferFunction) and back.dt == DT
        np.testing.assert_allclose(back.frequency_response(OMEGA)[:, 0, 0], response, rtol=1e-12)


def test_it_simulates_as_a_difference_equation():
    u = np.random.default_rng(1).normal(size=777)
    np.testing.assert_allclose(simulate_linear(FILTER, u, DT), by_lfilter(FILTER, u), atol=1e-12)
    with pytest.raises(ValueError, match=r"samples every 0\.01 s, the data have one every 0\.02 s"):
        simulate_linear(FILTER, u, 2 * DT)


def test_poles_and_modes_are_those_in_seconds():
    alone = dataclasses.replace(FILTER, delay=0)
    frequency, damping, poles = control.damp(alone.to_control(), doprint=False)
    mode = modes(FILTER)[0]
    k = int(np.argmax(np.imag(poles)))
    assert (mode.frequency, mode.damping) == pytest.approx((frequency[k], damping[k]), rel=1e-9)
    np.testing.assert_allclose(np.exp(FILTER.poles * DT), np.roots([1.0, -1.2, 0.5]), rtol=1e-12)
    assert np.exp(FILTER.zeros * DT) == pytest.approx([-0.5])
    delayed = DiscreteTransferFunction([1.0], [1.0, -0.5, 0.0], DT)
    assert np.exp(delayed.poles * DT) == pytest.approx([0.5])  # that at 0 is a delay


def test_the_response_has_the_derivatives_of_its_coefficients():
    def size(above):
        model = DiscreteTransferFunction(above, FILTER.denominator, DT)
        return jnp.sum(jnp.abs(model.frequency_response(jnp.asarray(OMEGA))) ** 2)

    above, step = np.asarray(FILTER.numerator), np.array([1e-6, 0.0])
    slope = (size(above + step) - size(above - step)) / 2e-6
    assert float(jax.grad(size)(FILTER.numerator)[0]) == pytest.approx(float(slope), rel=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DiscreteTransferFunction([1.0, 2.0], [1.0], DT), "no more above than below"),
        (lambda: DiscreteTransferFunction([1.0], [0.0, 1.0], DT), "starts with 0"),
        (lambda: DiscreteTransferFunction([1.0], [1.0], 0.0), "sample interval in s, above 0"),
        (lambda: DiscreteTransferFunction([1.0], [1.0], DT, delay=-1), "give whole samples"),
        (lambda: FILTER.frequency_response([1.0, 400.0]), "above Nyquist's, pi / dt = 314.159"),
        (lambda: DiscreteTransferFunction([1.0], [1.0, 0.4], DT).to_continuous(), "z = -0.4"),
        (lambda: DiscreteTransferFunction([1.0], [1.0, 0.0], DT).to_continuous(), "z = 0"),
        (lambda: PLANTS["lag"].to_discrete(DT, hold="foh"), 'give "zero" or "first"'),
        (lambda: PLANTS["lag"].to_discrete(0.0), "s above 0"),
        (lambda: jq.StateSpace([[-1.0]], [[1.0]], [[1.0]]).to_discrete(DT), "no ratio"),
        (lambda: from_control(control.tf([1.0], [1.0, 0.5], True)), "sampled"),
        (lambda: jq.TransferFunction(FILTER.to_control()), "this model is continuous"),
    ],
)
def test_what_makes_no_discrete_model_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
