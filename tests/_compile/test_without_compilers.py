"""Everything but speed is there without what knows the compilers: its import is blocked here."""

import os
import subprocess
import sys

import pytest
from conftest import ROOT


FEW = (
    "tests/simulation/test_simulate_guard.py::test_no_runaway_makes_values_or_gradients_infinite",
    "tests/simulation/test_simulate_options.py::test_ensembles_of_plants_laws_scenarios_and_delays_meet",
    "tests/identify/test_tied.py::test_a_tied_number_follows_the_free_one",
    "tests/tuning/test_lbfgs.py",
)
ROOMS = ("tests/simulation", "tests/tuning", "tests/identify")
OF_KERNELS = ("tests/simulation/test_ensemble_kernel.py",)


def passes(*words):
    command = [
        sys.executable, "-m", "pytest", "-q", "-x", "-p", "without_compilers",
        "-p", "no:cacheprovider", "-W", "ignore:loops take longer", "-m", "not slow", *words,
    ]  # fmt: skip
    path = os.pathsep.join([str(ROOT / "tests"), str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": path}
    ran = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout[-3000:] + ran.stderr[-1000:]
    return ran.stdout


@pytest.mark.slow
def test_flights_their_gradients_and_fits_need_no_compilers():
    assert " passed" in passes(*FEW)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_simulation_tuning_and_identification_need_no_compilers():
    ignored = [f"--ignore={path}" for path in OF_KERNELS]
    assert " passed" in passes(*ROOMS, *ignored)
