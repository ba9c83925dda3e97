"""What needs no JAX is answered without it."""

import json
import subprocess
import sys

import pytest

from jaxquad.workflows import load_result


PROGRAM = """
import contextlib, io, json, sys
from jaxquad.cli import main

answers = []
for words in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        try:
            code = main(words)
        except SystemExit as stop:
            code = stop.code
    answers.append([words, code, "jax" in sys.modules])
print(json.dumps(answers))
"""
SIGNAL = ["--band", "0.5", "10", "--rate", "500", "--amplitude", "0.2", "--out", "signal.csv"]
LIGHT = {
    "--help": 0,
    "identify --help": 0,
    "identify log --lagg": 2,
    "identify missing.csv --input u --output y": 2,
    "identify log.csv --input u --output y --band 3 1": 2,
    "identify log.csv --input u --output y --verify missing.csv": 2,
    "tune missing --inertia 1 --limit 1": 2,
    "tune in_degrees --inertia 1 --limit 1": 2,
    "autopilot missing": 2,
    "report missing": 2,
    "verify missing log.csv": 2,
    "channels log.csv": 0,
    "channels log.csv --json": 0,
    "channels missing.csv": 2,
    "batch missing": 2,
    " ".join(["design", "sweep", *SIGNAL, "--json"]): 0,
    " ".join(["design", "multisine", *SIGNAL]): 0,
}


IN_DEGREES = {
    "settings": {"input": "u", "output": "q"},
    "provenance": {"files": []},
    "record": {"file": "log.csv"},
    "band_rad_per_s": [1.0, 10.0],
    "response": {"outputs": ["q"], "output_units": ["deg/s"]},
}


def test_a_result_in_degrees_says_so_before_its_log_is_looked_for(tmp_path):
    (tmp_path / "result.json").write_text(json.dumps(IN_DEGREES))
    with pytest.raises(ValueError, match="unit of q is deg/s.*--output angle=0.017453293"):
        load_result(tmp_path).require_radians()
    known = IN_DEGREES | {"settings": IN_DEGREES["settings"] | {"units": {"q": "rad/s"}}}
    (tmp_path / "result.json").write_text(json.dumps(known))
    load_result(tmp_path).require_radians()


def test_help_lists_designs_and_wrong_options_do_not_import_jax(tmp_path):
    rows = "".join(f"{k / 100},{k % 7},{k % 5}\n" for k in range(50))
    (tmp_path / "log.csv").write_text(f"time,u,y\n{rows}")
    (tmp_path / "in_degrees").mkdir()
    (tmp_path / "in_degrees" / "result.json").write_text(json.dumps(IN_DEGREES))
    asked = json.dumps([line.split() for line in LIGHT])
    answer = subprocess.run(
        [sys.executable, "-c", PROGRAM, asked], cwd=tmp_path, capture_output=True, check=True
    )
    expected = [[line.split(), code, False] for line, code in LIGHT.items()]
    assert json.loads(answer.stdout) == expected


def test_the_package_is_the_command_and_a_reader_may_stop_early(tmp_path):
    command = [sys.executable, "-m", "jaxquad"]
    version = subprocess.run([*command, "--version"], capture_output=True, text=True, check=True)
    assert version.stdout.startswith("jaxquad ")
    with subprocess.Popen(
        [*command, "design", "sweep", *SIGNAL, "--json"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert b"Broken pipe" not in process.stderr.read()
