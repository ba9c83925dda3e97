"""What the README shows is what happens."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT
from test_notebooks import words


README = (ROOT / "README.md").read_text()
BLOCK = re.compile(r"```(\w*)\n(.*?)```", flags=re.S)


def blocks(text, kind=""):
    return [code for found, code in BLOCK.findall(text) if found == kind]


def page(name):
    return (ROOT / "docs" / name).read_text()


def run(*command, folder):
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_demo_prints_what_the_readme_shows(tmp_path):
    command = str(Path(sys.executable).with_name("jaxquad"))
    printed = " ".join(words(run(command, "demo", folder=tmp_path)))
    shown = blocks(README.partition("<!-- demo -->")[2])[1]
    assert len(shown.splitlines()) == 8
    for line in shown.splitlines():
        assert " ".join(words(line)) in printed, line


DIFFERENCES = """
k, h = jnp.array([0.2, 0.03]), 1e-6  # |error| bends where it is 0
slopes = [(error(k + h * unit) - error(k - h * unit)) / (2 * h) for unit in jnp.eye(2)]
assert jnp.allclose(jax.grad(error)(k), jnp.array(slopes), rtol=1e-4), slopes
assert not jq.evaluate(loop(k), flight).diverged.any()
"""


@pytest.mark.slow
def test_the_python_of_the_readme_runs_by_itself(tmp_path):
    first, second = blocks(README, "python")
    assert len(first.splitlines()) == 9
    # jnp's strict promotion, which the tests switch on, is not what a user has.
    code = "\n".join([first, second, DIFFERENCES])
    printed = run(sys.executable, "-c", code, folder=tmp_path)
    assert all(word in printed for word in ("gain", "lag + delay = 0.02", "verification"))
    assert "8 fits; 0 of them reached no minimum" in printed


@pytest.mark.slow
def test_the_loop_in_twelve_lines_prints_what_its_page_promises(tmp_path):
    example = blocks(page("control.md"), "python")[0]
    assert len(example.splitlines()) <= 12
    printed = run(sys.executable, "-c", example, folder=tmp_path)
    promised = ("stable loop", "stable for gains of 0.1104 to 2.148", "256 members", "CVaR20")
    assert all(word in printed for word in promised)


@pytest.mark.slow
def test_the_main_job_prints_what_its_page_shows(tmp_path):
    shown = words(blocks(page("main_job.md"))[0])
    job = str(ROOT / "fits" / "hover_roll.py")
    stdout = run(sys.executable, job, "--out", str(tmp_path), folder=ROOT)
    printed = words(stdout[stdout.index("One record, asked") :])
    assert printed[: len(shown)] == shown
    files = {"result.json", "report.html", "bode.png", "verification.png"}
    assert files <= {path.name for path in tmp_path.iterdir()}


@pytest.mark.slow
def test_the_estimates_beside_scipy_are_those_that_the_comparison_shows(tmp_path):
    (shown,) = [text for text in blocks(page("comparison.md")) if "scipy, u to y" in text]
    printed = run(sys.executable, str(ROOT / "fits" / "beside_scipy.py"), folder=tmp_path)
    assert words(printed) == words(shown)


def test_there_are_exactly_two_commands_to_set_up():
    assert len(re.findall(r"python3 -m venv", README)) == 2


def test_importing_the_library_leaves_the_flags_alone_and_heavy_modules_out():
    code = (
        "import jax, sys; before = jax.config.read('jax_enable_x64'); import jaxquad; "
        "assert jax.config.read('jax_enable_x64') == before; "
        "assert not {'scipy.signal', 'optimistix', 'matplotlib', 'diffrax'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
