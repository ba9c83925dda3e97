"""A parameter so near zero that its error exceeds it is known by a limit, in its own unit."""

from pathlib import Path

import jax
import numpy as np
import pytest
import scipy.optimize
from synthetic import response_of

import jaxquad as jq


FLOWN = np.geomspace(7.0, 238.0, 60)  # rad/s, as a Betaflight chirp shows them
ML = jq.identify.MaximumLikelihood()
SCORES = np.random.default_rng(0).normal(size=(3, 256))


def fit_flown(delay, seed, error=0.03):
    """A motor's lag of 25 ms beside a delay of less than a degree."""
    truth = jq.LaggedIntegrator(36.95, 0.025, delay)
    frf = response_of(truth, error=error, seed=seed, omega=FLOWN)
    return jq.fit(jq.LaggedIntegrator(30.0, 0.02, 0.002), frf)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 50e-6, 125e-6, 300e-6])
def test_a_small_delay_is_no_ignorance(delay):
    """At 1 Hz to 38 Hz 0.1 ms are 1.4 deg at most; 95 % of 40 intervals hold the truth."""
    fits = [fit_flown(delay, seed) for seed in range(40)]
    assert all(fit.identifiable and not fit.remarks for fit in fits)
    for name, value in {"gain": 36.95, "lag": 0.025, "delay": delay}.items():
        inside = [low <= value <= high for low, high in (fit.interval(name) for fit in fits)]
        assert sum(inside) >= 35


@pytest.mark.slow
def test_a_value_of_less_than_two_standard_errors_ends_at_its_one_sided_limit():
    fits = [fit_flown(125e-6, seed, error=0.045) for seed in range(40)]
    errors = [max(1.645 * f.standard_errors[2], f.noise_standard_errors[2] / 0.52) for f in fits]
    vague = [fit for fit, error in zip(fits, errors, strict=True) if error > fit.values[2] > 0]
    assert len(vague) > 10
    for fit in vague:
        (bound,) = fit.verdict.bounds
        assert bound.name == "delay" and fit.identifiable
        assert fit.interval("delay") == (0.0, bound.limit)
        # The cost is a parabola here, whose 95 % point is 1.645 standard errors off.
        wanted = fit.values[2] + 1.645 * fit.standard_errors[2]
        assert bound.limit == pytest.approx(wanted, rel=0.05)
        assert f"delay: {fit.values[2]:.3g}, below {bound.limit:.3g}" in fit.verdict.summary


@pytest.mark.slow
def test_models_drawn_around_it_keep_its_sign_and_its_order():
    for seed in range(6):
        fit = fit_flown(50e-6, seed)
        drawn = np.asarray(jq.identify.draw_models(fit, SCORES).delay)
        limit = fit.interval("delay")[1]
        assert drawn.min() >= 0 and limit < 3e-4
        assert 0.5 * limit < np.quantile(drawn, 0.95) < 1.5 * limit


@pytest.mark.slow
def test_a_firmware_s_chirp_with_a_delay_near_zero_is_identifiable(data):
    log = data / "betaflight_firmware" / "A_chirp_plain.BFL"
    proposal = jq.workflows.autopilot(log, jq.workflows.AutopilotSettings(axis="roll"))
    assert isinstance(proposal, jq.autopilot.AutopilotProposal)
    fit = proposal.identification.fit
    assert fit.identifiable
    for name, value in {"gain": 36.95, "lag": 0.025, "delay": 125e-6}.items():
        low, high = fit.interval(name)
        assert low <= value <= high
    assert fit.interval("delay")[1] < 4e-4


def swept(seed, noise=0.4, amplitude=0.1):
    """40 s of 40 e^(-0.01 s) / (s (0.03 s + 1)), 0.4 to 60 rad/s, most of it below the noise."""
    sweep = jq.sweep(0.4, 60.0, duration=40.0, sample_rate=100.0, amplitude=amplitude)
    model = jq.LaggedIntegrator(40.0, 0.03, 0.01).transfer_function()
    rate = np.asarray(jq.models.simulate_linear(model, sweep.signal, 0.01))
    rate = rate + np.random.default_rng(seed).normal(0, noise, rate.size)
    record = jq.Record(
        sweep.time, sweep.signal[:, None], rate[:, None], input_names=("u",), output_names=("q",),
        hold=0.01,
    )  # fmt: skip
    return jq.frequency_response(record)


@pytest.fixture(scope="module")
def weak():
    start = jq.LaggedIntegrator(40.0, 0.03, 0.01)
    return [jq.fit(start, swept(seed)) for seed in range(30)]


@pytest.mark.slow
def test_a_lag_at_zero_is_in_the_interval_of_the_delay(weak):
    """Either both are marked, or both intervals hold the truth, in 93 % of the records at least."""
    wrong = 0
    for fit in weak:
        lag, delay = fit.interval("lag"), fit.interval("delay")
        inside = lag[0] <= 0.03 <= lag[1] and delay[0] <= 0.01 <= delay[1]
        marked = not fit.determined[1:].any()
        assert marked or fit.determined[1:].all()
        wrong += not (inside or marked)
    assert wrong <= 2


@pytest.mark.slow
def test_the_sum_of_a_lag_at_zero_and_the_delay_is_named_with_its_error(weak):
    """Its scatter is as large as it says, and it is within 3.3 standard errors of the truth."""
    assert sum(fit.values[1] < 1e-3 for fit in weak) > 8
    named = [fit.combinations for fit in weak if not fit.identifiable]
    assert all(one and one[0].name == "lag + delay" for one in named)
    sums = [fit.derived(lambda model: model.lag + model.delay) for fit in weak]
    off = [(one.value - 0.04) / one.standard_error for one in sums]
    assert np.max(np.abs(off)) < 3.3
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.3


@pytest.mark.slow
def test_draws_of_a_lag_near_zero_spread_as_the_sum_says(weak):
    fit = next(fit for fit in weak if 0 < fit.values[1] < 1e-3 and not fit.identifiable)
    drawn = fit.ensemble(4000, jax.random.key(0), hold_undetermined=True)
    total = fit.derived(lambda model: model.lag + model.delay)
    assert np.asarray(drawn.lag).min() >= 0
    assert np.std(drawn.lag + drawn.delay) == pytest.approx(total.standard_error, rel=0.1)


@pytest.mark.slow
def test_a_small_lead_has_its_limit_for_the_lag_and_its_sum():
    """100 (0.004 s + 1) e^(-0.008 s) / s: no lag at all, and 4 ms late."""
    model = jq.TransferFunction([0.4, 100.0], [1.0, 0.0], delay=0.008)
    frf = response_of(model, error=0.01, seed=1, omega=np.geomspace(20.0, 140.0, 40))
    for start in ((0.01, 0.01), (0.001, 0.02)):
        fit = jq.fit(jq.LaggedIntegrator(100.0, *start), frf)
        total = fit.derived(lambda model: model.lag + model.delay)
        assert fit.values[1] < 1e-4 and abs(total.value - 0.004) < 4 * total.standard_error
        assert 0 < total.standard_error < 1e-3


def misfit(values, frf, error):
    """That of ln-magnitude and phase, in units of their error."""
    gain, lag, delay = values
    s = 1j * np.asarray(frf.omega)
    model = gain * np.exp(-delay * s) / (s * (lag * s + 1))
    ratio = np.log(np.asarray(frf.response)[:, 0, 0] / model)
    return np.concatenate([ratio.real, ratio.imag]) / error


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_an_interval_near_zero_ends_where_the_cost_has_risen(seed):
    """What a lag does beside a delay goes by its square; scipy finds where the cost rises.

    Farther out it rises less, so a side may be a part of that of a larger interval.
    """
    frf = response_of(jq.LaggedIntegrator(40.0, 0.015, 0.012), error=0.025, seed=seed)
    fit = jq.fit(jq.LaggedIntegrator(30.0, 0.02, 0.02), frf, cost=ML)

    def distance(lag):
        """In standard errors, from the best lag."""
        others = lambda x: misfit((x[0], lag, x[1]), frf, 0.025)
        start, bounds = fit.values[[0, 2]], (0, np.inf)
        found = scipy.optimize.least_squares(others, start, bounds=bounds, x_scale=(40, 0.01))
        rise = 2 * found.cost - np.sum(misfit(fit.values, frf, 0.025) ** 2)
        return np.sqrt(max(rise, 0.0))

    low, high = fit.interval("lag", model_error=False)
    assert fit.values[1] > 2.5 * fit.standard_errors[1]  # by the cost's curvature alone
    best, sides = fit.values[1], []
    for times in (1.0, 1.25, 1.5, 2.0):
        beyond = lambda lag, reach=1.96 * times: distance(lag) - reach
        end = scipy.optimize.brentq(beyond, 0.0, best) if beyond(0.0) > 0 else 0.0
        sides.append((best - end) / times)
    assert low == pytest.approx(best - max(sides), abs=0.05 * best) or (low == 0 and not end)
    assert distance(high) > 1.96
    derived = fit.derived(lambda model: model.lag, model_error=False)
    assert derived.interval == pytest.approx((low, high), abs=0.03 * fit.values[1])
    assert derived.standard_error == pytest.approx(fit.noise_standard_errors[1])


@pytest.mark.slow
def test_parameters_that_leave_zero_stay_within_numbers(monkeypatch):
    """A lag, delay and lead of a sweep in noise: Gauss-Newton steps 2e7 in ln(delay) from zero."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "studies")
    from near_bounds import CASES, measured  # pyright: ignore

    case = CASES["small lead"]
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # as a user's
        fit = jq.fit(case.start, measured(case, 110), free=case.free)
    assert fit.verdict.fitted and not fit.identifiable
