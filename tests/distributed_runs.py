"""One process of two that compute an ensemble together; see test_distributed.

python tests/distributed_runs.py 0 localhost:12345
"""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np

from jaxquad.control import PD
from jaxquad.loops import Loop
from jaxquad.models import DecoupledAxes
from jaxquad.simulation import evaluate, scenario, Step, WhiteNoise


MEMBERS, GAINS = 7, (40.0, 8.0)  # no multiple of two
INERTIA = 0.0552 * np.geomspace(0.5, 2.0, MEMBERS)[None]


def itae(devices, gains=GAINS, inertia=INERTIA):
    happens = scenario(
        duration=0.2,
        axes=1,
        reference={0: Step(0.07)},
        noise=WhiteNoise(1e-4),
        ensemble=MEMBERS,
        key=jax.random.key(1),
    )
    plant, controller = DecoupledAxes([0.0468], inertia), PD([gains[0]], [gains[1]])
    return evaluate(Loop(plant, controller), happens, devices=devices)


def cost(gains, devices):
    return jnp.mean(itae(devices, gains).itae)


SLOPE = jax.jit(jax.grad(cost), static_argnums=1)


def refused(process):
    """What is said of an ensemble that differs from process to process."""
    try:
        itae(jax.devices(), inertia=(1 + process) * INERTIA)
    except ValueError as error:
        return str(error)
    return ""


def main(process, address):
    jax.distributed.initialize(address, num_processes=2, process_id=process)
    everyone = tuple(jax.devices())
    together = itae(everyone)
    found = {
        "devices": len(everyone),
        "members": together.summary().members,
        "mean": np.asarray(together.summary().itae.mean).tolist(),
        "itae": np.asarray(together.itae).tolist(),
        "gradient": np.asarray(SLOPE(jnp.asarray(GAINS), everyone)).tolist(),
        "refused": refused(process),
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
