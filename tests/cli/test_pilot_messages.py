"""What a pilot types first, and what the answer has to name: one test for each sentence."""

import json
import shlex

import numpy as np
import pytest

from jaxquad.cli import main


STORED = {
    "settings": {"input": "u", "output": "q"},
    "provenance": {"files": []},
    "record": {"file": "log.csv"},
    "band_rad_per_s": [1.0, 10.0],
    "response": {"outputs": ["q"], "output_units": ["rad/s"]},
}


def refusal(words, capsys):
    assert main(words) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.count("\n") == 1
    return printed.err


def result_of(folder, rate, unit):
    response = {"outputs": [rate], "output_units": [unit]}
    (folder / "result.json").write_text(json.dumps(STORED | {"response": response}))
    return str(folder)


@pytest.mark.parametrize(
    ("words", "folder"), [([], "autopilot"), (["--axis", "Roll"], "autopilot_roll")]
)
def test_all_axes_are_tuned_in_one_run_and_one_axis_is_in_the_folders_name(
    words, folder, tmp_path, monkeypatch
):
    asked = []
    monkeypatch.setattr("jaxquad.cli._logs.run_autopilot", lambda *words: asked.append(words) or 0)
    log = tmp_path / "flight.bbl"
    log.touch()
    assert main(["autopilot", str(log), *words]) == 0
    [(_, read, settings, wanted)] = asked
    assert read == log and wanted.name == folder and wanted.parent.name == "flight"
    assert settings.axis == ("roll" if words else "all")


@pytest.mark.parametrize("rate", ["gyroADC[0]", "RATE.R"])
def test_tune_of_an_autopilots_result_names_jaxquad_autopilot_and_asks_for_no_option(
    rate, tmp_path, capsys
):
    said = refusal(["tune", result_of(tmp_path, rate, "deg/s")], capsys)
    assert "run jaxquad autopilot on the log" in said and "--inertia" not in said


def test_inertia_and_limit_are_asked_for_with_what_they_are_and_where_they_come_from(
    tmp_path, capsys
):
    said = refusal(["tune", result_of(tmp_path, "q", "rad/s")], capsys)
    assert all(word in said for word in ("--inertia", "kg m^2", "CAD", "--limit", "command"))


@pytest.mark.parametrize("content", [b"time,u,q\n0,0,0\n", b"\xb5H Product:Blackbox\xff"])
def test_a_log_given_to_report_is_to_be_identified_first(content, tmp_path, capsys):
    log = tmp_path / "my log.bfl"
    log.write_bytes(content)
    said = refusal(["report", str(log)], capsys)
    assert f"jaxquad identify {shlex.quote(str(log))}" in said and "codec" not in said


def test_a_file_name_with_a_blank_is_quoted_in_every_command_that_is_printed(tmp_path, capsys):
    folder, table = tmp_path / "my logs", tmp_path / "my flight.csv"
    folder.mkdir()
    table.write_text("time,u,q\n0,0,0\n")
    for words in (["identify", str(folder)], [str(folder)]):
        assert f"jaxquad batch {shlex.quote(str(folder))}" in refusal(words, capsys)
    said = refusal(["identify", str(table), str(table)], capsys)
    assert f"jaxquad identify {shlex.quote(str(table))} alone" in said


def test_two_channels_at_rest_are_not_called_the_same_signal(tmp_path, capsys):
    t = 0.01 * np.arange(2000)
    rows = np.stack([t, np.sin(7 * t), 0 * t, 0 * t], axis=1)
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="t,u,q,r", comments="")
    words = ["identify", str(tmp_path / "log.csv"), "--input", "u", "--output", "q"]
    main([*words, "--reference", "r", "--quiet", "--out", str(tmp_path / "out")])
    said = capsys.readouterr().err
    assert "same signal" not in said and "move" in said
