"""Loops with random delays, as kernels and plain: a process of its own, which XLA may end.

python tests/random_delays.py FIRST LAST      prints one line for each seed, then "same"
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxquad as jq
from jaxquad.simulation import Saturation


DT, SAMPLES = 0.005, 120
MODES = {
    "value": lambda f: f,
    "gradient": lambda f: jax.grad(f, argnums=(0, 1)),
    "forward derivative": lambda f: lambda *x: jax.jvp(f, x, jax.tree.map(jnp.ones_like, x)),
    "vmap of gradients": lambda f: jax.vmap(jax.grad(f), in_axes=(0, None)),
    "gradient of a checkpoint": lambda f: jax.grad(jax.checkpoint(f), argnums=(0, 1)),
}
SLOWEST = (2.0, 5.0)  # times the seconds of the plain loop, and seconds more


def draw(seed):
    """Delay in s, members (0: no ensemble), mode, precision, and whether the delay is traced."""
    rng = np.random.default_rng(seed)
    members = int(rng.choice([0, 1, 2, 20, 127, 128, 129, 300]))
    delay = rng.choice([0.0, 0.004, 0.03, 0.1, 0.3, 1.0]) * rng.uniform(0.9, 1.0)
    if rng.random() < 0.3:
        delay = DT * np.round(delay / DT)
    if members and rng.random() < 0.5:
        delay = delay * rng.uniform(rng.choice([0.0, 0.8]), 1.0, members)
    mode = list(MODES)[seed % len(MODES)]
    return delay, members, mode, rng.random() < 0.7, rng.random() < 0.3


def cost_of(delay, members, traced):
    inertia, longest = np.asarray([0.05, 0.1]), 1.2 * float(np.max(delay)) + 0.001
    if members:
        inertia = inertia[:, None] * np.linspace(0.7, 1.5, members)
    case = jq.scenario(
        duration=SAMPLES * DT, dt=DT, axes=2, reference={0: jq.Step(0.07)},
        disturbance={1: jq.Pulse(0.1, width=0.05, at=0.2)},
    )  # fmt: skip

    def cost(gains, late):
        plant = jq.DecoupledAxes([0.01, 0.02], inertia, lag=[0.02, 0.02])
        law = jq.LADRC(gains[0] * jnp.ones(2), gains[1] * jnp.ones(2), 20 * jnp.ones(2), dt=DT)
        late = {"delay": late, "longest_delay": longest} if traced else {"delay": delay}
        loop = jq.Loop(plant, law, drive=Saturation(1.5), dt=DT, **late)
        flight = jq.simulate(loop, case)
        return jnp.sum(flight.angle**2) + jnp.mean(flight.command[-1])

    return cost


def compiled(function, args, kernel):
    """What it computes, and the processor's seconds to compile it."""
    jq.engine(kernel=kernel)
    lowered = jax.jit(function).lower(*args)
    began = time.process_time()
    run = lowered.compile()
    return run(*args), time.process_time() - began


def compare(delay, members, mode, double, traced):
    with jax.enable_x64(double):
        gains, late = jnp.asarray([2.0, 12.0]), jnp.asarray(delay)
        gains = jnp.stack([gains, 1.1 * gains]) if "vmap" in mode else gains
        # A fresh function for each: JAX keeps what it has traced.
        runs = [
            compiled(MODES[mode](cost_of(delay, members, traced)), (gains, late), kernel)
            for kernel in ("auto", "off")
        ]
    jq.engine(kernel="auto")
    (fast, took), (slow, plainly) = runs
    rtol, atol = (1e-8, 1e-10) if double else (5e-3, 1e-3)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=rtol, atol=atol), fast, slow)
    assert took <= SLOWEST[0] * plainly + SLOWEST[1], f"{took:.1f} s against {plainly:.1f} s"
    return took, plainly


if __name__ == "__main__":
    for seed in range(*map(int, sys.argv[1:3])):
        delay, *others = draw(seed)
        print(seed, np.ravel(delay)[:2], *others, flush=True)
        took, plainly = compare(delay, *others)
        print(f"   compiled in {took:.1f} s, plain in {plainly:.1f} s", flush=True)
    print("same")
