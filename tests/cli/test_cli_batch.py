"""`jaxquad batch`, as a user types it."""

import csv
import json

import numpy as np
import pytest

import jaxquad as jq
from jaxquad.cli import main


GAIN = 100.0


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """A sweep, a hover without excitation, a file that is no log."""
    folder = tmp_path_factory.mktemp("fleet")
    sweep = jq.sweep(1.0, 40.0, duration=40.0, sample_rate=100.0, amplitude=0.2)
    model = jq.LaggedIntegrator(GAIN, 0.02, 0.01).transfer_function()
    rate = np.asarray(jq.models.simulate_linear(model, sweep.signal, 0.01))
    noise = np.random.default_rng(0).normal(0, 0.05, (2, rate.size))
    np.savez(folder / "sweep.npz", t=sweep.time, M=sweep.signal, q=rate + noise[0])
    np.savez(folder / "hover.npz", t=sweep.time, M=noise[0], q=noise[1])
    (folder / "notes.npz").write_text("no archive")
    (folder / "fleet.toml").write_text(
        'logs = "*.npz"\ninput = "M"\noutput = "gyro"\nband = [0.5, 6]\n'
        '[[override]]\nlogs = "[sh]*"\noutput = "q"\n'
    )
    return folder


@pytest.mark.slow
def test_a_fleet_gives_a_table_a_summary_and_reports(fleet, tmp_path, capfd, monkeypatch):
    out = tmp_path / "out"
    words = ["batch", str(fleet), "--config", str(fleet / "fleet.toml"), "--out", str(out)]
    assert main([*words, "--workers", "1", "--json"]) == 4
    printed = capfd.readouterr()
    rows = {row["log"]: row for row in json.loads(printed.out)}
    assert rows["notes.npz"]["status"] == "failed" and "notes.npz" in rows["notes.npz"]["error"]
    assert rows["hover.npz"]["status"] == "not identifiable"
    with (out / "table.csv").open(newline="") as file:
        table = {row["log"]: row for row in csv.DictReader(file)}
    sweep = table["sweep.npz"]
    assert abs(float(sweep["gain"]) - GAIN) < 3 * float(sweep["gain std.err."]) < 3
    # lag + delay, and half a sample of a held input
    assert float(sweep["lag + delay"]) == pytest.approx(0.035, rel=0.02)
    report = out / sweep["report"]
    assert "SHA-256" in report.read_text() and (report.parent / "bode.png").exists()
    assert sweep["report"] in (out / "summary.html").read_text()
    # The command in the report makes the same again.
    command = json.loads((report.parent / "result.json").read_text())["provenance"]["command"]
    assert "--input M --output q" in command and "--band 0.5 6" in command
    # A second run is done at once, without a process.
    monkeypatch.setattr("multiprocessing.context.SpawnProcess.start", pytest.fail)
    assert main(words) == 4
    printed = capfd.readouterr()
    assert "3 logs: 1 not identifiable, 1 failed, 1 identified" in printed.out
    assert printed.err.splitlines()[-1] == "3/3 sweep.npz: identified"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "complaint"),
    [("estimater = 1", "did you mean 'estimator'"), ("rate =", "not TOML"), ("logs='*.x'", "*.x")],
)
def test_a_config_that_cannot_be_is_one_line(fleet, tmp_path, capsys, text, complaint):
    config = tmp_path / "bad.toml"
    config.write_text(text)
    assert main(["batch", str(fleet), "--config", str(config), "--out", str(tmp_path)]) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1 and complaint in printed
