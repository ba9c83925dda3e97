"""The loop that a log's parameters describe, and a measured log's terms computed again."""

import numpy as np
import pytest

from jaxquad.autopilot import (
    ardupilot_loop,
    betaflight_loop,
    BetaflightPID,
    filter_choices,
    FilterChain,
    find_parameter,
    firmware_named,
    flown_loop,
    predict_loop,
    px4_loop,
    replay_terms,
)
from jaxquad.autopilot._parameters import gains_of, parameters_of
from jaxquad.records import read, read_settings
from jaxquad.records.formats import load_log
from jaxquad.spectra import frequency_response


HEADER = {
    "looptime": "125", "pid_process_denom": "2", "rollPID": "45,80,40", "pitchPID": "47,84,46",
    "yawPID": "45,80,0", "d_min": "30,34,0", "ff_weight": "120,125,120", "d_max_gain": "37",
    "d_max_advance": "20", "gyro_lpf1_dyn_hz": "250,500", "gyro_lpf2_static_hz": "500",
    "dterm_lpf1_dyn_hz": "75,150", "dterm_lpf1_dyn_expo": "5", "dterm_lpf2_static_hz": "150",
    "gyro_notch_hz": "200,0", "gyro_notch_cutoff": "150,0", "yaw_lowpass_hz": "100",
    "iterm_relax": "1", "iterm_relax_type": "1", "iterm_relax_cutoff": "15", "tpa_rate": "65",
    "tpa_breakpoint": "1350", "tpa_mode": "1", "pidsum_limit": "500", "pidsum_limit_yaw": "400",
    "dyn_notch_count": "3",
}  # fmt: skip


def test_a_header_gives_the_loop_that_it_describes():
    flown = betaflight_loop(HEADER, (4, 5, 0))
    law = flown.law
    assert law.dt == pytest.approx(250e-6) and law.gyro.rate_hz == pytest.approx(8000)
    np.testing.assert_array_equal(law.p, [45, 47, 45])
    np.testing.assert_array_equal(law.d, [30, 34, 0])  # d_min is the base
    assert law.d_max is not None
    np.testing.assert_array_equal(law.d_max.ceiling, [40, 46, 0])
    words = [x.in_words() for x in (*law.gyro.filters, *law.filters, *law.dterm)]
    assert [x.split()[0] for x in words] == ["pt1", "pt1", "notch", "pt1", "pt1"]
    assert law.dterm[0].in_words() == "pt1 105.375 Hz"  # 75 to 150 Hz at 30 % of throttle
    assert flown.at(0.0).dterm[0].in_words() == "pt1 75 Hz"
    assert float(flown.at(1.0).tpa) == pytest.approx(0.35) and float(flown.at(1.0).tpa_p) == 1
    assert any("dynamic notches" in x for x in flown.unmodelled)


def test_from_2025_on_d_is_the_base():
    values = {**HEADER, "rollPID": "45,80,30", "d_max": "40,46,0"}
    law = betaflight_loop(values, (2025, 12, 0)).law
    assert law.d_max is not None
    assert float(law.d[0]) == 30 and float(law.d_max.ceiling[0]) == 40
    np.testing.assert_allclose(law.integral_limit, [400, 400, 320])


def test_d_max_rises_with_d():
    law = betaflight_loop({**HEADER, "rollPID": "45,80,30", "d_max": "40,46,0"}, (2025, 12, 0)).law
    gains = gains_of(law, 0) * [1.0, 1.0, 1.5]
    new = parameters_of(law, 0, gains)
    assert (new["p_roll"], new["d_roll"], new["d_max_roll"]) == (45, 45, 60)


PX4_VALUES = {
    **{f"MC_{axis}RATE_{k}": x for axis in ("ROLL", "PITCH", "YAW")
       for k, x in (("P", "0.15"), ("I", "0.2"), ("D", "0.003"))},
    "IMU_GYRO_CUTOFF": "40", "IMU_DGYRO_CUTOFF": "30",
}  # fmt: skip
ARDUPILOT_VALUES = {
    **{f"ATC_RAT_{axis}_{k}": x for axis in ("RLL", "PIT", "YAW")
       for k, x in (("P", "0.135"), ("I", "0.135"), ("D", "0.0036"))},
    "INS_GYRO_FILTER": "20", "ATC_RAT_PIT_FLTD": "30",
}  # fmt: skip


@pytest.mark.parametrize(
    ("firmware", "values", "names"),
    [
        ("betaflight", HEADER, [
            ("gyro_lpf1_dyn_min_hz", "gyro_lpf1_dyn_max_hz"), ("gyro_lpf2_static_hz",),
            ("dterm_lpf1_dyn_min_hz", "dterm_lpf1_dyn_max_hz"), ("dterm_lpf2_static_hz",),
            ("gyro_notch2_hz", "gyro_notch2_cutoff"),  # the first one is on
        ]),
        ("px4", PX4_VALUES, [
            ("IMU_GYRO_CUTOFF",), ("IMU_DGYRO_CUTOFF",), ("IMU_GYRO_NF0_FRQ", "IMU_GYRO_NF0_BW"),
        ]),
        ("ardupilot", ARDUPILOT_VALUES, [("INS_GYRO_FILTER",), ("ATC_RAT_PIT_FLTD",)]),
    ],
)  # fmt: skip
def test_every_option_of_a_filter_can_be_stored_and_gives_the_loop_it_describes(
    firmware, values, names
):
    version = (4, 5, 0)
    choices = filter_choices(firmware, values, version, axis=1, change=2.0, line_hz=110.0)
    assert [tuple(choice.flown_parameters) for choice in choices] == names
    before = flown_loop(firmware, values, version).law
    f = np.array([3.0, 40.0, 140.0])
    for choice in choices:
        for option in (choice.options[0], choice.options[choice.flown], choice.options[-1]):
            for name, value in option.parameters.items():
                row = find_parameter(firmware, name)
                assert row.low <= value <= row.high and (not row.integer or value == round(value))
            changed = firmware_named(firmware).change_filters(values, option.parameters)
            after = flown_loop(firmware, changed, version).law
            if choice.stage == "derivative" or option.filter is None:
                continue
            # The chain changes by the option's response over that of the filter that flew.
            flown = choice.options[choice.flown].filter
            ratio = _alone(option.filter, choice.rate_hz, f) / _alone(flown, choice.rate_hz, f)
            np.testing.assert_allclose(_gyro(after, f) / _gyro(before, f), ratio, rtol=0.01)


def _alone(filter, rate_hz, hertz):
    return 1.0 if filter is None else np.asarray(FilterChain((filter,), rate_hz).response(hertz))


def _gyro(law, hertz):
    own = FilterChain(law.filters, 1 / law.dt) if isinstance(law, BetaflightPID) else FilterChain()
    return np.asarray(law.gyro.response(hertz)) * np.asarray(own.response(hertz))


def test_a_header_without_gains_is_refused():
    with pytest.raises(ValueError, match="rollPID"):
        betaflight_loop({"looptime": "125"}, (4, 5, 0))


def test_px4s_parameters_give_its_loop():
    gains = {f"MC_{x}RATE_{k}": "0.1" for x in ("ROLL", "PITCH", "YAW") for k in "PID"}
    flown = px4_loop({**gains, "IMU_GYRO_RATEMAX": "1000", "IMU_GYRO_NF0_FRQ": "90",
                      "MC_YAW_TQ_CUTOFF": "2", "IMU_GYRO_DNF_EN": "1"})  # fmt: skip
    law = flown.law
    assert law.dt == 1e-3 and len(law.gyro.filters) == 2
    np.testing.assert_array_equal(law.torque_hz, [0, 0, 2])
    assert flown.unmodelled[0].startswith("IMU_GYRO_DNF_EN")


def test_ardupilots_parameters_give_its_loop():
    gains = {f"ATC_RAT_{x}_{k}": "0.1" for x in ("RLL", "PIT", "YAW") for k in "PID"}
    flown = ardupilot_loop({**gains, "ATC_RAT_YAW_FLTE": "2.5", "INS_GYRO_RATE": "1",
                            "INS_GYRO_FILTER": "40", "ATC_RAT_RLL_SMAX": "60"})  # fmt: skip
    law = flown.law
    assert law.dt == 1 / 400 and law.gyro.rate_hz == 2000
    np.testing.assert_array_equal(law.error_hz, [0, 0, 2.5])
    assert np.all(np.isinf(law.pd_limit)) and "SMAX" in flown.unmodelled[0]


def notches_of(changed, **options):
    gains = {f"ATC_RAT_{x}_{k}": "0.1" for x in ("RLL", "PIT", "YAW") for k in "PID"}
    flown = ardupilot_loop({**gains, "INS_GYRO_RATE": "1", **changed}, **options)
    *notches, low_pass = flown.law.gyro.filters
    assert low_pass.in_words() == "Butterworth 2 20 Hz"
    return flown, [x.in_words() for x in notches]


FIXED = {"INS_HNTC2_ENABLE": "1", "INS_HNTC2_MODE": "0", "INS_HNTC2_FREQ": "50",
         "INS_HNTC2_BW": "10", "INS_HNTC2_HMNCS": "5", "INS_HNTC2_OPTS": "17"}  # fmt: skip
FOLLOWING = {"INS_HNTCH_ENABLE": "1", "INS_HNTCH_FREQ": "90", "INS_HNTCH_REF": "0.25",
             "INS_HNTCH_FM_RAT": "0.7"}  # fmt: skip


def test_ardupilots_harmonic_notches_are_where_the_throttle_puts_them():
    flown, names = notches_of({**FOLLOWING, **FIXED}, throttle=0.36)
    assert not flown.unmodelled
    # 90 Hz sqrt(0.36 / 0.25); the fixed one is double before triple, of harmonics 1 and 3.
    assert names == [
        "harmonic notch 108, 216 Hz, Q 1.97", "double harmonic notch 50, 150 Hz, Q 9.74",
    ]  # fmt: skip
    centre = lambda law: float(law.gyro.filters[0].centre_hz)
    expected = [63.0, 63.0, 90.0, 180.0]
    assert [centre(flown.at(x)) for x in (0.0, 0.1, 0.25, 1.0)] == pytest.approx(expected)
    assert notches_of({**FOLLOWING, "INS_HNTCH_HMNCS": "0"})[1] == []
    # Without a reference nothing is tracked, whatever the mode.
    still = {**FOLLOWING, "INS_HNTCH_REF": "0", "INS_HNTCH_MODE": "3"}
    assert notches_of(still, throttle=0.9)[1] == ["harmonic notch 90, 180 Hz, Q 1.97"]


@pytest.mark.parametrize(("mode", "what"), [("2", "RPM"), ("3", "ESC"), ("4", "spectrum")])
def test_notches_that_follow_what_parameters_do_not_say_ask_for_it(mode, what):
    changed = {**FOLLOWING, "INS_HNTCH_REF": "1", "INS_HNTCH_MODE": mode}
    flown, names = notches_of(changed)
    [words] = flown.unmodelled
    assert names == [] and what in words and "from 90 Hz on" in words
    followed = lambda *sources: {"tracked_hz": {int(mode): sources}}
    assert notches_of(changed, **followed(100.0, 120.0))[1] == [
        "harmonic notch 110, 220 Hz, Q 1.97"
    ]
    several = {**changed, "INS_HNTCH_OPTS": "2"}
    names = notches_of(several, **followed(70.0, 120.0))[1]
    assert len(names) == (1 if mode == "2" else 2)
    assert mode == "2" or names[0] == "harmonic notch 90, 180 Hz, Q 1.97"  # not below FREQ


@pytest.mark.slow
def test_the_terms_of_a_measured_log_follow_from_its_set_point_and_gyro(data):
    path = data / "betaflight_ar8" / "LOG00037.BFL"
    settings = read_settings(path)
    flown = betaflight_loop(settings.values, settings.version)
    table = load_log(path).tables[""].columns  # sample by sample, whatever their time stamps say
    columns = lambda kind, axes=3: np.stack([table[f"{kind}[{k}]"] for k in range(axes)], 1) * 1.0
    r, y = np.deg2rad(columns("setpoint")), np.deg2rad(columns("gyroADC"))
    throttle = np.clip((table["rcCommand[3]"] - 1000) / 1000, 0, 1)
    found = replay_terms(flown, r, y, throttle, dt=1e-3, integral=columns("axisI"))
    after = slice(100, None)  # 0.1 s for the filters
    miss = {
        name: np.median(
            np.abs(np.asarray(found[name])[:, :k] - columns(f"axis{name}", k))[after], 0
        )
        for name, k in (("P", 3), ("I", 3), ("D", 2), ("F", 3))
    }
    assert np.all(miss["P"] <= 1) and np.all(miss["F"] <= 1)
    assert np.all(miss["I"] <= 2) and np.all(miss["D"] <= 2)
    # D is small in most of this flight: where it is not, it must follow, at its full size.
    d = columns("axisD", 2)
    for k in (0, 1):
        assert np.corrcoef(np.asarray(found["D"])[after, k], d[after, k])[0, 1] > 0.9


@pytest.mark.slow
def test_the_laws_of_a_measured_log_reproduce_its_closed_loops(data):
    path = data / "betaflight_ar8" / "LOG00037.BFL"
    settings = read_settings(path)
    flown = betaflight_loop(settings.values, settings.version, throttle=0.34)
    assert any(x.startswith("feedforward_transition") for x in flown.unmodelled)
    law, omega = flown.law.without_gyro_filters(), 2 * np.pi * np.geomspace(5.0, 15.0, 12)
    for axis in (0, 1):
        names = f"setpoint[{axis}]", f"axisSum[{axis}]", f"gyroADC[{axis}]"
        parts = {"outputs": [names[2]], "start": 453.5, "stop": 469.0}
        plant = frequency_response(
            read(path, inputs=[names[1]], references=[names[0]], **parts), omega
        )
        loop = frequency_response(read(path, inputs=[names[0]], **parts), omega)
        per_radian = np.asarray(plant.response)[:, 0, 0] * np.pi / 180
        predicted = np.asarray(predict_loop(law.linear(axis), per_radian, omega))
        away = np.abs(predicted / np.asarray(loop.response)[:, 0, 0] - 1)
        assert np.isfinite(away).sum() >= 8 and np.nanmedian(away) < 0.12
