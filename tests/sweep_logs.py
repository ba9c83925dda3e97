"""Logs of noisy open-loop sweeps of K e^(-delay s) / (s (lag s + 1)), 40 s at 100 Hz."""

from pathlib import Path

import numpy as np

import jaxquad as jq


GAIN, LAG, DELAY = 100.0, 0.02, 0.01
TOTAL = LAG + DELAY + 0.005  # s: an input that is held for 10 ms is half of that late


def swept(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, command and measured rate."""
    sweep = jq.sweep(1.0, 40.0, duration=40.0, sample_rate=100.0, amplitude=0.2)
    model = jq.LaggedIntegrator(GAIN, LAG, DELAY).transfer_function()
    rate = np.asarray(jq.models.simulate_linear(model, sweep.signal, 0.01))
    return sweep.time, sweep.signal, rate + np.random.default_rng(seed).normal(0, 0.05, rate.size)


def write_sweep(path: Path, seed: int = 0) -> Path:
    """As CSV, driven by two motors: M = right - left."""
    time, command, rate = swept(seed)
    table = np.column_stack([time, -0.5 * command, 0.5 * command, rate])
    np.savetxt(path, table, delimiter=",", header="t,left,right,q", comments="")
    return path


def write_two_sweeps(path: Path) -> float:
    """As npz, with noise in between; the command is M = 0.5 w + 2 w^2. Returns a sweep's end."""
    time, command, first = swept(0)
    noise = np.random.default_rng(2).normal(0, 0.05, command.size)
    moment = np.concatenate([command, noise, command])
    rates = np.concatenate([first, 300 * noise, swept(1)[2]])
    speed = (np.sqrt(0.25 + 8 * (moment + 1)) - 0.5) / 4  # 2 w^2 + 0.5 w = M + 1
    np.savez(path, t=np.arange(moment.size) / 100, w=speed, q=rates)
    return float(time[-1])


def write_noise(path: Path, seed: int = 1) -> Path:
    """A command and a rate that have nothing to do with each other."""
    noise = np.random.default_rng(seed).standard_normal((4096, 2))
    np.savez(path, t=np.arange(4096) / 100, M=noise[:, 0], q=noise[:, 1])
    return path
