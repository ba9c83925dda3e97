"""Bias, scatter, honest errors and coverage of the inertia estimators on the simulated rig.

    python tests/benchmarks/inertia_study.py --members 256

The roll axis with +-u on two motors (KT = 0.0468 N m/V) under LADRC(10, 30) with the paper's b0,
2 ms samples, an encoder of 8192 counts, a motor lag of 20 ms and a permanent probe of 0.3 V at
2 Hz; the estimators start from a nominal inertia that is 45 % too high. Estimates of the second
half of the flight, in per cent of the truth.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxquad.control import LockInInertia, ProbeTones, RecursiveInertia, WindowedInertia


sys.path.insert(0, str(Path(__file__).parent.parent))
from rig_records import DT, fly, INERTIA, RigRecord  # noqa: E402


jax.config.update("jax_enable_x64", True)

TORQUE_GAIN = 0.0468
NOISE = np.radians(0.02)
GUST = 0.005  # N m, corner 2 rad/s

CONDITIONS = {
    "encoder only": {},
    "noise 0.02 deg": {"noise": NOISE},
    "gust, noise": {"noise": NOISE, "gust": GUST},
    "0.3 N m sine, noise": {"noise": NOISE, "sine": 0.3},
    "sine, gust, noise": {"noise": NOISE, "gust": GUST, "sine": 0.3},
    "gust, noise, 1 V": {"noise": NOISE, "gust": GUST, "tones": ((1.0, 2.0),)},
}


def estimators() -> dict[str, Any]:
    make = (TORQUE_GAIN, 0.08)
    printed = {"bandwidth": 50.0, "order": 1, "nuisance": ()}
    return {
        "first-order filter, no terms": WindowedInertia(*make, window=1.0, **printed),
        "least squares, 1 s": WindowedInertia(*make, window=1.0),
        "least squares, 5 s": WindowedInertia(*make),
        "recursive, 3 s": RecursiveInertia(*make),
        "recursive, 10 rad/s": RecursiveInertia(*make, bandwidth=10.0),
        "lock-in, 5 s": LockInInertia(*make, tones=ProbeTones(above=0.0)),
        "lock-in, 10 s": LockInInertia(*make, window=10.0, tones=ProbeTones(above=0.0)),
    }


@eqx.filter_jit
def listen(estimator: Any, record: RigRecord, every: int = 250) -> Any:
    """The estimate each half second of the second half."""

    def hear(state, now):
        state = estimator.update(state, *now)
        return state, estimator.estimate(state)

    start = estimator.init(jnp.zeros_like(record.measurement[0]))
    found = jax.lax.scan(hear, start, record)[1]
    half = record.measurement.shape[0] // 2
    return jax.tree.map(lambda x: x[half::every, 0], found)


def row(name: str, found: Any) -> str:
    inertia, deviation, trusted = (np.asarray(x) for x in found)
    error, deviation = inertia / INERTIA - 1, deviation / INERTIA
    scatter = np.std(inertia, axis=1).mean() / INERTIA
    median = np.median(deviation)  # a few members in doubt would outweigh all others
    covered = np.mean(np.abs(error) < 1.96 * deviation)
    cells = "".join(f"{100 * x:>10.2f}" for x in (error.mean(), scatter, median))
    return f"  {name:<30}{cells}{100 * covered:>10.0f}{100 * trusted.mean():>10.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--members", type=int, default=256)
    parser.add_argument("--duration", type=float, default=30.0, help="s")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--b0", type=float, nargs="+", default=[0.848, 1.6, 3.0])
    options = parser.parse_args()
    columns = ("bias", "sd", "told sd", "95 % holds", "trusted")
    for b0 in options.b0:
        for name, condition in CONDITIONS.items():
            record = fly(
                duration=options.duration + 10 * DT, members=options.members, seed=options.seed,
                torque_gain=TORQUE_GAIN, b0=b0, **condition,
            )  # fmt: skip
            record = jax.tree.map(jnp.asarray, record)
            print(f"b0 = {b0}, {name}\n  {'':<30}" + "".join(f"{c:>10}" for c in columns))
            for label, estimator in estimators().items():
                print(row(label, listen(estimator, record)), flush=True)


if __name__ == "__main__":
    main()
