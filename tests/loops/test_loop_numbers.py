"""Windows, margins and noise of LADRC on b/s^2: the numbers of docs/control.md."""

import numpy as np
import pytest
from loop_members import analysed, windows

from jaxquad.control import LADRC, PID
from jaxquad.loops import analyse, gain_window, Loop, loop_numbers
from jaxquad.models import DecoupledAxes


pytestmark = pytest.mark.usefixtures("compiled_quickly")
RATIOS = (2.0, 3.0, 5.0, 10.0, 20.0)  # wo / wc
HALF_K, HALF_L = {"feedback_factor": 0.5}, {"observer_factor": 0.5}


@pytest.fixture(scope="module")
def at_gains():
    """LADRC(10, 30, 2 ms) where b/b0 is 1, 0.53, 0.283 and about its edges."""
    gains = (1.0, 0.53, 0.283, 0.215, 0.2165, 4.42, 4.43)
    half = ({}, HALF_K, HALF_L, HALF_K | HALF_L)
    return analysed(*({"gain": gain} for gain in gains), *half)


@pytest.mark.slow
def test_stability_and_margins_of_10_30_are_those_of_the_record(at_gains):
    np.testing.assert_array_equal(at_gains.stable[:7], [1, 1, 1, 0, 1, 1, 0])
    np.testing.assert_allclose(at_gains.sensitivity_peak[:3], [1.763, 2.078, 7.08], rtol=1e-3)
    np.testing.assert_allclose(np.degrees(at_gains.phase_margin[:3:2]), [36.4, 9.1], atol=0.05)
    assert at_gains.gain_margin[0] == pytest.approx(4.426, rel=1e-3)
    assert 1 / at_gains.gain_reduction[0] == pytest.approx(4.633, rel=1e-3)


@pytest.mark.slow
def test_noise_to_command_is_the_gain_of_rms_from_one_sample_to_the_next(at_gains):
    full, half_k, half_l, both = np.asarray(at_gains.noise_gain[7:11])  # for b0 = 1
    assert (round(full), round(half_k), round(half_l), round(both)) == (310, 206, 224, 153)


@pytest.mark.slow
def test_half_gains_move_the_slowest_pole_as_told(at_gains):
    # With half of K the poles of the regulator are at -5 in continuous time, -4.95 at 2 ms.
    np.testing.assert_allclose(at_gains.abscissa[7:11], [-10, -5, -10, -5], rtol=0.011)
    np.testing.assert_allclose(at_gains.abscissa[8:11:2], [-4.95, -4.95], rtol=1e-4)


@pytest.mark.slow
def test_a_lag_costs_the_margins_of_the_table():
    lags = [{"lag": share / 10, "wo": wo} for wo in (30.0, 100.0) for share in (0.05, 0.1, 0.2)]
    peaks = np.asarray(analysed(*lags).sensitivity_peak)[:6]
    np.testing.assert_allclose(peaks, [2.1, 2.5, 3.9, 1.9, 2.5, 4.8], atol=0.05)


def continuous_window(k, factor):
    """Routh by roots: gains for which LADRC in continuous time with wc = 1 holds b/s^2."""
    (l1, l2, l3), (kp, kd) = factor * np.array([3 * k, 3 * k**2, k**3]), (1, 2)
    above = [kp * l1 + kd * l2 + l3, kp * l2 + kd * l3, kp * l3]
    below = np.polymul([1, l1 + kd, l2 + kd * l1 + kp, 0], [1, 0, 0])
    gains = np.geomspace(0.05, 10, 3001)
    stable = [np.all(np.roots(np.polyadd(below, g * np.array(above))).real < 0) for g in gains]
    return gains[stable][[0, -1]]


@pytest.mark.slow
def test_windows_of_fast_sampling_are_those_of_continuous_time():
    cases = [{"wc": 0.5, "wo": 0.5 * k} | half for half in ({}, HALF_L) for k in RATIOS]
    found = windows(*cases)  # only wc dt matters
    expected = [continuous_window(k, factor) for factor in (1, 0.5) for k in RATIOS]
    np.testing.assert_allclose(found.T, expected, rtol=0.02)  # wo dt is up to 0.02
    table = [[0.244, 4.0], [0.217, 4.4], [0.172, 5.1], [0.111, 6.2], [0.064, 7.2]]
    np.testing.assert_allclose(found.T[:5], table, rtol=0.02)
    assert 2.4 < np.min(found[1, 5:]) and np.max(found[1, 5:]) < 3.7


@pytest.mark.slow
def test_windows_at_2_ms_are_narrower_for_fast_observers():
    found = windows(
        *({"wo": 10 * k} for k in RATIOS), *({"gain": g, "b0": 3.0} for g in (1, 0.424))
    )
    np.testing.assert_allclose(found[0, :5], [0.244, 0.216, 0.171, 0.110, 0.064], atol=6e-4)
    np.testing.assert_allclose(found[1, :5], [4.05, 4.43, 5.08, 6.05, 6.55], atol=6e-3)
    np.testing.assert_allclose(found[:, 5:7], found[:, [1, 1]], rtol=1e-9)  # whatever b and b0


@pytest.mark.slow
def test_no_b0_stabilises_beyond_a_lag_of_about_half_a_time_constant():
    edges = {30.0: 0.48, 50.0: 0.44, 100.0: 0.42}  # of lag wc, by wo
    inside = [{"wo": wo, "lag": (at - 0.006) / 10} for wo, at in edges.items()]
    outside = [{"wo": wo, "lag": (at + 0.006) / 10} for wo, at in edges.items()]
    found = windows(*inside, *outside, {"lag": 0.02})
    assert np.all(np.isfinite(found[:, :3])) and np.all(np.isnan(found[:, 3:6]))
    np.testing.assert_allclose(found[:, 6], [0.28, 1.9], rtol=0.02)


@pytest.mark.slow
def test_the_printed_pid_needs_a_gain_above_33_and_an_unstable_plant_one_that_holds_it():
    # Over a stiffness of -2, kp b has to exceed 2: there a pole passes z = 1.
    axis = DecoupledAxes(1.0, 1.0, stiffness=[[0.0, -2.0]])
    law = PID([[0.01, 10.0]], [[0.05, 0.0]], [[0.15, 1.0]], filter=1e4, dt=1e-4)
    low, high = gain_window(Loop(axis, law))
    assert low[0] == pytest.approx(0.05 / (0.01 * 0.15), rel=0.01)  # its filter, its samples
    assert low[1] == pytest.approx(2.0 / 10.0, rel=1e-6)
    assert np.all(np.asarray(high) > 1e3)


def three_axes(law):
    """8 members of 3 axes."""
    plant = DecoupledAxes([1.0, 2.0, 0.5], np.geomspace(0.5, 2, 8)[None])
    return Loop(plant, law)


@pytest.mark.slow
def test_three_axes_are_analysed_as_each_alone():
    """8 members of 3 axes and 24 of one: the same loops, in one compile."""
    wo, b0 = np.array([24.0, 40.0, 60.0]), np.array([1, 2, 3.0])
    together = loop_numbers(three_axes(LADRC(8.0, wo, b0)), range(3))
    row = lambda x: np.repeat(x, 8)[None]
    flat = DecoupledAxes(row([1.0, 2.0, 0.5]), np.tile(np.geomspace(0.5, 2, 8), 3)[None])
    alone = loop_numbers(Loop(flat, LADRC(8.0, row(wo), row(b0))), [0])
    for a, b in zip(together, alone, strict=True):
        np.testing.assert_array_equal(a.reshape(1, 24), b)
    assert 0 < np.sum(together.stable) < together.stable.size
    assert np.isnan(together.phase_margin[~together.stable]).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "law", [LADRC([10.0, 8.0, 6.0], 30.0, 0.8), PID([5.0, 2.0, 3.0], [3.0] * 3, [1.0] * 3)]
)
def test_states_that_fill_up_a_controller_change_no_loop(law):
    filled = loop_numbers(three_axes(law), range(3))
    for axis in range(3):
        bare = analyse(three_axes(law), axis)
        slowest = np.real(bare.poles[:, 0])
        np.testing.assert_allclose(filled.abscissa[axis], slowest, rtol=1e-9)
        stable = filled.stable[axis]
        np.testing.assert_array_equal(stable, np.asarray(bare.stable))
        assert stable.any()
        # 1 + L is small where |S| is large: rounding of L counts as many times as the peak is high.
        rounding = 1e-11 * filled.sensitivity_peak[axis][stable]
        for name in ("sensitivity_peak", "phase_margin", "delay_margin", "noise_gain"):
            found, expected = getattr(filled, name)[axis], np.asarray(getattr(bare, name))
            assert np.all(np.abs(found / expected - 1)[stable] < rounding), name
