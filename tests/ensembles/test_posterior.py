"""Draws from a fit are as far apart as its errors say, and only where the record says anything."""

import dataclasses
import functools as ft
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import response_of

import jaxquad as jq
from jaxquad.ensembles import Ensemble, LogUniform, make_plant, Normal, Posterior, Uniform


pytestmark = pytest.mark.slow


ML, KEY = jq.identify.MaximumLikelihood(), jax.random.key(0)
RIG = jq.models.AttitudeAxis(L=0.197, K_t=0.1188, J_x=0.0552, lag=0.02)
START = jq.models.AttitudeAxis(L=0.197, K_t=0.2, J_x=0.1, lag=0.03)
GAIN = 0.197 * 0.1188 / 0.0552
MANY = 20000  # draws, which know a standard deviation to 0.5 %
INTEGRATOR = jq.LaggedIntegrator(280.0, 0.016, 0.011)
WIDE, NARROW = np.geomspace(1.0, 60.0, 30), np.geomspace(3.0, 12.0, 30)  # rad/s


def fit_rig(seed=0):
    return jq.fit(START, response_of(RIG, seed=seed), free=("J_x", "K_t", "lag"), cost=ML)


@ft.cache
def ratio_fit():
    """J_x and K_t are not determined, their ratio is."""
    return fit_rig()


@ft.cache
def sum_fit():
    """Lag and delay are not determined, their sum is, and so is the gain."""
    frf = response_of(INTEGRATOR, error=0.04, seed=0, omega=NARROW)
    return jq.fit(jq.LaggedIntegrator(280.0, 0.02, 0.02), frf, cost=ML)


def integrator_fit(truth: Any = INTEGRATOR, error=0.01, gain=280.0):
    frf = response_of(truth, error=error, seed=0, omega=WIDE)
    return jq.fit(jq.LaggedIntegrator(gain, 0.02, 0.02), frf, cost=ML)


@ft.cache
def sharp_fit():
    return integrator_fit()


@ft.cache
def transfer_function_fit():
    """The same response and the same free numbers as in `sharp_fit`."""
    start = jq.TransferFunction([280.0], [0.02, 1.0, 0.0], 0.02)
    frf = response_of(INTEGRATOR, error=0.01, seed=0, omega=WIDE)
    return jq.fit(start, frf, cost=ML, free=("numerator", "denominator[0]", "delay"))


class Rotor(eqx.Module):
    """A model of a user's own, with the numbers of `sharp_fit`."""

    gain: float
    lag: float
    late: float

    def transfer_function(self):
        return jq.TransferFunction([self.gain], [self.lag, 1.0, 0.0], self.late)

    def frequency_response(self, omega):
        return self.transfer_function().frequency_response(omega)


def gain_of(drawn):
    return np.asarray(drawn.L * drawn.K_t / drawn.J_x)


def spread(values):
    return float(np.std(np.asarray(values)))


def test_draws_have_the_mean_and_covariance_of_the_fit():
    fit = sharp_fit()
    drawn = fit.ensemble(MANY, KEY)
    values = np.stack([drawn.gain, drawn.lag, drawn.delay])
    np.testing.assert_allclose(values.mean(axis=1), fit.values, rtol=1e-3)
    errors = fit.standard_errors
    cov = np.cov(values) / np.outer(errors, errors)
    # 1 % errors: a logarithm's curvature adds less than what 20000 draws know.
    np.testing.assert_allclose(cov, fit.correlation, atol=0.03)


def test_draws_of_logarithms_are_log_normal_and_never_negative():
    fit = integrator_fit(error=0.2)
    lag = np.asarray(fit.ensemble(MANY, KEY).lag)
    relative = fit.standard_errors[1] / fit.values[1]
    assert relative > 0.15 and np.all(lag > 0)
    assert spread(np.log(lag)) == pytest.approx(relative, rel=0.03)
    assert np.median(lag) == pytest.approx(fit.values[1], rel=0.01)


def test_errors_widened_by_model_error_widen_the_draws():
    """A second lag that the model does not have."""
    truth = jq.TransferFunction([280.0], np.convolve([0.016, 1.0], [0.1, 1.0, 0.0]), 0.011)
    fit = integrator_fit(truth)
    assert fit.standard_errors[0] > 3 * fit.noise_standard_errors[0]
    drawn = fit.ensemble(MANY, KEY)
    assert spread(drawn.gain) == pytest.approx(fit.standard_errors[0], rel=0.05)


def test_only_what_is_free_or_tied_gets_a_last_axis():
    """And a parameter that may cross zero is drawn as it is."""
    free = ("K_t", jq.identify.Real("K_af", scale=1e-2))
    frf = response_of(RIG, seed=0, error=0.05)
    fit = jq.fit(START, frf, free=free, tied={"lag": lambda m: 0.1 * m.K_t}, cost=ML)
    drawn = fit.ensemble(MANY, KEY)
    assert drawn.K_t.shape == drawn.lag.shape == drawn.K_af.shape == (MANY,)
    np.testing.assert_allclose(drawn.lag, 0.1 * np.asarray(drawn.K_t), rtol=1e-12)
    assert drawn.J_x.shape == drawn.L.shape == () and float(drawn.J_x) == 0.1
    assert spread(drawn.K_af) == pytest.approx(fit.standard_errors[1], rel=0.03)
    assert drawn.K_af.min() < 0 < drawn.K_af.max()


def test_elements_of_an_array_are_drawn_in_place():
    fit = transfer_function_fit()
    drawn = fit.ensemble(MANY, KEY)
    assert drawn.denominator.shape == (3, MANY) and drawn.numerator.shape == (1, MANY)
    np.testing.assert_array_equal(np.asarray(drawn.denominator)[1:].T, [[1.0, 0.0]] * MANY)
    assert spread(drawn.denominator[0]) == pytest.approx(fit.standard_errors[1], rel=0.03)


def test_the_key_alone_decides_the_draws():
    one, again, other = (sharp_fit().ensemble(5, key) for key in (KEY, KEY, jax.random.key(1)))
    np.testing.assert_array_equal(one.lag, again.lag)
    assert not np.intersect1d(one.lag, other.lag).size


def test_what_is_not_determined_is_not_drawn():
    with pytest.raises(
        jq.identify.UndeterminedError, match=r"J_x, K_t \(only L K_t / J_x is\).*jq.identify.Prior"
    ):
        ratio_fit().ensemble(5, KEY)


def test_held_directions_leave_the_spread_of_what_is_determined():
    fit = ratio_fit()
    drawn = fit.ensemble(MANY, KEY, hold_undetermined=True)
    gain = fit.derived(lambda m: m.gain)
    assert spread(gain_of(drawn)) == pytest.approx(gain.standard_error, rel=0.03)
    assert spread(drawn.lag) == pytest.approx(fit.standard_errors[2], rel=0.03)
    assert np.mean(gain_of(drawn)) == pytest.approx(gain.value, rel=1e-3)
    # J and K stay at the fitted point but for half of the ratio's spread each.
    assert spread(drawn.J_x) < 0.01 * float(fit.model.J_x)


def test_directions_lost_in_noise_are_held_and_the_rest_keeps_its_spread():
    fit = sum_fit()
    assert not len(fit.verdict.exact) and fit.verdict.undetermined
    drawn = fit.ensemble(MANY, KEY, hold_undetermined=True)
    total = fit.derived(lambda m: m.lag + m.delay)
    assert spread(drawn.gain) == pytest.approx(fit.standard_errors[0], rel=0.03)
    assert spread(drawn.lag + drawn.delay) == pytest.approx(total.standard_error, rel=0.05)


@pytest.mark.parametrize("n", [0, -1, True])
def test_numbers_of_draws_that_make_no_sense_are_refused(n):
    with pytest.raises(ValueError, match="1 or more"):
        sharp_fit().ensemble(n, KEY)


def test_a_fit_without_a_minimum_is_refused():
    remark = jq.spectra.Remark("no minimum: one more step ...", kind="no minimum")
    lost = dataclasses.replace(sharp_fit(), remarks=(remark,))
    for hold in (False, True):
        with pytest.raises(ValueError, match="no minimum"):
            lost.ensemble(5, KEY, hold_undetermined=hold)
    with pytest.raises(ValueError, match="no minimum"):
        posterior_of(lost, believed=1.0)


def test_a_fit_without_finite_errors_is_refused():
    broken = dataclasses.replace(sharp_fit(), relative_covariance=np.full((3, 3), np.inf))
    with pytest.raises(ValueError, match="not finite"):
        broken.ensemble(5, KEY)


def test_a_parameter_at_zero_is_drawn_on_its_side_of_it():
    frf = response_of(jq.LaggedIntegrator(8.0, 0.1, 0.0), error=0.005, seed=6, omega=WIDE)
    fit = jq.fit(jq.LaggedIntegrator(8.0, 0.1, 0.03), frf, cost=ML)
    (bound,) = fit.verdict.bounds
    assert fit.identifiable and bound.name == "delay" and not fit.remarks
    drawn = np.asarray(fit.ensemble(2000, KEY).delay)
    assert drawn.min() >= 0
    # Half a normal distribution, as the draws are, has its limit by the likelihood ratio (95 %,
    # one-sided) at 1.645 deviations: 2 Phi(1.645) - 1 = 0.9 of it lies below, and less where the
    # optimum lies below zero, as here.
    below = np.mean(drawn < bound.limit)
    assert below == pytest.approx(math.erf(bound.limit / fit.standard_errors[2] / 2**0.5), abs=0.02)
    assert 0.86 < below < 0.91
    assert np.sqrt(np.mean(drawn**2)) == pytest.approx(fit.standard_errors[2], rel=0.05)


def test_the_truth_lies_in_the_range_of_the_draws_as_often_as_it_should():
    """Of 100 records the 95 % range of b holds the truth in 95, known to 2.2."""
    held = 0
    for seed in range(100):
        fit = fit_rig(seed)
        gain = gain_of(fit.ensemble(1000, KEY, hold_undetermined=True))
        low, high = np.quantile(gain, [0.025, 0.975])
        held += low < GAIN < high
    assert 88 <= held <= 100


class Around(NamedTuple):
    """An ensemble of a posterior around its nominal loop."""

    loop: jq.Loop
    ensemble: Ensemble

    def draw(self, n, key) -> Any:  # the plants are of any kind that an ensemble varies
        return self.ensemble.draw(self.loop, n, key)

    def fresh(self, n, key) -> Any:
        return self.ensemble.fresh(self.loop, n, key)


OF_POSTERIOR = ("recorded_dt", "believed", "plant")


def posterior_of(fit, **options) -> Around:
    given: dict[str, Any] = {"recorded_dt": 0.01} | options
    distributions = {name: x for name, x in given.items() if name not in OF_POSTERIOR}
    posterior = Posterior(fit, **{name: x for name, x in given.items() if name in OF_POSTERIOR})
    loop = jq.Loop(posterior.plant, jq.LADRC(10.0, 30.0, 1.0), delay=posterior.delay)
    return Around(loop, Ensemble(posterior, **distributions))


def test_plants_are_drawn_from_an_attitude_axis_with_a_believed_inertia():
    fit = ratio_fit()
    members = posterior_of(fit, believed=0.0552).draw(4096, KEY)
    gain = fit.derived(lambda m: m.gain)
    assert np.mean(members.plant.gain) == pytest.approx(gain.value, rel=1e-3)
    assert spread(members.plant.gain) == pytest.approx(gain.standard_error, rel=0.03)
    assert np.all(np.asarray(members.plant.inertia) == 0.0552)
    assert np.all(np.asarray(members.assumed_inertia) == 0.0552)
    assert spread(members.plant.lag) == pytest.approx(fit.standard_errors[2], rel=0.03)


def test_a_plant_that_needs_what_is_not_determined_is_refused():
    with pytest.raises(
        jq.identify.UndeterminedError, match="inertia, torque_gain .*J_x, K_t.*believed="
    ):
        posterior_of(ratio_fit())
    with pytest.raises(jq.identify.UndeterminedError, match="delay, lag .*distribution instead"):
        posterior_of(sum_fit(), believed=1.0)
    with pytest.raises(jq.identify.UndeterminedError, match="delay would"):
        posterior_of(sum_fit(), believed=1.0, lag=Uniform(0.01, 0.02))


def test_laws_replace_what_is_not_determined():
    fit = sum_fit()
    ensemble = posterior_of(fit, believed=1.0, lag=Uniform(0.01, 0.02), delay=0.011)
    members = ensemble.draw(4096, KEY)
    assert spread(members.plant.gain) == pytest.approx(fit.standard_errors[0], rel=0.03)
    assert np.all(np.asarray(members.delay) == 0.011) and members.longest_delay == 0.011
    lag = np.asarray(members.plant.lag)
    assert lag.min() == pytest.approx(0.01, rel=1e-3) and lag.max() == pytest.approx(0.02, rel=1e-3)


def test_factors_multiply_what_is_drawn_and_the_inertia_told_is_the_believed_one():
    ensemble = posterior_of(
        ratio_fit(), believed=0.0552, inertia=LogUniform(0.5, 3.0), assumed_inertia=Normal(0.1)
    )
    members = ensemble.draw(1024, KEY)
    inertia = np.asarray(members.plant.inertia[0])
    assert inertia.min() == pytest.approx(0.0276, rel=0.01)
    assert inertia.max() == pytest.approx(0.1656, rel=0.01)
    torque = np.asarray(members.plant.torque_gain[0]) / 0.0552
    assert np.std(torque) == pytest.approx(
        ratio_fit().derived(lambda m: m.gain).standard_error, rel=0.06
    )
    error = np.asarray(members.assumed_inertia[0]) / inertia
    assert np.std(error) == pytest.approx(0.1, rel=0.05)


def test_a_transfer_function_and_a_lagged_integrator_give_the_same_plants():
    fits = sharp_fit(), transfer_function_fit()
    ours, theirs = (posterior_of(fit, believed=0.05).draw(1024, KEY) for fit in fits)
    for name in ("torque_gain", "lag"):
        a, b = (np.asarray(getattr(m.plant, name)[0]) for m in (ours, theirs))
        assert np.mean(a) == pytest.approx(np.mean(b), rel=1e-4)
        assert np.std(a) == pytest.approx(np.std(b), rel=0.03)
    assert float(np.mean(ours.delay)) == pytest.approx(float(np.mean(theirs.delay)), rel=1e-3)
    assert np.mean(ours.plant.gain) == pytest.approx(fits[0].values[0], rel=1e-3)


def test_a_model_of_ones_own_with_such_a_transfer_function_is_drawn_like_it():
    frf = response_of(INTEGRATOR, error=0.01, seed=0, omega=WIDE)
    fits = sharp_fit(), jq.fit(Rotor(280.0, 0.02, 0.02), frf, cost=ML)
    ours, theirs = (posterior_of(fit, believed=0.05).draw(1024, KEY) for fit in fits)
    for name in ("torque_gain", "lag"):
        a, b = (getattr(members.plant, name) for members in (ours, theirs))
        np.testing.assert_allclose(a, b, rtol=1e-6)
    np.testing.assert_allclose(ours.delay, theirs.delay, rtol=1e-6)


@pytest.mark.parametrize("integrators", [1, 2])
@pytest.mark.parametrize("lag", [0.016, 0.0])
def test_models_of_the_same_response_make_the_same_plant(integrators, lag):
    model = jq.LaggedIntegrator(28.0, lag, 0.011, integrators=integrators)
    scaled = jq.TransferFunction(
        3 * model.transfer_function().numerator, 3 * model.transfer_function().denominator, 0.011
    )
    models = [model, scaled]
    if integrators == 2:
        models.append(
            jq.models.AttitudeAxis(L=0.2, K_t=28.0 * 0.06 / 0.2, J_x=0.06, lag=lag, delay=0.011)
        )
    for one in models:
        plant, delay = make_plant(one, believed=0.05)
        assert float(plant.gain[0]) == pytest.approx(28.0) and float(delay) == 0.011
        assert float(plant.inertia[0]) == 0.05
        assert (plant.lag is None) == (lag == 0)
        assert plant.lag is None or float(plant.lag[0]) == pytest.approx(lag)


def test_half_a_sample_of_the_records_hold_is_taken_off_the_delay_down_to_zero():
    fit = sharp_fit()
    whole, half, none = (
        posterior_of(fit, believed=1.0, recorded_dt=dt).draw(1024, KEY) for dt in (None, 0.01, 0.1)
    )
    np.testing.assert_allclose(half.delay, whole.delay - 0.005, atol=1e-15)
    assert np.all(np.asarray(none.delay) == 0) and none.longest_delay == 0
    assert np.mean(whole.delay) == pytest.approx(fit.values[2], rel=1e-3)
    assert half.longest_delay == pytest.approx(0.01)  # whole samples, a quarter above all draws
    assert half.longest_delay >= 1.25 * np.max(half.delay)


def test_a_fit_that_models_the_hold_has_the_plants_own_delay():
    silent = sharp_fit()
    with pytest.raises(ValueError, match="does not know how long the command was held"):
        Posterior(silent, believed=1.0)
    frf = response_of(INTEGRATOR, error=0.01, seed=0, omega=WIDE)
    frf = dataclasses.replace(frf, hold=0.0)
    knows = jq.fit(jq.LaggedIntegrator(280.0, 0.02, 0.02), frf, cost=ML)
    assert Posterior(knows, believed=1.0).delay == knows.model.delay
    with pytest.raises(ValueError, match="models the hold of the command"):
        Posterior(knows, recorded_dt=0.01, believed=1.0)


def test_lag_and_delay_keep_the_correlation_of_the_fit():
    fit = sharp_fit()
    members = posterior_of(fit, believed=1.0).draw(4096, KEY)
    drawn = np.corrcoef(members.plant.lag[0], members.delay)[0, 1]
    assert drawn == pytest.approx(fit.correlation[1, 2], abs=0.03)


def test_draws_of_a_fit_have_one_shape_and_fresh_ones_are_others():
    ensemble = posterior_of(sharp_fit(), believed=1.0)
    one, other = ensemble.draw(8, KEY), ensemble.draw(8, jax.random.key(1))
    fresh = ensemble.fresh(8, KEY)
    kinds = [jax.tree.structure(members) for members in (one, other, fresh)]
    assert kinds[0] == kinds[1] == kinds[2]
    assert not np.intersect1d(one.plant.lag, fresh.plant.lag).size


class Pendulum(eqx.Module):
    """A model of a user's own."""

    stiffness: jax.Array  # k / J


def test_any_other_model_is_drawn_by_a_function_of_it():
    said = "a Pendulum cannot be converted.*: give plant=.* or give .* a method transfer_function"
    with pytest.raises(ValueError, match=said):
        make_plant(Pendulum(jnp.asarray(0.09)), believed=1.0)

    def plant(model):
        return jq.DecoupledAxes([0.05 * model.gain], [0.05], stiffness=[model.lag]), 0.002

    fit = sharp_fit()
    members = posterior_of(fit, plant=plant, recorded_dt=None).draw(1024, KEY)
    assert spread(members.plant.gain) == pytest.approx(fit.standard_errors[0], rel=0.05)
    assert spread(members.plant.stiffness) == pytest.approx(fit.standard_errors[1], rel=0.05)
    assert members.plant.lag is None and np.all(np.asarray(members.delay) == 0.002)


def test_functions_of_the_wrong_kind_and_models_without_a_form_are_refused():
    with pytest.raises(ValueError, match="pair"):
        posterior_of(sharp_fit(), plant=lambda m: m)
    with pytest.raises(ValueError, match="plant= or believed=, not both"):
        posterior_of(sharp_fit(), plant=lambda m: m, believed=1.0)
    with pytest.raises(ValueError, match="give believed="):
        posterior_of(sharp_fit())
    with pytest.raises(ValueError, match="believed"):
        posterior_of(sharp_fit(), believed=-1.0)
    with pytest.raises(ValueError, match="recorded_dt"):
        posterior_of(sharp_fit(), believed=1.0, recorded_dt=-0.01)
    with pytest.raises(ValueError, match="give the mean"):
        posterior_of(sharp_fit(), believed=1.0, lag=Normal(0.1)).draw(8, KEY)
    for denominator in ([1.0, 3.0, 9.0], [1.0, 3.0, 9.0, 0.0], [1.0, 0.0, 0.0, 0.0]):
        with pytest.raises(ValueError, match="is not K"):
            make_plant(jq.TransferFunction([8.0], denominator), believed=1.0)
    with pytest.raises(ValueError, match="3 integrators"):
        make_plant(jq.LaggedIntegrator(8.0, integrators=3), believed=1.0)


def test_a_plant_of_the_wrong_sign_is_refused():
    fit = integrator_fit(jq.LaggedIntegrator(-280.0, 0.016, 0.011), gain=-280.0)
    with pytest.raises(ValueError, match="torque_gain .*sign"):
        posterior_of(fit, believed=1.0)


def test_str_says_what_was_fitted():
    text = str(posterior_of(ratio_fit(), believed=0.0552, inertia=LogUniform(0.5, 3.0)).ensemble)
    assert "fit of J_x, K_t, lag" in text and "log-uniform 0.5 .. 3" in text


def test_a_loop_around_another_plant_than_the_identified_one_is_refused():
    ensemble = posterior_of(sharp_fit(), believed=1.0)
    other = ensemble.loop.with_plant(jq.DecoupledAxes([280.0], [2.0]))
    with pytest.raises(ValueError, match="posterior.plant"):
        ensemble.ensemble.draw(other, 8, KEY)
