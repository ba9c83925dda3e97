"""Betaflight's proposed ADRC around the simulated quads of `throttle_flights`, in NumPy alone.

Written from the difference equations, without jaxquad: gyro and its first filter at 8 kHz, the
rest of the chain and the law at 4 kHz. All loops run side by side.
"""

from typing import NamedTuple

import numpy as np
from throttle_flights import notch, RATE, Truth


DT = 2 / RATE  # of the law
_DEGREES = 180 / np.pi
_LOWPASS = 1.553773974 * 150.0  # Hz, of each half of adrc_gyro_lpf_hz
_LEAK = 0.3  # 1/s
STATES = 16 + 12


class Design(NamedTuple):
    """A value per loop."""

    wc: np.ndarray  # rad/s
    wo: np.ndarray  # rad/s
    b0: np.ndarray  # deg/s^3 per pidsum, at the throttle in question


def scale(throttle, hover: float, power: float = 0.5):
    """Of b0 over the throttle."""
    return np.clip((throttle / hover) ** power, 1.0, 3.0)


def _pt1(hertz: float, rate: float) -> float:
    return 1 - 1 / (1 + 2 * np.pi * hertz / rate)


def period(state: np.ndarray, setpoint, push, truth: Truth, throttle, design: Design) -> np.ndarray:
    """The states of all loops two samples of the gyro later; the last axis counts the loops.

    16 commands that the ESCs delay; motors, rate in rad/s, first filter; notch; second filter; the
    halves of the observer's low-pass; z1, z2, z3; command. `push` is added to what the ESCs get.
    """
    sent = list(state[:16])
    spin, rate, x1, s0, s1, x2, l1, l2, z1, z2, z3, command = state[16:]
    share = 1 - np.exp(-1 / (RATE * truth.lag))
    slope = truth.gain(throttle) / 1000
    for _ in range(2):
        sent = [command + push, *sent[:15]]
        late = np.choose(truth.delay, sent)
        spin = spin + share * (late - spin)
        rate = rate + slope * spin / RATE
        x1 = x1 + _pt1(500, RATE) * (_DEGREES * rate - x1)
    b0, b1, b2, _, a1, a2 = notch(190.0, 3.0, RATE / 2)
    y = b0 * x1 + s0
    s0, s1 = b1 * x1 - a1 * y + s1, b2 * x1 - a2 * y
    x2 = x2 + _pt1(350, RATE / 2) * (y - x2)
    half = _pt1(_LOWPASS, RATE / 2)
    l1 = l1 + half * (x2 - l1)
    l2 = l2 + half * (l1 - l2)
    wc, wo, b = design
    error = z1 - l2
    z1, z2, z3 = (
        z1 + DT * (z2 - 3 * wo * error),
        z2 + DT * (z3 + b * command - 3 * wo**2 * error),
        z3 - DT * (_LEAK * z3 + wo**3 * error),
    )
    command = (wc**2 * (setpoint - z1) - 2 * wc * z2 - z3) / b
    return np.stack([*sent, spin, rate, x1, s0, s1, x2, l1, l2, z1, z2, z3, command])


def matrices(truth: Truth, throttle, design: Design) -> np.ndarray:
    """A, and what the set-point and a push on the command add, (loops, states, states + 2)."""
    n, found = truth.slope.size, []
    for each in np.eye(STATES + 2):
        state, setpoint, push = np.tile(each[:STATES, None], n), each[STATES], each[STATES + 1]
        found.append(period(state, setpoint, push, truth, throttle, design))
    return np.moveaxis(np.array(found), (0, 1, 2), (2, 1, 0))


class Observer:
    """The law in flight, for `throttle_flights.fly`; `design` has b0 at hover."""

    def __init__(self, design: Design, hover: float, power: float = 0.5):
        self.design, self.hover, self.power = design, hover, power
        self.state = np.zeros((6, *np.shape(design.wc)))

    def __call__(self, y: np.ndarray, setpoint: np.ndarray, throttle: np.ndarray) -> np.ndarray:
        l1, l2, z1, z2, z3, command = self.state
        half = _pt1(_LOWPASS, RATE / 2)
        l1 = l1 + half * (y - l1)
        l2 = l2 + half * (l1 - l2)
        wc, wo, b0 = self.design
        b = b0 * scale(throttle, self.hover, self.power)
        error = z1 - l2
        z1, z2, z3 = (
            z1 + DT * (z2 - 3 * wo * error),
            z2 + DT * (z3 + b * command - 3 * wo**2 * error),
            z3 - DT * (_LEAK * z3 + wo**3 * error),
        )
        command = np.clip((wc**2 * (setpoint - z1) - 2 * wc * z2 - z3) / b, -500, 500)
        self.state = np.stack([l1, l2, z1, z2, z3, command])
        return command


class Found(NamedTuple):
    """A value per loop."""

    stable: np.ndarray  # all eigenvalues within the unit circle
    peak: np.ndarray  # greatest |S|
    resonance: np.ndarray  # greatest |response| from set-point to rate
    bandwidth: np.ndarray  # Hz, where that response is -3 dB
    settling: np.ndarray  # s, of a step of the set-point to 5 %; nan after half a second
    sag: np.ndarray  # largest rate after a step of angular acceleration, rad/s per rad/s^2


def judge(truth: Truth, throttle, design: Design) -> Found:
    """What the loops are."""
    whole = matrices(truth, throttle, design)
    a, by_setpoint = whole[:, :, :STATES], whole[:, :, STATES]
    stable = np.abs(np.linalg.eigvals(a)).max(axis=1) < 1
    omega = np.geomspace(0.5, 0.999 * np.pi / DT, 500)
    peak, closed = np.zeros(stable.size), np.zeros((omega.size, stable.size))
    for k, w in enumerate(omega):
        x = np.linalg.solve(np.exp(1j * w * DT) * np.eye(STATES) - a, whole[:, :, STATES:])
        peak = np.maximum(peak, np.abs(1 + x[:, -1, 1]))  # S from a push to what the ESCs get
        closed[k] = np.abs(x[:, 17, 0]) * _DEGREES
    resonance = closed.max(axis=0)
    wide = np.array([omega[np.flatnonzero(c < np.sqrt(0.5))[0]] for c in closed.T]) / (2 * np.pi)
    return Found(stable, peak, resonance, wide, *_in_time(a, by_setpoint))


def _in_time(a: np.ndarray, by_setpoint: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Settling after a step of the set-point, and the sag after a step of acceleration."""
    steps = round(0.5 / DT)
    stepped, pushed = np.zeros((2, len(a), STATES))
    push = np.zeros(STATES)
    push[17] = DT
    rates, sag = np.zeros((steps, len(a))), np.zeros(len(a))
    for k in range(steps):
        stepped = np.einsum("nij,nj->ni", a, stepped) + by_setpoint
        pushed = np.einsum("nij,nj->ni", a, pushed) + push
        rates[k] = stepped[:, 17] * _DEGREES
        sag = np.maximum(sag, np.abs(pushed[:, 17]))
    beyond = np.abs(rates - 1) > 0.05
    last = steps - 1 - np.argmax(beyond[::-1], axis=0)
    return np.where(last >= steps - 1, np.nan, (last + 1) * DT), sag
