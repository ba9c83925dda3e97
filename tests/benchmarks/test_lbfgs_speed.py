"""The tuner's L-BFGS beside `optimistix.LBFGS` under vmap, from the same starts on the same cost.

    python -m pytest tests/benchmarks/test_lbfgs_speed.py -o addopts= -s

Both minimise the standard cost of docs/tuning.md over 16 members from four starts. The tuner's
gives each start its own trial points, and evaluates only those that are still running; under vmap
all starts run until the last one has ended.
"""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from tuning_case import coordinates_of, cost_at, ensemble, loop, minimise, pose, STARTS

from jaxquad.tuning import LBFGS


jax.config.update("jax_enable_x64", True)

MEMBERS, PROBLEMS, SCATTER = 16, 4, 0.15
KEY, START = jax.random.key(0), STARTS["slow"]


def case():
    members = ensemble().draw(loop(), MEMBERS, KEY)
    coordinates = coordinates_of(START)
    scatter = np.random.default_rng(0).normal(size=(PROBLEMS, coordinates.start.size))
    return members, coordinates, coordinates.start + SCATTER * scatter


def own(members, coordinates, start):
    """Costs at the ends, and evaluations of each start."""
    posed = pose(START, members, copies=len(start))

    def evaluate(z, on):
        found = cost_at(z, coordinates, posed, on)
        return np.asarray(found.value), np.asarray(found.gradient)

    found = minimise(evaluate, start, LBFGS())
    return found.value, found.evaluations


@eqx.filter_custom_jvp
def cost(z, given):
    return value_and_gradient(z, given)[0]


@cost.def_jvp
def _cost_jvp(primals, tangents):
    # Linearised as it is, optimistix would store every sample of the flights.
    value, gradient = value_and_gradient(*primals)
    return value, jnp.vdot(gradient, tangents[0])


def value_and_gradient(z, given):
    found = cost_at(z[None], *given)
    return found.value[0], found.gradient[0]


@eqx.filter_jit
def batched(start, given):
    solver = optx.LBFGS(rtol=1e-4, atol=1e-4)

    def one(z):
        found = optx.minimise(cost, solver, z, given, max_steps=60, throw=False)
        return cost(found.value, given), found.stats["num_steps"]

    return jax.vmap(one)(start)


def optimistix(members, coordinates, start):
    with jax.numpy_dtype_promotion("standard"):
        given = (coordinates, pose(START, members))
        value, steps = batched(jnp.asarray(start), given)
    return np.asarray(value), np.asarray(steps)


def test_the_tuners_lbfgs_beside_optimistix():
    members, coordinates, start = case()
    lines, best = [], np.inf
    for run in (own, optimistix):
        began = time.process_time()
        run(members, coordinates, start)
        first = time.process_time() - began
        began = time.process_time()
        value, count = run(members, coordinates, start)
        seconds = time.process_time() - began
        best = min(best, float(np.min(value)))
        lines.append((run.__name__, value, count, seconds, first))
    print()
    for name, value, count, seconds, first in lines:
        above = ", ".join(f"{x:.4f}" for x in value - best)
        print(
            f"{name:<12} {seconds:6.1f} s ({first:.1f} s at first), evaluations or steps "
            f"{np.asarray(count).tolist()}, cost above the best {above}"
        )
    assert np.max(lines[0][1] - best) < 5e-3
