"""The gain over the throttle, from outputs that scipy calculates of a known plant and curve."""

import json
from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

import jaxquad as jq
from jaxquad.autopilot import adrc_b0
from jaxquad.identify import curve_of_parameter, throttle_levels


pytestmark = pytest.mark.slow


DT = 0.004
LAG, DELAY, CURVE, SLOPE = 0.025, 0.004, 0.55, 80.0  # s, s, -, deg/s^2 per unit of command
LEVELS = (0.25, 0.4, 0.6)
SECONDS = 8.0


def gain(throttle):
    return SLOPE * (1 - CURVE + 2 * CURVE * throttle)


def flight(levels=LEVELS, *, seed=1, wander=0.01, noise=1.0):
    """Sweeps at each level, the throttle moving slowly around it, noise on the rate."""
    rng = np.random.default_rng(seed)
    count = round(SECONDS / DT)
    time = np.arange(count * len(levels)) * DT
    local = np.tile(np.arange(count) * DT, len(levels))
    phase = 2 * np.pi * (1.0 * local + 34.0 * local**2 / (2 * (SECONDS - 1)))
    u = np.where((local > 0.3) & (local < SECONDS - 0.7), 100 * np.sin(phase), 0.0)
    throttle = np.repeat(levels, count) + wander * np.sin(2 * np.pi * 0.23 * time)
    found: Any = cont2discrete(([1.0], [LAG, 1.0, 0.0]), DT, "zoh")
    numerator, denominator = found[:2]
    driven = np.concatenate([[0.0], gain(throttle) * u])[: time.size]  # one sample of delay
    y = lfilter(np.ravel(numerator), denominator, driven) + noise * rng.standard_normal(time.size)
    return jq.Record(
        time,
        np.stack([u, 1000 * throttle], axis=1),
        y,
        input_names=("sum", "throttle"),
        output_names="rate",
        output_units="deg/s",
        hold="dt",
    )


def identify(record, **options):
    return jq.identify.gain_over_throttle(record, throttle_range=(0.0, 1000.0), **options)


@pytest.fixture(scope="module")
def found():
    return identify(flight())


def test_stretches_are_where_each_level_was_flown(found):
    assert len(found.stretches) == found.throttle.size
    for spans, seconds in zip(found.stretches, found.seconds, strict=True):
        assert sum(stop - start for start, stop in spans) == pytest.approx(seconds, abs=2 * DT)
    starts = [spans[0][0] for spans in found.stretches]
    np.testing.assert_allclose(starts, SECONDS * np.arange(3), atol=0.05)


def test_gains_lag_delay_and_curve_are_recovered_within_their_errors(found):
    np.testing.assert_allclose(found.throttle, LEVELS, atol=0.005)
    assert np.all(np.abs(found.gain - gain(found.throttle)) < 3.5 * found.gain_errors)
    assert np.all(found.gain_errors < 0.02 * found.gain)
    for name, true in (("lag", LAG), ("delay", DELAY)):
        error = found.fit.standard_errors[found.fit.names.index(name)]
        assert abs(found.fit[name] - true) < 3.5 * error
    assert abs(found.curve.value - CURVE) < 3.5 * found.curve.standard_error < 0.1


def test_the_gain_between_the_levels_follows_the_curve_with_its_band(found):
    grid = np.linspace(0.25, 0.6, 8)
    band = found.over(grid)
    assert np.all((band.low < band.value) & (band.value < band.high))
    np.testing.assert_allclose(band.value, gain(grid), rtol=0.02)
    middle = found.b0_over(found.throttle[1:2])
    assert middle.value[0] == pytest.approx(found.b0(1).value, rel=0.02)


def test_drawn_plants_scatter_as_the_band_says_and_follow_a_curve(found):
    grid = np.array([0.3, 0.45, 0.6])
    plants, band = found.draw(grid, 4000, seed=3), found.over(grid)
    sigma = (band.high - band.low) / 2 / 1.96
    np.testing.assert_allclose(plants.gain.std(axis=1), sigma, rtol=0.1)
    assert np.all(np.abs(plants.gain.mean(axis=1) - band.value) < 0.1 * sigma)
    straight = plants.gain[1] - (plants.gain[0] + plants.gain[2]) / 2
    assert np.max(np.abs(straight)) < 1e-9 * band.value[1]
    b0 = plants.gain[0] / plants.lag
    reach = found.b0_over(grid[:1])
    assert b0.std() == pytest.approx(float(reach.high[0] - reach.low[0]) / 2 / 1.96, rel=0.1)


def test_b0_at_hover_is_that_of_gain_and_lag(found):
    law = found.adrc_b0(0.4)
    rad = found.over(np.array([0.4])).value[0] * np.pi / 180
    assert law.b0.value == pytest.approx(float(adrc_b0(1000 * rad, found.fit["lag"])), rel=1e-6)
    assert law.deviations[law.law] == min(law.deviations.values())
    assert not law.extrapolated and found.adrc_b0(0.9).extrapolated


def test_one_curve_gives_the_parameter_of_each_firmware(found):
    f = found.curve.value
    assert found.firmware_value("px4").value == pytest.approx(f)
    assert found.firmware_value("ardupilot").name == "MOT_THST_EXPO"
    assert found.firmware_value("betaflight").value == pytest.approx(100 * f)
    older = found.firmware_value("betaflight 2025.12").value / 100
    t = np.linspace(0, 1, 201)
    x = t * (1 + older * (1 - t) ** 2)  # what that firmware sends for a thrust t
    assert np.max(np.abs(f * x**2 + (1 - f) * x - t)) < 0.07 < np.max(np.abs(f * t**2 - f * t))


def test_a_firmwares_parameter_and_its_curve_are_each_others_inverse(found):
    assert curve_of_parameter("ardupilot", -0.3) == -0.3
    for firmware in ("px4", "betaflight", "betaflight 2025.12"):
        value = found.firmware_value(firmware).value
        assert curve_of_parameter(firmware, value) == pytest.approx(found.curve.value, abs=2e-3)


def test_the_gain_under_an_inverted_curve_is_that_of_a_full_slope(found):
    straight = found.straight_gain
    assert abs(straight.value - SLOPE) < 3.5 * straight.standard_error < 0.1 * SLOPE


def test_levels_of_throttle_are_those_of_the_gains_and_one_alone_says_what_to_fly(found):
    levels = throttle_levels(flight(), throttle_range=(0.0, 1000.0))
    np.testing.assert_allclose(levels.throttle, found.throttle, atol=0.005)
    assert np.all((levels.low < levels.throttle) & (levels.throttle < levels.high))
    assert levels.what_to_fly() == ""
    single = throttle_levels(flight((0.4,)), throttle_range=(0.0, 1000.0))
    advice = single.what_to_fly()
    assert advice.startswith("fly 0.30 and 0.50 as well, with the same excitation")
    assert ("turns of about 8 s" in advice) == (single.seconds[0] > 10)


def test_the_table_and_the_mapping_hold_the_levels_and_the_parameters(found):
    content = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert [each["throttle"] for each in content["levels"]] == found.throttle.tolist()
    assert content["firmware"][0]["name"] == "THR_MDL_FAC"
    assert "THR_MDL_FAC" in str(found) and "enough of the thrust curve" in str(found)


def test_a_throttle_that_never_rests_says_what_to_fly():
    record = flight((0.3,), wander=0.3)
    with pytest.raises(ValueError, match="hold it at two or three levels"):
        identify(record)
    with pytest.raises(ValueError, match="throttle_range="):
        jq.identify.gain_over_throttle(record)


def test_levels_that_are_close_or_single_hold_too_little_and_say_so():
    single = identify(flight((0.4,)))
    assert single.curve is None and single.b0(0).value > 0
    with pytest.raises(jq.identify.UndeterminedError, match="fly 0.30 and 0.50 as well"):
        single.firmware_value("px4")
    close = identify(flight((0.38, 0.46), noise=20.0))
    assert "too little of the thrust curve" in str(close)
    with pytest.raises(jq.identify.UndeterminedError, match="fly from"):
        close.firmware_value("px4")


def test_a_curve_that_the_firmware_inverts_already_is_found_again():
    record = flight()
    x = record.channel("throttle") / 1000
    sent = CURVE * x**2 + (1 - CURVE) * x  # the throttle of which the firmware makes x
    slope = 1 - CURVE + 2 * CURVE * x
    inputs = np.stack([record.channel("sum") * slope, 1000 * sent], axis=1)
    names = {"input_names": ("sum", "throttle"), "output_units": "deg/s", "hold": "dt"}
    found = identify(jq.Record(record.time, inputs, record.outputs, **names), flown_curve=CURVE)
    np.testing.assert_allclose(found.gain, SLOPE, rtol=0.02)
    curve = found.curve
    assert curve is not None and abs(curve.value - CURVE) < 3.5 * curve.standard_error


def test_known_filters_are_divided_out():
    record = flight()
    smooth = lfilter([0.5], [1, -0.5], record.outputs[:, 0])

    class Lowpass:
        def response(self, frequency_hz):
            return 0.5 / (1 - 0.5 * np.exp(-2j * np.pi * np.asarray(frequency_hz) * DT))

    names = {"input_names": ("sum", "throttle"), "output_units": "deg/s", "hold": "dt"}
    filtered = jq.Record(record.time, record.inputs, smooth, **names)
    plain, divided = identify(record), identify(filtered, filters=(Lowpass(),))
    assert divided.fit["delay"] == pytest.approx(plain.fit["delay"], rel=0.05)
    assert divided.fit["lag"] == pytest.approx(plain.fit["lag"], rel=0.05)
