"""Filters, noise, steps and terms of an autopilot: what is drawn is what the filters do."""

import numpy as np
import pytest

from jaxquad.autopilot import FilterChain, Notch, PT1
from jaxquad.identify import GainBand
from jaxquad.plot import (
    b0_figure,
    balance_figure,
    filters_figure,
    headless,
    spectra_figure,
    Spectrum,
    StepBand,
    steps_figure,
    ThrottleCurve,
)


@pytest.fixture(autouse=True, scope="module")
def without_pyplot():
    with headless():
        yield


GYRO = FilterChain((PT1(200.0), Notch(160.0, 4.0)), 4000.0)
SLOPE = FilterChain((PT1(100.0),), 1000.0)


def lines(panel):
    return {str(line.get_label()): np.asarray(line.get_data()) for line in panel.get_lines()}


def test_delays_of_chains_add_up_and_end_at_half_of_the_slowest_rate():
    _, delay = filters_figure({"gyro": [GYRO], "D term": [GYRO, SLOPE]})
    (hertz, gyro), (same, both) = lines(delay).values()
    np.testing.assert_array_equal(hertz, same)
    assert hertz[-1] < 500.0
    np.testing.assert_allclose(both - gyro, SLOPE.delay_ms(hertz), rtol=1e-6, atol=1e-9)


def test_a_spectrum_has_one_line_in_both_panels_and_degrees():
    hertz = np.linspace(5.0, 400.0, 80)
    flat = Spectrum(hertz, np.full(80, np.radians(1.0) ** 2))
    falling = Spectrum(hertz, 1 / hertz)
    gyro, slope = spectra_figure({"before": flat}, {"flown": falling, "before": falling}, unit="u")
    np.testing.assert_allclose(lines(gyro)["before"][1], 0.0, atol=1e-9)  # 1 (deg/s)^2/Hz
    looks = [
        next(each for each in panel.get_lines() if each.get_label() == "before")
        for panel in (gyro, slope)
    ]
    assert looks[0].get_linestyle() == looks[1].get_linestyle()
    assert "re 1 u" in slope.get_ylabel()


def test_steps_have_their_bands_and_terms_their_shares():
    time = np.linspace(0.0, 1.0, 50)
    rise = 1 - np.exp(-10 * time)
    bands = {k: StepBand(time, rise, rise - 0.1, rise + 0.1) for k in ("flown", "proposed")}
    [panel] = steps_figure(bands)
    filled = panel.collections
    assert len(filled) == 2 and filled[0].get_hatch() != filled[1].get_hatch()
    # What settles within .1 s is not drawn for 1 s, however long the measured one is.
    late = StepBand(3 * time, np.sin(time), np.sin(time) - 1, np.sin(time) + 1)
    quick = StepBand(time, *(1 - np.exp(-100 * time) for _ in range(3)))
    [panel] = steps_figure({"flown": quick}, measured=late)
    assert panel.get_xlim()[1] < 0.15 and "measured" in lines(panel)
    [alone] = steps_figure({}, measured=late)
    assert alone.get_xlim()[1] > 0
    [bars] = balance_figure({"P": 3.0, "I": 1.0}, unit="pidsum")
    assert [text.get_text() for text in bars.texts] == ["3 (75 %)", "1 (25 %)"]


def test_b0_over_the_throttle_has_its_levels_band_and_what_is_taken():
    throttle, ones = np.linspace(0.3, 0.6, 20), np.ones(20)
    levels = GainBand(np.array([0.3, 0.6]), *(x * np.ones(2) for x in (2.0, 1.5, 2.5)))
    curve = GainBand(throttle, 2 * ones, 1.8 * ones, 2.2 * ones)
    taken = {"proposed": ThrottleCurve(throttle, 4 * throttle)}
    [panel] = b0_figure(levels, taken, curve=curve)
    np.testing.assert_array_equal(lines(panel)["proposed"][1], 4 * throttle)
    assert panel.get_ylim()[0] == 0
    [alone] = b0_figure(levels, {})
    assert len(panel.collections) == len(alone.collections) + 1  # the band of the curve
