"""4096 adaptive loops of 5000 steps beside their hand-written AVX-512 form: one run, one thread.

    python -m pytest tests/benchmarks/test_ensemble_speed.py -o addopts= -s

The seconds are those of the processor, best of several runs by turns, so that what else the machine
does counts little. The baseline is found through JAXQUAD_BASELINES, ../shared/baselines by default.
"""

import time
from typing import Any

import adaptive_loop
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad import engine


jax.config.update("jax_enable_x64", True)

MEMBERS, STEPS, ROUNDS, DIFFERENCES = 4096, 5000, 3, 24  # flights of central differences
LIMITS = {"float64": 2.0, "float32": 1.6}  # times the AVX-512 code


@pytest.fixture(scope="module")
def baseline():
    found = adaptive_loop.baseline()
    if isinstance(found, str):
        pytest.skip(found)
    return found


def given(baseline, dtype, members=MEMBERS, steps=STEPS):
    arrays = baseline.tuning, baseline.inertias(members), baseline.disturbance(steps)
    return tuple(jnp.asarray(x, dtype) for x in arrays)


def compiled(function, args) -> Any:
    width = {"xla_cpu_prefer_vector_width": engine().vector_bits}
    options = {name: bits for name, bits in width.items() if bits is not None}
    return jax.jit(function, compiler_options=options).lower(*args).compile()


def mean(tuning, inertia, load):
    return jnp.mean(adaptive_loop.costs(tuning, inertia, load))


def seconds(functions):
    """Of the processor, for each, by turns."""

    def one(function):
        began = time.process_time()
        jax.block_until_ready(function())
        return time.process_time() - began

    return np.min([[one(function) for function in functions] for _ in range(ROUNDS)], axis=0)


@pytest.mark.parametrize("dtype", LIMITS)
def test_an_ensemble_and_its_gradient_beside_hand_written_code(baseline, dtype):
    args = given(baseline, dtype)
    flight, slope = compiled(adaptive_loop.costs, args), compiled(jax.grad(mean), args)
    runs = [lambda: baseline.run(*args, dtype), lambda: flight(*args), lambda: slope(*args)]
    code, forward, reverse = seconds(runs)
    memory = slope.memory_analysis().temp_size_in_bytes / 1e6
    nanoseconds = 1e9 / (MEMBERS * STEPS)
    print(
        f"\n{dtype}: AVX-512 code {code * nanoseconds:.1f} ns per instance-step, here "
        f"{forward * nanoseconds:.1f} ({forward / code:.2f} times); gradient for 12 parameters "
        f"{reverse * nanoseconds:.1f} ({reverse / forward:.2f} forward passes, "
        f"{reverse / (DIFFERENCES * code):.2f} of central differences), {memory:.1f} MB"
    )
    assert forward < LIMITS[dtype] * code
    assert reverse < 6 * forward
    assert reverse < DIFFERENCES * code
    assert memory < 50
    np.testing.assert_allclose(flight(*args), baseline.run(*args, dtype), rtol=LOOSE[dtype])


LOOSE = {"float64": 1e-9, "float32": 0.1}  # single precision: rounding grows in a limit cycle


def test_results_and_gradients_are_those_of_the_plain_path(baseline):
    args = given(baseline, "float64", members=300, steps=1000)
    plain = lambda *args: jnp.mean(adaptive_loop.plain(*args))
    for fast, slow in (
        (adaptive_loop.costs, adaptive_loop.plain),
        (jax.grad(mean), jax.grad(plain)),
    ):
        np.testing.assert_allclose(compiled(fast, args)(*args), jax.jit(slow)(*args), rtol=1e-9)
