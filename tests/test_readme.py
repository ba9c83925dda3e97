"""What the README shows is what happens."""

import re
import subprocess
import sys

from conftest import ROOT


README = (ROOT / "README.md").read_text()


def test_the_python_example_prints_a_table(capsys):
    (example,) = re.findall(r"```python\n(.*?)```", README, flags=re.S)
    assert len(example.splitlines()) <= 12
    # jnp's strict promotion, which the tests switch on, is not what a user has.
    run = subprocess.run([sys.executable, "-c", example], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert "gain" in run.stdout and "lag + delay = 0.05" in run.stdout


def test_there_are_exactly_two_commands_to_set_up():
    assert len(re.findall(r"python3 -m venv", README)) == 2


def test_importing_the_library_leaves_the_flags_alone_and_heavy_modules_out():
    code = (
        "import jax, sys; before = jax.config.read('jax_enable_x64'); import jaxquad; "
        "assert jax.config.read('jax_enable_x64') == before; "
        "assert not {'scipy.signal', 'optimistix', 'matplotlib', 'diffrax'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
