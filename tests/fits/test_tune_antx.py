"""From a measured flight to certified gains, as fits/tune_antx.py does it, with few members."""

import importlib
import json
import shutil
import subprocess
import sys
from contextlib import redirect_stdout
from io import StringIO

import numpy as np
import pytest
from conftest import ROOT


pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


SCRIPT = ROOT / "fits" / "tune_antx.py"
DT = 0.004  # s, of the flight


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    """The folder of a quick run, and what it printed."""
    sys.path.insert(0, str(ROOT / "fits"))
    try:
        script = importlib.import_module("tune_antx")
        quick = importlib.import_module("experiments.tuning").QUICK
    finally:
        sys.path.remove(str(ROOT / "fits"))
    out, printed = tmp_path_factory.mktemp("tune_antx"), StringIO()
    with redirect_stdout(printed):
        script.main(out, 0, quick, data / "antx_pitch")
    return out, printed.getvalue()


@pytest.fixture(scope="module")
def result(run):
    return json.loads((run[0] / "result.json").read_text())


@pytest.fixture(scope="module")
def certificate(run):
    return json.loads((run[0] / "certificate.json").read_text())


def test_the_first_line_says_that_the_certificate_holds(run, result, certificate):
    assert run[1].startswith("CERTIFICATE HOLDS on 256 fresh members")
    assert run[1].splitlines()[0] == result["verdict"]
    assert certificate["holds"] and certificate["designs"]["tuned"]["unstable"] == 0
    peak, overshoot = certificate["limits"]
    assert certificate["designs"]["tuned"]["statistics"]["sensitivity_peak"]["worst"] <= 2.5
    assert peak["members"] == 2304 and peak["met"] and peak["beyond"] == 0
    assert overshoot["members"] == 256 and overshoot["beyond"] == 0


def test_gain_and_total_delay_are_those_of_the_flight(result):
    """K and T + tau as the folder of the data expects them, within three standard errors."""
    found = result["identified"]
    gain, error = found["gain"]
    assert abs(gain - 282) < 3 * error
    late = found["late"]
    assert abs(late["value"] - 0.0268) < 3 * late["standard_error"]


def test_members_differ_in_lag_delay_and_their_sum_as_the_fit_says(result, certificate):
    """By noise alone they trade off; what is drawn counts model error, correlated as in the fit."""
    lag, delay = (np.array(certificate["members"][name])[0] for name in ("lag", "delay"))
    known = result["identified"]
    one, other, both = known["by_noise"]
    assert (both**2 - one**2 - other**2) / (2 * one * other) < -0.5
    one, other, both = known["lag"][1], known["delay"][1], known["late"]["standard_error"]
    correlation = (both**2 - one**2 - other**2) / (2 * one * other)
    # Draws are normal in the logarithms; the loop's delay is the fit's without half a hold.
    delay = delay + DT / 2
    chance = 3 / np.sqrt(lag.size)
    logs = np.log([lag, delay])
    assert np.corrcoef(logs)[0, 1] == pytest.approx(correlation, abs=chance * (1 - correlation**2))
    for drawn, name in zip(logs, ("lag", "delay"), strict=True):
        value, error = known[name]
        assert np.std(drawn) == pytest.approx(error / value, rel=chance / np.sqrt(2))
    # Of a sum of two such the distribution is wider than the slopes at its middle say.
    assert np.std(lag + delay) == pytest.approx(both, rel=0.25)


def test_what_is_assumed_and_that_nothing_was_flown_is_printed(run):
    assert "Assumed: inertia 0.5 to 2 times what was flown" in run[1] and "Not flown" in run[1]
    assert ", inside the identified band" in run[1]


@pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no gcc to compile the header")
def test_the_header_compiles(run):
    source = '#include "antx_pitch.h"\nint main(void) { return 0; }\n'
    command = ["gcc", "-std=c99", "-Wall", "-Wextra", "-fsyntax-only", f"-I{run[0]}", "-xc", "-"]
    subprocess.run(command, input=source, text=True, check=True)


def test_without_the_logs_it_says_so(tmp_path):
    command = [sys.executable, str(SCRIPT), "--data", str(tmp_path / "none")]
    found = subprocess.run(command, capture_output=True, text=True)
    assert found.returncode and "skipped: no flight logs at" in found.stderr
