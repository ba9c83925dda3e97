"""Errors that fits of several flights claim, whose plants differ by a known change.

    python tests/studies/conditions.py --draws 150

Two or three sweeps of a damped rate axis, fitted together with `conditions=`; the noise of each is
its own. For each parameter: claimed over actual errors (their own error is 1 / sqrt(2 draws)), and
coverage. One table, no file; seeds from 0.
"""

import argparse
import warnings
from collections.abc import Callable

import numpy as np
from plants import closed_loop, Loop, open_loop, Plant, RATE, record, start
from systems import Chirp

import jaxquad as jq


jq.enable_x64()
TRUTH = np.array([40.0, 0.8, 0.03, 0.02])  # gain, damping, lag, delay
WIDE, NARROW = Chirp(0.5, 40.0, 60.0), Chirp(0.5, 12.0, 60.0)
Make = Callable[[str, np.ndarray], Plant]


def in_air(title: str, theta: np.ndarray) -> Plant:
    """Under a controller, in gusts; the sweep is added to the set-point."""
    return closed_loop(title, RATE, theta, Loop(0.1, 0.05, 0.002), wave=WIDE, seconds=66.0,
                       gust=0.03, noise=0.05, at_input=False, dt=0.01)  # fmt: skip


def on_a_stand(title: str, theta: np.ndarray, wave: Chirp = WIDE) -> Plant:
    """Without feedback, with a noisy gyro."""
    return open_loop(title, RATE, theta, wave=wave, seconds=66.0, sd=0.5, dt=0.01)


def slowly(title: str, theta: np.ndarray) -> Plant:
    """Up to frequencies that do not tell a lag from a delay."""
    return on_a_stand(title, theta, NARROW)


SETTINGS: dict[str, tuple[Make, list[tuple[str, float, float]]]] = {
    "loop, gain 1.5 times": (in_air, [("gain", 1.5, 0.0)]),
    "loop, gain 1.5 and .6 times": (in_air, [("gain", 1.5, 0.0), ("gain", 0.6, 0.0)]),
    "stand, gain .5 times": (on_a_stand, [("gain", 0.5, 0.0)]),
    "stand, lag + .03 s": (on_a_stand, [("lag", 1.0, 0.03)]),
    "stand, slow sweep, lag + .05 s": (slowly, [("lag", 1.0, 0.05)]),
    "stand, slow sweep, delay + .03 s": (slowly, [("delay", 1.0, 0.03)]),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=150)
    seeds = np.arange(parser.parse_args().draws)
    warnings.simplefilter("ignore", jq.records.RecordWarning)
    print(f"setting | claimed / actual of {', '.join(RATE.names)} | coverage, %")
    for title, (make, changes) in SETTINGS.items():
        plants = [make(title, TRUTH)]
        conditions: list[jq.identify.Changed | None] = [None]
        for name, times, plus in changes:
            theta, k = TRUTH.copy(), RATE.names.index(name)
            theta[k] = times * theta[k] + plus
            plants.append(make(f"{title} {theta[k]:g}", theta))
            conditions.append(jq.identify.Changed(name, plus=plus, times=times))
        values, errors, inside = [], [], []
        for flights in zip(*(plant.fly(seeds) for plant in plants), strict=True):
            records = map(record, plants, flights)
            frfs = [jq.frequency_response(x) for x in records]
            fit = jq.fit(start(plants[0]), frfs, conditions=conditions)
            values.append(fit.values)
            errors.append(fit.standard_errors)
            ends = np.array([fit.interval(name) for name in fit.names])
            inside.append((ends[:, 0] <= TRUTH) & (TRUTH <= ends[:, 1]))
        ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / np.std(values, axis=0, ddof=1)
        shares = 100 * np.mean(inside, axis=0)
        print(title, " ".join(f"{x:.2f}" for x in ratio), " ".join(f"{x:.0f}" for x in shares),
              sep=" | ", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
