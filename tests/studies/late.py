"""What a command that acts late at random, or between samples, does to a fit.

    python tests/studies/late.py --draws 20

A rate axis (gain 40, lag .03 s, delay .01 s) flies a sweep of 60 s in open loop, sampled at 250 Hz.
Each sample of the command acts 0 to 2 samples late, with equal probability, and is held, or joined
to the next by a straight line. The truth of the delay has the mean of what is late. One table, no
file; seeds from 0.
"""

import argparse

import numpy as np
from scipy.signal import lfilter
from systems import Chirp

import jaxquad as jq


jq.enable_x64()
DT, FINE, TRUE = 0.004, 8, {"gain": 40.0, "lag": 0.03, "delay": 0.01}
SETTINGS = [  # most samples late; whether it is interpolated; the hold that is stated
    (0, False, "dt"), (2, False, "dt"), (0, True, 0.0), (2, True, 0.0), (0, True, "dt"),
]  # fmt: skip


def fly(seed: int, most: int, interpolated: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, command, measured rate."""
    rng, time = np.random.default_rng(seed), np.arange(round(66 / DT)) * DT
    command = 0.3 * Chirp(0.5, 60.0, 60.0)(time)
    place = np.arange(time.size) - rng.integers(0, most + 1, time.size)
    acting = np.where(place >= 0, command[place], 0.0)
    step = DT / FINE
    there = (np.arange(time.size * FINE) + 0.5) * step - TRUE["delay"]
    if interpolated:
        fine = np.interp(there, time, acting, left=0.0)
    else:
        sample = np.floor(there / DT + 1e-9).astype(int)
        fine = np.where(sample >= 0, acting[sample], 0.0)
    stay = np.exp(-step / TRUE["lag"])
    after = lfilter([1 - stay], [1, -stay], fine)
    before = np.concatenate([[0.0], after[:-1]])
    moment = fine + (before - fine) * (1 - stay) * TRUE["lag"] / step  # the mean over a step
    rate = np.concatenate([[0.0], np.cumsum(TRUE["gain"] * step * moment)[:-1]])[::FINE]
    return time, command, rate + 0.05 * rng.standard_normal(time.size)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=20)
    draws = parser.parse_args().draws
    print("late, samples | interpolated | hold | remarked, % | off by errors: gain, lag, delay")
    for most, interpolated, hold in SETTINGS:
        off, remarked = [], 0
        truth = np.array(list(TRUE.values())) + [0.0, 0.0, 0.5 * most * DT]
        for seed in range(draws):
            record = jq.Record(*fly(seed, most, interpolated), hold=hold)
            frf = jq.frequency_response(record, np.geomspace(0.6, 50.0, 60))
            fit = jq.fit(jq.LaggedIntegrator(30.0, lag=0.05, delay=0.005), frf)
            off.append((fit.values - truth) / fit.standard_errors)
            remarked += bool(fit.remarks)
        errors = " ".join(f"{x:+.1f}" for x in np.mean(off, axis=0))
        share = f"{100 * remarked / draws:.0f}"
        print(f"0 to {most} | {interpolated} | {hold} | {share} | {errors}", flush=True)


if __name__ == "__main__":
    main()
