"""How often a clock that drifts, a battery that falls and an uneven motor are remarked.

    python tests/studies/drift.py --draws 50

A rate axis (gain 40, lag .03 s, delay .01 s) flies a sweep of 60 s, in gusts and with a noisy gyro,
without feedback or under a controller. Then the outputs' stamps gain some ppm, the gain changes by
8 or 15 % over the record, or the motor has .02 s up and .05 s down. One table, no file; seeds from
0. Of a gain that changes, `at best` is the share that the most powerful test of the same chance
finds, which knows the plant and the noise up to small changes (Cramer-Rao bound); and the last
columns are coverage by the fit with the drift, of the gain or of the clock, as a term, by
`Fit.explain`, of the first draws.
"""

import argparse
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter
from scipy.stats import norm
from systems import Chirp, coloured

import jaxquad as jq


jq.enable_x64()
CONTROLLERS = {"P": (0.15, 0, 0), "PID": (0.15, 0.05, 0.004), "none": (0, 0, 0)}
DT, FINE, TRUE = 0.004, 4, {"gain": 40.0, "lag": 0.03, "delay": 0.01}
CHANCES, EXPLAINED = (0.004, 0.0005), 20  # of a remark where the gain is steady; draws


class Setting(NamedTuple):
    """How a record is made; the noise is that of the gyro, in rad/s."""

    name: str
    ppm: float = 0.0
    fall: float = 0.0  # of the gain, over the record
    lags: tuple[float, float] = (0.03, 0.03)  # s, of a motor that speeds up, and that slows down
    controller: str = "P"  # or PID, or none
    quantum: float = 0.0  # of the command
    noise: float = 0.05
    gust: float = 0.1


SETTINGS = [
    Setting("healthy, P"),
    Setting("healthy, PID, command of 50 steps", controller="PID", quantum=0.02),
    Setting("clock 50 ppm, P", ppm=50),
    Setting("clock 20 ppm, P, calm", ppm=20, noise=0.01, gust=0.02),
    Setting("clock -50 ppm, PID", ppm=-50, controller="PID"),
    Setting("clock 50 ppm, PID, command of 50 steps", ppm=50, controller="PID", quantum=0.02),
    Setting("clock 50 ppm, open loop", ppm=50, controller="none", noise=0.5),
    Setting("clock 200 ppm, open loop", ppm=200, controller="none", noise=0.5),
    Setting("clock 50 ppm, open loop, quiet", ppm=50, controller="none", noise=0.1),
    Setting("healthy, P, calm", gust=0.02),
    Setting("gain -15 %, P", fall=0.15),
    Setting("gain -15 %, P, calm", fall=0.15, gust=0.02),
    Setting("gain +15 %, PID, calm", fall=-0.15, gust=0.02, controller="PID"),
    Setting("gain -15 %, P, still air", fall=0.15, gust=0.01, noise=0.02),
    Setting("gain -8 %, PID, still air", fall=0.08, gust=0.005, noise=0.01, controller="PID"),
    Setting("gain -15 %, open loop", fall=0.15, controller="none", noise=0.5),
    Setting("motor .02 s up, .05 s down, P", lags=(0.02, 0.05)),
]


def fly(setting: Setting, draws: int) -> tuple[np.ndarray, ...]:
    """Time (samples), reference (samples), inputs and outputs (draws, samples)."""
    rng, time = np.random.default_rng(0), np.arange(round(66 / DT)) * DT
    gust = setting.gust * np.stack([coloured(rng, time.size, DT, 2.0) for _ in range(draws)])
    noise = setting.noise * rng.standard_normal((draws, time.size))
    kp, ki, kd = CONTROLLERS[setting.controller]
    reference = Chirp(0.5, 60.0, 60.0)(time) * 0.3
    gain = TRUE["gain"] * (1 - setting.fall * (time / time[-1] - 0.5))
    ago, step = int(np.ceil(TRUE["delay"] / DT)), DT / FINE
    late = ago * DT - TRUE["delay"]
    motor, rate, whole, slope, before = np.zeros((5, draws))
    u, y = np.zeros((2, draws, time.size))
    for k in range(time.size):
        y[:, k] = rate + noise[:, k]
        error = (reference[k] / kp if kp else 0.0) - y[:, k]
        whole, slope = whole + ki * DT * error, 0.8 * slope + 0.2 * (y[:, k] - before) / DT
        before = y[:, k].copy()
        u[:, k] = kp * error + whole - kd * slope if kp else reference[k]
        if setting.quantum:
            u[:, k] = setting.quantum * np.round(u[:, k] / setting.quantum)
        for part in range(FINE):  # the held command of `delay` ago; exact steps of the lag
            place = k - ago + (part >= FINE * (1 - late / DT))
            command = u[:, place] if place >= 0 else np.zeros(draws)
            up, down = setting.lags
            share = step / np.where(command > motor, up, down)
            rate += step * gain[k] * (command - (motor - command) * np.expm1(-share) / share)
            motor = command + (motor - command) * np.exp(-share)
        rate += DT * TRUE["gain"] * gust[:, k] * (kp > 0)
    if setting.ppm:
        there = np.clip(time * (1 - 1e-6 * setting.ppm), 0, time[-1])
        y = CubicSpline(time, y, axis=1)(there)
    return time, reference, u, y


def simulate(u: np.ndarray, gain: np.ndarray | float, lag: float) -> np.ndarray:
    """The undisturbed rate under a command."""
    step, late = DT / FINE, round(TRUE["delay"] / DT * FINE)
    command = np.concatenate([np.zeros(late), np.repeat(u, FINE)])[: u.size * FINE]
    fade = np.exp(-step / lag)
    motor = lfilter([0.0, 1 - fade], [1.0, -fade], command)
    pushed = step * command + (motor - command) * lag * (1 - fade)
    rise = gain * pushed.reshape(-1, FINE).sum(axis=1)
    return np.concatenate([[0.0], np.cumsum(rise)[:-1]])


def power_at_best(setting: Setting, time: np.ndarray, u: np.ndarray) -> float:
    """The share of records in which the best test finds the change of the gain."""
    gain, lag, delay = TRUE.values()
    share = time / time[-1] - 0.5
    steady = simulate(u, gain, lag)
    columns = [
        steady,
        (simulate(u, gain, 1.01 * lag) - simulate(u, gain, 0.99 * lag)) / 0.02,
        -delay * np.gradient(steady, DT),
        simulate(u, gain * share, lag),
    ]
    # Differences of the noise of the rate: a gust behind the lag, and what the gyro adds.
    gust = setting.gust * (CONTROLLERS[setting.controller][0] > 0)
    noise = (gain * DT * gust) ** 2 * np.exp(-2 * DT * np.arange(301))
    noise[:2] += np.array([2.0, -1.0]) * setting.noise**2
    whitener = np.append(1.0, solve_toeplitz(noise[:300], -noise[1:]))
    shock = np.sqrt(whitener @ noise)
    rows = [lfilter(whitener, 1.0, np.diff(x))[300:] / shock for x in columns]
    error = np.sqrt(np.linalg.inv(np.inner(rows, rows))[3, 3])
    chance = CHANCES[setting.fall < 0]
    return float(norm.cdf(abs(setting.fall) / error - norm.isf(chance)))


def covers(fit: jq.identify.Fit, prefix: str = "", late: float = 0.0) -> list[bool]:
    truth = TRUE | {"delay": TRUE["delay"] + late}
    ends = [(fit.interval(f"{prefix}{name}"), value) for name, value in truth.items()]
    return [low <= value <= high for (low, high), value in ends]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--setting", default="", help="those that contain this text alone")
    given = parser.parse_args()
    draws = given.draws
    print("setting | clock, drift, any remark, % | at best | coverage of gain, lag, delay, %")
    for setting in (one for one in SETTINGS if given.setting in one.name):
        time, reference, inputs, outputs = fly(setting, draws)
        clock, drift, every, inside, with_term = 0, 0, 0, [], []
        for u, y in zip(inputs, outputs, strict=True):
            references = None if setting.controller == "none" else reference
            record = jq.Record(time, u, y, references, hold=DT)
            frf = jq.frequency_response(record, np.geomspace(0.6, 50.0, 60))
            fit = jq.fit(jq.LaggedIntegrator(30.0, lag=0.05, delay=0.005), frf)
            kinds = [remark.kind for remark in (*frf.remarks, *fit.remarks)]
            clock, every = clock + ("clock" in kinds), every + bool(kinds)
            drift += "drift" in kinds
            inside.append(covers(fit))
            if (setting.fall or setting.ppm) and len(inside) <= EXPLAINED:
                title = f"a {'gain' if setting.fall else 'clock'} that drifts"
                terms = [x for x in fit.explain().candidates if x.title == title]
                late = 1e-6 * setting.ppm * time[-1] / 2  # the term is 0 at mid-record
                with_term += [covers(term.fit, "model.", late) for term in terms]
        percent = lambda values: f"{100 * np.mean(values):.0f}"
        line = [setting.name, " ".join(percent(x / draws) for x in (clock, drift, every))]
        line.append(percent(power_at_best(setting, time, inputs[0])) if setting.fall else "-")
        for rows in filter(len, (inside, with_term)):
            line.append(" ".join(map(percent, np.transpose(rows))))
        print(" | ".join(line), flush=True)


if __name__ == "__main__":
    main()
