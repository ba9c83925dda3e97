"""Parameter files, read back by a parser that is not the writer's."""

import re
from typing import Any

import jax
import numpy as np
import pytest
import yaml

from jaxquad.autopilot import (
    ardupilot_loop,
    ArduPilotRate,
    betaflight_loop,
    Butterworth,
    change_table,
    CrazyflieRate,
    FilterChain,
    list_parameters,
    parameter_file,
    PARAMETERS,
    propose_changes,
    px4_loop,
    PX4Rate,
    with_parameters,
    WordChange,
    write_parameter_files,
)


GYRO = FilterChain((Butterworth(40.0),), 8000.0)
LAWS: dict[str, PX4Rate | ArduPilotRate | CrazyflieRate] = {
    "px4": PX4Rate([0.15] * 3, [0.2] * 3, [0.003] * 3, gyro=GYRO),
    "ardupilot": ArduPilotRate([0.135] * 3, [0.135] * 3, [0.0036] * 3, gyro=GYRO),
    "crazyflie": CrazyflieRate([250.0] * 3, [500.0] * 3, [2.5] * 3, gyro=GYRO),
}
FACTOR = {"P": 1.21, "I": 0.77, "D": 1.1, "p": 1.21, "i": 0.77, "d": 1.1}


def proposed(law):
    """Other gains of roll, and another gyro filter."""
    old = list_parameters(law)
    roll = {k: x for k, x in old.items() if ("ROLL" in k or "RLL" in k or "roll" in k) and x}
    gyro = {k: 55.0 for k in old if k in ("IMU_GYRO_CUTOFF", "INS_GYRO_FILTER")}
    return old, {k: FACTOR.get(k[-1], 1.05) * x for k, x in roll.items()} | gyro


def read_params(text):
    """QGroundControl's .params: five columns divided by tabs."""
    rows = [line.split("\t") for line in text.splitlines() if not line.startswith("#")]
    assert all(row[:2] == ["1", "1"] and row[4] in ("6", "9") for row in rows)
    return {row[2]: float(row[3]) if row[4] == "9" else int(row[3]) for row in rows}


def read_param(text, folder):
    """ArduPilot's .param, by pymavlink."""
    mavparm = pytest.importorskip("pymavlink.mavparm")
    path = folder / "read.param"
    path.write_text(text)
    found = mavparm.MAVParmDict()
    assert found.load(str(path))
    return dict(found)


def read_yaml(text):
    content = yaml.safe_load(text)
    assert content["type"] == "persistent_param_state" and content["version"] == "1"
    return {name: row["stored_value"] for name, row in content["params"].items()}


def read_cli(text):
    """Betaflight's CLI: `set name = value` between `profile` and `save`."""
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    assert lines[0].startswith("profile ") and lines[-1] == "save"
    pairs = [line.removeprefix("set ").split(" = ") for line in lines[1:-1]]
    return {name: value for name, value in pairs}


def read_back(firmware, text, folder):
    if firmware == "px4":
        return read_params(text)
    return read_param(text, folder) if firmware == "ardupilot" else read_yaml(text)


@pytest.mark.parametrize("firmware", LAWS)
def test_what_is_written_is_read_back_as_the_same_loop(firmware, tmp_path):
    old, new = proposed(LAWS[firmware])
    changes = propose_changes(firmware, old, new)
    found = read_back(firmware, parameter_file(firmware, changes), tmp_path)
    stored = {name: float(np.float32(value)) for name, value in found.items()}
    assert stored == {x.parameter.name: x.new for x in changes}
    flashed = with_parameters(LAWS[firmware], stored)
    meant = with_parameters(LAWS[firmware], {x.parameter.name: x.new for x in changes})
    for one, other in zip(jax.tree.leaves(flashed), jax.tree.leaves(meant), strict=True):
        np.testing.assert_array_equal(one, other)
    back = read_back(firmware, parameter_file(firmware, changes, revert=True), tmp_path)
    assert set(back) == set(found)
    assert {k: np.float32(x) for k, x in back.items()} == {k: np.float32(old[k]) for k in back}


def test_a_written_file_makes_the_loop_that_a_log_of_it_would(tmp_path):
    """PX4 and ArduPilot log these very names, so the file stands for the next flight's log."""
    readers: dict[str, Any] = {"px4": px4_loop, "ardupilot": ardupilot_loop}
    for firmware, read in readers.items():
        values = {name: str(row.default) for name, row in PARAMETERS[firmware].items()}
        old = read(values).parameters()
        name = "MC_ROLLRATE_D" if firmware == "px4" else "ATC_RAT_RLL_D"
        changes = propose_changes(firmware, old, {name: 1.5 * old[name]})
        found = read_back(firmware, parameter_file(firmware, changes), tmp_path)
        flown = read({**values, **{k: f"{x:.9g}" for k, x in found.items()}})
        assert float(flown.law.d[0]) == pytest.approx(1.5 * old[name], rel=1e-7)


HEADER = {
    "looptime": "125", "pid_process_denom": "2", "rollPID": "45,80,40", "pitchPID": "47,84,46",
    "yawPID": "45,80,0", "d_min": "30,34,0", "ff_weight": "120,125,120", "pidsum_limit": "500",
    "dterm_lpf1_dyn_hz": "75,150",
}  # fmt: skip


def test_betaflights_cli_holds_whole_numbers_and_switches_the_sliders_off():
    old = betaflight_loop(HEADER, (2025, 12, 0)).parameters()
    new = {"p_roll": 52.4, "i_roll": 80.3, "dterm_lpf1_dyn_min_hz": 90.2}
    changes = propose_changes("betaflight", old, new)
    found = read_cli(parameter_file("betaflight", changes, profile=1))
    assert found == {
        "simplified_pids_mode": "OFF", "simplified_dterm_filter": "OFF", "p_roll": "52",
        "dterm_lpf1_dyn_min_hz": "90",
    }  # fmt: skip
    text = parameter_file("betaflight", changes, revert=True)
    # After a third of the way, too, the comment is true: it is of the flight alone.
    assert read_cli(text)["p_roll"] == "45" and "# the flight had p_roll 45" in text


@pytest.mark.parametrize(
    ("version", "base", "ceiling", "cutoff"),
    [
        ((4, 2, 0), "d_min_roll", "d_roll", "dyn_lpf_dterm_min_hz"),
        ((4, 5, 1), "d_min_roll", "d_roll", "dterm_lpf1_dyn_min_hz"),
        ((2025, 12, 0), "d_roll", "d_max_roll", "dterm_lpf1_dyn_min_hz"),
    ],
)
def test_betaflights_names_follow_the_version(version, base, ceiling, cutoff):
    header = {**HEADER, "d_max": "50,50,0"} if version >= (2025,) else HEADER
    old = betaflight_loop(header, version).parameters()
    new = {"d_roll": 33.0, "d_max_roll": 44.0, "dterm_lpf1_dyn_min_hz": 88.0}
    changes = propose_changes("betaflight", old, new)
    found = read_cli(parameter_file("betaflight", changes, version=version))
    assert (found[base], found[ceiling], found[cutoff]) == ("33", "44", "88")


def test_until_4_5_d_without_d_min_is_d(tmp_path):
    flown = betaflight_loop({**HEADER, "d_min": "0,0,0"}, (4, 5, 0))
    old = flown.parameters()
    assert old["d_roll"] == 40 and "d_max_roll" not in old
    files = write_parameter_files(
        tmp_path, "betaflight", old, {"d_roll": 46}, version=(4, 5, 0), shares=(1.0,)
    )
    assert read_cli(files.stages[0].read_text())["d_roll"] == "46"


def test_the_adrcs_parameters_need_a_build_that_has_them():
    old, new = {"adrc_b0_roll": 2000}, {"adrc_b0_roll": 2730}
    changes = propose_changes("betaflight", old, new)
    with pytest.raises(ValueError, match="15400"):
        parameter_file("betaflight", changes)
    assert (
        read_cli(parameter_file("betaflight", changes, version=(2026, 6)))["adrc_b0_roll"] == "2730"
    )


def test_words_are_set_last_and_back_and_for_betaflight_alone():
    changes = propose_changes("betaflight", {"adrc_b0_roll": 2000}, {"adrc_b0_roll": 2730})
    words = [WordChange("pid_type", "CLASSIC", "ADRC", "it flies")]
    text = parameter_file("betaflight", changes, version=(2026, 6), words=words, title="two\nlines")
    assert text.splitlines()[:2] == ["# two", "# lines"] and "simplified" not in text
    assert text.splitlines()[-3:] == [
        "# the flight had pid_type CLASSIC", "set pid_type = ADRC", "save",
    ]  # fmt: skip
    back = parameter_file("betaflight", changes, version=(2026, 6), words=words, revert=True)
    assert read_cli(back) == {"adrc_b0_roll": "2000", "pid_type": "CLASSIC"}
    table = change_table(changes, words)
    assert "| pid_type | CLASSIC | ADRC |  |  |" in table and "pid_type: it flies" in table
    with pytest.raises(ValueError, match="px4 stores numbers alone"):
        parameter_file("px4", [], words=words)


def test_a_staged_proposal_goes_a_third_of_the_way_then_all_and_back(tmp_path):
    old, new = proposed(LAWS["px4"])
    why = {"MC_ROLLRATE_P": "delay margin"}
    files = write_parameter_files(tmp_path, "px4", old, new, stem="roll", reasons=why)
    third, whole = (read_params(path.read_text()) for path in files.stages)
    assert [path.name for path in files.stages] == ["roll_033.params", "roll_100.params"]
    for name, value in whole.items():
        assert third[name] == pytest.approx(old[name] + (value - old[name]) / 3, rel=1e-6)
    assert read_params(files.revert.read_text()) == pytest.approx({k: old[k] for k in whole})
    row = "| MC_ROLLRATE_P | 0.15 | 0.1815 |  | 0.01 to 0.5 |"
    assert row in files.table.read_text()


@pytest.mark.parametrize("log", ["00000012.BIN", "a\nset p_roll = 250\r\n1\t1\tX\t9\t9.bfl"])
@pytest.mark.parametrize("firmware", [*LAWS, "betaflight"])
def test_files_name_the_log_and_what_flew_in_comments_that_are_read_as_nothing(
    firmware, log, tmp_path
):
    if firmware == "betaflight":
        old, new = betaflight_loop(HEADER, (2025, 12, 0)).parameters(), {"p_roll": 60}
        read = read_cli
    else:
        old, new = proposed(LAWS[firmware])
        read = lambda text: read_back(firmware, text, tmp_path)
    write = lambda log: write_parameter_files(tmp_path, firmware, old, new, log=log)
    plain, named = (
        [path.read_text() for path in (*files.stages, files.revert)]
        for files in map(write, ("", log))
    )
    safe = "".join(x if x.isprintable() else "?" for x in log)
    for before, after in zip(plain, named, strict=True):
        assert read(before) == read(after)
        assert f"what flew in {safe}" in after and f"what flew in {safe}" not in before
    if firmware == "crazyflie":  # its YAML has no comment for a parameter
        return
    comments = [dict(re.findall(r"^# the flight had (\S+) (\S+)$", x, re.M)) for x in named]
    assert comments[0] == comments[1] == comments[2] != {}
    back = read(named[2])
    for name, value in comments[2].items():
        assert np.float32(value) == np.float32(back[name])


def test_the_table_says_where_no_range_is_documented():
    old, new = proposed(LAWS["crazyflie"])
    assert "none documented" in change_table(propose_changes("crazyflie", old, new))
    changes = propose_changes("px4", {"MC_ROLLRATE_I": 0.2}, {"MC_ROLLRATE_I": 0.3})
    assert "0 or above" in change_table(changes)


def test_a_value_beyond_its_range_or_without_its_old_one_is_refused():
    old = {"MC_ROLLRATE_P": 0.15}
    with pytest.raises(ValueError, match=r"0.01 to 0.5\. Allow it"):
        propose_changes("px4", old, {"MC_ROLLRATE_P": 0.9})
    assert propose_changes("px4", old, {"MC_ROLLRATE_P": 0.9}, beyond=["MC_ROLLRATE_P"])
    with pytest.raises(ValueError, match="what flew is not known"):
        propose_changes("px4", {}, {"MC_ROLLRATE_P": 0.2})
    with pytest.raises(ValueError, match="share is 1.5"):
        propose_changes("px4", old, {"MC_ROLLRATE_P": 0.2}, share=1.5)


def test_what_rounding_undoes_is_no_change(tmp_path):
    old = {"p_roll": 45}
    assert propose_changes("betaflight", old, {"p_roll": 45.3}) == ()
    with pytest.raises(ValueError, match="Nothing changes"):
        write_parameter_files(tmp_path, "betaflight", old, {"p_roll": 45.3})
