"""Compiling `evaluate` and its gradient: seconds of the processor and by the clock, by options.

    python -m pytest tests/benchmarks/test_compile_speed.py -o addopts= -s

Ten seconds at 2 ms of a three-axis rig under three LADRC, and of three axes under an adaptive LADRC
with least squares; one loop and 48 inertias, under XLA's own options and under "light" ones.
Nothing is read from a cache. What was traced once is not traced again. Then, in seconds by the
clock, an ensemble beside `jax.vmap` of single loops, and `jq.evaluate` by itself, which chooses its
options, beside the same under XLA's own in the same run.
"""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.control import AdaptiveLADRC, certainty_equivalence, LADRC, RecursiveInertia
from jaxquad.loops import Loop
from jaxquad.models import DecoupledAxes, quanser_hover
from jaxquad.simulation import evaluate, MotorDrive, Pulse, Saturation, scenario, Step


jax.config.update("jax_enable_x64", True)

KT, J0 = 0.0468, 0.0552
HAPPENS = scenario(
    duration=10.0, axes=3, reference=Step(np.radians(4.0)), disturbance=Pulse(0.01, width=1.0, at=5)
)
LIGHT = {"xla_backend_optimization_level": 2, "xla_cpu_prefer_vector_width": 512}
GAINS = (jnp.full(3, 10.0), jnp.full(3, 30.0), jnp.full(3, KT / J0))


def rig(gains, inertia):
    plant = eqx.tree_at(lambda p: p.attitude.inertia, quanser_hover(), inertia)
    return Loop(plant, LADRC(*gains), drive=MotorDrive(plant.allocation))


def adaptive(gains, inertia):
    chart = certainty_equivalence(KT, J0, span=(0.5, 3.0), knots=6)
    law = AdaptiveLADRC(LADRC(*gains), RecursiveInertia(jnp.full(3, KT), np.full(3, J0)), chart)
    return Loop(DecoupledAxes([KT] * 3, inertia, lag=[0.005] * 3), law, drive=Saturation(20.0))


def spent(function):
    began = time.process_time()
    found = function()
    return time.process_time() - began, found


@pytest.mark.parametrize("members", [1, 48])
@pytest.mark.parametrize("make", [rig, adaptive])
def test_a_gradient(make, members):
    spread = np.geomspace(0.7, 1.5, members) if members > 1 else np.ones(())
    inertia = jnp.asarray(np.multiply.outer([J0, J0, 2 * J0], spread))
    cost = lambda gains, inertia: jnp.mean(evaluate(make(gains, inertia), HAPPENS).itae)
    functions = {"value": cost, "gradient": jax.value_and_grad(cost)}
    for name, options in (("XLA's own", None), ("light", LIGHT)):
        for what, function in functions.items():
            program = jax.jit(function, compiler_options=options)
            tracing, lowered = spent(lambda p=program: p.lower(GAINS, inertia))
            began = time.perf_counter()
            compiling, compiled = spent(lowered.compile)
            clock = time.perf_counter() - began
            run = lambda c=compiled: jax.block_until_ready(c(GAINS, inertia))
            least = min(spent(run)[0] for _ in range(5))
            print(
                f"\n{make.__name__} x {members}, {what}, {name} options: traced in {tracing:.1f} "
                f"s, compiled in {compiling:.1f} s ({clock:.1f} by the clock), runs in "
                f"{1e3 * least:.1f} ms",
                end="",
            )
            assert np.isfinite(jax.tree.leaves(run())[0])


def test_an_ensemble_beside_vmap_of_single_loops():
    inertia, scales = jnp.asarray([J0, J0, 2 * J0]), jnp.asarray(np.geomspace(0.7, 1.5, 48))
    cost = lambda gains, inertia: jnp.mean(evaluate(rig(gains, inertia), HAPPENS).itae)
    together = lambda gains: cost(gains, jnp.outer(inertia, scales))
    mapped = lambda gains: jnp.mean(jax.vmap(lambda scale: cost(gains, inertia * scale))(scales))
    found = []
    for name, function in (("an ensemble", together), ("vmap", mapped)):
        lowered = jax.jit(jax.value_and_grad(function), compiler_options=LIGHT).lower(GAINS)
        began = time.perf_counter()
        compiled = lowered.compile()
        took = time.perf_counter() - began
        run = lambda c=compiled: jax.block_until_ready(c(GAINS))
        least = 1e3 * min(timed(run) for _ in range(5))
        print(
            f"\n48 rigs, gradient, {name}: compiled in {took:.1f} s, runs in {least:.0f} ms", end=""
        )
        found.append(run())
    for one, other in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8)


@pytest.mark.parametrize("members", [1, 16, 32, 48, 64, 100])
def test_an_evaluation_that_chooses_its_options(members):
    spread = np.geomspace(0.7, 1.5, members) if members > 1 else np.ones(())
    loop = rig(GAINS, jnp.asarray(np.multiply.outer([J0, J0, 2 * J0], spread)))
    run = lambda: jax.block_until_ready(evaluate(loop, HAPPENS))
    began = time.perf_counter()
    first = run()
    took = time.perf_counter() - began
    arrays, rest = eqx.partition((loop, HAPPENS), eqx.is_array)
    whole = lambda arrays: evaluate(*eqx.combine(arrays, rest))
    program = jax.jit(whole)
    plain = lambda: jax.block_until_ready(program(arrays))
    np.testing.assert_allclose(plain().itae, first.itae, rtol=1e-9)
    own, other = (1e3 * min(timed(call) for _ in range(8)) for call in (run, plain))
    found = f"first call {took:.1f} s, then {own:.1f} ms; under XLA's own options {other:.1f} ms"
    print(f"\nrig x {members}: {found}", end="")


def timed(call):
    began = time.perf_counter()
    call()
    return time.perf_counter() - began
