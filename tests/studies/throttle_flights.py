"""Simulated flights of a 5-inch quad over three throttles, in NumPy alone: roll, 30 s each.

Written from the equations of the firmware's loop, without jaxquad. All flights run side by side.
The gyro and its filter run at 8 kHz, the rest of the chain and the PID at 4 kHz; the motors, the
thrust curve and the delay of the ESCs at 8 kHz. A chirp on the set-point runs at each throttle.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


RATE = 8000  # Hz, of the gyro
SECONDS = 30
THROTTLES = (0.28, 0.45, 0.62)
_DEGREES = 180 / np.pi


class Truth(NamedTuple):
    """A value per flight."""

    slope: np.ndarray  # K at full thrust slope: K(x) = slope (1 - f + 2 f x), rad/s^2 per 1000
    curve: np.ndarray  # f
    lag: np.ndarray  # s
    delay: np.ndarray  # samples at 8 kHz

    def gain(self, throttle):
        """K in rad/s^2 per 1000 units of pidsum."""
        return self.slope * (1 - self.curve + 2 * self.curve * throttle)

    def b0(self, throttle):
        """In deg/s^3 per unit of pidsum."""
        return _DEGREES * self.gain(throttle) / (1000 * self.lag)


class Flights(NamedTuple):
    """What a blackbox would hold, (samples, flights) each."""

    time: np.ndarray  # s
    setpoint: np.ndarray  # deg/s
    gyro: np.ndarray  # deg/s, filtered
    command: np.ndarray  # pidsum
    throttle: np.ndarray  # 0 to 1


def draw(rng: np.random.Generator, flights: int) -> Truth:
    """Quads that differ by a tenth or so."""
    return Truth(
        rng.uniform(1200, 1700, flights),
        rng.uniform(0.35, 0.75, flights),
        rng.uniform(0.018, 0.035, flights),
        rng.integers(6, 14, flights),
    )


Law = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def fly(
    truth: Truth, rng: np.random.Generator, log_rate: int = 1000, law: Law | None = None
) -> Flights:
    """Fly all of them, and log without an anti-aliasing filter, as a blackbox does.

    `law` takes the filtered gyro, the set-point and the throttle at 4 kHz and gives the command;
    None is the PID.
    """
    n, dt, steps = truth.slope.size, 1 / RATE, RATE * SECONDS
    throttle = _throttle(rng, n)
    setpoint = _chirps(rng, n)
    pt1 = lambda hertz, rate: 1 - 1 / (1 + 2 * np.pi * hertz / rate)
    k_gyro, k_slow, k_d = pt1(500, RATE), pt1(350, RATE / 2), (pt1(105, 4000), pt1(150, 4000))
    section = notch(190.0, 3.0, RATE / 2)
    share = 1 - np.exp(-dt / truth.lag)
    rate, spin, x1, x2, integral, d1, d2, before = (np.zeros(n) for _ in range(8))
    state = np.zeros((2, n))
    level, gust, command = throttle[0].copy(), np.zeros(n), np.zeros(n)
    sent = np.zeros((16, n))  # what the ESCs still delay
    columns = np.arange(n)
    phases = rng.uniform(0, 2 * np.pi, (4, n))
    spread = rng.uniform(0.96, 1.04, (2, n))
    every = RATE // log_rate
    logged = np.zeros((3, steps // every, n), np.float32)
    for k in range(steps):
        if k % 400 == 0:  # the throttle moves slowly
            x = throttle[k // 400]
            hertz = 2 * np.pi * dt * (90 + 260 * np.sqrt(x)) * spread
        if k % 16 == 0:
            noise = rng.standard_normal((16, n)) * 0.6
            pushes = rng.standard_normal(n)
        sent[k % 16] = command
        spin += share * (sent[(k - truth.delay) % 16, columns] - spin)
        level += share * (x - level)
        gust += dt * (25 * pushes * np.sqrt(500.0) - 6 * gust)  # rad/s^2
        slope = truth.slope * (1 - truth.curve + 2 * truth.curve * level)
        rate += dt * (slope * spin / 1000 + gust)
        phases[:2] += hertz
        phases[2:] = 2 * phases[:2]
        shake = 6.0 * np.sin(phases[0]) + 6.0 * np.sin(phases[1]) + np.sin(phases[2:]).sum(0) * 2.0
        x1 += k_gyro * (_DEGREES * rate + noise[k % 16] + shake - x1)
        if k % 2:
            continue
        y = section[0] * x1 + state[0]
        state[0] = section[1] * x1 - section[4] * y + state[1]
        state[1] = section[2] * x1 - section[5] * y
        x2 += k_slow * (y - x2)
        d1 += k_d[0] * (x2 - d1)
        d2 += k_d[1] * (d1 - d2)
        r = setpoint[k // 2]
        if law is None:
            error = r - x2
            integral = np.clip(integral + 0.244381 * 80 / 4000 * error, -400, 400)
            total = 0.032029 * 45 * error + integral - 0.000529 * 30 * (d2 - before) * 4000
            before = d2.copy()
        else:
            total = law(x2, r, x)
        command = np.clip(total, -500, 500)
        if k % every == 0:
            logged[:, k // every] = np.round(r), np.round(x2), np.round(command)
    stamps = np.arange(steps // every) / log_rate
    gas = np.repeat(throttle, 400 // every, axis=0)[: stamps.size]
    return Flights(stamps, logged[0], logged[1], logged[2], np.round(gas, 3))


def _throttle(rng, n) -> np.ndarray:
    """Every 0.05 s: three levels of 10 s, each with a hand that wanders by 1 %."""
    parts = SECONDS * 20
    hand = np.zeros((parts, n))
    for k in range(1, parts):
        hand[k] = 0.98 * hand[k - 1] + 0.002 * rng.standard_normal(n)
    middle = np.array(THROTTLES)[:, None] + rng.uniform(-0.03, 0.03, (3, n))
    return np.repeat(middle, parts // 3, axis=0) + hand


def _chirps(rng, n) -> np.ndarray:
    """Set-points at 4 kHz in deg/s: at each throttle 9 s from 1 to 50 Hz after 0.6 s of rest."""
    length = SECONDS * 4000 // 3
    time = np.arange(length) / 4000 - 0.6
    inside = (time >= 0) & (time < 9.0)
    ratio = np.log(50.0)
    phase = 2 * np.pi * 9.0 / ratio * (np.exp(ratio * np.clip(time, 0, 9.0) / 9.0) - 1)
    one = np.where(inside, np.sin(phase), 0.0)[:, None]
    amplitude = rng.uniform(60, 110, (3, 1, n))
    return np.concatenate([one * each for each in amplitude]).astype(np.float32)


def notch(centre, quality, rate) -> np.ndarray:
    """b0, b1, b2, a0, a1, a2 of the cookbook's notch, a0 = 1."""
    w = 2 * np.pi * centre / rate
    alpha, c = np.sin(w) / (2 * quality), np.cos(w)
    return np.array([1, -2 * c, 1, 1 + alpha, -2 * c, 1 - alpha]) / (1 + alpha)


def direct_least_squares(flights: Flights, k: int, part: slice, band: tuple[float, float]) -> float:
    """b0 as a regression of y'' on u in a band (Hz) of the raw signals gives it."""
    from scipy import signal

    dt = flights.time[1] - flights.time[0]
    y, u = (each[part, k].astype(float) for each in (flights.gyro, flights.command))
    second = np.gradient(np.gradient(y, dt), dt)
    passed = signal.butter(2, band, "bandpass", fs=1 / dt, output="sos")
    a, b = (signal.sosfiltfilt(passed, each)[200:-200] for each in (second, u))
    return float(a @ b / (b @ b))
