"""An ensemble on one and on two devices of a CPU, in one process and one run.

    python -m pytest tests/benchmarks/test_device_speed.py -o addopts= -s

4096 loops of 5000 steps of 2 ms: one axis with a motor lag, LADRC, a step and a pulse; forward, and
the gradient of the mean ITAE with respect to three gains. Devices take turns, and the best of each
counts. The ratio of seconds needs two idle cores; `work` is what it cannot exceed, twice the CPU
time of one device over that of two, and holds on a busy machine as well.
"""

import json
import os
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.control import LADRC
from jaxquad.loops import Loop
from jaxquad.models import DecoupledAxes
from jaxquad.simulation import evaluate, Pulse, Saturation, scenario, Step


MEMBERS, ROUNDS = 4096, {"forward": 8, "gradient": 3}
GAINS = np.array([10.0, 30.0, 0.8478])


def itae(gains, plant, happens, devices):
    controller = LADRC(gains[:1], gains[1:2], gains[2:])
    found = evaluate(Loop(plant, controller, drive=Saturation(20.0)), happens, devices=devices)
    return jnp.mean(found.itae)


def runs():
    """What is timed, by name and number of devices."""
    plant = DecoupledAxes([0.0468], 0.0552 * np.geomspace(0.5, 2.0, MEMBERS)[None], lag=[0.005])
    happens = scenario(
        duration=10.0,
        axes=1,
        reference={0: Step(np.radians(4.0))},
        disturbance={0: Pulse(0.1, width=1.0, at=5.0)},
    )
    gains = jnp.asarray(GAINS)
    slope = jax.jit(jax.grad(itae), static_argnums=3)
    for devices in (1, 2):
        yield ("forward", devices), lambda k=devices: itae(gains, plant, happens, k)
        yield ("gradient", devices), lambda k=devices: slope(gains, plant, happens, k)


def clocks():
    return np.array([time.perf_counter(), time.process_time()])


def main():
    """Prints the least seconds, of the clock and of the CPU, and the results of each run."""
    cases = dict(runs())
    results = {case: np.asarray(run()).tolist() for case, run in cases.items()}
    least = {case: np.full(2, np.inf) for case in cases}
    for what, rounds in ROUNDS.items():
        for case in [(what, 1), (what, 2)] * rounds:
            begun = clocks()
            jax.block_until_ready(cases[case]())
            least[case] = np.minimum(least[case], clocks() - begun)
    print(json.dumps([[*case, least[case].tolist(), results[case]] for case in cases]))


@pytest.fixture(scope="module")
def measured():
    load = os.getloadavg()[0]
    told = {"JAX_NUM_CPU_DEVICES": "2", "JAX_ENABLE_X64": "1"}
    ran = subprocess.run(
        [sys.executable, __file__], capture_output=True, text=True, env=os.environ | told
    )
    assert ran.returncode == 0, ran.stderr[-2000:]
    rows = json.loads(ran.stdout.splitlines()[-1])
    return load, {(what, devices): rest for what, devices, *rest in rows}


@pytest.mark.parametrize("what", ROUNDS)
def test_two_devices_are_faster(benchmark, measured, what):
    """By 1.8 or more, where two cores are idle."""
    load, rows = measured
    (one, alone), (two, together) = rows[what, 1], rows[what, 2]
    told = {"one": one[0], "two": two[0], "ratio": one[0] / two[0], "work": 2 * one[1] / two[1]}
    benchmark.pedantic(lambda: None)
    benchmark.extra_info.update(told, load=load)
    print(f"\n{what}: ", ", ".join(f"{k} {v:.3g}" for k, v in told.items()), f"(load {load:.1f})")
    np.testing.assert_allclose(together, alone, rtol=1e-12)


if __name__ == "__main__":
    main()
