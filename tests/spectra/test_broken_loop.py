"""The broken loop of a flight, beside that of the loop that was simulated."""

import warnings

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

import jaxquad as jq
from jaxquad.spectra import estimate_broken_loop


DT, NATURAL, DAMPING, SAMPLES = 0.004, 15.0, 0.5, 30000
SYSTEM = [NATURAL**2], [1, 2 * DAMPING * NATURAL, NATURAL**2]
ABOVE, BELOW = map(np.ravel, cont2discrete(SYSTEM, DT, "zoh")[:2])  # pyright: ignore


def flown(*, noise=0.02, entry="set-point"):
    """A loop flown by random steps; with its error as the input where the entry is that."""
    random = np.random.default_rng(1)
    r = np.repeat(random.standard_normal(SAMPLES // 100), 100)
    y = lfilter(ABOVE, BELOW, r)
    noisy = y + noise * random.standard_normal(SAMPLES)
    return jq.Record(DT * np.arange(SAMPLES), r - noisy, noisy, r)


def exact(omega):
    z = np.exp(1j * omega * DT)
    closed = np.polyval(ABOVE, z) / np.polyval(BELOW, z)
    return closed / (1 - closed)


@pytest.mark.parametrize("entry", ["set-point", "plant input"])
def test_the_loop_is_found_within_its_errors_by_either_entry(entry):
    found = estimate_broken_loop(flown(), entry=entry, band=(2.0, 60.0))
    away = np.abs(found.response / exact(found.omega) - 1) / found.error
    assert found.omega.size > 25 and np.sqrt(np.mean(away**2) / 2) < 2.5


def test_crossover_and_margins_are_those_of_the_loop():
    found = estimate_broken_loop(flown(noise=0.005), entry="set-point", band=(2.0, 80.0))
    omega = np.linspace(2.0, 80.0, 20000)
    loop = exact(omega)
    place = np.flatnonzero(np.abs(loop) > 1)[-1]
    margin = np.angle(-loop[place])
    assert found.crossover == pytest.approx(omega[place], rel=0.03)
    assert found.phase_margin[0] == pytest.approx(margin, abs=np.radians(3))


def test_what_the_reference_does_not_move_is_left_out():
    found = estimate_broken_loop(flown(noise=30.0), entry="set-point")
    assert found.omega.size < 5 and np.isnan(found.crossover)
    bare = jq.Record(DT * np.arange(100), np.sin(np.arange(100.0)), np.cos(np.arange(100.0)))
    with pytest.raises(ValueError, match="no reference"):
        estimate_broken_loop(bare, entry="set-point")


@pytest.mark.parametrize("entry", ["set-point", "plant input"])
def test_a_reference_that_rests_divides_nothing_by_nothing(entry):
    """A warning of NumPy is an error here."""
    record = flown()
    still = np.where(np.arange(SAMPLES) < SAMPLES // 2, 0.0, np.sin(0.04 * np.arange(SAMPLES)))
    for r in (still, 0 * still):
        y = lfilter(ABOVE, BELOW, r)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", jq.records.RecordWarning)  # of what is constant
            quiet = jq.Record(record.time, r - y, y, r)
        found = estimate_broken_loop(quiet, entry=entry)
        assert np.all(np.isfinite(found.response)) and np.all(np.isfinite(found.error))
    assert found.omega.size == 0
    short = jq.Record(DT * np.arange(60), *np.random.default_rng(0).standard_normal((3, 60)))
    assert estimate_broken_loop(short, entry=entry).omega.size == 0
