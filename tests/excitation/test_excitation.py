from typing import Any

import numpy as np
import pytest
from scipy.integrate import cumulative_simpson

from jaxquad.excitation import (
    check_guidelines,
    doublet,
    harmonics,
    multisine,
    sweep,
    three_two_one_one,
)


def full_size(**changes):
    options: dict[str, Any] = dict(duration=90.0, sample_rate=100.0, amplitude=0.1) | changes
    return sweep(0.3, 12.0, **options)


def excited(design):
    clock = design.time - design.lead
    return (clock > 0) & (clock < design.duration)


def published_frequency(design):
    """In rad/s, by eq. 5.15 and 5.16, after the cycles at the lowest one."""
    share = np.clip((design.time - design.lead_in) / (design.duration - design.lead_in), 0, 1)
    return 0.3 + 0.0187 * (np.exp(4.0 * share) - 1) * 11.7


def test_sweep_phase_is_the_integral_of_its_frequency():
    design = full_size(sample_rate=1000.0, fade_in=0.0, fade_out=0.0, trim=0.0)
    omega = published_frequency(design)
    phase = cumulative_simpson(omega, x=design.time, initial=0)
    # Simpson's rule is only second order at the kink where the lead-in ends.
    np.testing.assert_allclose(design.signal, 0.1 * np.sin(phase), atol=1e-7)
    assert 12.0 < omega[-1] < 12.0 * 1.0024


def test_sweep_begins_with_two_whole_cycles_at_the_lowest_frequency():
    design = full_size(sample_rate=1000.0)
    rising = (design.signal[:-1] <= 0) & (design.signal[1:] > 0)
    crossings = design.time[:-1][rising] - design.lead
    period = 2 * np.pi / 0.3
    np.testing.assert_allclose(crossings[:3], [0, period, 2 * period], atol=2e-3)


def test_sweep_is_zero_in_its_trim_and_lasts_as_long_as_asked():
    design = full_size()
    assert design.time[-1] == 96.0 and design.duration == 90.0
    assert not design.signal[~excited(design)].any()


def test_sweep_fades_leave_the_middle_at_full_amplitude():
    design, bare = full_size(), full_size(fade_in=0.0, fade_out=0.0)
    clock = design.time - design.lead
    middle = (clock > 2 * np.pi / 0.3) & (clock < 90 - 4 * np.pi / 12)
    np.testing.assert_array_equal(design.signal[middle], bare.signal[middle])
    assert np.abs(design.signal).max() <= 0.1
    assert abs(np.diff(design.signal)).max() < 0.1 * 12.1 / 100


def test_sweep_energy_stays_in_its_band():
    design = full_size()
    power = np.abs(np.fft.rfft(design.signal)) ** 2
    omega = 2 * np.pi * np.fft.rfftfreq(design.samples, 0.01)
    assert power[omega > 1.2 * 12].sum() < 1e-3 * power.sum()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (dict(duration=40.0), r"duration 40 s leaves no time for the sweep.*83\.7758 s or more"),
        (dict(amplitude=-0.1), "amplitude is -0.1"),
        (dict(sample_rate=3.0), r"omega_max 12 rad/s is not below 9\.42478 rad/s"),
        (dict(sample_rate=np.nan), "sample_rate is nan"),
        (dict(fade_in=60.0, fade_out=40.0), "fade_in 60 s and fade_out 40 s do not fit"),
        (dict(trim=-1.0), "trim is -1.0"),
    ],
)
def test_sweep_refuses(changes, said):
    with pytest.raises(ValueError, match=said):
        full_size(**changes)


def test_sweep_refuses_an_empty_band():
    with pytest.raises(ValueError, match="omega_max 2 rad/s is not above omega_min 3 rad/s"):
        sweep(3.0, 2.0, duration=30.0, sample_rate=100.0, amplitude=1.0)


def test_multisine_holds_its_lines_and_nothing_else():
    omega = harmonics(1.0, 60.0, period=20.0, lines=25)
    design = multisine(omega, period=20.0, periods=3, sample_rate=250.0, amplitude=0.2)
    spectrum = np.abs(np.fft.rfft(design.signal)) / design.samples
    bins = np.round(omega * 60.0 / (2 * np.pi)).astype(int)
    on_lines = spectrum[bins]
    assert np.ptp(on_lines) < 1e-12
    assert np.delete(spectrum, bins).max() < 1e-13
    assert np.abs(design.signal).max() == pytest.approx(0.2, rel=1e-15)


def test_multisine_repeats_to_the_last_bit():
    omega = harmonics(1.0, 60.0, period=20.0)
    design = multisine(omega, period=20.0, periods=3, sample_rate=250.0, amplitude=0.2)
    first, second, third = design.signal.reshape(3, -1)
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(first, third)
    assert abs(design.signal[0]) < 1e-3 * 0.2


@pytest.mark.parametrize(("lines", "limit"), [(None, 1.7), (60, 2.0), (25, 2.3)])
def test_multisine_has_a_low_crest_factor(lines, limit):
    omega = harmonics(1.0, 60.0, period=20.0, lines=lines)
    design = multisine(omega, period=20.0, periods=1, sample_rate=250.0, amplitude=1.0)
    assert np.abs(design.signal).max() / design.signal.std() < limit


def test_interleaved_lines_make_orthogonal_signals():
    omega = harmonics(1.0, 60.0, period=20.0)
    options: dict[str, Any] = dict(period=20.0, periods=1, sample_rate=250.0, amplitude=1.0)
    roll, pitch = (multisine(omega[i::2], **options).signal for i in range(2))
    assert abs(roll @ pitch) < 1e-10 * roll.size


def test_harmonics_are_distinct_multiples_within_the_band():
    omega = harmonics(1.0, 60.0, period=20.0, lines=100)
    order = omega * 20.0 / (2 * np.pi)
    np.testing.assert_allclose(order, np.round(order), rtol=1e-14)
    assert (np.diff(np.round(order)) >= 1).all()
    assert omega[0] >= 1.0 and omega[-1] <= 60.0


def test_multisine_refuses_a_period_of_no_whole_samples():
    omega = harmonics(1.0, 20.0, period=7.03)
    with pytest.raises(ValueError, match=r"70\.3 samples.*nearest are 7 s and 7\.1 s"):
        multisine(omega, period=7.03, periods=1, sample_rate=10.0, amplitude=1.0)


def test_multisine_refuses_a_line_off_the_harmonics():
    with pytest.raises(ValueError, match="the line 2 rad/s is 6.3662 times the fundamental"):
        multisine([2.0, np.pi], period=20.0, periods=1, sample_rate=50.0, amplitude=1.0)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (dict(period=0.05), "fewer than two harmonics of 125.664 rad/s"),
        (dict(period=20.0, lines=1), "lines is 1: the band holds 187 harmonics"),
        (dict(period=20.0, lines=500), "lines is 500: the band holds 187 harmonics"),
        (dict(period=-1.0), "period is -1.0"),
    ],
)
def test_harmonics_refuses(options, said):
    with pytest.raises(ValueError, match=said):
        harmonics(1.0, 60.0, **options)


def test_doublet_has_no_net_input():
    design = doublet(width=0.5, amplitude=2.0, sample_rate=100.0)
    assert design.signal.sum() == 0.0
    assert (design.signal[100:150] == 2.0).all() and (design.signal[150:200] == -2.0).all()
    assert design.samples == 100 + 100 + 300


def test_three_two_one_one_leaves_one_unit():
    design = three_two_one_one(width=0.5, amplitude=2.0, sample_rate=100.0)
    assert design.signal.sum() / 100.0 == 2.0 * 0.5
    changes = np.flatnonzero(np.diff(design.signal)) + 1
    np.testing.assert_array_equal(np.diff(changes), [150, 100, 50, 50])


def test_doublet_band_is_that_of_the_closed_form():
    design = doublet(width=0.5, amplitude=1.0, sample_rate=1000.0)
    # sin(x)^2 / x, x = omega width / 2, peaks at 0.7246 and is 0.7246 / sqrt(2) at both ends.
    x = 0.25 * np.array([design.omega_min, design.omega_max])
    np.testing.assert_allclose(np.sin(x) ** 2 / x, 0.7246 / np.sqrt(2), rtol=0.01)


def test_pulses_refuse_a_width_between_samples():
    with pytest.raises(ValueError, match=r"width of 0\.033 s is 3\.3 samples.*0\.03 s and 0\.04 s"):
        doublet(width=0.033, amplitude=1.0, sample_rate=100.0)


def test_a_sound_sweep_keeps_every_guideline():
    report = check_guidelines(full_size(), omega_bandwidth=1.0, omega_180=4.0)
    assert report.ok and len(report) == 8
    assert "FAIL" not in str(report)


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        (dict(duration=80.0), "record length"),
        (dict(sample_rate=40.0), "sample rate"),
        (dict(lead_in_cycles=1), "lead-in"),
        (dict(trim=1.0), "trim"),
    ],
)
def test_each_broken_guideline_is_named_alone(changes, rule):
    report = check_guidelines(full_size(**changes))
    assert [each.rule for each in report if not each.ok] == [rule]
    assert not report.ok and f"FAIL  {rule}" in str(report)


def test_a_narrow_short_sweep_breaks_range_and_window():
    design = sweep(1.0, 5.0, duration=30.0, sample_rate=100.0, amplitude=1.0)
    broken = [each.rule for each in check_guidelines(design) if not each.ok]
    assert broken == ["range", "window"]


def test_the_band_is_held_against_the_expected_response():
    report = check_guidelines(full_size(), omega_bandwidth=0.5, omega_180=6.0)
    broken = {each.rule: each.limit for each in report if not each.ok}
    assert broken == {"low end": 0.25, "high end": 15.0}


def test_a_record_of_four_to_five_cycles_is_kept_with_a_word():
    [length] = [each for each in check_guidelines(full_size()) if each.rule == "record length"]
    assert length.ok and "longer is safer" in length.message
