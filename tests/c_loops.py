"""Loops about a controller's C header and about its step in JAX, from the same equations."""

import ctypes
import functools as ft
import subprocess
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxquad.control import (
    BackCalculation,
    certainty_equivalence,
    EulerObserver,
    LADRC,
    PID,
    PredictiveObserver,
    ScheduledLADRC,
    ScheduledPID,
    Setpoint,
)
from jaxquad.export import write_c_header


AXES, DT, SAMPLES = 3, 0.002, 2500
NOMINAL = jnp.array([1.1, 1.25, 0.9])  # inertia per torque of a unit of command
MAP = certainty_equivalence(1.0, NOMINAL)
STRICT = ["-Wall", "-Wextra", "-Werror", "-pedantic", "-Wshadow", "-Wconversion"]
LIMIT = [3.0, 3.6, 2.7]

# All per axis: what XLA makes of a scalar, as x / b0 into x (1 / b0), rounds differently.
WC, WO, B0, HALF = [4.0, 3.0, 5.0], [25.0, 20.0, 30.0], [0.9, 0.8, 1.1], [0.5, 0.5, 0.5]
REST: dict[str, Any] = dict(b0=B0, limit=LIMIT)
LADRCS = {
    "LADRC": LADRC(WC, WO, **REST),
    "half gain": LADRC(WC, WO, feedback_factor=HALF, observer_factor=HALF, **REST),
    "predictive": LADRC(WC, WO, observer=PredictiveObserver(), **REST),
    "Euler": LADRC(WC, WO, observer=EulerObserver(), placement="continuous", **REST),
    "order 1": LADRC(WC, WO, order=1, **REST),
    "order 1, predictive": LADRC(WC, WO, observer=PredictiveObserver(), order=1, **REST),
    "order 1, Euler": LADRC(WC, WO, observer=EulerObserver(), order=1, **REST),
}
KP, KI, KD = [14.0, 12.0, 10.0], [9.0, 7.0, 8.0], [7.0, 6.0, 5.0]
WEIGHTS: dict[str, Any] = dict(
    proportional_weight=[0.7, 0.8, 1.0], derivative_weight=[0.3, 0.0, 0.5]
)
PIDS = {
    "PID": PID(KP, KI, KD, filter=[60.0, 90, 125], feedforward=B0, limit=LIMIT, **WEIGHTS),
    "unbounded": PID(KP, KI, KD, filter=[40.0] * 3, limit=[4.0, np.inf, 3.0], anti_windup=None),
    "filtered": PID(
        KP, KI, KD, filter=[60.0, 90, 125], measurement_filter=[50.0, 70, 90],
        feedforward=[1.0, 0.75, 1.25], limit=LIMIT,
        anti_windup=BackCalculation([0.3, 0.4, 0.5]), **WEIGHTS,
    ),
}  # fmt: skip
SCHEDULED = {
    "scheduled LADRC": ScheduledLADRC(LADRCS["LADRC"], MAP),
    "scheduled Euler": ScheduledLADRC(LADRCS["Euler"], MAP),
    "scheduled PID": ScheduledPID(PIDS["filtered"], MAP),
}

LAWS: dict[str, Any] = LADRCS | PIDS | SCHEDULED

_DRIVER = """
#include "law.h"
typedef struct {
    REAL reference[3], rate[3], acceleration[3], noise[3], load[3], inertia[3];
} sample;
void run(int samples, const sample *now, REAL (*command)[3], REAL (*b0)[3])
{
    law_state state;
    REAL angle[3] = {HALF, HALF, HALF}, rate[3] = {0, 0, 0}, measurement[3], given[3];
    START
    for (int k = 0; k < samples; ++k) {
        for (int j = 0; j < 3; ++j) measurement[j] = angle[j] + now[k].noise[j];
        TOLD
        law_step(&state, now[k].reference, AHEAD, measurement, command[k]);
        for (int j = 0; j < 3; ++j) {
            given[j] = SHARE * command[k][j];
            const REAL push = LAW_DT * ((now[k].load[j] + given[j]) / now[k].inertia[j]);
            angle[j] += ORDER == 1 ? push : LAW_DT * (rate[j] + HALF * push);
            rate[j] += push;
        }
        APPLIED
    }
}
"""


_TOLD = """law_schedule(&state, now[k].inertia);
        for (int j = 0; j < 3; ++j) b0[k][j] = state.b0[j];"""


class Flight(NamedTuple):
    """How the loop is closed."""

    ahead: bool = True  # with the set-point's derivatives
    told: bool = False  # the inertia
    share: float = 1.0  # of the command that the drive gives, applied unless 1
    order: int = 2  # of the plant


@ft.cache
def signals():
    """Set-point with derivatives, noise, load torque in units of the command, and inertia/KT."""
    time, axis = DT * np.arange(SAMPLES)[:, None], np.arange(AXES)
    slow = 1.5 + axis
    reference = 1.0 * (time > 0.1) - 0.8 * (time > 2.5) + 0.1 * np.sin(slow * time)
    rate, acceleration = 0.1 * slow * np.cos(slow * time), -0.1 * slow**2 * np.sin(slow * time)
    noise = 3e-4 * np.random.default_rng(0).standard_normal((SAMPLES, AXES))
    load = 0.5 * (time > 1.5) + 0 * axis
    inertia = np.asarray(NOMINAL) * (1 + 0.2 * np.floor(time / 0.5) / (1 + axis))
    return np.stack([reference, rate, acceleration, noise, load, inertia])


PLAIN = Flight()


def in_c(tmp_path, controller, precision, *flags, flight=PLAIN):
    """Commands and b0 in a loop about the header, in its arithmetic, [2, samples, axes]."""
    kind, f = (np.float32, "f") if precision == "float" else (np.float64, "")
    write_c_header(tmp_path / "law.h", controller, name="law", precision=precision, axes=AXES)
    begins = "law_init_at" in (tmp_path / "law.h").read_text()
    words = {
        "START": "law_init_at(&state, angle);" if begins else "law_init(&state);",
        "TOLD": _TOLD if flight.told else "(void)b0;",
        "AHEAD": "now[k].rate, now[k].acceleration" if flight.ahead else "0, 0",
        "APPLIED": "law_applied(&state, given);" if flight.share != 1 else "",
        "SHARE": f"{flight.share}{f}", "HALF": f"0.5{f}", "ORDER": str(flight.order),
        "REAL": precision,
    }  # fmt: skip
    text = ft.reduce(lambda text, word: text.replace(*word), words.items(), _DRIVER)
    (tmp_path / "law.c").write_text(text)
    library = tmp_path / f"law{''.join(flags)}.so"
    command = ["gcc", "-std=c99", *STRICT, "-O2", *flags, "-shared", "-fPIC", "law.c"]
    subprocess.run([*command, "-o", library, "-lm"], cwd=tmp_path, check=True)
    now = np.ascontiguousarray(np.moveaxis(signals(), 0, 1).astype(kind))
    found = np.zeros((2, SAMPLES, AXES), kind)
    arrays = (ctypes.c_void_p(x.ctypes.data) for x in (now, *found))
    ctypes.CDLL(str(library)).run(SAMPLES, *arrays)
    return found


@ft.cache
def in_jax(name, precision, *, flight=PLAIN, fused=False, b0=None):
    """The commands in the same loop about `step`, with the bytes of the `b0` that it is told.

    In float every operation rounds, unless `fused`: XLA contracts products and sums of a fused
    loop, and in float32 that alone moves the command by 1e-5 of its scale.
    """
    kind = jnp.float32 if precision == "float" else jnp.float64
    arrays, rest = eqx.partition(LAWS[name], eqx.is_array)
    options = None if fused or precision == "double" else {"xla_disable_hlo_passes": "fusion"}
    run = lambda x, now: _scan(eqx.combine(x, rest), now, flight)
    more = 0 * signals()[0] if b0 is None else np.frombuffer(b0, kind).reshape(SAMPLES, AXES)
    now = jnp.asarray(np.concatenate([signals(), more[None]])).astype(kind)
    return np.asarray(jax.jit(run, compiler_options=options)(arrays, now))


def _scan(controller, now, flight):
    law = controller.scheduled_at(NOMINAL) if flight.told else controller.prepared()

    def sample(carry, now):
        state, angle, rate = carry
        reference, measurement = Setpoint(*now[:3]) if flight.ahead else now[0], angle + now[3]
        if isinstance(controller, ScheduledLADRC):
            state, command = law.step_with(state, reference, measurement, now[6])
        else:
            here: Any = ScheduledPID(controller.pid, lambda _: now[6]) if flight.told else law
            here = here.scheduled_at(now[5]) if flight.told else here
            state, command = here.step(state, reference, measurement)
        given = flight.share * command
        push = DT * ((now[4] + given) / now[5])
        angle = angle + (push if flight.order == 1 else DT * (rate + 0.5 * push))
        state = law.applied(state, given) if flight.share != 1 else state
        return (state, angle, rate + push), command

    zero = jnp.zeros(AXES, now.dtype)
    start = law.init(zero, zero + 0.5), zero + 0.5, zero
    return jax.lax.scan(sample, start, jnp.moveaxis(now, 0, 1))[1]
