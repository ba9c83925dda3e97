"""An actuator that follows rising commands faster than falling ones: said, and fitted behind."""

import pickle

import numpy as np
import pytest

import jaxquad as jq
from jaxquad.spectra import TWO_LAGS


DT, DELAY, GAIN = 0.01, 2, 8.0


def flown(up, down, seed=0):
    """A rate behind a motor that is commanded in steps, under a proportional controller."""
    rng, samples = np.random.default_rng(seed), 5000
    r = np.sign(rng.standard_normal(samples // 10)).repeat(10)
    u, y, rate, motor = np.zeros(samples), np.zeros(samples), 0.0, 0.0
    noise = 0.02 * rng.standard_normal(samples)
    for k in range(samples):
        y[k] = rate + noise[k]
        u[k] = r[k] - 0.4 * y[k]
        command = u[k - DELAY] if k >= DELAY else 0.0
        lag = up if command > motor else down
        before = motor
        motor = command + (before - command) * np.exp(-DT / lag)
        rate += GAIN * (command * DT + (before - motor) * lag)
    return jq.Record(DT * np.arange(samples), u, y, r, hold=DT)


@pytest.fixture(scope="module")
def response():
    return jq.frequency_response(flown(0.04, 0.1), np.geomspace(1.0, 40.0, 40))


def test_two_lags_are_remarked_with_what_they_are(response):
    (remark,) = (one for one in response.remarks if one.kind == TWO_LAGS)
    assert "slower while its command falls" in remark
    words = remark.split("errors): ")[1].replace(",", "").split()
    for value, error, truth in ((words[0], words[2], 0.04), (words[7], words[9], 0.1)):
        assert float(value) == pytest.approx(truth, abs=3 * float(error))
    assert not any(one.kind == "nonlinear" for one in response.remarks)
    assert pickle.loads(pickle.dumps(remark)).clear == remark.clear


@pytest.mark.slow
def test_the_fit_behind_two_lags_holds_the_truth(response):
    fit = jq.fit(jq.LaggedIntegrator(5.0, lag=0.05, delay=0.01), response)
    explanation = fit.explain()
    behind = explanation.candidates[0].fit
    truth = {"gain": GAIN, "lag": 2 / (1 / 0.04 + 1 / 0.1), "delay": DELAY * DT}
    for k, (name, value) in enumerate(truth.items()):
        assert behind[name] == pytest.approx(value, abs=3 * behind.standard_errors[k])
        assert behind.standard_errors[k] < 0.2 * value
    # Without, the lag is off by more than its interval.
    low, high = fit.interval("lag")
    assert not low <= truth["lag"] <= high
    assert "an actuator of two lags" in str(explanation) and explanation.best is not None


@pytest.mark.parametrize("seed", range(4))
def test_one_lag_is_not_remarked(seed):
    response = jq.frequency_response(flown(0.06, 0.06, seed), np.geomspace(1.0, 40.0, 40))
    assert all(one.kind != TWO_LAGS for one in response.remarks)
