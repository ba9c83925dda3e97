"""1e5 and 1e6 adaptive loops of 5000 steps on a GPU: the whole time loop is one kernel.

    python -m pytest tests/benchmarks/test_accelerator_speed.py -o addopts= -s

Forward, and the gradient of the mean cost with respect to 12 tuning parameters; best of five runs,
with what starts a kernel, without copies from and to the host. The mean over 1e6 loops is also that
of ten batches, one after another: each may keep more of its samples. Skipped where JAX has no GPU.
"""

import sys
import time

import adaptive_loop
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad import engine


STEPS, ROUNDS = 5000, 5
BATCH = 100_000
CASES = [(BATCH, np.float32), (1_000_000, np.float32), (BATCH, np.float64)]
TUNING = (6.0, 4.0, 25.0, 20.0, *(1 / np.linspace(0.5, 2.25, 8)))


@pytest.fixture(autouse=True)
def gpu():
    if jax.default_backend() != "gpu":
        pytest.skip(f"the platform is {jax.default_backend()}")
    with jax.enable_x64(True):
        yield jax.devices()[0].device_kind


def given(members, steps, kind):
    sizes = np.random.default_rng(0).uniform(0.6, 1.8, (3, members))
    inertia = np.array(adaptive_loop.INERTIA)[:, None] * sizes
    t = np.arange(steps) * adaptive_loop.DT
    load = np.stack([0.05 * np.sin(2 * t), 0.05 * np.sin(3 * t), 0.02 * np.sin(2.5 * t)], 1)
    return tuple(jnp.asarray(x, kind) for x in (TUNING, inertia, load))


def costs(*args):
    return adaptive_loop.costs(*args, chunk=None)


def mean(*args):
    return jnp.mean(costs(*args))


def gradient_by_batches(tuning, inertia, load):
    """That of the mean, from batches of `BATCH` members in turn."""
    batches = jnp.moveaxis(inertia.reshape(3, -1, BATCH), 1, 0)

    def add(total, batch):
        return total + jax.grad(mean)(tuning, batch, load), None

    return jax.lax.scan(add, jnp.zeros_like(tuning), batches)[0] / len(batches)


def seconds(run, *args):
    compiled = jax.jit(run).lower(*args).compile()
    taken = []
    for _ in range(ROUNDS + 1):
        began = time.perf_counter()
        jax.block_until_ready(compiled(*args))
        taken.append(time.perf_counter() - began)
    return min(taken)


@pytest.mark.parametrize("members, kind", CASES)
def test_loops_per_second(gpu, members, kind):
    args = given(members, STEPS, kind)
    count = members * STEPS
    runs = [("forward", costs), ("gradient", jax.grad(mean))]
    runs += [(f"gradient by batches of {BATCH}", gradient_by_batches)] if members > BATCH else []
    for what, run in runs:
        taken = seconds(run, *args)
        name = np.dtype(kind).name
        print(f"\n{gpu}, {members} loops, {name}, {what}: {count / taken:.3g} loop-steps/s")
    assert engine().left_plain == ()


def test_results_and_gradients_are_those_of_the_plain_scan(monkeypatch):
    args = given(1024, 500, np.float64)
    plain = lambda *args: jnp.mean(adaptive_loop.plain(*args))
    monkeypatch.setattr(sys.modules[__name__], "BATCH", 256)
    slopes = jax.jit(jax.grad(plain))(*args)
    np.testing.assert_allclose(
        jax.jit(costs)(*args), jax.jit(adaptive_loop.plain)(*args), rtol=1e-9
    )
    for fast in (jax.grad(mean), gradient_by_batches):
        np.testing.assert_allclose(jax.jit(fast)(*args), slopes, rtol=1e-9)
    assert engine().left_plain == ()
