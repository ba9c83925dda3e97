"""A flown loop reproduced: a loop in plain numbers flies, its log is identified and compared."""

import dataclasses
import json
from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete

import jaxquad as jq
from jaxquad.autopilot import BetaflightPID, FilterChain, PT1


pytestmark = pytest.mark.slow


RATE = 1000.0  # Hz, of gyro, loop and log
DT, LAG, GAIN, LATE = 1 / RATE, 0.025, 60.0, 3  # s, s, deg/s^2 per pidsum, samples
P, I, D, CUTOFF = 45.0, 80.0, 30.0, 105.0
SAMPLES = 12_000
LAW = BetaflightPID(p=P, i=I, d=D, dterm=(PT1(CUTOFF),), dt=DT)


def fly(amplitude=80.0, noise=2.0):
    """A chirp of the set-point from 1 to 60 Hz; by Betaflight's equations, written once more."""
    rng = np.random.default_rng(5)
    time = np.arange(SAMPLES) * DT
    rise = np.log(60.0) / 11.0
    sweep = np.sin(2 * np.pi * (np.exp(rise * (time - 0.5)) - 1) / rise)
    r = np.where((time > 0.5) & (time < 11.5), amplitude * sweep, 0.0)
    flow, entry = np.array([[-1 / LAG, 0.0], [1.0, 0.0]]), np.array([[GAIN / LAG], [0.0]])
    steps: Any = cont2discrete((flow, entry, np.eye(2), np.zeros((2, 1))), DT)
    a, b = steps[0], steps[1][:, 0]
    x, u, y = np.zeros(2), np.zeros(SAMPLES + LATE), np.zeros(SAMPLES)
    share, integral, smooth = 1 - 1 / (1 + 2 * np.pi * CUTOFF * DT), 0.0, 0.0
    for k in range(SAMPLES):
        y[k] = x[1] + noise * rng.standard_normal()
        integral += 0.244381 * I * DT * (r[k] - y[k])
        before, smooth = smooth, smooth + share * (y[k] - smooth)
        derivative = 0.000529 * D * (smooth - before) / DT
        u[k + LATE] = 0.032029 * P * (r[k] - y[k]) + integral - derivative
        x = a @ x + b * u[k]
    return jq.Record(time, u[LATE:], y, r, output_units="deg/s", hold="dt")


@pytest.fixture(scope="module")
def log():
    return fly()


@pytest.fixture(scope="module")
def fit(log):
    response = jq.frequency_response(log, 2 * np.pi * np.geomspace(1.5, 50.0, 40))
    return jq.fit(jq.LaggedIntegrator(40.0, 0.03, 0.002), response)


@pytest.fixture(scope="module")
def closed(log):
    """From the set-point to the rate."""
    chosen = jq.records.select(log, inputs="r", outputs="y")
    return jq.frequency_response(chosen, 2 * np.pi * np.geomspace(1.0, 50.0, 30))


def test_the_loop_that_flew_is_reproduced_within_the_errors(log, fit):
    found = jq.autopilot.reproduce_flight(fit, LAW, log, unit="deg/s")
    assert found.kind == "flown" and "is the one that flew" in str(found)
    assert found.ratio < 1.3 and found.misfit < 0.05
    assert abs(found.scale - 1) < 4 * found.scale_error < 0.1
    content = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert content["kind"] == "flown"


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_other_gains_are_refused_with_the_factor_between_them(closed, fit, factor):
    law = dataclasses.replace(LAW, p=factor * P, i=factor * I, d=factor * D)
    found = jq.autopilot.reproduce_flight(fit, law, closed, unit="deg/s")
    assert found.kind == "not flown" and "is not the one that flew" in found.verdict
    assert found.scale == pytest.approx(1 / factor, rel=0.1)  # of first order in the factor


def test_a_plant_that_is_not_explained_does_not_say_that_other_gains_flew(closed, fit):
    law = dataclasses.replace(LAW, p=1.25 * P, i=1.25 * I, d=1.25 * D)
    doubtful = dataclasses.replace(fit, chi_squared=4.8)
    found = jq.autopilot.reproduce_flight(doubtful, law, closed, unit="deg/s")
    assert found.kind == "not flown" and "misses by 2.2 times its errors" in found.verdict
    assert "fly a chirp" in found.verdict and "is not the one" not in found.verdict


def test_another_filter_of_the_derivative_is_refused(closed, fit):
    law = dataclasses.replace(LAW, dterm=(PT1(CUTOFF / 3),))
    assert jq.autopilot.reproduce_flight(fit, law, closed, unit="deg/s").kind == "not flown"


def test_a_filter_counts_in_the_law_and_in_what_was_logged(closed, fit):
    chain = FilterChain((PT1(200.0),), RATE)
    share = 1 - 1 / (1 + 2 * np.pi * 200.0 * DT)
    whole = dataclasses.replace(LAW, gyro=chain)
    plain = jq.autopilot.reproduce_flight(fit, whole, closed, unit="deg/s")
    seen = jq.autopilot.reproduce_flight(fit, whole, closed, unit="deg/s", filters=[chain])
    z = np.exp(1j * plain.omega * DT)
    passed = share / (1 - (1 - share) / z)
    np.testing.assert_allclose(seen.predicted, plain.predicted * passed, rtol=1e-9)


def test_a_log_without_excitation_cannot_tell(fit):
    still = jq.autopilot.reproduce_flight(fit, LAW, fly(amplitude=0.05), unit="deg/s")
    assert still.kind == "unknown" and "this log cannot tell which gains flew" in still.verdict
    with pytest.raises(ValueError, match="no reference"):
        record = fly()
        bare = jq.records.select(record, inputs="u", outputs="y")
        jq.autopilot.reproduce_flight(fit, LAW, bare)
