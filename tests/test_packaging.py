"""What is uploaded: a wheel made from the source archive, which a bare environment can run."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from conftest import ROOT


pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]
OFFLINE = ("No matching distribution", "ConnectionError", "NewConnectionError", "Max retries")


def run(*command, **options):
    """A command outside of the source tree; skips where it finds no package index."""
    hidden = ("PYTHONPATH", "JAX_COMPILATION_CACHE_DIR", "XLA_FLAGS")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    words = [str(word) for word in command]
    done = subprocess.run(words, capture_output=True, text=True, env=environment, **options)
    if done.returncode and any(sign in done.stderr for sign in OFFLINE):
        pytest.skip("no package index can be reached")
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The wheel and the source archive from which it was made."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--outdir", folder, ROOT)
    (wheel,), (archive,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, archive


def package_files():
    """Those of the package, as git knows them."""
    found = (path for path in (ROOT / "jaxquad").rglob("*") if path.is_file())
    names = (path.relative_to(ROOT).as_posix() for path in found)
    return {name for name in names if "__pycache__" not in name}


def test_the_wheel_holds_the_package_and_nothing_else(built):
    names = set(zipfile.ZipFile(built[0]).namelist())
    own = {name for name in names if not name.split("/")[0].endswith(".dist-info")}
    assert own == package_files()
    assert {"jaxquad/py.typed", "jaxquad/__init__.pyi"} < own


def test_the_source_archive_holds_documents_and_tests(built):
    with tarfile.open(built[1]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"README.md", "CHANGELOG.md", "LICENSE", "pyproject.toml"} < names
    assert package_files() < names
    assert not [name for name in names if name.startswith(("results/", "build/"))]


def is_there(python):
    """Whether it runs: a version manager has names of what is not installed."""
    if shutil.which(python) is None:
        return False
    return subprocess.run([python, "--version"], capture_output=True).returncode == 0


@pytest.mark.parametrize("python", ["python3.11", "python3.13"])
def test_a_bare_environment_runs_the_demo(built, tmp_path, python):
    if not is_there(python):
        pytest.skip(f"{python} is not installed")
    run(python, "-m", "venv", tmp_path / "venv")
    binaries = tmp_path / "venv" / "bin"
    run(binaries / "python", "-m", "pip", "install", "-q", built[0])
    where = run(binaries / "python", "-c", "import jaxquad; print(jaxquad.__file__)", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(tmp_path / "venv")
    printed = run(binaries / "jaxquad", "demo", "--quiet", cwd=tmp_path)
    assert "gain" in printed and (tmp_path / "results" / "demo" / "report.html").is_file()
