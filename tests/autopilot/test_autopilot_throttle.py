"""Gains over the throttle from logs of a simulated PX4 with a thrust curve."""

import json

import numpy as np
import pytest
from px4_flights import DT, Vehicle, write_log

from jaxquad.cli import main


THROTTLES, CURVE = (0.25, 0.45, 0.65), 0.6
VEHICLE = Vehicle(curve=CURVE)
OMEGA = np.geomspace(0.1, np.pi / DT * 0.99, 2000)


def read_params(path):
    """QGroundControl's tab-separated file."""
    rows = [row.split("\t") for row in path.read_text().splitlines() if not row.startswith("#")]
    return {name: float(value) for _, _, name, value, _ in rows}


def tuned(folder, vehicle, throttles, curve_flown, shown=None):
    """The JSON of `jaxquad autopilot` on a flight of 15 s at each throttle."""
    flown = vehicle.fly(seconds=15.0 * len(throttles), throttles=throttles)
    parameters = vehicle.parameters | {"THR_MDL_FAC": curve_flown}
    log = write_log(folder / "flight.ulg", flown, parameters, shown or throttles)
    assert main(["autopilot", str(log), "--axis", "roll", "--out", str(folder)]) == 0
    return json.loads((folder / "autopilot.json").read_text())


@pytest.mark.slow
def test_gains_of_three_throttles_keep_ms_at_each_and_the_curve_has_its_own_files(tmp_path, capsys):
    content = tuned(tmp_path, VEHICLE, THROTTLES, 0.0)
    throttle, after = content["throttle"], content["stages"][-1]
    new = VEHICLE.proposed(read_params(tmp_path / "proposal_100.params"))
    true = [1 / np.min(np.abs(1 + new.at(x).loop(OMEGA))) for x in THROTTLES]
    assert max(true) <= 1.8 and len(after["peaks"]) == 3
    np.testing.assert_array_less(true, after["peaks"])  # at and around the three levels
    np.testing.assert_array_less(after["peaks"], 1.2 * np.array(true))
    low, high = (VEHICLE.at(x).gain for x in (throttle["certified_at"][0], THROTTLES[-1]))
    assert throttle["ratio_of_gains"][0] == pytest.approx(high / low, rel=0.05)
    # The thrust curve goes alone, and back.
    least, most = throttle["thrust_curve"]["interval_95"]
    [(name, value)] = read_params(tmp_path / "thrust_curve.params").items()
    assert name == "THR_MDL_FAC" and least < value < most and least < CURVE < most
    assert read_params(tmp_path / "thrust_curve_revert.params") == {"THR_MDL_FAC": 0.0}
    for end in ("033", "100", "revert"):
        assert "THR_MDL_FAC" not in (tmp_path / f"proposal_{end}.params").read_text()
    said = capsys.readouterr().out
    assert "levels: plants are drawn over all of it" in said and "in files of its own" in said
    page = (tmp_path / "autopilot.html").read_text()
    assert "THRUST CURVE" in page and "gains hold from throttle" in page
    assert page.count(">Ms at throttle") == 3 and f">{after['peaks'][0]:.2f}<" in page


@pytest.mark.slow
def test_a_curve_that_flew_right_is_kept_and_the_gain_is_one(tmp_path):
    straight = Vehicle()
    content = tuned(tmp_path, straight, THROTTLES, CURVE)
    ratio, least, most = content["throttle"]["ratio_of_gains"]
    assert least < 1 < most and ratio == pytest.approx(1, abs=0.05)
    curve = content["throttle"]["thrust_curve"]
    assert not curve["proposed"] and "it is kept" in curve["text"]
    assert not list(tmp_path.glob("thrust_curve*"))


@pytest.mark.slow
def test_one_level_of_throttle_is_said_with_what_to_fly(tmp_path, capsys):
    content = tuned(tmp_path, Vehicle(), (0.5, 0.5), 0.0)
    said = "gains hold near throttle 0.50, the only level of the log: fly 0.40 and 0.60 as well"
    assert said in content["throttle"]["text"] and said in capsys.readouterr().out
    assert content["throttle"]["gain_over_throttle"] is None
    assert len(content["stages"][-1]["peaks"]) == 1 and not list(tmp_path.glob("thrust_curve*"))
