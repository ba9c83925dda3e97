"""What the scripts say of two measured logs of autopilots: neither holds enough for new gains."""

import subprocess
import sys

import pytest
from conftest import ROOT


pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
SCRIPTS = ("betaflight_ar8", "crazyflie_rates")


def run(name: str, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "fits" / f"{name}.py"), *options]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT)


@pytest.mark.parametrize("name", SCRIPTS)
def test_without_the_log_it_says_so(name, tmp_path):
    found = run(name, "--data", str(tmp_path))
    assert found.returncode == 2 and "set JAXQUAD_DATA or give --data" in found.stderr


def test_betaflights_loop_is_reproduced_and_its_plant_is_not_told(data, tmp_path):
    found = run("betaflight_ar8", "--data", str(data / "betaflight_ar8"), "--out", str(tmp_path))
    assert found.returncode == 0, found.stderr
    text = found.stdout
    assert "roll: P 77, I 119, D 55" in text and "not modelled: feedforward_transition 40" in text
    assert text.count("=> this log cannot tell") == 2
    told = [line for line in text.splitlines() if line.startswith("=> this log cannot tell")]
    assert "law and plant, flown on the logged set-point, miss the rate by" in told[0]
    assert "mode CHIRP" in told[1] and told[1].endswith(
        "says jaxquad recipe betaflight --axis pitch"
    )
    assert text.count("which shows no curve: fly 0.24 and 0.44") == 2
    off = [float(x) for line in text.splitlines() if line[:4] in ("  P:", "  I:", "  D:")
           for x in line.replace(",", "").split() if x[0].isdigit()]  # fmt: skip
    assert len(off) == 6 and max(off) <= 2 and max(off[:2]) <= 1
    for axis in ("roll", "pitch"):
        assert not list((tmp_path / axis).glob("proposal_100*"))
        assert f"set p_{axis}" in (tmp_path / axis / "proposal_revert.txt").read_text()


def test_the_crazyflies_plant_is_told_and_its_gains_are_not(data, tmp_path):
    folder = data / "crazyflie_rollpitch"
    found = run("crazyflie_rates", "--data", str(folder), "--out", str(tmp_path))
    assert found.returncode == 0, found.stderr
    text = found.stdout
    assert "this log cannot tell which gains flew" in text and "Nothing is\nproposed" in text
    assert text.count("direct estimate, 100 frequencies") + text.count("lag + delay = 0.07") >= 2
    assert (tmp_path / "roll" / "result.json").is_file()
