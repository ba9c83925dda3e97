"""Metrics of 1000 closed loops while they run, beside metrics from their records, in one run.

    python -m pytest tests/benchmarks/test_evaluate_speed.py -o addopts= \
        --benchmark-columns=min,median

One axis with a motor lag and an LADRC, 5000 steps of 2 ms, 1000 inertias, a step and a pulse. The
memory in `extra_info` is what XLA reserves for temporaries and results; `test_alone` is the loop
with nothing but its final angle, which shows what the metrics add.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.control import LADRC
from jaxquad.loops import Loop
from jaxquad.models import DecoupledAxes
from jaxquad.simulation import (
    evaluate,
    metrics,
    Pulse,
    Saturation,
    scan_loop,
    scenario,
    simulate,
    Step,
)


jax.config.update("jax_enable_x64", True)

MEMBERS = 1000
HAPPENS = scenario(
    duration=10.0,
    axes=1,
    reference={0: Step(np.radians(4.0))},
    disturbance={0: Pulse(0.1, width=1.0, at=5.0)},
)
CONTROLLER, DRIVE = LADRC([10.0], [30.0], [0.8478]), Saturation(20.0)


def plant(members):
    inertia = 0.0552 * np.geomspace(0.5, 2.0, members)
    return DecoupledAxes([0.0468], inertia[None] if members > 1 else inertia, lag=[0.005])


def reserved(run, loop):
    memory = eqx.filter_jit(run).lower(loop, HAPPENS).compile().compiled.memory_analysis()
    return (memory.temp_size_in_bytes + memory.output_size_in_bytes) / 1e6


class LastAngle(eqx.Module):
    """An accumulator that keeps the angle only."""

    def begin(self, like):
        return like

    def update(self, total, now):
        return now.angle, None


@pytest.fixture(scope="module", params=[1, MEMBERS])
def rig(request):
    return plant(request.param)


@pytest.mark.benchmark(group="evaluate")
def test_evaluate(benchmark, rig):
    loop = Loop(rig, CONTROLLER, drive=DRIVE)
    found = benchmark(lambda: jax.block_until_ready(evaluate(loop, HAPPENS)))
    benchmark.extra_info["MB"] = reserved(evaluate, loop)
    assert np.isfinite(found.itae).all()


@pytest.mark.benchmark(group="evaluate")
def test_simulate_then_metrics(benchmark, rig):
    loop = Loop(rig, CONTROLLER, drive=DRIVE)
    run = lambda: metrics(simulate(loop, HAPPENS))
    found = benchmark(lambda: jax.block_until_ready(run()))
    benchmark.extra_info["MB"] = reserved(simulate, loop)
    exact = evaluate(loop, HAPPENS)
    np.testing.assert_allclose(found.itae, exact.itae, rtol=1e-12)


@pytest.mark.benchmark(group="evaluate")
def test_alone(benchmark, rig):
    run = eqx.filter_jit(lambda loop, happens: scan_loop(loop, happens, LastAngle())[0])
    loop = Loop(rig, CONTROLLER, drive=DRIVE)
    benchmark(lambda: jax.block_until_ready(run(loop, HAPPENS)))


@pytest.mark.benchmark(group="gradient of the mean ITAE, 3 gains")
def test_gradient(benchmark, rig):
    def itae(gains, rig, happens):
        wc, wo, b0 = (x[None] for x in gains)
        return jnp.mean(evaluate(Loop(rig, LADRC(wc, wo, b0), drive=DRIVE), happens).itae)

    gains = jnp.asarray([10.0, 30.0, 0.8478])
    slope = eqx.filter_jit(eqx.filter_grad(itae))
    found = benchmark(lambda: jax.block_until_ready(slope(gains, rig, HAPPENS)))
    cost = lambda gains: itae(gains, rig, HAPPENS)
    step = 1e-5 * gains
    numeric = [
        (cost(gains.at[k].add(step[k])) - cost(gains.at[k].add(-step[k]))) / (2 * step[k])
        for k in range(3)
    ]
    np.testing.assert_allclose(found, np.array(numeric), rtol=1e-5)
