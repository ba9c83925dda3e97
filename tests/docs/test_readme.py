"""What the README shows is what happens."""

import re
import subprocess
import sys

import pytest
from conftest import ROOT
from test_notebooks import words


README = (ROOT / "README.md").read_text()


EXAMPLES = re.findall(r"```python\n(.*?)```", README, flags=re.S)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("example", "words"),
    [
        (EXAMPLES[0], ("gain", "lag + delay = 0.05")),
        (
            EXAMPLES[1],
            ("stable loop", "stable for gains of 0.1104 to 2.148", "256 members", "CVaR20"),
        ),
    ],
    ids=["identify", "control"],
)
def test_the_python_examples_print_what_they_promise(example, words):
    assert len(example.splitlines()) <= 12
    # jnp's strict promotion, which the tests switch on, is not what a user has.
    run = subprocess.run([sys.executable, "-c", example], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert all(word in run.stdout for word in words), run.stdout


@pytest.mark.slow
def test_the_main_job_prints_what_the_readme_shows(tmp_path):
    part = README.partition("## What the main job prints")[2]
    shown = words(re.findall(r"```\n(.*?)```", part, flags=re.S)[0])
    command = [sys.executable, str(ROOT / "fits" / "hover_roll.py"), "--out", str(tmp_path)]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    printed = words(run.stdout[run.stdout.index("One record, asked") :])
    assert printed[: len(shown)] == shown
    files = {"result.json", "report.html", "bode.png", "verification.png"}
    assert files <= {path.name for path in tmp_path.iterdir()}


def test_there_are_exactly_two_commands_to_set_up():
    assert len(re.findall(r"python3 -m venv", README)) == 2


def test_importing_the_library_leaves_the_flags_alone_and_heavy_modules_out():
    code = (
        "import jax, sys; before = jax.config.read('jax_enable_x64'); import jaxquad; "
        "assert jax.config.read('jax_enable_x64') == before; "
        "assert not {'scipy.signal', 'optimistix', 'matplotlib', 'diffrax'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
