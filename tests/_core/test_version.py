"""The version is that of the distribution, and a tree that is not installed says so."""

import os
import subprocess
import sys
import sysconfig
from importlib.metadata import version
from pathlib import Path

import pytest
from conftest import ROOT

import jaxquad as jq


def test_the_version_is_that_of_the_distribution():
    assert jq.__version__ == version("jaxquad")
    assert "__version__" in dir(jq)


def test_the_version_costs_an_import_nothing():
    code = "import jaxquad, sys; assert 'importlib.metadata' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.fixture
def not_installed(tmp_path):
    """A folder with all that is installed here but jaxquad, and with its source tree."""
    for path in Path(sysconfig.get_path("purelib")).iterdir():
        if "jaxquad" not in path.name and path.suffix != ".pth":
            (tmp_path / path.name).symlink_to(path)
    (tmp_path / "jaxquad").symlink_to(ROOT / "jaxquad")
    return tmp_path


def test_a_tree_that_is_not_installed_says_so(not_installed):
    environment = os.environ | {"PYTHONPATH": str(not_installed)}
    command = [sys.executable, "-S", "-m", "jaxquad", "--version"]
    done = subprocess.run(
        command, capture_output=True, text=True, env=environment, cwd=not_installed
    )
    assert done.stdout == "jaxquad 0+not.installed\n", done.stderr
