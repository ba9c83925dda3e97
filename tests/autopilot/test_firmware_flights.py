"""Logs that Betaflight's and ArduPilot's own firmware flew, with known truth: law, plant, gains."""

import dataclasses
import json
import math
import re
from types import SimpleNamespace

import numpy as np
import pytest

from jaxquad.autopilot import (
    AxesProposal,
    check_law,
    read_flown,
)
from jaxquad.cli import main
from jaxquad.workflows import (
    _autopilot as workflow,
    autopilot,
    IdentifySettings,
    propose_settings,
)


BETAFLIGHT, ARDUPILOT = "betaflight_firmware", "ardupilot_firmware"
FLOWN = [
    (BETAFLIGHT, "A_chirp_roll.BFL", "roll"), (BETAFLIGHT, "A_chirp_plain.BFL", "roll"),
    (BETAFLIGHT, "A_sticks.BFL", "roll"), (BETAFLIGHT, "A_sticks.BFL", "pitch"),
    (BETAFLIGHT, "A_doublets.BFL", "pitch"), (BETAFLIGHT, "A_throttle.BFL", "roll"),
    (BETAFLIGHT, "B_chirp_three_axes.BFL", "pitch"), (BETAFLIGHT, "B_chirp_three_axes.BFL", "yaw"),
    (BETAFLIGHT, "A_hover.BFL", "roll"),
    (ARDUPILOT, "mixer_chirp_roll.BIN", "roll"), (ARDUPILOT, "rate_chirp_pitch.BIN", "pitch"),
]  # fmt: skip
SOME = {"A_sticks.BFL", "mixer_chirp_roll.BIN"}
LEFT = {"P": 0.01, "I": 0.03, "D": 0.01, "output": 0.01}  # beyond what rounding of the log explains


def flown_of(path, axis):
    """The loop that flew and the channels of its law."""
    asked, proposal = propose_settings(path, IdentifySettings(axis=axis))
    assert proposal is not None
    flown = read_flown(path, proposal, asked)
    assert flown.flight is not None
    return flown, flown.flight


def law_of(path, axis, **changed):
    """The law of a log replayed, with other gains where `changed` has some."""
    flown, flight = flown_of(path, axis)
    loop = flown.loop
    if changed:
        loop = dataclasses.replace(loop, law=dataclasses.replace(loop.law, **changed))
    return check_law(loop, flown.axis, flight), flown


@pytest.mark.parametrize(
    ("folder", "name", "axis"),
    [x if x[1] in SOME else pytest.param(*x, marks=pytest.mark.slow) for x in FLOWN],
)
def test_the_law_replayed_leaves_nothing_of_the_logged_terms(data, folder, name, axis):
    check, _ = law_of(data / folder / name, axis)
    assert check.flew, check.text
    assert set(check.terms) >= {"P", "I", "output"}
    for term, each in check.terms.items():
        assert each.share < LEFT[term], (term, each)
        assert abs(each.size - 1) < max(0.02, each.rounding / each.rms), (term, each)
    if folder == ARDUPILOT:
        assert check.terms["output"].share < 1e-4 and check.late == pytest.approx(1 / 400)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "wrong"),
    [({"relax": None}, "I"), ({"p": [50.0, 47.0, 45.0]}, "P"), ({"d": [34.0, 34.0, 0.0]}, "D")],
)
def test_another_law_is_named_by_its_term(data, changed, wrong):
    check, _ = law_of(data / BETAFLIGHT / "A_chirp_roll.BFL", "roll", **changed)
    assert not check.flew and check.wrong[0] == wrong
    assert check.text.startswith(f"these are not the gains that flew: {wrong} in the log")


@pytest.mark.slow
def test_a_set_point_that_acts_a_loop_later_is_found_and_said(data):
    flown, flight = flown_of(data / ARDUPILOT / "rate_chirp_pitch.BIN", "pitch")
    check = check_law(flown.loop, flown.axis, dataclasses.replace(flight, late=0.0))
    assert check.flew and check.shifted and check.late == pytest.approx(1 / 400)
    assert "+2.5 ms after its stamp" in check.text


# K in deg/s^2 per unit, motor lag in s; width of the interval of K at most.
TRUTH = [
    (BETAFLIGHT, "A_chirp_roll.BFL", "roll", 36.95, 0.025, 0.05),
    (BETAFLIGHT, "A_chirp_plain.BFL", "roll", 36.95, 0.025, 0.05),
    (BETAFLIGHT, "A_sticks.BFL", "roll", 37.67, 0.025, 0.05),
    (BETAFLIGHT, "A_doublets.BFL", "roll", 37.11, 0.025, 0.12),
    (BETAFLIGHT, "B_chirp_three_axes.BFL", "roll", 28.28, 0.045, 0.05),
    (BETAFLIGHT, "B_chirp_three_axes.BFL", "pitch", 24.24, 0.045, 0.05),
    (BETAFLIGHT, "B_chirp_three_axes.BFL", "yaw", 4.09, 0.045, 0.06),
    (ARDUPILOT, "mixer_chirp_roll.BIN", "roll", 25067.0, 0.03, 0.03),
    (ARDUPILOT, "rate_chirp_pitch.BIN", "pitch", 25067.0, 0.03, 0.03),
]
OUTPUTS = {"betaflight": "proposal_100.txt", "ardupilot": "proposal_100.param"}


def run(path, axis, folder):
    code = main(["autopilot", str(path), "--axis", axis, "--out", str(folder)])
    assert (folder / "autopilot.html").exists()
    return code, json.loads((folder / "autopilot.json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize(("folder", "name", "axis", "gain", "lag", "width"), TRUTH)
def test_the_true_plant_is_inside_and_gains_are_proposed(
    data, tmp_path, folder, name, axis, gain, lag, width
):
    code, content = run(data / folder / name, axis, tmp_path)
    assert code == 0 and content["kind"] == "proposed", content["verdict"]
    low, high = content["plant"]["intervals_95"]["gain"]
    assert low < gain < high and high - low < width * gain
    low, high = content["plant"]["intervals_95"]["lag"]
    assert low < lag < high
    assert (tmp_path / OUTPUTS[content["firmware"]]).exists()
    *_, after = content["stages"]
    assert after["stable"] == 1 and after["peak"] <= 1.8 and after["delay_margin"] > 0.003
    assert content["reproduction"]["misfit"] < 0.1
    if folder == ARDUPILOT:
        before = content["stages"][0]
        assert before["peak"] == pytest.approx(1.80, abs=0.06)  # of the true loop
        assert after["angle"]["closed"] and after["angle"]["peak"] < 1.8
    elif name == "A_chirp_plain.BFL":
        assert content["feed_forward"]["text"].startswith("off, and stays so; f_roll = ")
        assert "f_roll" not in content["new"]
    elif axis != "yaw":  # where iterm_relax is on
        assert after["relaxed"] is not None and after["relaxed"] <= 1.8


@pytest.mark.slow
def test_the_gain_over_the_throttle_and_the_thrust_curve_are_the_vehicles(data, tmp_path):
    code, content = run(data / BETAFLIGHT / "A_throttle.BFL", "roll", tmp_path)
    assert code == 0 and len(content["stages"][-1]["peaks"]) == 3
    levels = content["throttle"]["gain_over_throttle"]["levels"]
    inertia, arm, thrust, curve, idle = 0.0045, 0.11, 12.0, 0.6, 0.055
    for level in levels:
        motor = idle + (1 - idle) * level["throttle"]
        slope = 2 * curve * motor + 1 - curve
        true = 4 * arm / math.sqrt(2) * thrust * slope * (1 - idle) / 1000 / inertia
        low, high = level["gain_interval_95"]
        assert low < math.degrees(true) < high
    # Of the motor's range above idle, where thrust_linear acts, the curve is a little straighter.
    square = curve * (1 - idle) ** 2
    straight = (1 - idle) * (1 - curve) + 2 * curve * idle * (1 - idle)
    low, high = content["throttle"]["thrust_curve"]["interval_95"]
    assert low < 100 * square / (square + straight) < high


@pytest.mark.slow
def test_a_hover_is_refused_with_what_to_fly(data, tmp_path, capsys):
    code, content = run(data / BETAFLIGHT / "A_hover.BFL", "roll", tmp_path)
    assert code == 3 and content["kind"] == "cannot tell" and content["new"] == {}
    assert "you did not move roll" in content["verdict"] and "model" not in content["verdict"]
    assert "jaxquad recipe betaflight --axis roll" in content["verdict"]
    assert (tmp_path / "proposal_revert.txt").exists()


@pytest.mark.slow
def test_all_axes_come_in_one_page_and_one_file_with_one_save(data, tmp_path, capsys):
    path = data / BETAFLIGHT / "B_chirp_three_axes.BFL"
    assert main(["autopilot", str(path), "--out", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "autopilot.json").read_text())
    assert {axis: each["kind"] for axis, each in content["axes"].items()} == {
        "roll": "proposed", "pitch": "proposed", "yaw": "proposed",
    }  # fmt: skip
    text = (tmp_path / "proposal_100.txt").read_text()
    assert text.count("\nsave") == 1
    for name, value in content["new"].items():
        assert f"set {name} = {value:g}" in text
    assert {"p_roll", "p_pitch", "p_yaw"} <= set(content["new"])
    back = (tmp_path / "proposal_revert.txt").read_text()
    assert all(f"set {name} = {value:g}" in back for name, value in content["old"].items())
    page = (tmp_path / "autopilot.html").read_text()
    assert all(f"rate loop of {axis}" in page for axis in content["axes"])
    # The loop that swung in yaw is said to be that, and is not gone towards in steps.
    assert "swung between the motors" in content["axes"]["yaw"]["verdict"]
    assert np.isfinite(content["axes"]["yaw"]["stages"][-1]["delay_margin"])


@pytest.mark.slow
def test_all_axes_are_of_one_flight_of_a_file_with_several(data, tmp_path, capsys):
    names = ("A_sticks.BFL", "A_chirp_roll.BFL")
    path = tmp_path / "flash.BFL"
    path.write_bytes(b"".join((data / BETAFLIGHT / name).read_bytes() for name in names))
    assert main(["autopilot", str(path), "--out", str(tmp_path / "out")]) == 0
    content = json.loads((tmp_path / "out" / "autopilot.json").read_text())
    kinds = {axis: each["kind"] for axis, each in content["axes"].items()}
    assert kinds == {"roll": "proposed", "pitch": "cannot tell", "yaw": "cannot tell"}
    for each in content["axes"].values():
        assert each["identified_with"]["output"].startswith("log2.")


@pytest.mark.slow
def test_all_axes_are_tuned_in_one_run_into_one_file_with_d_max(data, tmp_path):
    log = str(data / BETAFLIGHT / "B_chirp_three_axes.BFL")
    assert main(["autopilot", log, "--out", str(tmp_path), "--quiet"]) == 0
    text = (tmp_path / "proposal_100.txt").read_text()
    names = {"p_roll", "p_pitch", "p_yaw", "i_yaw", "d_pitch", "d_max_roll", "d_max_pitch"}
    assert all(f"set {name} = " in text for name in names)
    assert text.count("save") == 1
    # Yaw swung between the motors' limits, and would a third of the way: that file holds all of it.
    [yaw] = re.findall("set p_yaw = .*", (tmp_path / "proposal_033.txt").read_text())
    assert yaw in text


@pytest.mark.slow
@pytest.mark.usefixtures("without_type_checks")  # of the stand-ins
def test_an_axis_that_fails_costs_no_other(data, monkeypatch):
    def tune(path, settings, filters):
        if settings.axis == "pitch":
            raise ValueError("the gain is not above 0")
        return SimpleNamespace(kind="kept", verdict="as it flew", shared_filters={})

    monkeypatch.setattr(workflow, "_tune_axis", tune)
    found = autopilot(data / ARDUPILOT / "mixer_chirp_roll.BIN")
    assert isinstance(found, AxesProposal)
    assert list(found.axes) == ["roll", "yaw"] and found.kind == "kept"
    assert "pitch: the gain is not above 0" in found.verdict
