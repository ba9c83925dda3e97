"""Two processes that compute one ensemble: each makes the same call and gets all members."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from distributed_runs import GAINS, itae, MEMBERS, SLOPE


pytestmark = pytest.mark.slow  # processes that start JAX
PROGRAM = Path(__file__).parents[1] / "distributed_runs.py"
SECONDS = 120  # JAX waits without an end for a process that does not come


def free_port():
    with socket.socket() as held:
        held.bind(("localhost", 0))
        return held.getsockname()[1]


def start(process, address):
    return subprocess.Popen(
        [sys.executable, str(PROGRAM), str(process), address],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"JAX_ENABLE_X64": "1", "JAX_PLATFORMS": "cpu"},
    )


@pytest.fixture(scope="module", params=[0, 1])
def found(request, both):
    return both[request.param]


@pytest.fixture(scope="module")
def both():
    address = f"localhost:{free_port()}"
    started = [start(process, address) for process in range(2)]
    try:
        said = [process.communicate(timeout=SECONDS) for process in started]
    except subprocess.TimeoutExpired:
        for process in started:
            process.kill()
        said = [process.communicate() for process in started]
    errors = "\n".join(error[-2000:] for _, error in said)
    if "aren't implemented on the CPU backend" in errors:
        pytest.skip("this jaxlib has no collectives between processes on CPUs")
    assert [process.returncode for process in started] == [0, 0], errors
    return [json.loads(out.strip().splitlines()[-1]) for out, _ in said]


def test_every_process_gets_the_numbers_of_all_members(found):
    alone = itae(1)
    assert (found["devices"], found["members"]) == (2, MEMBERS)
    np.testing.assert_allclose(found["itae"], alone.itae, rtol=1e-12)
    np.testing.assert_allclose(found["mean"], alone.summary().itae.mean, rtol=1e-12)


def test_every_process_gets_the_gradient_of_all_members(found):
    alone = SLOPE(jnp.asarray(GAINS), (jax.local_devices()[0],))
    np.testing.assert_allclose(found["gradient"], alone, rtol=1e-12)


def test_processes_with_different_ensembles_are_refused(found):
    assert "were not given the same plant" in found["refused"]


def test_the_processes_agree(both):
    assert both[0] == both[1]
