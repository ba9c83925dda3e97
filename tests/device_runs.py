"""The same ensembles on one device and on two: a program, whose last line is what it found.

python tests/device_runs.py
"""

import json
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxquad.control import LADRC, PD
from jaxquad.loops import Loop
from jaxquad.models import DecoupledAxes
from jaxquad.simulation import (
    devices_for,
    evaluate,
    over_devices,
    Pulse,
    Saturation,
    scenario,
    simulate,
    Step,
    WhiteNoise,
)


MEMBERS, SAMPLES = 67, 120  # no multiple of two
INERTIA = 0.0552 * np.geomspace(0.5, 2.0, MEMBERS)[None]
OPTIONS = {"delay": np.linspace(0.0, 0.0081, MEMBERS), "longest_delay": 0.0081, "bound": 0.062}


def happens(members: Any = MEMBERS):
    return scenario(
        duration=SAMPLES * 0.002,
        axes=1,
        reference={0: Step(np.radians(4.0))},
        disturbance={0: Pulse(0.1, width=0.1, at=0.1)},
        noise=WhiteNoise(np.radians(0.02)),
        ensemble=members,
        key=jax.random.key(3),
    )


def plant(inertia=INERTIA):
    return DecoupledAxes([0.0468], inertia)


def one_axis(run, devices, b0=0.0468 / INERTIA):
    """Some members leave the bound."""
    controller, drive = LADRC([10.0], [30.0], b0), Saturation([20.0])
    return run(Loop(plant(), controller, drive=drive, **OPTIONS), happens(), devices=devices)


def cost(gains, devices):
    """Of gains that the members share, and of the inertia that each has for itself."""
    shared, inertia = gains
    controller = PD(shared[:1], shared[1:])
    found = evaluate(Loop(plant(inertia), controller), happens(), devices=devices)
    return jnp.mean(found.itae) + jnp.mean(found.rms)


def apart(found, expected):
    """The largest difference, relative to the largest number of an array."""
    worst = 0.0
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        x, y = np.asarray(x, float), np.asarray(y, float)
        there = np.isfinite(y)
        np.testing.assert_array_equal(x[~there], y[~there])
        scale = np.max(np.abs(y[there]), initial=0.0) or 1.0
        worst = max(worst, np.max(np.abs(x[there] - y[there]), initial=0.0) / scale)
    return worst


def noisy(own, gains):
    """Each member draws its own noise; whether it knows that it is on one device already."""
    inertia, keys = own
    noise = jax.vmap(lambda key: jax.random.normal(key, (SAMPLES,)), out_axes=-1)(keys)
    step = lambda x, w: (x - (gains[0] * x + gains[1] * w) / inertia,) * 2
    track = jax.lax.scan(step, jnp.ones_like(inertia), noise)[1]
    alone = not devices_for(MEMBERS, None)
    return jnp.mean(track**2, axis=0), jnp.full(inertia.shape, alone)


def drawn(gains, devices):
    own = (jnp.linspace(1.0, 2.0, MEMBERS), jax.random.split(jax.random.key(5), MEMBERS))
    costs, alone = over_devices(noisy, own, gains, devices=devices)
    return jnp.sum(costs), alone.all()


def kernels(devices):
    """Whether the loop of each device is one kernel."""
    loop = (Loop(plant(), LADRC([10.0], [30.0], [0.85])), happens())
    run = eqx.filter_jit(lambda loop, happens: evaluate(loop, happens, devices=devices))
    return "xla_cpu_small_call" in run.lower(*loop).as_text()


def by_hand(inertia):
    """Of data that lie where they were put."""
    return evaluate(Loop(plant(inertia), PD([40.0], [10.0])), happens(inertia.shape[-1]))


def lies(tree):
    """On which devices, and whether for good."""
    arrays = jax.tree.leaves(tree)
    return sorted({d.id for x in arrays for d in x.devices()}), any(x.committed for x in arrays)


def main():
    one, two = jax.local_devices()
    shared, inertia = jnp.asarray([0.4, 0.1]), jnp.asarray(INERTIA)
    slope = jax.jit(jax.grad(cost), static_argnums=1)
    gains = (100 * shared, inertia)
    of_drawn = jax.jit(jax.value_and_grad(drawn, has_aux=True), static_argnums=1)
    drawn_by_two = of_drawn(shared, 2)
    both = one_axis(evaluate, None)
    found = {
        "evaluate": apart(both, one_axis(evaluate, 1)),
        "simulate": apart(one_axis(simulate, 2), one_axis(simulate, 1)),
        "gradient": apart(slope(gains, 2), slope(gains, 1)),
        "gradient of a cost of one's own": apart(drawn_by_two[1], of_drawn(shared, 1)[1]),
        "alone within": bool(drawn_by_two[0][1]),
        "diverged": int(np.sum(both.diverged)),
        "results lie on": lies(both),
        "those of data put by hand lie on": lies(by_hand(jax.device_put(inertia, two))),
        "those of split data lie on": lies(by_hand(in_two(inertia))),
        "kernels": kernels((one, two)),
        "devices for 63": len(devices_for(63, None)),
        "devices for 64": len(devices_for(64, None)),
    }
    print(json.dumps(found))


def in_two(x):
    mesh = Mesh(np.array(jax.local_devices()), ("members",))
    both = jnp.concatenate([x, x], axis=1)
    return jax.device_put(both, NamedSharding(mesh, PartitionSpec(None, "members")))


if __name__ == "__main__":
    main()
