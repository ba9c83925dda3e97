import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from jaxquad.models import (
    AttitudeAxis,
    free_responses,
    LaggedIntegrator,
    sample_rational,
    simulate_linear,
    StateSpace,
    TransferFunction,
)


OMEGA = jnp.asarray(np.geomspace(0.1, 300.0, 60))
DT, SAMPLES = 0.02, 400
NOISE = jax.random.normal(jax.random.key(0), (SAMPLES,))
MODELS = {
    "double integrator": ([0.424], [1.0, 0.0, 0.0]),
    "lag and two integrators": ([0.424], [0.02, 1.0, 0.0, 0.0]),
    "lightly damped mode": ([1.0, 3.0, 200.0], [1.0, 0.2, 100.0]),
    "feedthrough and an integrator": ([2.0, 3.0, 5.0], [4.0, 6.0, 0.0]),
    "poles from 0.01 to 100 rad/s": ([1e3, 1.0], np.poly([-0.01, -1.0, -30.0, -100.0])),
}


def model(name, delay: float | jax.Array = 0.0):
    numerator, denominator = MODELS[name]
    return TransferFunction(numerator, denominator, delay)


def held(name, u, dt):
    """scipy's response to an input that stays at each sample."""
    discrete = signal.cont2discrete(signal.tf2ss(*MODELS[name]), dt, "zoh")
    return signal.dlsim(discrete, u)[1][:, 0]


def straight(name, u, dt):
    """python-control's response to an input that runs straight from sample to sample."""
    system = control.ss(*signal.tf2ss(*MODELS[name]))
    return control.forced_response(system, dt * np.arange(len(u)), u).outputs  # pyright: ignore


def high_order():
    poles = np.concatenate([-np.geomspace(0.5, 200, 6), [-1 + 20j, -1 - 20j, -3 + 70j, -3 - 70j]])
    zeros = np.concatenate([-np.geomspace(1, 90, 5), [-0.5 + 40j, -0.5 - 40j]])
    return np.real(1e5 * np.poly(zeros)), np.real(np.poly(poles))


def test_a_transfer_function_of_order_ten_answers_like_python_control():
    numerator, denominator = high_order()
    found = TransferFunction(numerator, denominator).frequency_response(OMEGA)[:, 0, 0]
    expected = control.TransferFunction(numerator, denominator)(1j * np.asarray(OMEGA))
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_a_delay_turns_the_phase_and_leaves_the_magnitude():
    plain, late = (
        model("lightly damped mode", delay).frequency_response(OMEGA) for delay in (0.0, 0.03)
    )
    turned = np.asarray(plain) * np.exp(-0.03j * np.asarray(OMEGA))[:, None, None]
    np.testing.assert_allclose(late, turned, rtol=1e-13)


def test_a_series_multiplies_the_responses_and_adds_the_delays():
    first, second = model("double integrator", 0.01), model("lightly damped mode", 0.02)
    product = np.asarray(first.frequency_response(OMEGA) * second.frequency_response(OMEGA))
    np.testing.assert_allclose((first * second).frequency_response(OMEGA), product, rtol=1e-12)
    assert float((first * second).delay) == pytest.approx(0.03)


def test_poles_and_zeros_are_the_roots():
    found = model("lightly damped mode")
    np.testing.assert_allclose(found.poles, np.roots([1.0, 0.2, 100.0]))
    np.testing.assert_allclose(found.zeros, np.roots([1.0, 3.0, 200.0]))


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (([1.0, 0.0, 0.0], [1.0, 1.0]), "3 coefficients and the denominator 2"),
        (([1.0], [0.0, 1.0]), "starts with 0"),
        (([1.0], [1.0, np.nan]), "denominator is .*nan.* finite"),
        (([1.0], [1.0, 1.0], -0.1), "delay is -0.1"),
        (([1.0], [1.0, 1.0], np.inf), "delay is inf"),
    ],
)
def test_models_that_are_not_causal_and_finite_are_refused(arguments, complaint):
    with pytest.raises(ValueError, match=complaint):
        TransferFunction(*arguments)


@pytest.mark.parametrize("lag", [0.0, 0.03])
def test_the_attitude_axis_answers_like_python_control(lag):
    axis = AttitudeAxis(0.197, 0.1188, 0.0552, lag=lag, delay=0.01, K_af=0.003)
    denominator = np.polymul([0.0552, 0.003, 0.0], [lag, 1.0])
    reference = control.TransferFunction([0.197 * 0.1188], denominator)
    omega = np.asarray(OMEGA)
    expected = reference(1j * omega) * np.exp(-0.01j * omega)
    np.testing.assert_allclose(axis.frequency_response(OMEGA)[:, 0, 0], expected, rtol=1e-10)
    polynomials = axis.transfer_function().frequency_response(OMEGA)[:, 0, 0]
    np.testing.assert_allclose(polynomials, expected, rtol=1e-10)


def test_inertia_and_thrust_are_told_apart_only_by_an_added_inertia():
    truth, twin = AttitudeAxis(0.197, 0.1188, 0.0552), AttitudeAxis(0.197, 0.2376, 0.1104)
    assert truth.gain == pytest.approx(0.424, abs=5e-4)
    same = [m.frequency_response(OMEGA) for m in (truth, twin)]
    np.testing.assert_allclose(*same, rtol=1e-14)
    loaded = [float(m.with_added_inertia(0.0276).gain) for m in (truth, twin)]
    assert loaded[0] == pytest.approx(float(truth.gain) / 1.5)
    assert loaded[1] == pytest.approx(float(truth.gain) / 1.25)


def test_an_axis_outside_physics_is_refused():
    with pytest.raises(ValueError, match="J_x is 0.0"):
        AttitudeAxis(0.197, 0.1188, 0.0)
    with pytest.raises(ValueError, match="lag is -0.01"):
        AttitudeAxis(0.197, 0.1188, 0.0552, lag=-0.01)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("hold", ["zero", "first"])
def test_a_simulation_agrees_with_an_independent_discretisation(name, hold):
    found = simulate_linear(model(name), NOISE, DT, hold=hold)
    expected = {"zero": held, "first": straight}[hold](name, np.asarray(NOISE), DT)
    # Two realisations of one model, each with the rounding of an exponential.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["lag and two integrators", "feedthrough and an integrator"])
@pytest.mark.parametrize("hold", ["zero", "first"])
@pytest.mark.parametrize("delay", [0.3, 1.0, 2.75])  # samples
def test_a_delay_within_a_sample_is_exact(name, hold, delay):
    found = simulate_linear(model(name, delay * DT), NOISE, DT, hold=hold)
    parts = 20  # the delays are whole multiples of the fine step
    fine = np.arange(parts * SAMPLES) / parts
    if hold == "zero":
        dense = np.asarray(NOISE)[np.floor(fine + 1e-9).astype(int)]
    else:
        dense = np.interp(fine, np.arange(SAMPLES), NOISE)
    late = round(delay * parts)
    response = {"zero": held, "first": straight}[hold](name, dense[: len(fine) - late], DT / parts)
    expected = np.concatenate([np.zeros(late), response])[::parts]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("delay", [0.0, 0.4])  # samples
def test_a_held_sine_settles_to_the_frequency_response_times_that_of_the_hold(delay):
    periods, per_period = 20, 20
    damped = TransferFunction([200.0], [1.0, 20.0, 100.0], delay * DT)
    omega = 2 * np.pi / (per_period * DT)
    phase = omega * DT * np.arange(periods * per_period)
    found = np.asarray(simulate_linear(damped, jnp.sin(phase), DT))[-per_period:]
    amplitude = 2 * np.mean(found * np.exp(-1j * phase[-per_period:])) * 1j
    # Above Nyquist the hold's images fold back; their sum is the discrete-time response.
    images = omega + 2 * np.pi / DT * np.arange(-20000, 20001)
    hold = (1 - np.exp(-1j * images * DT)) / (1j * images * DT)
    response = np.asarray(damped.frequency_response(jnp.asarray(images)))[:, 0, 0]
    assert amplitude == pytest.approx(np.sum(hold * response), rel=1e-9)  # images fall as 1/n^3


@pytest.mark.slow
def test_the_output_has_the_gradient_of_finite_differences_in_lag_and_delay():
    def final(lag, delay):
        axis = AttitudeAxis(0.197, 0.1188, 0.0552, lag=lag, delay=delay)
        return simulate_linear(axis.transfer_function(), NOISE, DT)[-1]

    lag, delay, h = 0.05, 0.7 * DT, 1e-6
    both = jax.jit(jax.value_and_grad(final, argnums=(0, 1)))
    value = lambda *at: float(both(*at)[0])
    _, found = both(lag, delay)
    by_lag = (value(lag + h, delay) - value(lag - h, delay)) / (2 * h)
    by_delay = (value(lag, delay + h) - value(lag, delay - h)) / (2 * h)
    np.testing.assert_allclose(found, [by_lag, by_delay], rtol=1e-6)  # rounding over h


def test_free_responses_span_every_start_and_every_constant_bias():
    A, B, C, D = signal.tf2ss(*MODELS["lag and two integrators"])
    times = DT * np.arange(SAMPLES)
    initial, bias = free_responses(model("lag and two integrators"), SAMPLES, DT)
    assert initial.shape == bias.shape == (SAMPLES, 3)
    start = [1.0, -2.0, 3.0]
    pushed = signal.lsim((A, np.eye(3), C, np.zeros((1, 3))), np.ones((SAMPLES, 3)) * start, times)
    released = signal.lsim((A, B, C, D), np.zeros(SAMPLES), times, X0=start)
    for columns, expected in ((initial, released[1]), (bias, pushed[1])):
        columns = np.asarray(columns)
        scale = np.linalg.norm(columns, axis=0)
        weights = np.linalg.lstsq(columns / scale, expected)[0]
        rest = expected - columns / scale @ weights
        assert np.linalg.norm(rest) < 1e-10 * np.linalg.norm(expected)


def test_a_pure_gain_has_no_states_and_passes_the_delayed_input():
    u = np.asarray(NOISE)
    late = simulate_linear(TransferFunction([2.0], [4.0], 3 * DT), NOISE, DT)
    np.testing.assert_allclose(late, np.concatenate([np.zeros(3), u[:-3] / 2]), atol=1e-15)


def test_models_build_under_jit_from_constants_and_from_traced_values():
    def response(inertia):
        fixed = AttitudeAxis(0.197, 0.1188, 0.0552).transfer_function()
        free = AttitudeAxis(0.197, 0.1188, inertia, lag=0.02).transfer_function()
        return (fixed * free).frequency_response(OMEGA)

    np.testing.assert_allclose(jax.jit(response)(0.0552), response(0.0552), rtol=1e-13)


def test_an_unknown_hold_is_refused_with_those_that_exist():
    with pytest.raises(ValueError, match="'second'.*zero.*first"):
        simulate_linear(model("double integrator"), NOISE, DT, hold="second")


@pytest.mark.slow
@pytest.mark.parametrize("hold", ["zero", "first"])
@pytest.mark.parametrize("delay", [0.0, 0.033, 0.04])
@pytest.mark.parametrize("name", ["lightly damped mode", "feedthrough and an integrator"])
def test_the_difference_equation_gives_the_simulated_samples(name, delay, hold):
    plant, u = model(name, delay), np.asarray(NOISE)
    sampled = sample_rational(plant, DT, hold)
    u = u - u[0]  # a straight input would begin before the record
    late = np.concatenate([np.zeros(int(sampled.shift)), u])[:SAMPLES]
    denominator = np.concatenate([[1.0], np.asarray(sampled.below)])
    found = signal.lfilter(np.asarray(sampled.above), denominator, late)
    expected = np.asarray(simulate_linear(plant, u, DT, hold=hold))
    np.testing.assert_allclose(found, expected, atol=1e-11 * np.abs(expected).max())


@pytest.mark.parametrize(
    "model",
    [
        LaggedIntegrator(8.0, 0.05, 0.03),
        TransferFunction([1.0, 2.0], [1.0, 0.5, 4.0], 0.1),
        AttitudeAxis(L=0.2, K_t=0.1, J_x=0.05, lag=0.05),
        StateSpace([[-1.0]], [[1.0]], [[1.0]]),
    ],
    ids=lambda model: type(model).__name__,
)
def test_a_number_is_one_frequency(model):
    for omega in (3, 3.0, np.float64(3.0)):
        np.testing.assert_array_equal(
            model.frequency_response(omega), model.frequency_response([3.0])
        )
