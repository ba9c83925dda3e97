"""What a record cannot tell is said before any number is read."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import response_of

import jaxquad as jq
from jaxquad.identify.uncertainty._zero_bounds import one_sided, one_sided_limits, polish


ML = jq.identify.MaximumLikelihood()
RIG = jq.models.AttitudeAxis(L=0.197, K_t=0.1188, J_x=0.0552, lag=0.02)
GAIN = 0.197 * 0.1188 / 0.0552
ADDED = 0.0276
STARTS = [(0.05, 0.02), (0.3, 0.02), (0.05, 0.4), (0.9, 0.5)]


def start(K_t=0.2, J_x=0.1, lag=0.03):
    return jq.models.AttitudeAxis(L=0.197, K_t=K_t, J_x=J_x, lag=lag)


@pytest.fixture(scope="module")
def alone():
    return jq.fit(start(), response_of(RIG, seed=0), free=("J_x", "K_t", "lag"), cost=ML)


def test_inertia_and_thrust_are_refused_in_the_users_own_names(alone):
    text = str(alone)
    assert not alone.identifiable
    assert text.splitlines()[0].startswith("NOT IDENTIFIABLE")
    assert "only L K_t / J_x is determined by this record" in text
    assert "+0.707 J_x" in text and "+0.707 K_t" in text
    assert "jq.identify.Prior" in text and "second record" in text


def test_numbers_behind_a_refusal_are_kept_and_marked(alone):
    assert alone.determined.tolist() == [False, False, True]
    assert alone.values[0] == float(alone.model.J_x) and np.isinf(alone.standard_errors[:2]).all()
    assert alone.values[2] == pytest.approx(0.02, rel=0.2)
    row = next(line for line in str(alone).splitlines() if line.startswith("J_x *"))
    assert f"{alone.values[0]:.5g}" in row and "inf" in row and "not determined" in row
    assert "lag *" not in str(alone)


def test_the_determined_combination_has_its_own_error_bar(alone):
    (ratio,) = alone.combinations
    assert ratio.name == "L K_t / J_x"
    assert abs(ratio.value - GAIN) < 3 * ratio.standard_error < 0.1 * GAIN
    gain = alone.derived(lambda m: m.gain, "gain")
    assert gain.value == pytest.approx(ratio.value, rel=1e-9)
    assert gain.standard_error == pytest.approx(ratio.standard_error, rel=1e-6)
    low, high = ratio.interval
    assert low < ratio.value < high and f"{ratio.value:.5g}" in str(ratio)


def test_a_quantity_along_the_null_direction_is_refused(alone):
    with pytest.raises(jq.identify.UndeterminedError, match="J_x"):
        alone.derived(lambda m: m.J_x, "J_x")


def test_four_starts_give_four_pairs_and_one_ratio():
    frf = response_of(RIG, seed=1)
    fits = [jq.fit(start(*pair), frf, free=("J_x", "K_t", "lag"), cost=ML) for pair in STARTS]
    pairs = np.array([(float(f.model.J_x), float(f.model.K_t)) for f in fits])
    ratios = np.array([fit.combinations[0].value for fit in fits])
    assert np.ptp(np.log(pairs[:, 0])) > 1
    np.testing.assert_allclose(ratios, ratios[0], rtol=1e-6)
    np.testing.assert_allclose([fit.cost for fit in fits], fits[0].cost, rtol=1e-9)


def add_inertia(model):
    return model.with_added_inertia(ADDED)


@pytest.mark.slow
def test_a_second_record_under_known_added_inertia_tells_them_apart():
    frfs = response_of(RIG, seed=2), response_of(add_inertia(RIG), seed=3)
    both = jq.fit(
        start(), frfs, free=("J_x", "K_t", "lag"), conditions=(None, add_inertia), cost=ML
    )
    assert both.identifiable and both.condition < 100
    np.testing.assert_array_less(
        np.abs(both.values - [0.0552, 0.1188, 0.02]), 3 * both.standard_errors
    )
    # The error of the ratio is amplified by about (1 + J / dJ) sqrt(2).
    gain = both.derived(lambda m: m.gain, "gain")
    growth = (both.standard_errors[0] / both.values[0]) / (gain.standard_error / gain.value)
    assert 2 < growth < 8


@pytest.mark.slow
def test_a_static_torque_tells_them_apart():
    """Hanging a known mass on the arm gives L K_t, here to 1 %."""
    prior = jq.identify.Prior(lambda m: m.L * m.K_t, 0.197 * 0.1188, 0.01 * 0.197 * 0.1188)
    frf = response_of(RIG, seed=4)
    fit = jq.fit(start(), frf, free=("J_x", "K_t", "lag"), cost=ML, priors=[prior])
    assert fit.identifiable
    np.testing.assert_allclose(fit.values[:2], [0.0552, 0.1188], rtol=0.03)
    assert fit.standard_errors[1] / fit.values[1] == pytest.approx(0.01, rel=0.01)


def test_a_variance_below_zero_by_rounding_is_left_alone():
    covariance = np.array([[-1e-20, 0.0], [0.0, 1.0]])
    np.testing.assert_array_equal(one_sided(covariance, 0, -1.0), covariance)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("below", [49.0, 51.0, 1e4, 1e8])
def test_an_optimum_far_below_zero_leaves_the_tail_of_an_exponential_distribution(below):
    """Its second moment is 2 / below^2 to first order, and nothing overflows on the way."""
    [[variance]] = one_sided(np.array([[4.0]]), 0, -2.0 * below)
    assert variance == pytest.approx(8.0 / below**2 - 40.0 / below**4 + 296.0 / below**6, rel=1e-6)


def controller_at(share):
    """A response that a remark calls the controller's at its lowest frequencies."""
    frf = response_of(jq.LaggedIntegrator(8.0, 0.05, 0.03), error=0.02, seed=1)
    omega = np.asarray(frf.omega)
    pair = frf.output_names[0], frf.input_names[0]
    omega = omega[: round(share * omega.size)]
    remark = jq.spectra.Remark("feedback-dominated: {where}", omega, pair, jq.spectra.DOMINATED)
    return dataclasses.replace(frf, remarks=(remark,))


@pytest.mark.slow
def test_a_response_that_is_mostly_the_controllers_has_no_model():
    """However well one fits: no other structure is advised."""
    start = jq.LaggedIntegrator(8.0, 0.05, 0.03)
    verdict = (fit := jq.fit(start, controller_at(0.7), cost=ML)).verdict
    assert verdict.kind == "no model" and not fit.determined.any()
    assert "21 of the 30 points in use" in verdict.reasons[0] and "-1/C" in verdict.reasons[0]
    assert "references=" in verdict.remedies[0] and len(verdict.remedies) == 2
    assert len(fit.remarks) == 1
    assert jq.fit(start, controller_at(0.3), cost=ML).identifiable


def test_a_prior_that_only_the_model_error_reconciles_with_the_record_is_suspected():
    truth = jq.LaggedIntegrator(60.0, 0.04, 0.015)
    frf = response_of(truth, error=0.003, seed=0)
    for gain, suspected in ((80.0, True), (60.0, False)):
        fit = jq.fit(truth, frf, cost=ML, priors=[jq.identify.Prior("gain", gain, 0.1)])
        assert (
            any("prior which the record contradicts" in each for each in fit.remarks) == suspected
        )


def test_along_the_null_direction_the_posterior_is_the_prior_and_is_called_so():
    frf = response_of(RIG, seed=4)
    prior = jq.identify.Prior("K_t", 0.1188, 0.006)
    fit = jq.fit(start(), frf, free=("J_x", "K_t", "lag"), cost=ML, priors=[prior])
    assert fit.identifiable
    assert fit.values[1] == pytest.approx(0.1188, rel=1e-4)
    assert fit.standard_errors[1] == pytest.approx(0.006, rel=1e-3)
    assert any("determined by the prior alone" in remark for remark in fit.remarks)


@pytest.mark.slow
@pytest.mark.parametrize("band", [(3.0, 12.0), (1.0, 6.0)], ids=["inside", "delay runs to zero"])
def test_lag_and_delay_of_a_narrow_band_are_determined_as_a_sum(band):
    truth = jq.LaggedIntegrator(280.0, 0.016, 0.011)
    frf = response_of(truth, error=0.04, seed=0, omega=np.geomspace(band[0], band[1], 30))
    fit = jq.fit(jq.LaggedIntegrator(280.0, 0.02, 0.02), frf, free=("lag", "delay"), cost=ML)
    (total,) = fit.combinations
    assert total.name == "lag + delay" and not fit.determined.any()
    assert abs(total.value - 0.027) < 3 * total.standard_error < 0.01


@pytest.mark.slow
def test_a_narrow_band_is_named_with_a_wider_one_to_excite():
    truth = jq.LaggedIntegrator(8.0, 0.05, 0.03)
    narrow = response_of(truth, omega=np.geomspace(5.0, 8.0, 30), error=0.05, seed=2)
    fit = jq.fit(truth, narrow, cost=ML)
    assert fit.verdict.remedies[0].startswith(
        "excite the axis (jq.sweep) over more than 5 to 8 rad/s (0.796 to 1.27 Hz)"
    )
    few = jq.fit(truth, response_of(truth, omega=np.geomspace(5.0, 8.0, 4)), cost=ML)
    assert few.verdict.kind == "too few points" and "5 to 8 rad/s" in few.verdict.remedies[0]
    hover = jq.spectra.Remark("the reference explains neither", kind=jq.spectra.DOMINATED)
    four = response_of(truth, omega=np.geomspace(5.0, 8.0, 4))
    fed_back = dataclasses.replace(four, remarks=(hover,))
    assert jq.fit(truth, fed_back, cost=ML).verdict.remedies == (
        "excite the axis (jq.sweep), record longer, or use a longer window",
    )
    wide = response_of(truth, omega=np.geomspace(0.5, 8.0, 30), error=0.2, seed=0)
    lost = jq.fit(truth, wide, cost=ML).verdict
    assert lost.undetermined and not any("excite" in remedy for remedy in lost.remedies)


def test_no_wider_band_is_advised_where_none_would_help(alone):
    assert alone.verdict.undetermined and not any(
        "excite" in each for each in alone.verdict.remedies
    )


@pytest.mark.slow
def test_a_common_factor_of_numerator_and_denominator_is_not_determined():
    truth = jq.TransferFunction([8.0], [1.0, 3.0, 9.0])
    fit = jq.fit(truth, response_of(truth, seed=0), cost=ML, free=("numerator", "denominator"))
    assert set(fit.verdict.undetermined) == set(fit.names)
    shares = np.array(list(fit.verdict.null_directions[0].values()))
    np.testing.assert_allclose(np.abs(shares), 0.5, atol=1e-3)
    assert len(fit.combinations) == 3


@pytest.mark.slow
def test_a_parameter_without_effect_is_named():
    frf = response_of(RIG, seed=0)
    fit = jq.fit(start(), frf, free=("K_t", "lag", jq.identify.Real("K_af", scale=1e-9)), cost=ML)
    assert fit.verdict.undetermined == ("K_af",)
    assert "nothing about it is determined" in str(fit)
    assert np.isfinite(fit.values[:2]).all()


@pytest.mark.slow
def test_a_well_posed_fit_says_nothing_of_the_kind():
    fit = jq.fit(start(), response_of(RIG, seed=0), free=("K_t", "lag"), cost=ML)
    assert fit.identifiable and not fit.verdict.null_directions and "NOT" not in str(fit)


@pytest.mark.slow
def test_what_is_fixed_takes_part_in_names_only_where_it_acts_alike():
    """The arm acts as the thrust does; the lag does not."""
    frf = response_of(RIG, seed=0)
    fit = jq.fit(start(lag=0.02), frf, free=("J_x", "K_t"), cost=ML)
    assert [c.name for c in fit.combinations] == ["L K_t / J_x"]


class Sum(eqx.Module):
    """A gain that is the sum of three, and one that is a product with a sum."""

    a: jax.Array
    b: jax.Array
    c: jax.Array
    product: bool = eqx.field(static=True, default=False)

    def frequency_response(self, omega):
        s = jax.lax.complex(jnp.zeros_like(omega), omega)
        gain = self.a * (self.b + self.c) if self.product else self.a + self.b + self.c
        return (gain.astype(s.dtype) / s)[:, None, None]


def summed(values, product=False):
    a, b, c = (jnp.asarray(float(value)) for value in values)
    return Sum(a, b, c, product)


@pytest.mark.slow
@pytest.mark.parametrize("values", [(2, 2, 2), (1, 3, 5), (0.5, 0.5, 9)])
def test_a_sum_is_never_taken_for_a_product(values):
    """At equal values the two are alike to first order: only a finite move tells."""
    fit = jq.fit(summed(values), response_of(summed((2, 2, 4)), seed=0), cost=ML)
    (total,) = fit.combinations
    assert total.name == "a + b + c" and abs(total.value - 8) < 3 * total.standard_error
    with pytest.raises(jq.identify.UndeterminedError):
        fit.derived(lambda m: m.a * m.b * m.c, "a b c")


@pytest.mark.slow
def test_what_is_no_product_and_no_sum_is_not_named():
    truth, start = summed((2, 2, 2), True), summed((1, 3, 5), True)
    fit = jq.fit(start, response_of(truth, seed=0), cost=ML)
    assert not fit.combinations and not fit.identifiable
    assert "neither a product nor a sum" in str(fit)
    with pytest.raises(jq.identify.UndeterminedError):
        fit.derived(lambda m: m.a**2 * m.b * m.c)


def test_a_fit_from_the_wrong_sign_is_doubted_aloud():
    frf = response_of(jq.LaggedIntegrator(8.0, 0.1, 0.02), seed=0)
    fit = jq.fit(jq.LaggedIntegrator(-8.0, 0.1, 0.02), frf, cost=ML)
    assert not fit.identifiable
    assert any("minimum" in remark and "starting values" in remark for remark in fit.remarks)


@pytest.mark.slow
def test_where_there_is_no_minimum_no_number_is_given():
    frf = response_of(jq.LaggedIntegrator(8.0, 0.1, 0.02), seed=0)
    fit = jq.fit(jq.LaggedIntegrator(2.0, 0.4, 0.1), frf, cost=ML, max_steps=1)
    assert not fit.identifiable and not fit.combinations
    assert fit.verdict.kind == "no minimum" and not fit.verdict and not fit.determined.any()
    assert np.isinf(fit.standard_errors).all() and "NO MINIMUM" in str(fit)
    assert any(remark.kind == "no minimum" for remark in fit.remarks)
    assert "has not converged" in str(fit) and "more steps (max_steps=)" in fit.verdict.remedies[0]
    assert "the fit found no minimum: where the solver stopped" in str(fit)


@pytest.mark.slow
@pytest.mark.parametrize("steps", [1, 2, 3, 4, 5])
def test_a_fit_that_still_moves_by_a_quarter_of_an_error_has_no_numbers(steps):
    frf = response_of(jq.LaggedIntegrator(280.0, 0.016, 0.011), seed=0)
    start = jq.LaggedIntegrator(150.0, 0.03, 0.02)
    whole, short = jq.fit(start, frf), jq.fit(start, frf, max_steps=steps)
    off = np.max(np.abs(short.values - whole.values) / whole.noise_standard_errors)
    assert short.identifiable == (off < 0.25), f"{off:.2f} standard errors off"
    assert steps != 3 or 0.25 < off < 1.0  # one of them is near enough to look like a minimum


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_no_number_has_an_error_of_more_than_half_its_size(seed):
    # at .3, the largest error of a point that counts, rounding would say which points do
    frf = response_of(jq.LaggedIntegrator(8.0, 0.02, 0.0), error=0.29, seed=seed)
    fit = jq.fit(jq.LaggedIntegrator(8.0, 0.03), frf, free=("gain", "lag"), cost=ML)
    bounded = np.isin(fit.names, [bound.name for bound in fit.verdict.bounds])
    sharp = fit.determined & ~bounded
    assert np.all(fit.standard_errors[sharp] <= 0.5 * np.abs(fit.values[sharp]))
    assert set(np.array(fit.names)[~fit.determined]) == set(fit.verdict.undetermined)


def narrow(noise, seed, low=0.5, high=6.0, duration=60.0, omega=None):
    """Lag and delay of 20 ms each, from a sweep that ends far below 1 / lag."""
    truth = jq.LaggedIntegrator(gain=80.0, lag=0.02, delay=0.02)
    sweep = jq.sweep(low, high, duration=duration, sample_rate=100.0, amplitude=1.0)
    clean = np.asarray(jq.models.simulate_linear(truth.transfer_function(), sweep.signal, 0.01))
    rate = clean + np.random.default_rng(seed).normal(0, noise, clean.size)
    record = jq.Record(sweep.time, sweep.signal, rate, input_names="u", output_names="q")
    frf = jq.frequency_response(record, omega, estimator=jq.spectra.LocalPolynomial(integrators=1))
    start = jq.LaggedIntegrator(gain=70.0, lag=0.02, delay=0.02)
    return jq.fit(start, frf)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 3, 4])
def test_what_a_blurred_parameter_is_determined_with_is_named_whatever_direction_blurs_it(seed):
    fit = narrow(2.0, seed)
    assert "delay" in fit.verdict.undetermined
    (combination,) = fit.combinations
    assert combination.name == "lag + delay"
    assert abs(combination.value - 0.045) < 4 * combination.standard_error  # half a sample of hold
    alone = set(fit.verdict.undetermined) == {"lag", "delay"}
    assert ("only lag + delay" in str(fit)) == alone and "lag + delay is determined" in str(fit)


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "seed"), [(15.0, 1), (15.0, 2), (20.0, 0), (20.0, 2)])
def test_a_combination_whose_error_is_a_third_of_its_size_is_not_determined(noise, seed):
    fit = narrow(noise, seed, 1.0, 8.0, duration=20.0, omega=np.geomspace(1.5, 8.0, 40))
    assert not fit.identifiable
    for found in fit.combinations:
        assert found.standard_error <= 0.3 * abs(found.value)


@pytest.mark.slow
def test_a_value_that_the_record_does_not_determine_is_not_given_by_its_name():
    truth = jq.models.AttitudeAxis(L=0.2, K_t=0.1, J_x=0.05, lag=0.05)
    fit = jq.fit(truth, response_of(truth, seed=0), free=("K_t", "J_x", "lag"), cost=ML)
    assert fit["lag"] == fit.values[2]
    for k, name in enumerate(("K_t", "J_x")):
        said = rf"{name} has no value of its own: .*only L K_t / J_x.* fit.values\[{k}\]"
        with pytest.raises(jq.identify.UndeterminedError, match=said):
            fit[name]


NARROW = np.geomspace(1.0, 6.0, 30)


@pytest.mark.slow
def test_what_ran_to_zero_and_is_mixed_up_with_another_is_refused_with_it():
    frf = response_of(jq.LaggedIntegrator(280.0, 0.016, 0.011), error=0.04, seed=0, omega=NARROW)
    fit = jq.fit(jq.LaggedIntegrator(280.0, 0.02, 0.02), frf, free=("lag", "delay"), cost=ML)
    ran = [remark for remark in fit.remarks if "ran to zero" in remark]
    assert ran and not any("no minimum" in remark for remark in fit.remarks)
    assert not fit.verdict.bounds and not fit.determined.any()
    assert [one.name for one in fit.combinations] == ["lag + delay"]


STARTS_OF_A_LAG = [(70.0, 0.03), (90.0, 20.0), (70.0, 1e-4), (80.0, 1e-9)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2])
def test_a_lag_that_may_be_zero_has_one_verdict_from_every_start(seed):
    """Of seed 0 the best lag is zero, of seed 2 a third of its standard error."""
    frf = response_of(jq.LaggedIntegrator(80.0, 1e-9, 0.02), error=0.05, seed=seed)
    fits = [
        jq.fit(jq.LaggedIntegrator(*start, 0.02), frf, free=("gain", "lag"), cost=ML)
        for start in STARTS_OF_A_LAG
    ]
    first = fits[0]
    assert first.identifiable and not first.remarks
    (bound,) = first.verdict.bounds
    assert f"lag: {first.values[1]:.3g}, below {bound.limit:.3g} (95 %)" in str(first.verdict)
    assert first.interval("lag") == (0.0, bound.limit)
    for other in fits[1:]:
        assert other.identifiable and not other.remarks
        np.testing.assert_allclose(other.values, first.values, rtol=1e-5)
        np.testing.assert_allclose(other.interval("gain"), first.interval("gain"), rtol=1e-5)
        np.testing.assert_allclose(other.verdict.bounds[0].limit, bound.limit, rtol=0.02)


@pytest.mark.parametrize("seed", [0, 2])
def test_a_limit_of_another_level_is_where_the_cost_has_risen_by_as_much(seed, monkeypatch):
    """The profile is searched to 2 % of its rise: to 1 % of the limit."""
    frf = response_of(jq.LaggedIntegrator(80.0, 1e-9, 0.02), error=0.05, seed=seed)
    start = jq.LaggedIntegrator(70.0, 0.03, 0.02)
    fit = jq.fit(start, frf, free=("gain", "lag"), cost=ML)
    for level, score in ((0.68, 0.4677), (0.9, 1.2816), (0.999, 3.0902)):
        monkeypatch.setattr("jaxquad.identify.uncertainty._zero_bounds._RISE", score**2)
        (bound,) = jq.fit(start, frf, free=("gain", "lag"), cost=ML).verdict.bounds
        for model_error, limit in ((True, bound.limit), (False, bound.noise_limit)):
            low, high = fit.interval("lag", level=level, model_error=model_error)
            assert low == 0 and high == pytest.approx(limit, rel=0.02)


def test_a_limit_that_rounding_hides_is_infinite_and_a_model_without_numbers_no_error(monkeypatch):
    """A lag at zero beside a free delay may have a variance of -10, or reach 1e300 s."""
    calls = []
    watched = lambda *given: calls.append(given) or one_sided_limits(*given)
    monkeypatch.setattr("jaxquad.identify.uncertainty._zero_bounds.one_sided_limits", watched)
    frf = response_of(jq.LaggedIntegrator(80.0, 1e-9, 0.02), error=0.05, seed=0)
    jq.fit(jq.LaggedIntegrator(70.0, 0.03, 0.02), frf, free=("gain", "lag"), cost=ML)
    [(problem, solution, k, inflations)] = calls
    limits, _ = one_sided_limits(problem, solution, k, (-10.0, np.nan, np.inf, *inflations))
    assert limits[:3] == [np.inf] * 3 and 0 < limits[3] < 0.01
    for far in (700.0, 800.0, np.inf):
        z = np.where(np.arange(2) == k, far, solution.z)
        assert not np.isfinite(polish(problem, z, [k], solution)[1].cost)


def test_a_pole_that_runs_away_is_named_with_all_that_goes_with_it():
    names = ("numerator[0]", "denominator[1]", "denominator[2]")
    truth = jq.TransferFunction([30.0], [1.0, 3.0], delay=0.01)
    start = jq.TransferFunction([900.0], [1.0, 40.0, 90.0], delay=0.01)
    fit = jq.fit(start, response_of(truth, seed=0), free=names)
    assert fit.verdict.undetermined == names
    (ran,) = [remark for remark in fit.remarks if remark.kind == "runaway"]
    assert ran.startswith(", ".join(names))
