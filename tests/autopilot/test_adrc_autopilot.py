"""From a Betaflight log to the parameters of its proposed ADRC, judged on the true quad."""

import json
import sys
from pathlib import Path

import flight_logs
import numpy as np
import pytest
from adrc_flights import ADRC, HEADER, write_log

from jaxquad.cli import main
from jaxquad.workflows import AutopilotSettings, SettingsError


sys.path.append(str(Path(__file__).parents[1] / "studies"))
import adrc_loop  # noqa: E402  # pyright: ignore
import throttle_flights as simulated  # noqa: E402  # pyright: ignore


POWERS = {"FIXED": 0.0, "SQRT": 0.5, "LINEAR": 1.0, "QUADRATIC": 2.0}
FLOWN = {"wc": 60.0, "wo": 200.0, "b0": 6000.0}  # of ADRC


@pytest.mark.parametrize(
    ("wrong", "words"),
    [({"law": "lqr"}, "pid, adrc"), ({"hover": 30}, "share"),
     ({"hover": 0.3, "law": "pid"}, "ADRC")],
)  # fmt: skip
def test_settings_that_cannot_be_are_refused(wrong, words):
    with pytest.raises(SettingsError, match=words):
        AutopilotSettings(**wrong)


def test_law_and_hover_are_options_and_back():
    settings = AutopilotSettings(axis="roll", law="adrc", hover=0.3)
    assert settings.words() == ["--axis", "roll", "--law", "adrc", "--hover", "0.3"]


def test_another_firmware_is_refused_in_one_line(tmp_path, capsys):
    path = flight_logs.px4(tmp_path, nav_state=10)
    options = ["--axis", "roll", "--law", "adrc", "--out", str(tmp_path / "out")]
    assert main(["autopilot", str(path), *options]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("jaxquad: error: --law is adrc") and "Betaflight alone" in said
    assert "px4" in said and not (tmp_path / "out").exists()


def fly(law=None):
    rng = np.random.default_rng(3)
    truth = simulated.draw(rng, 1)
    return truth, simulated.fly(truth, rng, 1000, law)


@pytest.fixture(scope="module")
def flown_by_pid():
    return fly()


@pytest.fixture(scope="module")
def flown_by_adrc():
    design = adrc_loop.Design(*(np.array([FLOWN[name]]) for name in ("wc", "wo", "b0")))
    return fly(adrc_loop.Observer(design, 0.3))


def read_cli(path):
    """What a file for the CLI sets, as text."""
    words = [line.split() for line in path.read_text().splitlines() if line.startswith("set ")]
    return {name: value for _, name, _, value in words}


def true_peak(truth, values, throttles, law, hover):
    """Ms of the true quad, the worst of these throttles; unstable loops have none."""
    peaks = []
    for x in throttles:
        scaled = values["adrc_b0_roll"] * adrc_loop.scale(x, hover, POWERS[law])
        wc, wo = values["adrc_wc_roll"], values["adrc_wo_roll"]
        found = adrc_loop.judge(truth, x, adrc_loop.Design(*map(np.array, ([wc], [wo], [scaled]))))
        assert found.stable.all()
        peaks.append(float(found.peak[0]))
    return max(peaks)


@pytest.mark.slow
def test_three_throttles_give_a_file_that_holds_on_the_true_quad(flown_by_pid, tmp_path, capsys):
    truth, flights = flown_by_pid
    path = write_log(tmp_path / "flight.bbl", flights)
    options = ["--axis", "roll", "--law", "adrc", "--hover", "0.3", "--out", str(tmp_path)]
    assert main(["autopilot", str(path), *options]) == 0
    said = capsys.readouterr().out
    assert "only a build of Betaflight's pull request 15400" in said and "all three axes" in said
    written = {each.name for each in tmp_path.iterdir()} - {"flight.bbl"}
    assert written == {
        "autopilot.html", "autopilot.json", "proposal_100.txt", "proposal_revert.txt",
        "proposal.md",
    }  # fmt: skip
    content = json.loads((tmp_path / "autopilot.json").read_text())
    assert [each["kind"] for each in content["reproduction"]] == ["flown"] * 3
    new, back = (read_cli(tmp_path / f"proposal_{end}.txt") for end in ("100", "revert"))
    assert set(new) == set(back)
    assert (new["pid_type"], back["pid_type"]) == ("ADRC", "CLASSIC")
    assert (back["adrc_wc_roll"], back["adrc_b0_roll"]) == ("60", "2000")
    law, values = new["adrc_b0_law"], {k: float(x) for k, x in new.items() if k[-4:] == "roll"}
    assert values == {k: x for k, x in content["new"].items() if k in values}
    assert new["adrc_hover_throttle"] == "30" and new["adrc_gyro_lpf_hz"] == "150"
    worst = content["proposal"]["stages"]["proposed"]["peak"]
    throttles = content["proposal"]["throttle"]
    assert throttles[0] < 0.32 and throttles[-1] > 0.58
    # 3 % are the search's reserve.
    assert true_peak(truth, values, throttles, law, 0.3) <= min(1.8, 1.03 * worst)
    table = (tmp_path / "proposal.md").read_text()
    assert "| pid_type | CLASSIC | ADRC |" in table and "deg/s^3 | 100 to 65535" in table
    page = (tmp_path / "autopilot.html").read_text()
    assert all(f'id="{section}"' in page for section in ("changes", "steps", "b0", "filters"))


@pytest.mark.slow
def test_one_throttle_is_enough_for_that_throttle(flown_by_pid, tmp_path, capsys):
    truth, flights = flown_by_pid
    path = write_log(tmp_path / "flight.bbl", flights, part=slice(10000, 20000))
    options = ["--axis", "roll", "--law", "adrc", "--out", str(tmp_path)]
    assert main(["autopilot", str(path), *options]) == 0
    said = capsys.readouterr().out
    assert "b0 over the throttle is not known" in said and "fly 0.36 and 0.56" in said
    new = read_cli(tmp_path / "proposal_100.txt")
    at = float(new["adrc_hover_throttle"]) / 100
    assert at == pytest.approx(0.46, abs=0.011) and new["adrc_b0_law"] == "SQRT"
    values = {k: float(x) for k, x in new.items() if k[-4:] == "roll"}
    assert true_peak(truth, values, [at], "SQRT", at) <= 1.8


@pytest.mark.slow
def test_a_flown_adrc_is_read_reproduced_and_staged(flown_by_adrc, tmp_path, capsys):
    truth, flights = flown_by_adrc
    path = write_log(tmp_path / "flight.bbl", flights, changed=ADRC)
    assert main(["autopilot", str(path), "--axis", "roll", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "the ADRC flew" in said and "only a build" not in said
    content = json.loads((tmp_path / "autopilot.json").read_text())
    assert {each["kind"] for each in content["reproduction"]} == {"flown"}
    third, new, back = (
        read_cli(tmp_path / f"proposal_{end}.txt") for end in ("033", "100", "revert")
    )
    assert set(third) <= set(new) == set(back) <= {f"adrc_{name}_roll" for name in FLOWN}
    for name, flew in FLOWN.items():
        key = f"adrc_{name}_roll"
        if key in new:
            assert float(back[key]) == flew
            part = flew + (float(new[key]) - flew) / 3
            assert float(third.get(key, flew)) == pytest.approx(part, abs=0.51)
            assert 1 / 3 <= float(new[key]) / flew <= 3
    throttles, stages = content["proposal"]["throttle"], content["proposal"]["stages"]
    for file, stage in ((third, "a third of the way"), (new, "proposed")):
        values = {f"adrc_{name}_roll": x for name, x in FLOWN.items()}
        values |= {name: float(x) for name, x in file.items()}
        peak = true_peak(truth, values, throttles, "SQRT", 0.3)
        assert peak <= min(1.8, 1.03 * stages[stage]["peak"])
    # The PID of the same header did not fly.
    options = ["--axis", "roll", "--law", "pid", "--out", str(tmp_path / "pid")]
    assert main(["autopilot", str(path), *options]) == 2
    assert "--law is pid, but the ADRC flew" in capsys.readouterr().err


@pytest.mark.slow
def test_another_adrc_than_that_of_the_header_is_noticed(flown_by_adrc, tmp_path, capsys):
    _, flights = flown_by_adrc
    wrong = ADRC | {"adrcB0": "4000,2000,2000"}
    path = write_log(tmp_path / "flight.bbl", flights, changed=wrong)
    assert main(["autopilot", str(path), "--axis", "roll", "--out", str(tmp_path)]) == 3
    assert "is not the one that flew" in capsys.readouterr().out
    flew = read_cli(tmp_path / "proposal_revert.txt")
    assert flew == {"adrc_wc_roll": "60", "adrc_wo_roll": "200", "adrc_b0_roll": "4000"}


@pytest.mark.slow
def test_limits_that_no_parameters_keep_end_with_what_flew(flown_by_pid, tmp_path, capsys):
    path = write_log(tmp_path / "flight.bbl", flown_by_pid[1])
    options = ["--axis", "roll", "--law", "adrc", "--sensitivity", "1.05", "--fresh", "16"]
    assert main(["autopilot", str(path), *options, "--out", str(tmp_path)]) == 4
    assert "no parameters are proposed" in capsys.readouterr().out
    flew = read_cli(tmp_path / "proposal_revert.txt")
    pid = dict(zip(("p_roll", "i_roll", "d_roll"), HEADER["rollPID"].split(","), strict=True))
    assert {name: flew[name] for name in pid} == pid and "pid_type" not in flew
