"""The loop of `baselines/adaptive_loop` on our ensemble engine, beside its AVX-512 form.

Three Euler angles, three rates and four rotors under three adaptive LADRC: an extended state
observer, an estimate of the inertia from filtered rates and torques, and a map of it to b0. Every
quantity is an array [members], which XLA turns into the fewest and plainest loops.
"""

import functools as ft
import importlib
import os
import pathlib
import shutil
import sys
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxquad.models import sincos
from jaxquad.simulation import run_ensemble, runge_kutta


HERE = pathlib.Path(__file__).parents[2]
FOLDER = pathlib.Path(os.environ.get("JAXQUAD_BASELINES", HERE / "../shared/baselines"))
DT, REFERENCE = 0.002, 4.0 * 3.14159265 / 180
ARM, THRUST, DRAG, ROTOR, LAG = 0.197, 2.0e-6, 4.0e-8, 6e-5, 0.05
INERTIA, DAMPING = (0.0552, 0.0552, 0.110), (0.008, 0.008, 0.009)
HOVER, SLOWEST, FASTEST = 900.0, 100.0, 1600.0  # rad/s
FILTER, FORGET, KNOTS = 20.0, 1 - DT / 0.5, (0.5, 0.25)


class Axis(NamedTuple):
    """What one LADRC remembers."""

    z1: Any
    z2: Any
    z3: Any
    rate: Any  # filtered
    torque: Any  # filtered
    cross: Any  # sums of the least squares
    square: Any
    command: Any


class State(NamedTuple):
    body: tuple[Any, ...]  # three angles, three rates, four rotors
    axes: tuple[Axis, ...]
    cost: Any


def start(members: int, dtype: Any) -> State:
    full = lambda value: jnp.full(members, value, dtype)
    body = (*map(full, [0.01745] * 3 + [0.0] * 3 + [HOVER] * 4),)
    axis = Axis(*map(full, [0.01745, 0.0, 0.0, 0.0, 0.0, 0.0, 1e-3, 0.0]))
    return State(body, (axis,) * 3, full(0.0))


@jax.custom_jvp
def over(x: Any) -> Any:
    """1 / x, whose derivative needs no second division."""
    return 1 / x


@over.defjvp
def _over_jvp(primals, tangents):
    inverse = over(primals[0])
    return inverse, -inverse * inverse * tangents[0]


def slopes(body: Any, asked: Any, inertia: Any, load: Any) -> Any:
    phi, theta, _, p, q, r, *rotors = body
    (s_phi, c_phi), (s_theta, c_theta) = sincos(phi), sincos(theta)
    heading = (q * s_phi + r * c_phi) * over(c_theta)
    jx, jy, jz, *inverse = inertia
    w1, w2, w3, w4 = (w * w for w in rotors)
    spin = ROTOR * ((rotors[0] + rotors[2]) - (rotors[1] + rotors[3]))
    roll = ARM * THRUST * (w4 - w2) - spin * q + (jy - jz) * (q * r)
    pitch = ARM * THRUST * (w1 - w3) + spin * p + (jz - jx) * (p * r)
    yaw = DRAG * ((w1 + w3) - (w2 + w4)) + (jx - jy) * (p * q)
    torques = zip((roll, pitch, yaw), DAMPING, (p, q, r), load, inverse, strict=True)
    turning = [(torque - k * rate + d) * j for torque, k, rate, d, j in torques]
    lags = [(to - w) * (1 / LAG) for to, w in zip(asked, rotors, strict=True)]
    return (p + heading * s_theta, q * c_phi - r * s_phi, heading, *turning, *lags)


def between(low: float, x: Any, high: float) -> Any:
    # Unlike `jnp.clip`'s, its derivative divides by nothing where the limits are met.
    return jax.lax.clamp(jnp.asarray(low, x.dtype), x, jnp.asarray(high, x.dtype))


def b0_of(share: Any, knots: Any) -> Any:
    """Piecewise linear in the estimated share of the nominal inertia."""
    x = between(0.0, (share - KNOTS[0]) * (1 / KNOTS[1]), 7.0)
    parts = [(knots[k + 1] - knots[k]) * between(0.0, x - k, 1.0) for k in range(7)]
    return knots[0] + ft.reduce(jnp.add, parts)


def control(k: int, axis: Axis, angle: Any, rate: Any, tuning: Any) -> tuple[Axis, Any]:
    wc, wo, nominal = tuning[k // 2], tuning[2 + k // 2], INERTIA[k]
    slope = FILTER * (rate - axis.rate)
    filtered = axis.rate + DT * slope
    torque = axis.torque + DT * FILTER * (axis.command - axis.torque)
    cross = FORGET * axis.cross + DT * ((nominal * slope - torque) * slope)
    square = FORGET * axis.square + DT * (slope * slope)
    share = (nominal - cross * over(square + 1e-6)) * (1 / nominal)
    b0 = b0_of(share, tuning[4:]) * (1 / nominal)
    error = angle - axis.z1
    z1 = axis.z1 + DT * axis.z2 + 3 * DT * wo * error
    z2 = axis.z2 + DT * axis.z3 + 3 * DT * wo * wo * error + DT * (b0 * axis.command)
    z3 = axis.z3 + DT * wo * wo * wo * error
    command = (wc * wc * (REFERENCE - z1) - 2 * wc * z2 - z3) * over(b0)
    command = between(-0.6, command, 0.6)
    cost = DT * ((REFERENCE - angle) ** 2 + 1e-3 * command * command)
    return Axis(z1, z2, z3, filtered, torque, cross, square, command), cost


def mixed(commands: Any) -> Any:
    gains = [1 / (2 * ARM * THRUST)] * 2 + [1 / (4 * DRAG)]
    x, y, z = (u * gain for u, gain in zip(commands, gains, strict=True))
    squares = HOVER**2 + y + z, HOVER**2 - x - z, HOVER**2 - y + z, HOVER**2 + x - z
    return [jnp.sqrt(between(SLOWEST**2, w, FASTEST**2)) for w in squares]


def step(state: State, parts: Any, load: Any) -> tuple[State, None]:
    tuning, inertia = parts
    body = state.body
    told = [control(k, state.axes[k], body[k], body[3 + k], tuning) for k in range(3)]
    axes, costs = zip(*told, strict=True)
    asked = mixed([axis.command for axis in axes])
    moved = runge_kutta(lambda body: slopes(body, asked, inertia, load), body, DT)
    return State(moved, axes, state.cost + costs[0] + costs[1] + costs[2]), None


def costs(tuning: Any, inertia: Any, load: Any, chunk: int | None = 128) -> Any:
    """The cost [members] of 12 tuning parameters, inertias [3, members], torques [samples, 3]."""
    begin = start(inertia.shape[1], inertia.dtype)
    # One sum over the members at the end is cheaper to differentiate than one at every sample.
    tuning = jnp.broadcast_to(tuning[:, None], (12, inertia.shape[1]))
    parts = (tuple(tuning), (*inertia, *(1 / inertia)))
    own = (True, False)
    return run_ensemble(step, begin, parts, load, of_members=own, chunk=chunk)[0].cost


def plain(tuning: Any, inertia: Any, load: Any) -> Any:
    """The same by one scan: no kernel, no chunks, no blocks."""
    begin = start(inertia.shape[1], inertia.dtype)
    parts = (tuple(tuning), (*inertia, *(1 / inertia)))
    return jax.lax.scan(lambda state, now: step(state, parts, now), begin, load)[0].cost


class Baseline(NamedTuple):
    """The AVX-512 code, and the case it is timed with."""

    library: dict[str, Any]
    timing: Any  # the module that builds and calls it

    @property
    def tuning(self) -> Any:
        return np.array(self.timing.M.TUN0)

    def inertias(self, members: int) -> Any:
        return self.timing.inertias(members)

    def disturbance(self, steps: int) -> Any:
        return self.timing.disturbance(steps)

    def run(self, tuning: Any, inertia: Any, load: Any, dtype: str) -> Any:
        arrays = (np.asarray(x) for x in (inertia, load, tuning))
        return self.timing.simulate(self.library[dtype], *arrays, np.dtype(dtype))[0]


def baseline() -> Baseline | str:
    """The hand-written code, or why there is none."""
    folder = FOLDER / "adaptive_loop"
    cpu = pathlib.Path("/proc/cpuinfo")
    if not (folder / "run.py").is_file():
        return f"no {folder}/run.py: set JAXQUAD_BASELINES to the folder of the baselines"
    if shutil.which("g++") is None or "avx512dq" not in cpu.read_text():
        return "the hand-written code needs g++ and a CPU with AVX-512"
    sys.path.insert(0, str(folder))  # its files import each other
    timing = importlib.import_module("run")
    return Baseline({"float64": timing.build(True), "float32": timing.build(False)}, timing)
