"""What to set and to fly, for each firmware: lines that it knows, within its ranges."""

import json
import re

import numpy as np
import pytest
from conftest import ROOT
from px4_flights import DT, Vehicle, write_log
from scipy.ndimage import uniform_filter1d

from jaxquad.autopilot import firmware_named
from jaxquad.cli import main
from jaxquad.records import AXES
from jaxquad.workflows import autopilot, AutopilotSettings, recipe


FIRMWARES = ("betaflight", "ardupilot", "px4")
CHOICES = ("all", *AXES)
SWITCHED = ("OFF", "ON")
# Read in the sources: src/main/cli/settings.c of Betaflight 2025.12, 2026.6 and master; ArduCopter
# 4.7-dev (mode_systemid.cpp, Parameters.cpp, AP_InertialSensor.cpp); PX4 1.17 (logger/module.yaml,
# rc_update/params.c). Words that a parameter takes, or its range.
KNOWN = {
    "betaflight": {
        "debug_mode": ("NONE", "CHIRP"), "blackbox_sample_rate": ("1/1", "1/2", "1/4", "1/8"),
        **{f"blackbox_disable_{x}": SWITCHED for x in (
            "pids", "rc", "setpoint", "gyro", "gyrounfilt", "debug", "motors")},
        "chirp_lag_freq_hz": range(256), "chirp_lead_freq_hz": range(256),
        **{f"chirp_amplitude_{axis}": range(501) for axis in AXES},
        "chirp_frequency_start_deci_hz": range(1, 1001),
        "chirp_frequency_end_deci_hz": range(1, 10001), "chirp_time_seconds": range(1, 256),
    },
    "ardupilot": {
        "SID_AXIS": range(20), "SID_MAGNITUDE": (0, 1), "SID_F_START_HZ": (0.01, 100),
        "SID_F_STOP_HZ": (0.01, 100), "SID_T_FADE_IN": (0, 20), "SID_T_REC": (0, 255),
        "SID_T_FADE_OUT": (0, 5), "LOG_BITMASK": range(1 << 22), "INS_RAW_LOG_OPT": range(16),
        **{f"FLTMODE{k}": range(29) for k in range(1, 7)},
    },
    "px4": {"SDLOG_PROFILE": range(4096), "SDLOG_MODE": range(5), "RC_MAP_AUX1": range(19)},
}  # fmt: skip
SETTING = {
    "betaflight": r"set (\w+) = (\S+)",
    "ardupilot": r"(\w+),(\S+)",
    "px4": r"param set (\w+) (\S+)",
}


def values(firmware, text):
    """The parameters of a text to paste, in its order."""
    lines = [line for line in text.splitlines() if not line.startswith(("aux", "save"))]
    settings: dict[str, str] = {}
    for line in lines:
        match = re.fullmatch(SETTING[firmware], line)
        assert match is not None, line
        settings[match[1]] = match[2]
    return settings


def is_possible(known, value):
    if isinstance(known, range):
        return int(value) in known
    if isinstance(known[0], str):
        return value in known
    return known[0] <= float(value) <= known[1]


@pytest.mark.parametrize("axis", CHOICES)
@pytest.mark.parametrize("firmware", FIRMWARES)
def test_the_lines_are_parameters_of_the_firmware_with_values_that_it_takes(firmware, axis):
    answer = recipe(firmware, axis)
    assert answer.axes == (AXES if axis == "all" else (axis,))
    for text in (answer.paste, answer.back):
        assert text.endswith("\n") and max(map(len, text.splitlines())) < 70
        for name, value in values(firmware, text).items():
            assert is_possible(KNOWN[firmware][name], value), (name, value)


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_what_is_set_goes_back_unless_it_is_the_default_or_without_effect(firmware):
    answer = recipe(firmware)
    paste, back = values(firmware, answer.paste), values(firmware, answer.back)
    assert not [name for name, value in back.items() if paste[name] == value]
    defaults = {"OFF", "1/4", "3", "30", "20"} if firmware == "betaflight" else set()
    for name in paste.keys() - back.keys():  # the other SID_ do nothing where SID_AXIS is 0
        assert paste[name] in defaults or name.startswith("SID_"), name
    assert recipe(firmware, "yaw").back == answer.back


@pytest.mark.parametrize("axis", CHOICES)
def test_betaflight_excites_the_axes_alone_and_each_use_of_the_switch_is_counted(axis):
    answer = recipe("betaflight", axis, amplitude=80, switch=2)
    paste = values("betaflight", answer.paste)
    sizes = {x: int(paste[f"chirp_amplitude_{x}"]) for x in AXES}
    assert sizes == {x: 80 if x in answer.axes else 0 for x in AXES}
    flight = answer.steps.flight
    assert [x in flight.rpartition("power-on: ")[2] for x in AXES] == [
        AXES.index(x) <= AXES.index(answer.axes[-1]) for x in AXES
    ]
    assert "aux 19 55 1 1700 2100 0 0" in answer.paste  # permanent id of CHIRP; AUX 2
    assert "aux 19 0 0 900 900 0 0" in answer.back  # an empty range is off
    assert answer.paste.endswith("\nsave\n") and answer.back.endswith("\nsave\n")


@pytest.mark.parametrize("k", range(3))
def test_ardupilot_sweeps_at_the_mixer_and_starts_where_the_firmware_lets_it(k):
    answer = recipe("ardupilot", AXES[k], amplitude=0.08, switch=3)
    paste = values("ardupilot", answer.paste)
    assert paste["SID_AXIS"] == str(10 + k) and paste["SID_MAGNITUDE"] == "0.08"
    assert int(paste["LOG_BITMASK"]) & 0b11 == 3  # both: in each loop
    assert paste["FLTMODE3"] == "25" and values("ardupilot", answer.back)["FLTMODE3"] == "0"
    assert list(paste)[0] == "SID_AXIS" == list(values("ardupilot", answer.back))[-1]
    assert "Stabilize" in answer.steps.flight and "Loiter" not in "".join(answer.steps)
    constant = 2 / float(paste["SID_F_START_HZ"])  # s, before the sweep
    assert float(paste["SID_T_REC"]) > constant + float(paste["SID_T_FADE_OUT"])


def test_px4_logs_at_high_rate_while_a_switch_is_on():
    answer = recipe("px4", "pitch", switch=10)
    assert values("px4", answer.paste) == {
        "SDLOG_PROFILE": "17", "SDLOG_MODE": "3", "RC_MAP_AUX1": "10",
    }  # fmt: skip
    assert "channel 10" in answer.steps.flight and "autotune" not in "".join(answer.steps)


@pytest.mark.slow
@pytest.mark.usefixtures("compiled_quickly")
def test_the_sticks_of_px4_determine_gains_and_bank_the_vehicle_by_less_than_60_deg(tmp_path):
    random, stick = np.random.default_rng(1), []
    while len(stick) < 20 / DT:  # pulses to both sides in turn, the stick within 0.1 s
        for side in (1, -1):
            stick += [side * np.deg2rad(50)] * int(random.uniform(0.2, 0.5) / DT)
    rest = [0.0] * round(2 / DT)
    setpoint = uniform_filter1d([*rest, *stick, *rest], round(0.1 / DT))
    vehicle = Vehicle()
    flown = vehicle.fly(seconds=setpoint.size * DT, setpoint=setpoint)
    assert np.max(np.abs(np.cumsum(flown[2]) * DT)) < np.deg2rad(60)
    log = write_log(tmp_path / "flight.ulg", flown, vehicle.parameters)
    settings = AutopilotSettings(axis="roll", members=16, fresh=64)
    assert autopilot(log, settings).kind == "proposed"


@pytest.mark.parametrize("axis", CHOICES)
def test_files_are_read_as_ground_stations_read_them(axis, tmp_path):
    mavparm = pytest.importorskip("pymavlink.mavparm")
    answer = recipe("ardupilot", axis)
    for path, text in answer.files(tmp_path / "set.param").items():
        path.write_text(text)
        found = mavparm.MAVParmDict()
        assert found.load(str(path))
        comments = [line for line in text.splitlines() if line.startswith("#")]
        assert len(comments) + len(found) == len(text.splitlines())
        meant = answer.back if "back" in path.name else answer.paste
        numbers = {name: float(x) for name, x in values("ardupilot", meant).items()}
        assert dict(found) == {name: np.float32(x) for name, x in numbers.items()}
    answer = recipe("px4", axis)
    for path, text in answer.files("set.PARAMS").items():  # five columns of QGroundControl
        rows = [line.split("\t") for line in text.splitlines() if not line.startswith("#")]
        assert {(*row[:2], row[4]) for row in rows} == {("1", "1", "6")}  # int32, as PX4 has them
        meant = answer.back if "back" in path.name else answer.paste
        assert {row[2]: row[3] for row in rows} == values("px4", meant)


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_a_file_of_another_firmware_is_refused_and_other_endings_are_text(firmware, capsys):
    answer = recipe(firmware)
    texts = answer.paste, answer.back
    assert tuple(answer.files("set").values()) == texts
    if firmware != "betaflight":
        assert answer.load != texts
    assert answer.load == tuple(answer.files(f"set.{answer.suffix}").values())
    for ending in {"param", "params"} - {answer.suffix}:
        assert main(["recipe", firmware, "--out", f"nowhere/set.{ending}"]) == 2
        out, error = capsys.readouterr()
        assert out == "" and f"name it set.{answer.suffix}" in " ".join(error.split())


@pytest.mark.parametrize("axis", CHOICES)
@pytest.mark.parametrize("firmware", FIRMWARES)
def test_a_recipe_is_text_for_a_terminal_and_content_for_json(firmware, axis):
    answer = recipe(firmware, axis)
    assert max(map(len, str(answer).splitlines())) <= 80
    flat = " ".join(str(answer).split())
    assert all(" ".join(step.split()) in flat for step in answer.steps)
    content = json.loads(json.dumps(answer.content()))
    assert content["paste"] == answer.paste and content["back"] == answer.back
    assert content["steps"] == answer.steps._asdict() and content["axes"] == list(answer.axes)
    assert content["command"] == answer.command
    assert answer.command.endswith(f" --axis {axis}") == (axis != "all")


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("firmware", FIRMWARES)
def test_a_verdict_advises_the_flight_of_the_recipe_and_names_it(firmware, axis):
    advice = firmware_named(firmware).what_to_fly(axis)
    assert recipe(firmware, axis).steps.flight[1:] in advice
    assert f"jaxquad recipe {firmware} --axis {axis}" in advice
    assert firmware_named("crazyflie").what_to_fly(axis).count(f"{axis} stick") == 1


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_the_guide_of_a_firmware_agrees_with_its_recipe(firmware):
    page = (ROOT / "docs" / f"{firmware}.md").read_text()
    setting = page.partition("**Set.**")[2].partition("**Run.**")[0]
    paste = values(firmware, recipe(firmware).paste)
    assert f"jaxquad recipe {firmware}" in setting
    shown = re.findall(r"`set (\w+) = (\w+)`|\b(SDLOG_\w+|RC_MAP_\w+) (\d+)", setting)
    rows = re.findall(r"^\| ([A-Z_]+(?:, [A-Z_]+)*) \| ([\d.]+(?:, [\d.]+)*)", setting, flags=re.M)
    pairs = [(a or c, b or d) for a, b, c, d in shown]
    for names, numbers in rows:
        pairs += zip(names.split(", "), numbers.split(", "), strict=True)
    assert pairs and [(x, paste[x]) for x, _ in pairs] == pairs


@pytest.mark.parametrize(
    ("firmware", "options", "said"),
    [
        ("betaflight", {"amplitude": 900}, "900, the amplitude of the chirp in deg/s: give 20 to"),
        ("betaflight", {"amplitude": float("nan")}, "nan, the amplitude"),
        ("betaflight", {"switch": 0}, "0, the AUX channel of the switch: give 1 to 14"),
        ("ardupilot", {"amplitude": 15}, "15, SID_MAGNITUDE, of the mixer's range: give 0.01 to"),
        ("ardupilot", {"switch": 7}, "7, the position of the mode switch"),
        ("px4", {"switch": 3}, "3, the RC channel"),
        ("px4", {"amplitude": 1}, "1, but PX4 is excited by the sticks: leave it out."),
    ],
)
def test_what_is_not_flyable_is_refused_with_its_limits(firmware, options, said, capsys):
    ((name, value),) = options.items()
    with pytest.raises(ValueError, match=re.escape(f"`{name}` is {said}")):
        recipe(firmware, **options)
    assert main(["recipe", firmware, f"--{name}", str(value)]) == 2
    out, error = capsys.readouterr()
    assert out == "" and f"--{name} is {said}" in " ".join(error.split())


@pytest.mark.parametrize("firmware", ["crazyflie", "inav"])
def test_a_firmware_without_a_recipe_is_refused_with_those_that_have_one(firmware, capsys):
    assert main(["recipe", firmware]) == 2
    error = capsys.readouterr().err
    assert repr(firmware) in error and all(name in error for name in FIRMWARES)
    with pytest.raises(ValueError, match="axis is 'Roll'"):
        recipe("px4", "Roll")


def test_the_command_prints_writes_and_gives_json(tmp_path, capsys):
    file = tmp_path / "new" / "set.param"
    words = ["recipe", "ArduPilot", "--axis", "Pitch", "--out", str(file)]
    assert main(words) == 0
    back = file.with_name("set_back.param")
    assert capsys.readouterr().out == f"{recipe('ardupilot', 'pitch')}\n\n{file}\n{back}\n"
    answer = recipe("ardupilot", "pitch")
    assert (file.read_text(), back.read_text()) == answer.load
    assert main([*words[:-1], str(file.with_suffix(".txt"))]) == 0
    assert file.with_suffix(".txt").read_text() == answer.paste
    capsys.readouterr()
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["firmware"] == "ardupilot"
