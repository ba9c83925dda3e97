"""Ten seconds of a closed loop at 2 ms, one and a thousand inertias, beside hand-written C.

    python -m pytest tests/benchmarks/test_loop_speed.py -o addopts= --benchmark-columns=min,median

C and "as C" compute the same: Euler angles, rates and lagging torques of a quadrotor under three
LADRC, one Runge-Kutta step a sample (`baselines/ladrc_loop` beside the data, or the folder that
JAXQUAD_BASELINES names; skipped where it or gcc is not there). The rig is the library's own:
quaternions, four motor voltages with lag and limits. C keeps no trajectory in the ensemble; ours
keeps angle, measurement, command and disturbance of every sample.
"""

import ctypes
import os
import shutil
import subprocess
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.control import LADRC
from jaxquad.loops import align, Loop, per_member
from jaxquad.models import Allocation, Attitude, MotorLag, Multirotor, QUANSER_HOVER
from jaxquad.simulation import MotorDrive, Saturation, Scenario, simulate


jax.config.update("jax_enable_x64", True)

DT, SAMPLES, MEMBERS = 0.002, 5000, 1000
INERTIA = np.array([0.0552, 0.0552, 0.1104])
SPREAD = np.linspace(0.7, 1.5, MEMBERS)
WC, WO = np.array([10.0, 10.0, 6.0]), np.array([30.0, 30.0, 18.0])
STEP = np.radians(4)
EXACT = [0.080522003175, 0.06981317008, 0.06981317008]  # of the baseline's README


class Quadrotor(eqx.Module):
    """What quad.c integrates: Euler angles, body rates, lagging torques."""

    inertia: jax.Array = per_member(rank=1)

    def init(self, euler=None, *, ensemble=()):
        wide = jnp.broadcast_shapes(ensemble, self.inertia.shape[1:])
        return (jnp.zeros((3, *wide)),) * 3

    def derivative(self, state, inputs, disturbance):
        (phi, theta, _), (p, q, r), torque = state
        inertia = align(self.inertia, torque)
        turn = q * jnp.sin(phi) + r * jnp.cos(phi)
        across = q * jnp.cos(phi) - r * jnp.sin(phi)
        euler = jnp.stack([p + turn * jnp.tan(theta), across, turn / jnp.cos(theta)])
        gyroscopic = jnp.cross(state[1], inertia * state[1], axis=0)
        rate = (torque + disturbance - 0.01 * state[1] - gyroscopic) / inertia
        return euler, rate, (inputs - torque) / 0.02

    def measure(self, state):
        return state[0]


def scenario(samples=SAMPLES) -> Scenario:
    still = np.zeros((samples, 3))
    torque = still.copy()
    torque[:, 0] = 0.3 * np.sin(0.4 * np.pi * DT * np.arange(samples))
    return Scenario(*(jnp.asarray(x) for x in (still + STEP, still, torque, still)))


def as_c(inertia, samples=SAMPLES):
    law = LADRC(WC, WO, 1 / INERTIA, placement="continuous", dt=DT)
    loop, case = Loop(Quadrotor(inertia), law, dt=DT, drive=Saturation(1.5)), scenario(samples)
    return lambda: simulate(loop, case)


def rig(inertia):
    sheet = QUANSER_HOVER
    allocation = Allocation(sheet.arm, sheet.thrust_coefficient, sheet.torque_coefficient)
    plant = Multirotor(Attitude(inertia, damping=(0.01,) * 3), allocation, MotorLag(0.02))
    gain = np.array([sheet.arm * sheet.thrust_coefficient] * 2 + [sheet.torque_coefficient])
    law = LADRC([4.0, 4.0, 2.0], [40.0, 40.0, 20.0], 1.8 * gain / INERTIA, dt=DT)
    case = eqx.tree_at(lambda s: s.disturbance, scenario(), 0.01 * scenario().disturbance)
    loop = Loop(plant, law, dt=DT, drive=MotorDrive(allocation))
    return lambda: simulate(loop, case)


INERTIAS = INERTIA[:, None] * SPREAD


@pytest.mark.benchmark(group="one loop")
def test_ours_as_c(benchmark):
    run = as_c(jnp.asarray(INERTIA))
    found = benchmark(lambda: jax.block_until_ready(run()))
    assert found.angle.shape == (SAMPLES, 3) and not found.diverged


@pytest.mark.benchmark(group="one loop")
def test_ours_rig(benchmark):
    run = rig(INERTIA)
    found = benchmark(lambda: jax.block_until_ready(run()))
    assert np.max(np.abs(found.angle[-1] - STEP)) < 0.01


@pytest.mark.benchmark(group="one loop")
def test_ours_rig_gradient(benchmark):
    """Reverse mode, of the squared error by the nine gains of the three LADRC."""
    sheet = QUANSER_HOVER
    allocation = Allocation(sheet.arm, sheet.thrust_coefficient, sheet.torque_coefficient)
    plant, case = Multirotor(Attitude(INERTIA), allocation, MotorLag(0.02)), scenario()
    drive = MotorDrive(allocation)
    gain = np.array([sheet.arm * sheet.thrust_coefficient] * 2 + [sheet.torque_coefficient])
    case = eqx.tree_at(lambda s: s.disturbance, case, 0.01 * case.disturbance)

    @jax.jit
    @jax.grad
    def slope(gains):
        found = simulate(Loop(plant, LADRC(*gains, dt=DT), dt=DT, drive=drive), case)
        return jnp.sum((found.angle - STEP) ** 2)

    gains = (jnp.array([4.0, 4.0, 2.0]), jnp.array([40.0, 40.0, 20.0]), 1.8 * gain / INERTIA)
    found = benchmark(lambda: jax.block_until_ready(slope(gains)))
    assert all(np.all(np.isfinite(x)) for x in found)


@pytest.mark.benchmark(group="a thousand inertias")
def test_thousand_as_c(benchmark):
    run = as_c(jnp.asarray(INERTIAS))
    found = benchmark.pedantic(lambda: jax.block_until_ready(run()), rounds=3, warmup_rounds=1)
    assert found.angle.shape == (SAMPLES, 3, MEMBERS)


@pytest.mark.benchmark(group="a thousand inertias")
def test_thousand_rigs(benchmark):
    run = rig(INERTIAS)
    found = benchmark.pedantic(lambda: jax.block_until_ready(run()), rounds=3, warmup_rounds=1)
    assert not np.any(found.diverged)


@pytest.fixture(scope="module")
def compiled_c(tmp_path_factory):
    near = Path(__file__).parents[2] / ".." / "shared" / "baselines"
    source = Path(os.environ.get("JAXQUAD_BASELINES", near)) / "ladrc_loop" / "quad.c"
    if not source.is_file() or shutil.which("gcc") is None:
        pytest.skip(f"no {source} or no gcc: set JAXQUAD_BASELINES to the folder of baselines")
    library = tmp_path_factory.mktemp("c") / "libquad.so"
    options = ["-O3", "-march=native", "-fopenmp", "-shared", "-fPIC"]
    subprocess.run(["gcc", *options, "-o", library, source, "-lm"], check=True)
    return ctypes.CDLL(str(library))


def call_c(library, inertias):
    """Final states [members, 9] and costs of the loops, without their trajectories."""
    members = len(inertias)
    states, costs = np.empty((members, 9)), np.empty(members)
    given = [np.ascontiguousarray(x, float) for x in (inertias, [0.01] * 3)]
    gains = [np.ascontiguousarray(x, float) for x in (WC, WO, 1 / INERTIA, [STEP] * 3)]
    number, at = ctypes.c_double, lambda x: x.ctypes.data_as(ctypes.c_void_p)
    numbers = map(number, (1.5, 0.3, 0.4 * np.pi))
    library.batch(
        members, SAMPLES, number(DT), *map(at, given), number(0.02), *map(at, gains), *numbers,
        at(states), at(costs),
    )  # fmt: skip
    return states, costs


@pytest.mark.benchmark(group="one loop")
def test_c(benchmark, compiled_c):
    states, _ = benchmark(lambda: call_c(compiled_c, INERTIA[None]))
    np.testing.assert_allclose(states[0, :3], EXACT, rtol=1e-10)
    after = as_c(jnp.asarray(INERTIA), SAMPLES + 1)().angle[-1]  # the last sample steps no more
    np.testing.assert_allclose(after, states[0, :3], rtol=1e-10)


@pytest.mark.benchmark(group="a thousand inertias")
def test_thousand_c(benchmark, compiled_c):
    states, _ = benchmark.pedantic(
        lambda: call_c(compiled_c, INERTIAS.T), rounds=3, warmup_rounds=1
    )
    assert np.all(np.isfinite(states))
