"""From the sweep to certified gains, as fits/tune_hover.py does it, with few members."""

import importlib
import json
import shutil
import subprocess
import sys
from contextlib import redirect_stdout
from io import StringIO

import jax
import numpy as np
import pytest
import tuning_case
from conftest import ROOT


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def script():
    sys.path.insert(0, str(ROOT / "fits"))
    try:
        return importlib.import_module("tune_hover")
    finally:
        sys.path.remove(str(ROOT / "fits"))


@pytest.fixture(scope="module")
def run(script, tmp_path_factory):
    """The folder of a quick run, and what it printed."""
    out, printed = tmp_path_factory.mktemp("tune_hover"), StringIO()
    quick = importlib.import_module("experiments.tuning").QUICK
    with redirect_stdout(printed):
        script.main(out, 0, quick)
    return out, printed.getvalue()


@pytest.fixture(scope="module")
def result(run):
    return json.loads((run[0] / "result.json").read_text())


def test_the_first_line_says_that_the_certificate_holds(run, result):
    assert run[1].startswith("CERTIFICATE HOLDS on 256 fresh members")
    assert run[1].splitlines()[0] == result["verdict"]
    assert "CERTIFICATE HOLDS" in run[1].splitlines()[1]
    certificate = json.loads((run[0] / "certificate.json").read_text())
    assert certificate["holds"] and certificate["designs"]["tuned"]["unstable"] == 0
    assert set(certificate["designs"]) == {"tuned", "paper b0 = 3", "paper b0 = 1.6", "b0 = KT/J"}


def test_the_sweep_finds_gain_and_lag_of_the_rig(script, result):
    gain, (lag, error) = result["identified"]["gain"], result["identified"]["lag"]
    truth = script.SHEET.arm * script.SHEET.thrust_coefficient / script.INERTIA
    assert abs(gain["value"] - truth) < 3 * gain["standard_error"]
    assert abs(lag - 0.02) < 3 * error and error < 0.001


def test_the_papers_gains_are_unstable_on_three_quarters_and_on_a_third_of_section_3(result):
    """Printed: 75 % and 38 % of 256; 71 and 37 % of 1024, so that 256 scatter by 3 %."""
    found = result["section_3"]["paper_unstable_percent"]
    assert found["paper b0 = 3"] == pytest.approx(72, abs=9)
    assert found["paper b0 = 1.6"] == pytest.approx(38, abs=9)


def test_the_tuned_map_reaches_what_the_prototype_reached_on_section_3(result):
    """Tuned on 16 members only: the targets for 64 are 8.5 and 15 deg s^2, and an Ms of 3.6."""
    row = result["section_3"]["designs"]["tuned"]
    itae = row["statistics"]["itae"]
    assert row["unstable"] == 0 and row["diverged"] == 0
    assert np.degrees(itae["mean"]) < 1.1 * 8.5 and np.degrees(itae["worst"]) < 1.1 * 15
    assert row["statistics"]["sensitivity_peak"]["worst"] <= 3.6


def test_its_members_are_those_of_the_case_that_the_tuner_is_tested_on(script):
    ours, theirs = script.assumed().ensemble, tuning_case.ensemble()
    for name, one in theirs.distributions.items():
        assert str(ours.distributions[name]) == str(one)
    loops = script.assumed().loop, tuning_case.loop()
    pairs = zip((ours, theirs), loops, strict=True)
    drawn, expected = (e.draw(loop, 8, jax.random.key(1)) for e, loop in pairs)
    np.testing.assert_array_equal(drawn.assumed_inertia, expected.assumed_inertia)
    np.testing.assert_array_equal(drawn.delay, expected.delay)
    ours, theirs = script.flight(), tuning_case.flight()
    np.testing.assert_allclose(ours.reference, theirs.reference)
    np.testing.assert_allclose(ours.disturbance, theirs.disturbance)
    assert script.EVENTS == tuning_case.EVENTS


@pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no gcc to compile the header")
def test_the_header_compiles(run):
    source = '#include "hover_roll.h"\nint main(void) { return 0; }\n'
    command = ["gcc", "-std=c99", "-Wall", "-Wextra", "-fsyntax-only", f"-I{run[0]}", "-xc", "-"]
    subprocess.run(command, input=source, text=True, check=True)


def test_figures_are_written(run):
    assert {"certificate.png", "convergence.png"} <= {path.name for path in run[0].iterdir()}
