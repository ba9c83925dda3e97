"""How often an actuator of two lags, and one of coarse steps, is remarked, and what is said of it.

    python tests/studies/two_lags.py --draws 20

Plants behind a motor with one lag while it speeds up and another while it slows down, or whose
command is rounded to steps, without feedback and under controllers, in gusts and with noisy
sensors. Integrated by Runge-Kutta in steps of a fifth of a sample, without the library. One table,
no file; seeds from 0.
"""

import argparse
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from systems import Chirp, coloured, multisine

import jaxquad as jq


jq.enable_x64()
FINE = 5


class Lagged(eqx.Module):
    """gain e^(-delay s) / ((s^2 + p s + q) (lag s + 1)), or (s + p) for order 1."""

    gain: jax.Array
    lag: jax.Array
    delay: jax.Array
    p: jax.Array
    q: jax.Array
    order: int = eqx.field(static=True, default=1)

    def frequency_response(self, omega):
        s = jax.lax.complex(jnp.zeros_like(omega), omega)
        slow = s + self.p if self.order == 1 else s**2 + self.p * s + self.q
        return (self.gain * jnp.exp(-self.delay * s) / slow / (self.lag * s + 1))[:, None, None]


class Setting(NamedTuple):
    """The plant is gain / (s + p) or gain / (s^2 + p s + q), the controller (kp, ki, kd)."""

    name: str
    up: float = 0.03
    down: float = 0.03
    steps: float = 0.0  # of the actuator, to the amplitude
    order: int = 1
    gain: float = 40.0
    p: float = 0.0
    q: float = 0.0
    controller: tuple[float, float, float] = (0.15, 0.0, 0.0)
    signal: str = "sweep"
    amplitude: float = 0.3
    dt: float = 0.004
    delay: float = 0.01
    band: tuple[float, float] = (0.6, 50.0)
    noise: float = 0.05
    gust: float = 0.1
    bend: float = 0.0  # of a static u |u|, or of u^2 where it is negative


NONE = (0.0, 0.0, 0.0)
OPEN = {"controller": NONE, "gust": 0.02}
DAMPED = Setting("", p=2.0, noise=0.2, **OPEN)
MODE = Setting("", order=2, gain=64.0, p=4.0, q=64.0, noise=0.01, signal="multisine",
               band=(0.6, 40.0), **OPEN)  # fmt: skip
STEPPED = Setting(
    "", p=1.0, dt=0.01, delay=0.02, signal="steps", noise=0.3, band=(0.6, 30.0), **OPEN
)
ANGLE = Setting("", order=2, controller=(1.0, 0.2, 0.15), noise=0.002, band=(1.0, 40.0))
SETTINGS = [
    Setting("rate, P, .02 / .05", 0.02, 0.05),
    Setting("rate, PID, .05 / .02", 0.05, 0.02, controller=(0.15, 0.05, 0.004)),
    Setting("rate, P, .025 / .035", 0.025, 0.035),
    Setting("rate, P, .02 / .05, noise 6 times", 0.02, 0.05, noise=0.3),
    DAMPED._replace(name="damped rate, open, .02 / .05", up=0.02, down=0.05),
    MODE._replace(name="mode, multisine, .03 / .08", up=0.03, down=0.08),
    STEPPED._replace(name="damped rate, steps, .04 / .1", up=0.04, down=0.1),
    ANGLE._replace(name="angle, PD, .02 / .04", up=0.02, down=0.04),
    Setting("rate, P, healthy"),
    Setting("rate, PID, healthy", controller=(0.15, 0.05, 0.004)),
    DAMPED._replace(name="damped rate, healthy"),
    MODE._replace(name="mode, multisine, healthy"),
    STEPPED._replace(name="damped rate, steps, healthy"),
    ANGLE._replace(name="angle, PD, healthy"),
    DAMPED._replace(name="damped rate, u |u| of 20 %", bend=0.2),
    DAMPED._replace(name="damped rate, u^2 of 20 %", bend=-0.2),
    Setting("rate, P, 5 steps", steps=5),
    Setting("rate, P, 8 steps", steps=8),
    Setting("rate, P, 5 steps, quiet", steps=5, noise=0.01, gust=0.02),
    DAMPED._replace(name="damped rate, open, 5 steps", steps=5, noise=0.05),
    DAMPED._replace(name="damped rate, open, 4.7 steps", steps=4.7, noise=0.05),
    DAMPED._replace(name="damped rate, open, 8 steps", steps=8, noise=0.05),
    DAMPED._replace(name="damped rate, open, 5 steps, noise 4 times", steps=5),
    MODE._replace(name="mode, multisine, 5 steps", steps=5),
    ANGLE._replace(name="angle, PD, 4 steps", steps=4),
]


def fly(setting: Setting, draws: int, seconds: float = 66.0) -> tuple[np.ndarray, ...]:
    """Time, reference (samples), inputs and outputs (draws, samples)."""
    s, rng = setting, np.random.default_rng(0)
    count = round(seconds / s.dt)
    time = np.arange(count) * s.dt
    gust = s.gust * np.stack([coloured(rng, count, s.dt, 2.0) for _ in range(draws)])
    noise = s.noise * rng.standard_normal((draws, count))
    if s.signal == "sweep":
        reference = Chirp(0.8 * s.band[0], 1.2 * s.band[1], seconds - 6)(time)
    elif s.signal == "multisine":
        reference = multisine(3, 0.8 * s.band[0], 1.2 * s.band[1], count, s.dt) / 2
    else:
        reference = np.sign(np.random.default_rng(5).standard_normal(count // 12 + 1)).repeat(12)[
            :count
        ]
    reference = s.amplitude * reference
    kp, ki, kd = s.controller
    h, late, quantum = s.dt / FINE, round(s.delay / s.dt * FINE), s.amplitude / max(s.steps, 1)

    def slope(state, command, wind):
        motor, x, v = state
        speed = (command - motor) / np.where(command > motor, s.up, s.down)
        push = s.gain * (motor + wind)
        if s.order == 1:
            return np.stack([speed, push - s.p * x, 0 * v])
        return np.stack([speed, v, push - s.p * v - s.q * x])

    state, whole, rate, before = np.zeros((3, draws)), 0.0, 0.0, np.zeros(draws)
    does_when, u, y = np.zeros((count * FINE + late + FINE, draws)), *np.zeros((2, draws, count))
    for k in range(count):
        y[:, k] = state[1] + noise[:, k]
        whole, rate = whole + ki * s.dt * y[:, k], 0.8 * rate + 0.2 * (y[:, k] - before) / s.dt
        before = y[:, k].copy()
        u[:, k] = reference[k] - kp * y[:, k] - whole - kd * rate
        does = u[:, k]
        if s.steps:
            does = quantum * np.round(does / quantum)
        does = does + (s.bend > 0) * s.bend * does * np.abs(does) / s.amplitude
        does = does - (s.bend < 0) * s.bend * does**2 / s.amplitude
        does_when[k * FINE + late : (k + 1) * FINE + late] = does
        for part in range(FINE):
            command, wind = does_when[k * FINE + part], gust[:, k]
            a = slope(state, command, wind)
            b = slope(state + h / 2 * a, command, wind)
            c = slope(state + h / 2 * b, command, wind)
            d = slope(state + h * c, command, wind)
            state = state + h / 6 * (a + 2 * b + 2 * c + d)
    return time, reference, u, y


def start(s: Setting) -> tuple[eqx.Module, dict[str, float], tuple[str, ...] | None]:
    lag = 2 / (1 / s.up + 1 / s.down)
    truth = {"gain": s.gain, "lag": lag, "delay": s.delay}
    if s.p == 0:
        model = jq.LaggedIntegrator(
            0.8 * s.gain, lag=1.3 * lag, delay=0.7 * s.delay, integrators=s.order
        )
        return model, truth, None
    values = map(jnp.asarray, (0.8 * s.gain, 1.3 * lag, 0.7 * s.delay, 1.2 * s.p, 0.9 * s.q))
    free = ("gain", "lag", "delay", "p") + ("q",) * (s.order == 2)
    return (
        Lagged(*values, order=s.order),
        truth | {"p": s.p} | ({"q": s.q} if s.order == 2 else {}),
        free,
    )


def inside(fit, truth: dict[str, float]) -> np.ndarray:
    """Whether the intervals hold the truth."""
    intervals = {name: fit.interval(name) for name in truth}
    return np.array([low <= truth[name] <= high for name, (low, high) in intervals.items()])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--only", type=int, nargs="*", help="places in the list of settings")
    options = parser.parse_args()
    draws = options.draws
    print("setting | two lags, steps, not linear remarked, % | coverage of the fit, % | behind two "
          "lags, % | up and down, means and scatter, mean errors, coverage, %")  # fmt: skip
    for setting in [SETTINGS[k] for k in options.only or range(len(SETTINGS))]:
        time, reference, inputs, outputs = fly(setting, draws)
        model, truth, free = start(setting)
        counts, plain, behind, lags = (
            dict.fromkeys(("two lags", "steps", "nonlinear"), 0),
            [],
            [],
            [],
        )
        for u, y in zip(inputs, outputs, strict=True):
            references = None if setting.controller == NONE else reference
            record = jq.Record(time, u, y, references, hold=setting.dt)
            frf = jq.frequency_response(record, np.geomspace(*setting.band, 60))
            fit = jq.fit(model, frf, free=free)
            kinds = {remark.kind for remark in (*frf.remarks, *fit.remarks)}
            for kind in counts:
                counts[kind] += kind in kinds
            plain.append(inside(fit, truth))
            if "two lags" in kinds and setting.up != setting.down:
                explanation = fit.explain()
                behind.append(inside(explanation.candidates[0].fit, truth))
                words = explanation.actuator.split(": ")[1].replace(",", "").split()
                lags.append([float(words[k]) for k in (0, 2, 8, 10)])
        shares = " ".join(f"{100 * x / draws:.0f}" for x in counts.values())
        cells = [" ".join(f"{100 * x:.0f}" for x in np.mean(plain, axis=0)), "-", "-"]
        if lags:
            cells[1] = " ".join(f"{100 * x:.0f}" for x in np.mean(behind, axis=0))
            values, errors = np.array(lags)[:, ::2], np.array(lags)[:, 1::2]
            off = np.abs(values - [setting.up, setting.down]) <= 1.96 * errors
            rows = values.mean(axis=0), values.std(axis=0), errors.mean(axis=0)
            cells[2] = ", ".join(" ".join(f"{x:.4f}" for x in row) for row in rows)
            cells[2] += ", " + " ".join(f"{100 * x:.0f}" for x in np.mean(off, axis=0))
        print(" | ".join([setting.name, shares, *cells]), flush=True)


if __name__ == "__main__":
    main()
