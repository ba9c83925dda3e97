"""A record that tells too few frequencies apart says so; a longer one does not."""

import numpy as np
import pytest
from scipy.signal import lfilter

import jaxquad as jq


DT = 0.004
SAID = "the record is too short"


def closed_loop(seconds, seed, start=12.0):
    """A part of 30 s in which a sweep of 0.3 to 20 Hz moves a rate loop with lag and delay."""
    rng, samples, late = np.random.default_rng(seed), 7500, 4
    time, decay = DT * np.arange(samples), np.exp(-DT / 0.03)
    reference = 0.5 * np.sin(2 * np.pi * DT * np.cumsum(0.3 * (20 / 0.3) ** (time / 30.0)))
    gust = 0.005 * np.asarray(lfilter([1.0], [1.0, -0.9], rng.standard_normal(samples)))
    noise = 0.01 * rng.standard_normal(samples)
    rate, motor, integral, u, y = 0.0, 0.0, 0.0, np.zeros(samples), np.zeros(samples)
    for k in range(samples):
        y[k] = rate + noise[k]
        integral += (reference[k] - y[k]) * DT
        u[k] = 0.06 * (reference[k] - y[k]) + 0.05 * integral
        pushed = (u[k - late] if k >= late else 0.0) + gust[k]
        moved = pushed + (motor - pushed) * decay
        rate, motor = rate + 120.0 * DT * (motor + moved) / 2, moved
    part = (time >= start) & (time < start + seconds)
    return jq.Record(time[part], u[part], y[part], reference[part], hold=DT)


def remarks(record):
    return [r for r in jq.frequency_response(record).remarks if SAID in r]


@pytest.mark.slow
@pytest.mark.parametrize(("seconds", "seed"), [(0.8, 0), (0.8, 4), (1.6, 3), (1.6, 8)])
def test_a_second_of_a_closed_loop_is_called_too_short(seconds, seed):
    """Whether or not any frequency has an error below 30 %: the last digits can decide that."""
    [said] = remarks(closed_loop(seconds, seed))
    assert "at least 15" in said and "cycles of the lowest (at least 5)" in said
    assert "Record at least" in said


@pytest.mark.slow
def test_a_record_without_any_response_says_why():
    """The references move the input too little, at all frequencies."""
    u, y, r = np.random.default_rng(0).standard_normal((3, 600))
    record = jq.Record(DT * np.arange(600), u + 1e-6 * r, y, 1e-6 * r, hold=DT)
    said = jq.frequency_response(record).remarks
    assert any("move the inputs too little" in x and "record longer" in x for x in said)
    plain = jq.frequency_response(closed_loop(6.4, 0)).remarks
    assert not any("move the inputs too little" in x for x in plain)


def test_a_band_of_a_single_resolution_is_too_narrow_in_a_short_record():
    """Seven cycles, but of frequencies that the record does not tell apart, as in 2.4 s."""
    rng, samples, spacing = np.random.default_rng(0), 600, 2 * np.pi / 2.4
    u, noise = rng.standard_normal(samples), np.diff(rng.standard_normal(samples + 1))
    y = np.asarray(lfilter([0.1], [1.0, -0.9], u)) + 0.3 * noise
    record = jq.Record(DT * np.arange(samples), u, y, hold=DT)

    def remarks(low, high):
        omega = np.append(np.linspace(low, high, 12), 250.0) * spacing  # the last one is lost
        return [r for r in jq.frequency_response(record, omega).remarks if SAID in r]

    [said] = remarks(7.05, 7.95)
    assert "at least 2)" in said and "cycles of the lowest (at least 10)" in said
    assert not remarks(7.05, 9.45) and not remarks(10.05, 10.95)


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
def test_six_seconds_and_thirty_are_not(seed):
    assert not remarks(closed_loop(6.4, seed)) and not remarks(closed_loop(30.0, seed, start=0.0))


def test_a_grid_that_is_narrow_by_choice_is_not_remarked():
    record = closed_loop(30.0, 0, start=0.0)
    said = jq.frequency_response(record, np.array([1.0, 1.1])).remarks
    assert not any(SAID in remark for remark in said)
