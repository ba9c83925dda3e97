"""Proposed gains on the true plants of simulated PX4 flights: how often Ms keeps its limit.

    python tests/studies/autopilot.py --flights 40

Each flight has its own plant, gust, noise and gains: what `jaxquad autopilot` says of its log, and
for proposals the greatest |S| of the loop as it was simulated.
"""

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np


sys.path.append(str(Path(__file__).parents[1]))

import px4_flights as simulated  # noqa: E402

import jaxquad as jq  # noqa: E402
from jaxquad.autopilot import AutopilotProposal
from jaxquad.workflows import autopilot, AutopilotSettings


SEED = 20261122
SETTINGS = AutopilotSettings(axis="roll")


def draw(rng) -> simulated.Vehicle:
    """From a slow to a quick quad, its gains from sluggish to lively."""
    lag, late = rng.uniform(0.015, 0.05), int(rng.integers(16, 64))
    gain = rng.uniform(40.0, 200.0)
    crossover = rng.uniform(0.15, 0.5) / (lag + late / simulated.GYRO_HZ + 0.008)
    p = float(np.clip(crossover / gain, 0.01, 0.5))
    gains = (p, rng.uniform(0.5, 3.0) * p, rng.uniform(0.0, 0.4) * lag * p)
    return simulated.Vehicle(gain, lag, late, gains)


def main() -> None:
    parser = argparse.ArgumentParser(description="proposed gains on the true plants")
    parser.add_argument("--flights", type=int, default=40)
    parser.add_argument("--amplitude", type=float, default=1.5, help="of the chirp, rad/s")
    options = parser.parse_args()
    count = options.flights
    jq.enable_x64()
    rng = np.random.default_rng(SEED)
    kinds, peaks, certified, gusts = Counter(), [], [], []
    omega = np.geomspace(0.1, 400 * np.pi * 0.99, 3000)
    with tempfile.TemporaryDirectory() as folder:
        for k in range(count):
            vehicle = draw(rng)
            noise, gust = rng.uniform(0.01, 0.1), rng.uniform(0.002, 0.03)
            flown = vehicle.fly(amplitude=options.amplitude, noise=noise, gust=gust, seed=k)
            log = simulated.write_log(Path(folder) / "log.ulg", flown, vehicle.parameters)
            found = autopilot(log, SETTINGS)
            assert isinstance(found, AutopilotProposal)  # the PID flew
            kinds[found.kind] += 1
            line = f"{k:3d} {found.kind}"
            if found.kind == "proposed":
                after, changed = found.stages[-1], vehicle.proposed(found.new)
                peaks.append(1 / np.min(np.abs(1 + changed.loop(omega))))
                certified.append(after.peak)
                gusts.append(changed.effect() / vehicle.effect())
                line += f" Ms {peaks[-1]:.2f}, certified {after.peak:.2f}, gusts {gusts[-1]:.2f}"
                line += f", filters {changed.cutoff:.0f} and {changed.slope:.0f} Hz"
            print(line, flush=True)
    print(f"{count} flights, seed {SEED}: {dict(kinds)}")
    if not peaks:
        return
    limit, true = SETTINGS.sensitivity, np.array(peaks)
    kept, middle, most = np.sum(true <= limit), np.median(gusts), max(gusts)
    print(f"true Ms at most {limit}: {kept} of {true.size}, greatest {true.max():.2f}")
    print(f"true Ms at most the certified worst: {np.sum(true <= certified)} of {true.size}")
    print(f"gusts on the true plant, of what flew: median {middle:.2f}, most {most:.2f}")


if __name__ == "__main__":
    main()
