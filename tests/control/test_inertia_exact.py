"""Inertia estimators on exact records: what is exact, and which printed form is not."""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from inertia_runs import EXACT, exact, GAIN, gusty, heard, lock_in, recursive, TONE, windowed
from rig_records import DT, fly, INERTIA
from scipy.signal import lfilter

from jaxquad.control import paper_inertia, ProbeTones


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2, 3])
def test_exact_data_give_the_exact_inertia_for_any_filter(order):
    """Both sides of the sampled equation pass the same filter: nothing is approximated."""
    for bandwidth in (5.0, 50.0, 200.0):
        inertia, deviation, trusted = heard(
            windowed(bandwidth=bandwidth, order=order, window=1.0), exact(), since=6.0
        )
        np.testing.assert_allclose(inertia, 1.0, rtol=1e-9)
        np.testing.assert_allclose(deviation, 0.0, atol=0.01)  # ages between windows
        np.testing.assert_array_equal(trusted, 1.0)


def test_recursion_and_lock_in_are_exact_too_and_know_it():
    for estimator in (recursive(), lock_in()):
        inertia, deviation, trusted = heard(estimator, exact(), since=12.6)
        np.testing.assert_allclose(inertia, 1.0, rtol=1e-9)
        assert np.all(deviation < 0.02) and np.all(trusted == 1.0)


def filtered(record, bandwidth):
    """Rate over each sample, torque that changes it, both filtered, by SciPy: rate, q0, q1."""
    a = np.exp(-bandwidth * DT)
    rate = np.diff(record.measurement[:, 0, 0]) / DT
    torque = GAIN * (record.command[1:, 0, 0] + record.command[:-1, 0, 0]) / 2
    lag = lambda x: lfilter([1 - a], [1, -a], x)
    return rate, lag(rate), lag(torque)


def test_the_estimator_without_nuisance_terms_is_the_papers_and_its_nominal_inertia_cancels():
    """Eq. (22)-(24) over any window of 0.6 s, under a constant load that biases both alike."""
    _, q0, q1 = filtered(exact(), 5.0)
    window = slice(6898, 7199)  # the differences of the last 300 samples before 14.4 s
    parts = [jnp.asarray(x[window]) for x in (q0, q1)]
    paper = [float(paper_inertia(*parts, J_n=J_n, dt=DT)) for J_n in (0.03, 0.0552, 0.1)]
    np.testing.assert_allclose(paper, paper[0], rtol=1e-12)
    own = heard(windowed(bandwidth=5.0, order=1, window=0.6, nuisance=()), exact(), since=14.4)
    np.testing.assert_allclose(own[0][0, 0], paper[0] / INERTIA, rtol=1e-9)
    assert abs(own[0][0, 0] - 1) > 0.01


def test_the_naive_hold_filter_is_biased_by_half_a_sample_of_its_bandwidth():
    """q0' = bandwidth (rate - q0) is not the difference of the sampled q0: (e^x - 1)/x - 1."""
    record = fly(duration=15.02, tones=TONE, **EXACT)
    bandwidth = 50.0
    rate, q0, q1 = filtered(record, bandwidth)
    slope = bandwidth * (rate - q0)
    x, y = slope[-5000:], q1[-5000:]
    estimate = (x @ y) / (x @ x) / INERTIA
    assert estimate == pytest.approx(np.expm1(bandwidth * DT) / (bandwidth * DT), rel=1e-6)
    assert estimate - 1 == pytest.approx(bandwidth * DT / 2, rel=0.05)
    assert estimate * INERTIA == pytest.approx(0.05805, abs=1e-5)


def test_a_constant_torque_biases_the_papers_integral_unless_windows_hold_whole_periods():
    """int(q0') is 0 over whole periods only. With a constant and the rate as terms any will do."""
    options = {"bandwidth": 5.0, "order": 1}
    paper = {w: windowed(window=w, nuisance=(), **options) for w in (0.6, 1.0)}
    spread = {w: np.ptp(heard(e, exact(), since=8.0)[0]) for w, e in paper.items()}
    assert spread[1.0] < 1e-9 and spread[0.6] > 1
    three_terms = heard(windowed(window=0.6, **options), exact(), since=8.0)[0]
    np.testing.assert_allclose(three_terms, 1.0, rtol=1e-9)


@pytest.mark.slow
def test_a_stiffness_of_the_rig_reads_as_less_inertia_at_one_tone():
    record = fly(duration=15.02, stiffness=0.5, tones=TONE, **EXACT)
    expected = 1 - 0.5 / (4 * np.pi) ** 2 / INERTIA
    for estimator in (windowed(window=1.0), lock_in()):
        np.testing.assert_allclose(heard(estimator, record, since=12.0)[0], expected, rtol=1e-4)
    unsure = heard(windowed(window=1.0, nuisance=("offset", "rate", "angle")), record, since=12.0)
    assert not np.any(unsure[2])


@pytest.mark.slow
def test_two_tones_tell_stiffness_from_inertia():
    record = fly(duration=15.02, stiffness=0.05, tones=((1.0, 1.0), (1.0, 3.0)), **EXACT)
    stiff = lock_in(tones=ProbeTones((1.0, 3.0), above=0.0), nuisance=("angle",))
    for estimator in (windowed(window=1.0, nuisance=("offset", "rate", "angle")), stiff):
        np.testing.assert_allclose(heard(estimator, record, since=12.0)[0], 1.0, rtol=2e-4)
    state = stiff.init(jnp.zeros((1, 64)))
    state, _ = jax.lax.scan(
        lambda state, now: (stiff.update(state, *now), None),
        state,
        jax.tree.map(jnp.asarray, record),
    )
    np.testing.assert_allclose(stiff.stiffness(state), 0.05, rtol=5e-3)


def test_a_motors_lag_falls_in_quadrature():
    record = fly(duration=15.02, **{**EXACT, "lag": 0.02, "b0": 1.6})
    for estimator in (lock_in(), recursive()):
        np.testing.assert_allclose(heard(estimator, record, since=14.0)[0], 1.0, rtol=3e-3)


def test_the_default_regression_is_numpys_least_squares():
    """Torque on acceleration, rate and 1, all through three stages by SciPy, over a window."""
    estimator = windowed()
    last = slice(5000, 7500)
    a = np.exp(-15.0 * DT)
    stages = lambda x: ft.reduce(lambda y, _: lfilter([1 - a], [1, -a], y, axis=0), range(3), x)
    u, angle = (x[:, 0, :8] for x in gusty())
    change = np.diff(angle, axis=0)
    raw = [
        np.ones((7508, 8)),
        (change[1:] + change[:-1]) / (2 * DT),
        np.diff(change, axis=0) / DT**2,
    ]
    torque = GAIN * (u[2:] + u[1:-1]) / 2
    late = lambda x: np.concatenate([np.zeros((2, 8)), stages(x)])[last]  # nothing before sample 2
    x, y = np.stack([late(part) for part in raw], axis=-1), late(torque)
    solved = [np.linalg.lstsq(x[:, m], y[:, m])[0][2] / INERTIA for m in range(8)]
    np.testing.assert_allclose(heard(estimator, gusty())[0][7500, :8], solved, rtol=1e-9)
