"""Whether a controller or an excitation moved the input, from records without a reference."""

from typing import Any

import numpy as np
import pytest
from scipy import signal

from jaxquad.records import Record
from jaxquad.spectra import DOMINATED, EARLY, frequency_response, JointInputOutput, Welch


DT, SAMPLES = 0.01, 6000
TIME = DT * np.arange(SAMPLES)
OMEGA = np.geomspace(2.0, 60.0, 50)
LATE = 2  # samples, of the plant


def rate_plant():
    """20 / (s (0.03 s + 1))."""
    return held([0.03, 1.0, 0.0])


def held(below):
    """20 over a polynomial of s, of an input that is held: coefficients of powers of 1/z."""
    found: Any = signal.cont2discrete(([20.0], below), DT)
    return np.ravel(found[0]), np.asarray(found[1])


def loop(controller, *, seed, gust=0.0, noise=0.0, sweep=0.0, delay=0):
    """y = P (u + gust) + noise under u = sweep - C y, by its exact difference equation."""
    rng = np.random.default_rng(seed)
    above, below = rate_plant()
    above = np.concatenate([np.zeros(LATE), above])
    back, poles = controller
    back = np.concatenate([np.zeros(delay), back])
    r = sweep * signal.chirp(TIME, 0.3, TIME[-1], 12.0, method="logarithmic")
    wind = gust * filtered([0.1], [1.0, -0.98], rng.standard_normal(SAMPLES))
    loop = add(np.convolve(below, poles), np.convolve(above, back))
    assert np.all(np.abs(np.roots(loop)) < 1)
    y = filtered(np.convolve(above, poles), loop, r + wind)
    y += filtered(np.convolve(below, poles), loop, noise * rng.standard_normal(SAMPLES))
    references = r if sweep else None
    return Record(TIME, r - filtered(back, poles, y), y, references)


def filtered(above, below, x):
    return np.asarray(signal.lfilter(above, below, x))


def add(a, b):
    """Of powers of 1/z."""
    long, short = (a, b) if len(a) > len(b) else (b, a)
    return long + np.concatenate([short, np.zeros(len(long) - len(short))])


P = (np.array([0.25]), np.array([1.0]))
PI = (np.array([0.25 + 0.5 * DT, -0.25]), np.array([1.0, -1.0]))
BUTTER: Any = signal.butter(2, 15.0, fs=1 / DT)
FILTERED = (0.25 * BUTTER[0], BUTTER[1])
WELCH = Welch(10.0)


def remarks_of(record, *, joint=False, kind=DOMINATED):
    if not joint:
        record = Record(record.time, record.inputs, record.outputs)
    estimator = JointInputOutput(WELCH) if joint else WELCH
    found = frequency_response(record, OMEGA, estimator=estimator)
    return [each for each in found.remarks if each.kind == kind]


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize("moved", [{"gust": 1.0}, {"noise": 0.05}, {"gust": 1.0, "noise": 0.02}])
@pytest.mark.parametrize("controller", [P, PI, FILTERED], ids=["P", "PI", "filtered"])
def test_a_hover_shows_the_controller(controller, moved, delay):
    (remark,) = remarks_of(loop(controller, seed=1, delay=delay, **moved))
    assert len(remark.omega) > 40 and "reference" in remark


@pytest.mark.parametrize("controller", [P, PI, FILTERED], ids=["P", "PI", "filtered"])
def test_an_excitation_that_moves_the_input_more_than_feedback_is_none(controller):
    flown = loop(controller, seed=2, sweep=1.0, gust=0.02, noise=1e-3)
    assert remarks_of(flown) == []
    assert remarks_of(flown, joint=True) == []


def test_gusts_that_move_the_input_more_than_the_excitation_are_remarked():
    assert remarks_of(loop(P, seed=3, sweep=0.05, gust=5.0, noise=0.02))


def excitation(name):
    rng = np.random.default_rng(5)
    if name == "sweep":
        return signal.chirp(TIME, 0.3, TIME[-1], 12.0, method="logarithmic")
    if name == "multisine":
        lines = np.arange(20, 700, 7)
        phases = 2 * np.pi * np.outer(TIME, lines / TIME[-1]) + np.pi * lines**2 / len(lines)
        return np.sum(np.cos(phases), axis=1)
    if name == "binary":
        return np.repeat(rng.choice([-1.0, 1.0], SAMPLES // 10), 10)
    return rng.standard_normal(SAMPLES)


@pytest.mark.parametrize("early", [0, 1], ids=["answers next", "logged at once"])
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.3])
@pytest.mark.parametrize("name", ["sweep", "multisine", "binary", "white"])
def test_an_open_loop_is_none(name, noise, early):
    """Even where the logger writes an answer beside its cause, and nothing else moves either."""
    u = excitation(name)
    above, below = held([0.03, 1.06, 2.0])
    y = filtered(above[early:], below, u)
    y += noise * np.std(y) * np.random.default_rng(6).standard_normal(SAMPLES)
    assert remarks_of(Record(TIME, u, y)) == []


@pytest.mark.parametrize(("start", "damping", "seed"), [(0.05, 0.3, 4), (0.2, 0.2, 5)])
def test_a_quiet_mode_that_is_sampled_slowly_is_none(start, damping, seed):
    """Below its resonance it lags hardly, and its answers seem to move the input."""
    plant: Any = signal.cont2discrete(([1.0], [1 / 40**2, 2 * damping / 40, 1.0]), DT)
    u = signal.chirp(TIME, start, TIME[-1], 24.0, method="logarithmic")
    y = filtered(np.ravel(plant[0]), plant[1], u)
    y += 10**-2.5 * np.std(y) * np.random.default_rng(seed).standard_normal(SAMPLES)
    found = frequency_response(
        Record(TIME, u, y), np.geomspace(0.35, 120.0, 60), estimator=Welch(20.0)
    )
    assert not [each for each in found.remarks if each.kind == DOMINATED]


@pytest.mark.parametrize("samples", [3, 8])
def test_an_output_before_its_input_is_named_with_the_time_that_explains_it(samples):
    flown = loop(P, seed=2, sweep=1.0, gust=0.02, noise=1e-3)
    shift = LATE + 3 + samples  # the plant's own lag is that of about three samples
    inputs, references = flown.inputs[:-shift], flown.references[:-shift]
    early = Record(TIME[:-shift], inputs, flown.outputs[shift:], references)
    (remark,) = remarks_of(early, joint=True, kind=EARLY)
    least = float(remark.split("at least ")[1].split(" ms")[0])
    assert 0.5 * samples * 10 < least < 10 * shift and "time stamps" in remark
    (direct,) = remarks_of(early)
    assert "time stamps" in direct
