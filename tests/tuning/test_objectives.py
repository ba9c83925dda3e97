"""What a tune minimises: quantities, penalties, limits and risks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tuning_case import ensemble, ladrc, loop

from jaxquad.ensembles import LogUniform, Uniform
from jaxquad.simulation import evaluate, Pulse, scenario, Step
from jaxquad.tuning import (
    CVaR,
    LBFGS,
    Limit,
    Mean,
    Mix,
    Objective,
    QUANTITIES,
    tune,
    Worst,
)


pytestmark = pytest.mark.usefixtures("compiled_quickly")
VALUES = np.random.default_rng(0).normal(size=37)


def soft(x):
    return np.log1p(np.exp(8 * x)) / 8


@pytest.mark.parametrize("share", [0.2, 0.333, 1.0, 0.01])
def test_cvar_is_the_least_over_its_levels_and_its_gradient_shares_out_the_worst(share):
    # Rockafellar and Uryasev: the least of t + mean(max(x - t, 0)) / share, which is at a member.
    bound = [t + np.mean(np.maximum(VALUES - t, 0)) / share for t in VALUES]
    assert float(CVaR(share)(jnp.asarray(VALUES))) == pytest.approx(np.min(bound), rel=1e-12)
    slope = np.asarray(jax.grad(CVaR(share))(jnp.asarray(VALUES)))
    assert np.sum(slope) == pytest.approx(1.0) and np.all(slope >= 0)
    assert np.all(np.diff(slope[np.argsort(VALUES)]) >= -1e-15)


def test_mean_worst_and_their_mix():
    x = jnp.asarray(VALUES)
    mixed = Mix(((0.5, Mean()), (0.25, Worst()), (0.25, CVaR(0.2))))
    expected = 0.5 * VALUES.mean() + 0.25 * VALUES.max() + 0.25 * float(CVaR(0.2)(x))
    assert float(mixed(x)) == pytest.approx(expected)
    assert all(part in mixed.text for part in ("0.5", "0.25", "20 %"))


def test_the_standard_cost_is_that_of_section_3():
    rng = np.random.default_rng(1)
    itae, rate, peak = (rng.uniform(0.5, 2.0, 9) * x for x in (0.1, 20.0, 2.0))
    abscissa = rng.uniform(-3.0, -0.3, 9)
    numbers = {"itae": itae, "activity_rate": rate, "sensitivity_peak": peak, "abscissa": abscissa}
    found = Objective().costs({name: jnp.asarray(x)[None] for name, x in numbers.items()})
    expected = np.log(itae) + 2 * soft(np.log(rate / 20)) + 3 * soft(np.log(peak / 2))
    np.testing.assert_allclose(found, expected + 5 * soft(abscissa + 0.5), rtol=1e-12)


def test_the_peak_of_an_unstable_member_counts_for_nothing_and_pulls_nowhere():
    peaks = Objective({"sensitivity_peak": 1.0}, ())
    cost = lambda a, peak: peaks.costs({"abscissa": a[None], "sensitivity_peak": peak[None]})
    abscissa, e = jnp.array([-2.0, -0.1, 0.5]), jnp.full(3, jnp.e)
    np.testing.assert_allclose(cost(abscissa, e), [1.0, 0.4, 0.0])
    of_abscissa, of_peak = jax.grad(lambda a, p: jnp.sum(cost(a, p)), (0, 1))(abscissa, e)
    assert of_peak[2] == 0 and of_peak[0] > of_peak[1] > 0
    np.testing.assert_array_equal(of_abscissa, 0.0)


def test_axes_add_up_in_an_objective_and_the_worst_one_counts_in_a_limit():
    values = jnp.array([[1.0, 2.0], [3.0, 1.0]])
    combined = lambda name, **options: QUANTITIES[name].combine_axes(values, **options)
    np.testing.assert_array_equal(combined("itae"), [4.0, 3.0])
    np.testing.assert_array_equal(combined("itae", worst=True), [3.0, 2.0])
    np.testing.assert_array_equal(combined("phase_margin"), [1.0, 1.0])
    np.testing.assert_array_equal(combined("overshoot"), [3.0, 2.0])


def test_limits_say_by_how_much_and_their_constraints_agree():
    values = jnp.array([1.5, 2.0, 3.0])
    most, least = Limit("sensitivity_peak", at_most=2.5), Limit("gain_margin", at_least=2.0)
    assert float(most.excess(values)) == pytest.approx(0.5)
    assert float(least.excess(values)) == pytest.approx(0.5)
    np.testing.assert_allclose(most.beyond(values), np.log(np.array([1.5, 2.0, 3.0]) / 2.5))
    np.testing.assert_allclose(least.beyond(values), -np.log(np.array([1.5, 2.0, 3.0]) / 2.0))
    typical = Limit("itae", at_most=2.5, over=Mean())
    assert float(typical.excess(values)) < 0 and np.all(np.asarray(typical.beyond(values)) < 0)
    assert "sensitivity_peak" in str(most) and "2.5" in str(most)


def test_levels_stay_finite_where_quantities_are_not():
    for name, value in (("gain_margin", np.inf), ("sensitivity_peak", np.inf), ("itae", 0.0)):
        assert np.isfinite(float(QUANTITIES[name].level(value)))
    assert float(QUANTITIES["abscissa"].level(-2.5)) == -2.5


def test_bad_choices_are_refused_with_what_there_is():
    with pytest.raises(ValueError, match="no quantity 'ITAE'.*itae"):
        Limit("ITAE", at_most=1.0)
    with pytest.raises(ValueError, match="give one of the two"):
        Limit("itae", at_most=1.0, at_least=0.5)
    with pytest.raises(ValueError, match="counts by its logarithm"):
        Limit("sensitivity_peak", at_most=0.0)
    with pytest.raises(ValueError, match="share is 0"):
        CVaR(0.0)
    with pytest.raises(ValueError, match="terms is empty"):
        Objective(terms={})
    with pytest.raises(ValueError, match="events"):
        Objective(events=(-1.0,))


@pytest.mark.slow
def test_numbers_of_flights_are_those_of_the_metrics_between_events():
    """Of all members in the mean, as a listener hears them at the start."""
    around, parts = loop(ladrc(4.0, 50.0, 1.5)), [(0.0, 2.5), (2.5, 4.5), (4.5, 6.5)]
    quick = ensemble(lag=Uniform(0.001, 0.012), inertia=LogUniform(0.5, 1.5))
    members, heard = quick.draw(around, 8, jax.random.key(0)), []
    large = scenario(
        duration=7.0, axes=1, disturbance=Pulse(-0.2, width=0.5, at=5.9),
        reference=Step(np.radians(90.0)) + Step(np.radians(-75.0), at=4.5),
    )  # fmt: skip
    stop, load_start = 6.5, 2.6
    names = [name for name, quantity in QUANTITIES.items() if not quantity.linear]
    tune(
        around, members, large, fresh=None, progress=False, method=LBFGS(evaluations=1),
        objective=Objective(
            dict.fromkeys(names, 1.0), (), events=(0.0, 2.5, 4.5), stop=stop, load_start=load_start
        ),
        listener=heard.append,
    )  # fmt: skip
    assert heard[-1].phase == "optimise"
    found = {name: float(heard[-1].means[name][0]) for name in names}
    happens, flown = members.flight(large), members.loop(around.controller)
    whole = evaluate(flown, happens, stop=stop, load_start=load_start)
    each = [evaluate(flown, happens, start=start, stop=stop) for start, stop in parts]
    mean = lambda x: float(np.mean(np.asarray(x)))
    rate = mean(whole.activity) / 6.5
    assert found.pop("activity_rate") == pytest.approx(rate, rel=1e-9)
    overshoot = mean(np.nanmax([np.asarray(part.overshoot) for part in each], axis=0))
    assert found.pop("overshoot") == pytest.approx(overshoot, rel=1e-9) and overshoot > 0.5
    for name in ("itae", "iae", "ise"):  # ITAE's clock starts again with each part
        total = sum(mean(vars(part)[name]) for part in each)
        assert found.pop(name) == pytest.approx(total, rel=2e-3), name
    # A command within 1 % of the limit counts in part, so that the share has a gradient.
    assert np.ptp(np.asarray(whole.saturation_share)) > 0.01
    share = mean(whole.saturation_share)
    assert found.pop("saturation_share") == pytest.approx(share, abs=0.01)
    for name, value in found.items():
        assert value == pytest.approx(mean(vars(whole)[name]), rel=1e-9), name
