import shlex

import numpy as np
import pytest
from flight_logs import ardupilot, CHIRP, COLLECTIVE, crazyflie, IN_RUN, px4, TIME, WAVE
from log_writers import DataFlash

from jaxquad.cli import make_parser
from jaxquad.records import parse_mix, propose, read, read_settings, ReadError, RecordError
from jaxquad.workflows import IdentifySettings, open_logs, SettingsError


@pytest.mark.parametrize("place", range(1, 13))
def test_ardupilot_chirps_are_found_with_axis_time_band_and_summing_point(tmp_path, place):
    proposal = propose(ardupilot(tmp_path, place))
    axis = ("roll", "pitch", "yaw")[(place - 1) % 3]
    letter = axis[0].upper()
    setup = proposal.setup
    assert (setup.axis, setup.rate, setup.reference) == (axis, f"RATE.{letter}", "SIDD.Targ")
    assert setup.command == {f"RATE.{letter}Out": 1.0}
    assert setup.injected_at == ("angle", "angle", "rate", "mixer")[(place - 1) // 3]
    assert setup.late_s == {f"RATE.{letter}Des": 0.0025, "SIDD.Targ": 0.0025}
    assert setup.band == (0.5, 8.0)
    assert setup.longest == (pytest.approx(22.0), pytest.approx(30.0, abs=0.01))
    record = read(proposal.path, **proposal.options)
    if place >= 10:
        w = WAVE[IN_RUN] * {"roll": 0.1, "pitch": 0.2, "yaw": 1.0}[axis]
        middle = slice(100, -100)
        late = setup.late_s["SIDD.Targ"]
        flown = np.interp(record.time, TIME[IN_RUN], w)
        flown += np.interp(record.time, TIME[IN_RUN] + late, CHIRP[IN_RUN])
        np.testing.assert_allclose(record.inputs[middle, 0], flown[middle], atol=1e-2)


def test_the_printed_line_is_what_the_command_line_takes(tmp_path):
    proposal = propose(ardupilot(tmp_path, 10))
    line = str(proposal).splitlines()[-1].strip()
    words = shlex.split(line)
    assert words[:2] == ["jaxquad", "identify"]
    typed = settings_typed(words)
    assert parse_mix(typed.input or "") == {"RATE.ROut": {"RATE.ROut": 1.0}}
    assert typed.reference == "SIDD.Targ"
    assert (typed.rate, typed.band) == (400.0, (0.5, 8.0))


def test_an_integral_term_that_works_against_the_sweep_is_told(tmp_path):
    assert "ATC_RAT_PIT_I = 0.1" in str(propose(ardupilot(tmp_path, 11, gain="0.1")))
    assert "ATC_RAT" not in str(propose(ardupilot(tmp_path, 11)))


def test_all_chirps_into_one_place_are_segments_of_the_printed_line(tmp_path):
    proposal = propose(ardupilot(tmp_path, 10, runs=((21, 24, 6.0), (25.5, 30, 8.0))))
    assert "2 times: 0.5 .. 8 Hz (3.14 .. 50.3 rad/s), 2.997 + 4.497 s" in str(proposal)
    assert np.allclose(proposal.segments, [(21, 24), (25.5, 30)], atol=0.01)
    # One record is that of the longest.
    assert proposal.options["start"] == pytest.approx(25.5)
    line = str(proposal).splitlines()[-1].strip()
    typed = settings_typed(shlex.split(line))
    np.testing.assert_allclose(typed.segments, proposal.segments)
    assert typed.start is None and typed.stop is None


THREE = ((21, 24, 6.0), (25, 27.5, 8.0, 8), (28, 31.5, 8.0, 10))  # roll, pitch, roll again


def test_several_chirps_are_listed_with_number_axis_place_time_and_band(tmp_path):
    proposal = propose(ardupilot(tmp_path, 10, runs=THREE))
    lines = [line.strip() for line in str(proposal).splitlines()]
    assert lines[2] == "chirps of this log (* used; --chirp N chooses one):"
    assert lines[3:6] == [
        "* 1: roll, the mixer (SID_AXIS 10), t = 21 .. 23.9975 s, 0.5 .. 6 Hz",
        "2: pitch, the rate set-point (SID_AXIS 8), t = 25 .. 27.4975 s, 0.5 .. 8 Hz",
        "* 3: roll, the mixer (SID_AXIS 10), t = 28 .. 31.4975 s, 0.5 .. 8 Hz",
    ]
    assert np.allclose(proposal.segments, [(21, 24), (28, 31.5)], atol=0.01)
    assert "chirps of this log" not in str(propose(ardupilot(tmp_path, 10)))


@pytest.mark.parametrize(
    ("options", "axis", "spans"),
    [
        ({"chirp": 2}, "pitch", [(25, 27.5)]),
        ({"chirp": 3}, "roll", [(28, 31.5)]),
        ({"chirp": 3, "stop": 30.5}, "roll", [(28, 30.5)]),
        ({"axis": "pitch"}, "pitch", [(25, 27.5)]),
        ({"start": 24.5, "stop": 28.5}, "pitch", [(25, 27.5)]),
        ({"start": 25.5, "axis": "roll"}, "roll", [(28, 31.5)]),
        ({"start": 22}, "roll", [(22, 24), (28, 31.5)]),
    ],
)
def test_chirps_are_chosen_by_number_axis_or_time(tmp_path, options, axis, spans):
    proposal = propose(ardupilot(tmp_path, 10, runs=THREE), **options)
    assert proposal.setup.axis == axis
    assert list(proposal.setup.command) == [f"RATE.{axis[0].upper()}Out"]
    assert proposal.setup.injected_at == ("rate" if axis == "pitch" else "mixer")
    assert np.allclose(proposal.segments, spans, atol=0.01)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"chirp": 4}, r"there is no chirp 4. Chirps of this log: 1: roll, .*; 3: roll, the mixer"),
        ({"chirp": 2, "axis": "yaw"}, "chirp 2 is not on the axis yaw"),
        ({"chirp": 2, "start": 28}, "chirp 2 lies outside the span of start and stop"),
    ],
)
def test_a_chirp_that_the_log_does_not_hold_is_refused_with_a_list(tmp_path, options, complaint):
    with pytest.raises(RecordError, match=complaint):
        propose(ardupilot(tmp_path, 10, runs=THREE), **options)
    with pytest.raises(RecordError, match="the chirps of px4 have no numbers"):
        propose(px4(tmp_path, state=2), chirp=1)


def test_the_setting_chirp_decides_what_is_read(tmp_path):
    path = ardupilot(tmp_path, 10, runs=THREE)
    typed = settings_typed(["jaxquad", "identify", str(path), "--chirp", "2"])
    opened = open_logs(path, typed)
    assert opened.settings.output == "RATE.P" and opened.settings.chirp is None
    assert opened.records[0].time[[0, -1]] == pytest.approx([25, 27.5], abs=0.01)
    opened = open_logs(path, IdentifySettings(start=24.5, stop=30))
    assert opened.settings.output == "RATE.P"
    with pytest.raises(SettingsError, match="`chirp` is for a proposal"):
        IdentifySettings(chirp=2, input="a", output="b")


def test_a_span_without_a_chirp_is_identified_without_a_reference(tmp_path):
    proposal = propose(ardupilot(tmp_path, 10), axis="roll", stop=21.5)
    assert not proposal.setup.reference and not proposal.setup.injected_at
    assert "1: roll, the mixer (SID_AXIS 10), t = 22" in str(proposal)


@pytest.mark.parametrize(("place", "words"), [(13, "the thrust"), (19, "the velocity set-point")])
def test_a_chirp_that_turns_no_axis_is_refused_with_what_to_fly(tmp_path, place, words):
    path = ardupilot(tmp_path, place)
    with pytest.raises(RecordError, match=rf"{words} .SID_AXIS {place}., which turns no .* 10 \("):
        propose(path)
    runs = ((21, 26, 6.0), (27, 30, 8.0, 11))
    proposal = propose(ardupilot(tmp_path, place, runs=runs))
    assert proposal.setup.axis == "pitch" and f"1: no axis, {words}" in str(proposal)


def test_the_hovers_throttle_that_the_firmware_learns_is_no_change_of_the_loop(tmp_path):
    changes = ((25.0, 0.2), (27.0, 0.25))
    proposal = propose(ardupilot(tmp_path, 10, changes=changes, changed="MOT_THST_HOVER"))
    assert not proposal.changes and proposal.setup.longest[1] == pytest.approx(30, abs=0.01)


@pytest.mark.parametrize("terms", [False, True])
def test_a_log_of_a_plane_is_refused_by_its_name(tmp_path, terms):
    log = DataFlash()
    log.define("MSG", "QZ", "TimeUS,Message")
    log.write("MSG", 1, b"ArduPlane V4.5.7 (2a3dc4b7)")
    for name in ("ATT", *(("PIDR", "PIDP") if terms else ())):
        log.define(name, "Qff", "TimeUS,Tar,Act")
        log.write_rows(name, np.arange(50) * 10_000, np.arange(50.0), np.arange(50.0))
    (tmp_path / "log.bin").write_bytes(log.content)
    with pytest.raises(RecordError, match="log is of ArduPlane V4.5.7 .2a3dc4b7.") as refused:
        propose(tmp_path / "log.bin")
    assert ("--output PIDR.Act" in str(refused.value)) == terms


def test_a_change_of_the_loops_parameters_splits_the_log_there(tmp_path):
    proposal = propose(ardupilot(tmp_path, 10, changes=((25.0, 0.2), (27.0, 0.2))))
    assert proposal.setup.longest == (
        pytest.approx(25.0, abs=0.01),
        pytest.approx(30.0, abs=0.01),
    )
    assert "ATC_RAT_RLL_P 0.135000005 -> 0.200000003 at t = 25" in str(proposal)
    assert "others: 22" in str(proposal) and "LOG_BITMASK" not in str(proposal)
    [change] = proposal.changes
    assert (change.name, change.time) == ("ATC_RAT_RLL_P", pytest.approx(25.0, abs=0.01))


def test_injections_with_other_parameters_are_no_segments_of_the_same_record(tmp_path):
    runs = ((21, 23.5, 6.0), (24.6, 27, 8.0), (28.5, 31, 8.0))
    proposal = propose(ardupilot(tmp_path, 10, runs=runs, changes=((24.0, 0.2),)))
    assert np.allclose(proposal.segments, [(24.6, 27), (28.5, 31)], atol=0.01)
    whole = propose(ardupilot(tmp_path, 10, runs=runs))
    assert len(whole.segments) == 3 and not whole.changes


def test_px4s_parameter_updates_split_a_log_without_injections(tmp_path):
    proposal = propose(px4(tmp_path, nav_state=10, change=28.0), axis="roll")
    assert proposal.setup.longest[1] == pytest.approx(28.0, abs=0.01)
    assert proposal.options["start"] == pytest.approx(20.0, abs=0.01)
    assert "MC_ROLLRATE_P 0.15" in str(proposal)


def test_the_settings_of_a_time_are_those_before_later_changes(tmp_path):
    path = ardupilot(tmp_path, 10, changes=((25.0, 0.2), (27.0, 0.3)))
    name = "ATC_RAT_RLL_P"
    found = [float(read_settings(path, at=at).values[name]) for at in (24.0, 26.0, 28.0, None)]
    np.testing.assert_allclose(found, [0.135, 0.2, 0.3, 0.3], rtol=1e-6)


def test_the_collective_is_proposed_as_a_second_input(data, tmp_path):
    proposal = propose(data / "betaflight_ar8/LOG00037.BFL", axis="roll")
    record = read(proposal.path, **proposal.options_with_throttle)
    throttle = record.channel("throttle")
    assert throttle.min() > -0.01 and 0.2 < throttle.max() <= 1.0
    with pytest.raises(RecordError, match="holds no collective"):
        propose(ardupilot(tmp_path, 10)).options_with_throttle  # noqa: B018


@pytest.mark.filterwarnings("ignore:resampled to 400 Hz, faster than 'CTUN.ThO' 10 Hz")
@pytest.mark.parametrize(
    ("firmware", "channel"),
    [("ardupilot", "RATE.AOut"), ("ardupilot", "CTUN.ThO"), ("crazyflie", "controller.cmd_thrust"),
     ("crazyflie", "stabilizer.thrust")],
)  # fmt: skip
def test_the_collective_of_every_vehicle_is_a_share_of_full_thrust(tmp_path, firmware, channel):
    if firmware == "ardupilot":
        proposal = propose(ardupilot(tmp_path, 10, collective=channel))
    else:
        proposal = propose(crazyflie(tmp_path, channel), axis="roll")
    assert list(proposal.setup.throttle) == [channel]
    record = read(proposal.path, **proposal.options_with_throttle)
    assert len(record.input_names) == 2 and record.input_names[1] == "throttle"
    inside = slice(200, -200)  # of ends that anti-aliasing and 10 Hz know less well
    wanted = np.interp(record.time, TIME, COLLECTIVE)
    np.testing.assert_allclose(record.channel("throttle")[inside], wanted[inside], atol=2e-3)


def settings_typed(words):
    """The settings of `jaxquad identify ...`."""
    options = vars(make_parser().parse_args(words[1:]))
    keys = IdentifySettings.options()
    return IdentifySettings(**{key: value for key, value in options.items() if key in keys})


def test_without_a_chirp_the_loops_set_point_is_no_reference(tmp_path):
    proposal = propose(ardupilot(tmp_path, 0, sidd=False), axis="pitch")
    assert proposal.options["references"] is None
    assert "RATE.PDes is computed by the attitude loop" in str(proposal)
    assert "external reference: none" in str(proposal) and "--reference" not in str(proposal)


@pytest.mark.parametrize(("state", "axis", "i"), [(2, "roll", 0), (4, "pitch", 1), (6, "yaw", 2)])
def test_px4_autotune_is_found_with_its_axis_and_time(tmp_path, state, axis, i):
    setup = propose(px4(tmp_path, state=state)).setup
    assert setup.axis == axis and setup.command == {f"vehicle_torque_setpoint.xyz[{i}]": 1.0}
    assert setup.rate == f"vehicle_angular_velocity.xyz[{i}]"
    assert setup.reference == f"autotune_attitude_control_status.rate_sp[{i}]"
    assert setup.longest == (pytest.approx(22.0), pytest.approx(30.0, abs=0.01))


def test_two_runs_of_autotune_are_two_segments(tmp_path):
    twice = np.where((TIME > 24) & (TIME < 26), 0, 4)
    proposal = propose(px4(tmp_path, state=twice))
    assert np.allclose(proposal.segments, [(22, 24), (26, 30)], atol=0.01)
    assert "--segment" in proposal.command_line and "--start" not in proposal.command_line


def test_px4s_rate_set_point_is_of_the_outside_in_acro_alone(tmp_path):
    acro, stabilised = propose(px4(tmp_path, nav_state=10)), propose(px4(tmp_path))
    assert acro.setup.axis == "pitch"  # which moves most
    assert acro.setup.reference == "vehicle_rates_setpoint.pitch"
    assert not stabilised.setup.reference
    assert "vehicle_rates_setpoint.pitch is computed by the attitude loop" in str(stabilised)
    assert acro.units["vehicle_angular_velocity.xyz[1]"] == "rad/s"


def test_betaflight_and_crazyflie_logs_get_what_their_readme_says(data):
    proposal = propose(data / "betaflight_ar8/LOG00037.BFL", axis="yaw")
    assert proposal.setup.command == {"axisMixed[2]": 1.0}  # of a quadrotor with its motors
    assert (proposal.setup.rate, proposal.setup.reference) == ("gyroADC[2]", "setpoint[2]")
    proposal = propose(data / "crazyflie_rollpitch/log15", axis="roll")
    motors = dict(
        zip(("motor.m1", "motor.m2", "motor.m3", "motor.m4"), (-1, -1, 1, 1), strict=True)
    )
    assert proposal.setup.command == motors and proposal.options["references"] is None
    proposal = propose(data / "crazypad_hover/E8_log00")
    assert proposal.setup.rate.endswith("controller.r_roll") and not proposal.setup.reference


def test_files_of_no_known_vehicle_and_axes_that_are_none_are_refused(tmp_path):
    np.savez(tmp_path / "log.npz", t=TIME, u=WAVE)
    with pytest.raises(RecordError, match="not a log of a known autopilot"):
        propose(tmp_path / "log.npz")
    with pytest.raises(RecordError, match="axis is 'heave': use one of roll, pitch, yaw"):
        propose(tmp_path / "log.npz", axis="heave")
    with pytest.raises(ReadError, match="no such file"):
        propose(tmp_path / "none.bin")
    log = DataFlash()
    log.define("ATT", "Qf", "TimeUS,Roll")
    log.write_rows("ATT", np.arange(50) * 10_000, np.arange(50.0))
    (tmp_path / "log.bin").write_bytes(log.content)
    with pytest.raises(RecordError, match="log.bin: the log has no RATE messages. Set LOG_BITMASK"):
        propose(tmp_path / "log.bin")
