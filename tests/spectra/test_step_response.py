"""The step response of a flown loop, beside that of the loop that was simulated."""

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter, resample_poly

import jaxquad as jq
from jaxquad.spectra import estimate_step


DT, NATURAL, DAMPING = 0.004, 15.0, 0.5  # s, rad/s, -
SYSTEM = [NATURAL**2], [1, 2 * DAMPING * NATURAL, NATURAL**2]
ABOVE, BELOW = map(np.ravel, cont2discrete(SYSTEM, DT, "zoh")[:2])  # pyright: ignore
EXACT = np.asarray(lfilter(ABOVE, BELOW, np.ones(2000)))


def stick(random, samples):
    """Steps of random size and length, behind the lag of a hand."""
    values, k = np.zeros(samples), 0
    while k < samples:
        longer = int(random.uniform(0.4, 3.0) / DT)
        values[k : k + longer] = random.standard_normal()
        k += longer
    stay = np.exp(-DT / 0.02)
    return lfilter([1 - stay], [1, -stay], values)


def flown(seed=0, *, seconds=60.0, noise=0.02, reference=stick):
    """A second-order loop in gusts and noise."""
    random, samples = np.random.default_rng(seed), int(seconds / DT)
    r = reference(random, samples)
    y = lfilter(ABOVE, BELOW, r)
    gusts = lfilter([np.sqrt(1 - 0.99**2)], [1, -0.99], random.standard_normal(samples))
    y = y + noise * (gusts + random.standard_normal(samples))
    return jq.Record(np.arange(samples) * DT, r, y, r, input_names="u", output_names="y")


def exact_at(found):
    return np.interp(found.time, np.arange(EXACT.size) * DT, EXACT, left=0.0)


def test_the_step_of_a_known_loop_is_found_within_two_per_cent_of_a_quiet_log():
    found = estimate_step(flown(noise=0.002))
    assert found.is_conclusive and found.is_resolved
    assert np.max(np.abs(found.mean - exact_at(found))) < 0.02
    truth = found._replace(mean=exact_at(found))
    assert found.rise_time == pytest.approx(truth.rise_time, rel=0.05)
    assert found.overshoot == pytest.approx(truth.overshoot, abs=0.02)
    assert found.final == pytest.approx(1.0, abs=0.02)
    assert found.settling_time == pytest.approx(truth.settling_time, rel=0.1)


def test_its_standard_error_is_that_of_many_flights():
    found = [estimate_step(flown(seed)) for seed in range(40)]
    late = [np.searchsorted(found[0].time, t) for t in (0.2, 0.5, 1.0, 1.8)]
    ratio = [((f.mean - exact_at(f)) / f.standard_error)[late] for f in found]
    assert 0.6 < np.sqrt(np.mean(np.square(ratio))) < 1.6
    assert abs(np.mean(ratio)) < 0.6


def sweep(_, samples):
    band = 2 * np.pi * 0.5, 2 * np.pi * 12
    made = jq.sweep(*band, duration=samples * DT - 10, sample_rate=1 / DT, amplitude=1.0)
    return np.pad(made.signal, (0, samples))[:samples]


def one_step(_, samples):
    values = np.zeros(samples)
    values[samples // 2 : samples // 2 + 200] = 1.0
    return values


@pytest.mark.parametrize(
    ("reference", "noise", "why"),
    [
        (sweep, 0.02, "too little power at low frequencies"),
        (one_step, 0.02, "active in 2 of 11 windows"),
        (stick, 2.0, "standard error"),
    ],
)
def test_a_log_that_cannot_tell_the_step_says_so(reference, noise, why):
    found = estimate_step(flown(reference=reference, noise=noise))
    assert not found.is_conclusive and any(why in text for text in found.doubts)
    assert "this log cannot tell it" in str(found)


def test_no_reference_and_no_room_are_refused():
    record = flown(seconds=2.0)
    with pytest.raises(ValueError, match="choose another length"):
        estimate_step(record, length=2.0)
    bare = jq.Record(record.time, record.inputs, record.outputs)
    with pytest.raises(ValueError, match="no reference"):
        estimate_step(bare)
    assert estimate_step(bare, reference="u", length=0.1).names == ("u", "y")


def test_a_log_that_was_resampled_far_above_its_own_rate_has_the_same_step():
    record = flown(noise=0.002)
    r, y = (resample_poly(record.channel(name), 10, 1) for name in ("r", "y"))
    time = DT / 10 * np.arange(r.size)
    found = estimate_step(jq.Record(time, r, y, r, input_names="u", output_names="y"))
    assert found.is_conclusive
    assert np.max(np.abs(found.mean - exact_at(found))) < 0.02


def rests(seconds, reference=stick):
    """Nothing is asked for before and behind the flight, as of a vehicle on the ground."""

    def values(random, samples):
        count = int(seconds / DT)
        return np.pad(reference(random, samples - 2 * count), count)

    return values


def test_a_rest_on_the_ground_before_and_behind_the_flight_changes_nothing():
    flight = estimate_step(flown(noise=0.002, seconds=60.0), length=2.0)
    longer = estimate_step(flown(noise=0.002, seconds=100.0, reference=rests(20.0)), length=2.0)
    assert longer.is_conclusive and len(longer.windows) < longer.total
    assert np.max(np.abs(longer.mean - exact_at(longer))) < 0.02
    assert np.max(longer.standard_error) < 2 * np.max(flight.standard_error)


def test_a_reference_without_power_at_most_frequencies_divides_nothing_by_nothing():
    """A warning of NumPy is an error here; between its tones rounding alone is left."""

    def tones(_, samples):
        t = DT * np.arange(samples)
        return np.sin(2 * np.pi * t) + np.sin(2 * np.pi * 0.25 * t)

    for reference in (tones, rests(25.0, tones), rests(20.0, sweep)):
        found = estimate_step(flown(noise=0.0, reference=reference))
        assert all(np.all(np.isfinite(part)) for part in (found.mean, found.standard_error))
        assert found.doubts


@pytest.mark.parametrize("resting", ["r", "y"])
def test_where_nothing_moves_there_is_no_step(resting):
    record = flown()
    part = {name: 0 * record.channel(name) for name in resting}
    r, y = (part.get(name, record.channel(name)) for name in ("r", "y"))
    with pytest.warns(jq.records.RecordWarning, match="constant"):
        still = jq.Record(record.time, record.channel("u"), y, r, output_names="y")
    found = estimate_step(still)
    assert found.doubts and "rests" in found.doubts[0] and "cannot tell" in str(found)
