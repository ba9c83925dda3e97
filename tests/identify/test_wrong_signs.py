"""A start of the wrong sign ends at zero: the intervals count what is left, and it is said."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest
from scipy.stats import t as student_t
from synthetic import response_of

import jaxquad as jq


OMEGA = np.geomspace(0.3, 30.0, 60)


class Zero(eqx.Module):
    """8 (s + zero) / (s^2 + 2 zeta wn s + wn^2)."""

    gain: float
    zero: float
    zeta: float
    wn: float

    def frequency_response(self, omega):
        above, below = [1.0, self.zero], [1.0, 2 * self.zeta * self.wn, self.wn**2]
        numerator = [self.gain * each for each in above]
        return jq.TransferFunction(numerator, below).frequency_response(omega)


TRUTH = Zero(8.0, -0.6, 0.5, 4.0)


def fitted(seed, start, **options):
    frf = response_of(TRUTH, error=0.02, seed=seed, omega=OMEGA)
    return jq.fit(start, frf, **options)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_intervals_beside_a_zero_of_the_wrong_sign_hold_the_truth(seed):
    fit = fitted(seed, Zero(6.0, 0.5, 0.7, 5.0))
    assert fit["zero"] == 0
    for name in ("gain", "zeta", "wn"):
        low, high = fit.interval(name)
        assert low < getattr(TRUTH, name) < high
        by_noise = np.diff(fit.interval(name, model_error=False))
        assert high - low > 2 * by_noise
    said = [remark for remark in fit.remarks if remark.startswith("zero came out as 0")]
    assert len(said) == 1 and "jq.identify.Real('zero')" in said[0]


@pytest.mark.slow
def test_the_advice_finds_the_truth():
    free = ["gain", jq.identify.Real("zero", 1.0), "zeta", "wn"]
    fit = fitted(0, Zero(6.0, 0.5, 0.7, 5.0), free=free)
    low, high = fit.interval("zero")
    assert low < TRUTH.zero < high and not fit.remarks


@pytest.mark.slow
def test_a_lag_that_is_zero_is_no_wrong_sign():
    truth, remarks = jq.LaggedIntegrator(80.0, 1e-9, 0.03), []
    for seed in range(10):
        frf = response_of(truth, error=0.02, seed=seed, omega=OMEGA)
        remarks += jq.fit(jq.LaggedIntegrator(60.0, 0.02, 0.04), frf).remarks
    assert not remarks


class Leading:
    def frequency_response(self, omega):
        omega = np.asarray(omega)
        return (80.0 / (1j * omega) * np.exp(0.004j * omega))[:, None, None]


@pytest.mark.slow
def test_two_at_zero_have_errors_that_fit_their_limits():
    """A response that leads: the lag and the delay do the same to it, and both end at zero."""
    frf = response_of(Leading(), error=0.02, seed=0, omega=OMEGA)
    fit = jq.fit(jq.LaggedIntegrator(60.0, 0.02, 0.02), frf)
    assert fit["lag"] == fit["delay"] == 0
    for k, name in enumerate(fit.names[1:], start=1):
        limit = fit.interval(name)[1]
        assert 0.2 * limit < fit.standard_errors[k] < limit < 0.02
    total = fit.derived(lambda model: model.lag + model.delay, "lag + delay")
    assert total.standard_error < 0.02
    assert any(remark.startswith("lag and delay came out as 0") for remark in fit.remarks)


def test_a_gain_of_the_wrong_sign_is_told():
    frf = response_of(jq.LaggedIntegrator(80.0, 0.06, 0.03), error=0.01, seed=0, omega=OMEGA)
    fit = jq.fit(jq.LaggedIntegrator(-50.0, 0.05, 0.02), frf)
    assert not fit.identifiable
    assert any("start with the other sign of the gain" in remark for remark in fit.remarks)


@pytest.mark.slow
@pytest.mark.parametrize("method, said", [("direct", True), ("joint", False)])
def test_a_model_that_grows_needs_a_reference(method, said):
    grows = jq.TransferFunction([20.0], [1.0, -3.0])
    frf = dataclasses.replace(response_of(grows, error=0.01, seed=0, omega=OMEGA), method=method)
    start = jq.TransferFunction([15.0], [1.0, -2.0])
    remarks = jq.fit(start, frf, free=["numerator[0]", "denominator[1]"]).remarks
    assert any("a pole at +3" in remark for remark in remarks) == said


@pytest.mark.slow
def test_an_interval_keeps_the_sign_of_its_parameter():
    """Also where a negative one came out as 0, and where it is too loose for a limit."""
    fit = fitted(0, Zero(6.0, 0.5, 0.7, 5.0))
    values = np.where(np.array(fit.names) == "zero", -0.0, fit.values)
    values = np.where(np.array(fit.names) == "zeta", 0.001, values)
    verdict = dataclasses.replace(fit.verdict, bounds=())
    moved = dataclasses.replace(fit, values=values, verdict=verdict)
    assert moved.interval("zero")[0] < 0 == moved.interval("zero")[1]
    assert moved.interval("zeta")[0] == 0 < moved.interval("zeta")[1]
    assert moved.interval("zeta", level=0.99)[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize("model_error", [True, False])
@pytest.mark.parametrize("freedom", [9.0, np.inf])
def test_an_interval_of_another_level_reaches_as_far_as_students_t(freedom, model_error):
    fit = fitted(0, Zero(6.0, 0.5, 0.7, 5.0))
    # Without the profile of its zero, which makes them wider.
    fit = dataclasses.replace(fit, degrees_of_freedom=np.full(4, freedom), profiles=())
    errors = fit.standard_errors if model_error else fit.noise_standard_errors
    for name, error in (("gain", errors[0]), ("wn", errors[3])):
        for level in (0.5, 0.9, 0.99):
            reach = student_t(freedom).ppf(0.5 + level / 2) * error
            wanted = max(fit[name] - reach, 0.0), fit[name] + reach  # both keep their sign
            interval = fit.interval(name, level=level, model_error=model_error)
            assert interval == pytest.approx(wanted)
    derived = fit.derived(lambda model: model.wn, model_error=model_error)
    assert derived.interval_at(0.99) == pytest.approx(wanted, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("level", [0, 1, 95, -0.5, np.nan, True])
def test_a_level_that_is_no_share_is_refused(level):
    fit = fitted(0, Zero(6.0, 0.5, 0.7, 5.0))
    for name in ("gain", "zero"):
        with pytest.raises(ValueError, match="level is .*: give a share between 0 and 1"):
            fit.interval(name, level=level)
