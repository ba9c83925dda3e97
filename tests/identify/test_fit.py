import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.optimize import least_squares
from synthetic import OMEGA, response_of

import jaxquad as jq


TRUTH = jq.LaggedIntegrator(280.0, 0.016, 0.011)
START = jq.LaggedIntegrator(150.0, 0.03, 0.02)
COSTS = [jq.identify.CoherenceWeighted(), jq.identify.MaximumLikelihood()]


def cost_14(values, frf, sign=1.0, power=2):
    """Eq. (14) written out with numpy: corrected, or with the printed minus and weight."""
    model = jq.LaggedIntegrator(*values).frequency_response(jnp.asarray(OMEGA))
    ratio = np.asarray(model / frf.response)[:, 0, 0]
    weight = (1.58 * (1 - np.exp(-np.asarray(frf.coherence)[:, 0, 0]))) ** power
    decibels, degrees = 20 * np.log10(np.abs(ratio)), np.degrees(np.angle(ratio))
    return 20 / OMEGA.size * np.sum(weight * (decibels**2 + sign * 0.01745 * degrees**2))


@pytest.mark.slow
@pytest.mark.parametrize("cost", COSTS, ids=["eq14", "ml"])
@pytest.mark.parametrize("solver", [None, optx.GaussNewton(rtol=1e-8, atol=1e-8)], ids=["lm", "gn"])
def test_a_noise_free_response_gives_the_parameters_back(cost, solver):
    fit = jq.fit(START, response_of(TRUTH), cost=cost, solver=solver)
    # The solver stops at a relative change of 1e-6, and converges quadratically.
    np.testing.assert_allclose(fit.values, [280.0, 0.016, 0.011], rtol=1e-6)
    assert fit.newton_decrement < 1e-12 and fit.identifiable and not fit.remarks


def test_the_cost_is_equation_14_and_its_minimum_that_of_scipy():
    frf = response_of(TRUTH, seed=0)
    fit = jq.fit(START, frf, cost=jq.identify.CoherenceWeighted())
    assert fit.cost == pytest.approx(cost_14(fit.values, frf), rel=1e-10)
    T, T_hat = (
        np.asarray(r)[:, 0, 0] for r in (fit.model.frequency_response(frf.omega), frf.response)
    )
    gamma_squared = np.asarray(frf.coherence)[:, 0, 0]
    assert fit.cost == pytest.approx(jq.identify.paper_cost(T, T_hat, gamma_squared), rel=1e-10)

    def root(log_values):
        ratio = jq.LaggedIntegrator(*np.exp(log_values)).frequency_response(jnp.asarray(OMEGA))
        log = np.log(np.asarray(ratio / frf.response)[:, 0, 0])
        weight = np.sqrt(20 / OMEGA.size) * 1.58 * (1 - np.exp(-0.95))
        decibels, degrees = np.real(log) * 20 / np.log(10), np.degrees(np.imag(log))
        return weight * np.concatenate([decibels, np.sqrt(0.01745) * degrees])

    peer = least_squares(root, np.log([150.0, 0.03, 0.02]), method="lm", xtol=1e-12, ftol=1e-12)
    np.testing.assert_allclose(fit.values, np.exp(peer.x), rtol=1e-6)
    assert fit.cost == pytest.approx(2 * peer.cost, rel=1e-9)


def test_the_printed_minus_has_no_minimum():
    frf = response_of(TRUTH)
    costs = [
        cost_14([280.0, 0.016, delay], frf, sign=-1.0, power=1) for delay in (0.011, 0.05, 0.15)
    ]
    assert costs[0] > costs[1] > costs[2] and costs[2] < -100


@pytest.mark.slow
def test_bounds_and_insensitivities_are_those_of_the_hessian():
    frf = response_of(TRUTH, seed=1)
    fit = jq.fit(START, frf, cost=jq.identify.CoherenceWeighted())
    hessian = np.asarray(
        jax.hessian(lambda z: _smooth_cost(jnp.exp(z), frf))(jnp.log(jnp.asarray(fit.values)))
    )
    # CIFER's are built on the Hessian; ours on its Gauss-Newton part, which leaves out terms in
    # the residual, here 2 %.
    bound = 200 * np.sqrt(np.diagonal(np.linalg.inv(hessian)))
    np.testing.assert_allclose(fit.cramer_rao, bound, rtol=0.05)
    np.testing.assert_allclose(fit.insensitivity, 100 / np.sqrt(np.diagonal(hessian)), rtol=0.05)


def _smooth_cost(values, frf):
    ratio = jq.LaggedIntegrator(*values).frequency_response(jnp.asarray(OMEGA)) / frf.response
    log = jnp.log(ratio)[:, 0, 0]
    weight = 20 / OMEGA.size * (1.58 * (1 - np.exp(-0.95))) ** 2
    scale = (20 / np.log(10)) ** 2, 0.01745 * np.degrees(1.0) ** 2
    return weight * jnp.sum(scale[0] * jnp.real(log) ** 2 + scale[1] * jnp.imag(log) ** 2)


@pytest.mark.slow
@pytest.mark.parametrize("cost", COSTS, ids=["eq14", "ml"])
def test_standard_errors_are_the_scatter_even_of_correlated_noise(cost):
    frfs = [response_of(TRUTH, error=0.01, correlation=0.7, seed=k) for k in range(200)]
    fits = [jq.fit(START, frf, cost=cost) for frf in frfs]
    values = np.array([fit.values for fit in fits])
    predicted = np.mean([fit.noise_standard_errors for fit in fits], axis=0)
    # The standard deviation of 200 draws is itself uncertain by 5 %.
    np.testing.assert_allclose(predicted / values.std(axis=0), 1.0, atol=0.15)
    inside = np.abs(values - [280.0, 0.016, 0.011]) < 1.96 * np.array(
        [fit.noise_standard_errors for fit in fits]
    )
    assert np.all(inside.mean(axis=0) > 0.89)


def test_a_scaled_output_scales_the_gain_alone():
    frf = response_of(TRUTH, seed=2)
    scaled = eqx.tree_at(lambda f: f.response, frf, frf.response * (180 / np.pi))
    one, two = jq.fit(START, frf), jq.fit(START, scaled)
    np.testing.assert_allclose(two.values, one.values * [180 / np.pi, 1, 1], rtol=1e-6)
    np.testing.assert_allclose(two.cramer_rao, one.cramer_rao, rtol=1e-5)


def test_parameters_are_selected_by_name_by_place_or_all():
    select = jq.identify.select_parameters
    by_name = select(TRUTH, ("gain", jq.identify.Real("delay", scale=0.01)))
    by_place = select(TRUTH, lambda m: (m.gain, m.delay))
    assert by_name.names == by_place.names == ("gain", "delay")
    assert select(TRUTH, None).names == ("gain", "lag", "delay")


@pytest.mark.slow
def test_a_fit_is_the_same_however_its_parameters_are_selected_and_scaled():
    frf = response_of(TRUTH)
    by_name = jq.fit(TRUTH, frf, free=("gain", jq.identify.Real("delay", scale=0.01)))
    by_place = jq.fit(TRUTH, frf, free=lambda m: (m.gain, m.delay))
    np.testing.assert_allclose(by_name.values, by_place.values, rtol=1e-6)


@pytest.mark.slow
def test_a_real_parameter_may_cross_zero():
    truth = jq.TransferFunction([-3.0, 8.0], [1.0, 3.0, 9.0])
    start = jq.TransferFunction([1.0, 5.0], [1.0, 2.0, 6.0])
    free = (jq.identify.Real("numerator[0]"), "numerator[1]", "denominator[1]", "denominator[2]")
    fit = jq.fit(start, response_of(truth), free=free)
    np.testing.assert_allclose(fit.values, [-3.0, 8.0, 3.0, 9.0], rtol=1e-6)


class TiedAxes(eqx.Module):
    """A user's own module: two outputs that share an inertia."""

    inertia: jax.Array

    def frequency_response(self, omega):
        s = jax.lax.complex(jnp.zeros_like(omega), omega)
        inertia = self.inertia.astype(s.dtype)
        return jnp.stack([1 / (inertia * s), 1 / (inertia * s * s)], axis=1)[:, :, None]


@pytest.mark.slow
def test_a_users_own_module_with_two_outputs_fits():
    frf = response_of(TiedAxes(jnp.asarray(0.0552)))
    fit = jq.fit(TiedAxes(jnp.asarray(0.2)), frf)
    assert fit.values[0] == pytest.approx(0.0552, rel=1e-7)
    assert fit.average_cost == pytest.approx(fit.cost / 2)


@pytest.mark.slow
def test_a_model_that_cannot_explain_the_response_says_so_and_widens_its_errors():
    frf = response_of(jq.LaggedIntegrator(280.0, 0.2, 0.011), seed=0)
    lacking = jq.fit(jq.LaggedIntegrator(280.0, 0.0, 0.02), frf, free=("gain", "delay"))
    assert "does not explain the whole response" in " ".join(lacking.remarks)
    proper = jq.fit(jq.LaggedIntegrator(280.0, 0.1, 0.02), frf)
    assert lacking.standard_errors[0] > 3 * proper.standard_errors[0]


@pytest.mark.slow
def test_a_solver_that_stops_early_is_no_minimum():
    fit = jq.fit(START, response_of(TRUTH, seed=0), max_steps=1)
    assert any("stopped early" in remark for remark in fit.remarks)
    assert any("no minimum" in remark for remark in fit.remarks)
    assert fit.newton_decrement > 0.1


def test_derived_quantities_carry_the_covariance():
    fit = jq.fit(START, response_of(TRUTH, seed=3))
    total = fit.derived(lambda m: m.lag + m.delay, "lag + delay")
    by_hand = np.sqrt(np.array([0, 1, 1]) @ fit.covariance @ np.array([0, 1, 1]))
    assert total.standard_error == pytest.approx(by_hand, rel=1e-9)
    assert total.value == pytest.approx(fit.values[1] + fit.values[2], rel=1e-12)
    assert total.standard_error < 0.5 * fit.standard_errors[1]


def test_a_variance_that_is_the_rounding_of_others_is_no_error():
    fit = jq.fit(START, response_of(TRUTH, seed=3))
    large = 1e14 * np.array([[0, 0, 0], [0, 1, -1 - 1e-14], [0, -1 - 1e-14, 1]])
    lost = dataclasses.replace(fit, relative_covariance=large)
    with pytest.raises(jq.identify.UndeterminedError, match="lost in the rounding"):
        lost.derived(lambda m: m.lag / fit.units[1] + m.delay / fit.units[2], "lag + delay")


def test_undamped_gauss_newton_that_diverges_says_so():
    solver = optx.GaussNewton(rtol=1e-8, atol=1e-8)
    with pytest.raises(ValueError, match="the fit diverged.*at its default"):
        jq.fit(jq.LaggedIntegrator(1.0, 0.5, 0.5), response_of(TRUTH, seed=0), solver=solver)


@pytest.mark.parametrize("start", [(280.0, 1e200, 0.01), (280.0, 0.02, 1e200)])
def test_a_fit_that_diverges_by_the_default_solver_names_what_else_to_try(start):
    with pytest.raises(ValueError, match="the fit diverged.*fit fewer parameters") as error:
        jq.fit(jq.LaggedIntegrator(*start), response_of(TRUTH, seed=0))
    assert "solver=" not in str(error.value)


def test_a_local_minimum_is_called_one():
    """A delay that starts a whole turn away stays there."""
    fit = jq.fit(jq.LaggedIntegrator(1e4, 1.0, 1.0), response_of(TRUTH, seed=0))
    assert any("local minimum" in remark for remark in fit.remarks)


@pytest.mark.slow
def test_exact_data_end_a_fit_without_a_remark():
    """Where rounding is all that is left, no step lowers the cost: that is the minimum."""
    truth = jq.LaggedIntegrator(25000.0, 0.03, 0.001, damping=0.5)
    for seed in range(4):
        factors = np.exp(np.random.default_rng(seed).normal(0, 0.5, 4))
        start = jq.LaggedIntegrator(
            *(truth.gain * factors[0], 0.03 * factors[1], 0.001), damping=factors[3]
        )
        fit = jq.fit(start, response_of(truth, omega=np.geomspace(0.5, 200.0, 60)))
        assert fit.cost < 1e-15 and fit.identifiable and not fit.remarks


def test_what_noise_makes_of_a_response_beyond_its_excitation_is_left_out():
    truth, start = jq.LaggedIntegrator(80.0, 0.06, 0.03), jq.LaggedIntegrator(60.0, 0.04, 0.04)
    clean = response_of(truth, seed=0)

    def with_last(size: float, error: float) -> jq.identify.Fit:
        response, errors = np.array(clean.response), np.array(clean.random_error)
        response[-1] *= size
        errors[-1] = error
        changed = {"response": jnp.asarray(response), "random_error": jnp.asarray(errors)}
        return jq.fit(start, dataclasses.replace(clean, **changed))

    inside = jq.fit(start, clean, band=(OMEGA[0], OMEGA[-2]))
    np.testing.assert_array_equal(with_last(300.0, 0.6).values, inside.values)
    assert np.any(with_last(0.5, 0.4).values != inside.values)  # low by chance
