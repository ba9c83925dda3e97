"""Inertia estimators run over records of the rig, which rig_records makes by NumPy."""

import functools as ft
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from rig_records import DT, fly, INERTIA, RigRecord

from jaxquad.control import LockInInertia, ProbeTones, RecursiveInertia, WindowedInertia


GAIN = 0.0468  # N m/V, of a voltage +-u on both motors
PERMANENT = ProbeTones(above=0.0)
EXACT: dict[str, Any] = {
    "counted": False,
    "lag": 0.0,
    "torque_gain": GAIN,
    "members": 64,
}  # one shape for all
TONE = ((3.0, 2.0),)  # V, Hz
# The rig: gust, noise and lag as on the rig, with the paper's b0 after adaptation.
RIG: dict[str, Any] = {"noise": np.radians(0.02), "torque_gain": GAIN, "b0": 1.6}


@eqx.filter_jit
def listen(estimator, record: RigRecord):
    """The estimate after every sample."""

    def hear(state, now):
        state = estimator.update(state, *now)
        return state, estimator.estimate(state)

    record = jax.tree.map(jnp.asarray, record)
    start = estimator.init(jnp.zeros_like(record.measurement[0]))
    return jax.lax.scan(hear, start, record)[1]


def heard(estimator, record, *, since=0.0):
    """Inertia and deviation relative to the truth, and trust, of the one axis."""
    found = listen(estimator, record)
    inertia, deviation, trusted = (np.asarray(x)[round(since / DT) :, 0] for x in found)
    return inertia / INERTIA, deviation / INERTIA, trusted


def windowed(**options):
    return WindowedInertia(GAIN, 0.08, **options)


def recursive(**options):
    return RecursiveInertia(GAIN, 0.08, **options)


def lock_in(*, tones=PERMANENT, **options):
    return LockInInertia(GAIN, 0.08, tones, **options)


@ft.cache
def exact() -> RigRecord:
    """No encoder, noise or lag, but a constant torque."""
    return fly(duration=15.02, offset=0.1, tones=TONE, **EXACT)


@ft.cache
def gusty() -> RigRecord:
    """Gust 5 mN m, noise 0.02 deg, encoder, lag 20 ms, 0.3 V at 2 Hz; 64 members."""
    return fly(duration=15.02, members=64, gust=0.005, seed=1, **RIG)


@ft.cache
def swung() -> RigRecord:
    """The paper's disturbance, 0.3 N m in 5 s, on the counted angle."""
    return fly(duration=15.02, members=64, sine=0.3, seed=2, **RIG)
