"""The commands of docs/measured.md, typed where the measured flights lie, and their answers."""

import json
import re
import shlex
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT

from jaxquad.cli import main


pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("compiled_quickly")]
DATE = re.compile(rb"20\d\d-\d\d-\d\d[T ]\d\d:\d\d(:\d\d\+00:00)?")
PAGE = (ROOT / "docs" / "measured.md").read_text()
COMMANDS = [
    shlex.split(block.replace("\\\n", " "))[1:]
    for block in re.findall(r"```sh\n(.*?)```", PAGE, flags=re.S)
]


@pytest.fixture
def identified(data, tmp_path, monkeypatch, capsys):
    """Type the k-th command of the page for a file: exit code, printed text, result.json."""
    monkeypatch.chdir(data)

    def type_in(named, k=0):
        words = [words for words in COMMANDS if words[1].endswith(named)][k]
        code = main([*words, "--out", str(tmp_path)])
        return code, capsys.readouterr().out, json.loads((tmp_path / "result.json").read_text())

    return type_in


def numbers(result):
    return {row["name"]: row["value"] for row in result["fit"]["parameters"]}


def test_the_pitch_rig_has_its_gain_and_the_sum_of_lag_and_delay(identified):
    code, printed, result = identified("antx_log3_prbs.npz")
    found = numbers(result)
    assert code == 0 and 270 < found["gain"] < 295
    assert 0.024 < found["lag"] + found["delay"] < 0.029  # s
    assert "joint" in printed and "direct" in printed and "lag + delay" in printed


def test_equal_runs_give_equal_bytes(data, tmp_path):
    [words] = [words for words in COMMANDS if words[1].endswith("antx_log3_prbs.npz")]
    printed, pages = [], []
    for _ in range(2):
        command = [sys.executable, "-m", "jaxquad", *words, "--out", str(tmp_path / "found")]
        ran = subprocess.run([*command, "--force", "--quiet"], cwd=data, capture_output=True)
        assert ran.returncode == 0
        files = sorted((tmp_path / "found").iterdir())
        printed.append((ran.stdout, ran.stderr))
        pages.append({each.name: DATE.sub(b"", each.read_bytes()) for each in files})
    assert printed[0] == printed[1]
    assert pages[0] == pages[1] and len(pages[0]) == 4


@pytest.mark.parametrize(("file", "inertia"), [("log15", 1.1e-5), ("log15.npz", 1.3e-5)])
def test_the_crazyflies_inertia_comes_from_its_thrust_curve(identified, file, inertia):
    """README of the data: about 1.1e-5 in roll, 1.3e-5 in pitch, lag + delay about 70 ms."""
    code, _, result = identified(file)
    found = numbers(result)
    assert code == 0
    # 15 %: what two bands and the two structures of the page differ by.
    assert 1 / found["gain"] == pytest.approx(inertia, rel=0.15)
    assert found["lag"] + found["delay"] == pytest.approx(0.07, rel=0.15)


def test_a_band_that_the_model_does_not_hold_over_is_told(identified):
    code, printed, result = identified("log15", k=1)
    assert code == 3 and "NO MODEL of this structure holds" in printed
    [changed] = [each for each in result["fit"]["remarks"] if "over the whole band" in each]
    # The upper two thirds of the frequencies in use, on a logarithmic scale.
    response = {key: np.ravel(result["response"][key]) for key in ("coherence", "random_error")}
    used = (response["coherence"] >= 0.6) & (response["random_error"] < 0.3)
    omega = np.array(result["response"]["omega_rad_per_s"])[used]
    third = np.geomspace(omega[0], omega[-1], 4)[1]
    upper = f"above {third:.3g} rad/s ({third / (2 * np.pi):.3g} Hz)"
    assert changed.startswith(f"{upper} the gain is 0.31")
    # Their row of the table holds what the thrust curve gives, too.
    [row] = [line for line in printed.splitlines() if line.strip().startswith(f"{upper}  ")]
    assert float(row.split("+-")[3].split()[1]) == pytest.approx(0.07, rel=0.15)


def test_feedback_without_an_outside_reference_is_no_plant(identified, tmp_path):
    """Its page shows the spectrum over the throttle, which the log's proposal names."""
    code, printed, result = identified("LOG00037.BFL")
    assert code == 3 and "! feedback-dominated: " in printed
    assert "Spectrum of gyroADC[1] over throttle" in (tmp_path / "report.html").read_text()
    assert not result["fit"]["identifiable"]
    assert not any(row["determined"] for row in result["fit"].get("parameters", []))


def test_a_hover_is_not_identifiable(identified):
    code, printed, result = identified("E8_log00")
    assert code == 3 and "NOT IDENTIFIABLE from this record: coherence reaches 0.6" in printed
    assert "parameters" not in result["fit"]


def test_the_cessna_has_cifers_poles_at_a_lower_cost(identified):
    code, printed, result = identified("sweep_data_2017_12_10_19_05.npy")
    assert code == 0 and result["fit"]["cost"] < 1
    [(zeta, omega)] = re.findall(r"\[(\S+) \+- \S+, (\S+) \+-", printed)
    assert float(zeta) == pytest.approx(0.63, abs=0.02)
    assert float(omega) == pytest.approx(6.11, rel=0.01)


def test_a_limit_far_beyond_the_record_gives_no_design_to_be_flown(identified, tmp_path, capsys):
    """M stays within 0.79, and the data end at 75 rad/s, but the descent goes far beyond both."""
    _, _, result = identified("antx_log3_prbs.npz")
    result["settings"]["units"] = {"q": "rad/s"}
    (tmp_path / "result.json").write_text(json.dumps(result))
    vehicle = ["--inertia", "0.0552", "--limit", "10", "--members", "16", "--fresh", "64"]
    code = main(["tune", str(tmp_path), *vehicle])
    printed = capsys.readouterr().out
    assert code == 4 and printed.startswith(
        "CERTIFICATE FAILS on 64 fresh members (576 linear loops), not to be flown"
    )
    assert "members are lost" in printed and "FAIL PERFORMANCE" in printed
    stored = json.loads((tmp_path / "tuned" / "tuned.json").read_text())
    page = (tmp_path / "tuned" / "report.html").read_text()
    holds = {verdict["name"]: verdict["holds"] for verdict in stored["verdicts"]}
    assert not stored["holds"] and holds["STABILITY"] and not holds["PERFORMANCE"]
    # Where the descent ends is chance here: its verdict says what the descent itself says.
    assert holds["CONVERGENCE"] == ("the descent ended at a stationary point" in printed)
    for text in (printed, str(stored["certificate"]["remarks"]), page):
        assert "13 times the largest command of the record" in text
    for text in (printed, stored["verdicts"][1]["text"], page):
        assert "rad/s lies beyond the identified band of 4.4 to 75.4 rad/s" in text
    assert "PERFORMANCE FAILS" in page


def test_the_demo_of_a_measured_flight_is_the_pitch_rig(data, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("JAXQUAD_DATA", str(data))
    assert main(["demo", "--flight", "--out", str(tmp_path)]) == 0
    found = numbers(json.loads((tmp_path / "result.json").read_text()))
    assert 270 < found["gain"] < 295
    assert "measured: an ANT-X quadrotor" in capsys.readouterr().out
