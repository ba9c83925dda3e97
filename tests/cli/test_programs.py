"""How many programs are compiled: each takes longer than most of what it computes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT
from sweep_logs import write_sweep


pytestmark = pytest.mark.usefixtures("compiled_quickly")
_COUNT = """
import runpy, sys
import jax
compiled = []
def listen(event, duration, **facts):
    if "backend_compile" in event:
        compiled.append(facts.get("fun_name"))
jax.monitoring.register_event_duration_secs_listener(listen)
sys.argv = sys.argv[1:]
try:
    runpy.run_path(sys.argv[0], run_name="__main__")
except SystemExit as stop:
    assert not stop.code, stop.code
print("compiled:", len(compiled), *compiled)
"""


def programs(*arguments: str) -> list[str]:
    """Names of the programs that a script compiles in a process of its own."""
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", _COUNT, *arguments],
        capture_output=True, text=True, timeout=600, env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1].split()[2:]


@pytest.mark.slow
def test_the_main_job_compiles_at_most_15_programs(tmp_path):
    found = programs(str(ROOT / "fits" / "hover_roll.py"), "--out", str(tmp_path))
    assert len(found) <= 15, found


SWEEP = ["--input", "M=right-left", "--output", "q", "--band", "0.5", "6", "--unit", "q=rad/s"]


@pytest.fixture
def command(tmp_path):
    """A script that is the command line; 4 is a design that is not to be flown."""
    script = tmp_path / "command.py"
    script.write_text("import sys\nfrom jaxquad.cli import main\nsys.exit(main() not in (0, 4))\n")
    return str(script)


def identified(command: str, folder: Path) -> list[str]:
    log = write_sweep(folder / "sweep.csv")
    return programs(command, "identify", str(log), *SWEEP, "--out", str(folder))


@pytest.mark.slow
def test_an_identification_compiles_at_most_6_programs(command, tmp_path):
    found = identified(command, tmp_path)
    assert len(found) <= 6, found


@pytest.mark.slow
def test_a_tune_of_a_stored_result_compiles_at_most_40_programs(command, tmp_path):
    identified(command, tmp_path)
    sizes = ["--members", "16", "--fresh", "32", "--duration", "2"]
    plant = ["--inertia", "0.05", "--limit", "1"]
    found = programs(command, "tune", str(tmp_path), *plant, *sizes)
    assert len(found) <= 40, " ".join(found)
