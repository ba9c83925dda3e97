"""How often a notch that a model lacks is remarked, what intervals hold, and what is silent.

    python tests/studies/misfit.py --draws 200 --first 1000

K e^(-tau s) / (s (T s + 1)) is fitted by the defaults to sweeps of plants that have a notch as
well, and the healthy plants of `plants.py` are fitted with their own models.
`remarked` are those with a remark on the misfit or a likely resonance, of records whose misfit is
1.5 random errors or more; `silent` are records without any remark in which a number is off by more
than 4 claimed errors; `held` are 95 % intervals that hold the truth.
"""

import argparse
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from plants import make, record, start
from systems import Chirp, from_transfer_function, respond

import jaxquad as jq


NOTCHES = (
    (75.0, 2.0, 0.5),
    (90.0, 3.0, 0.35),
    (60.0, 1.5, 0.8),
    (40.0, 8.0, 1.0),
    (25.0, 5.0, 2.0),
)
HEALTHY = ("short-10", "short-20", "open-white", "closed-setpoint", "light-mode")
TRUTH = np.array([40.0, 0.03, 0.01])
DT, LENGTH = 0.005, 30.0  # s


class Outcome(NamedTuple):
    misfit: float
    remarked: bool
    silent: bool
    held: np.ndarray  # by parameter


def notched(frequency: float, quality: float, deviation: float, seed: int) -> jq.Record:
    """A sweep of 2 to 140 rad/s through the lagged integrator and a notch, in white noise."""
    gain, lag, delay = TRUTH
    numerator = gain * np.array([1.0, 0.0, frequency**2])
    denominator = np.polymul([lag, 1.0, 0.0], [1.0, frequency / quality, frequency**2])
    time = np.arange(round((LENGTH + 6) / DT)) * DT
    u = Chirp(2.0, 140.0, LENGTH)(time)[:, None]
    y = respond(from_transfer_function(numerator, denominator, delay), u, DT)
    noise = deviation * np.random.default_rng([seed, int(frequency)]).standard_normal(y.shape)
    return jq.Record(time, u, y + noise, hold=DT)


def outcome(fit: jq.identify.Fit, truth: np.ndarray) -> Outcome:
    intervals = np.array([fit.interval(name) for name in fit.names])
    held = (intervals[:, 0] <= truth) & (truth <= intervals[:, 1])
    remarked = any(remark.kind in ("misfit", "resonance") for remark in fit.remarks)
    off = np.abs(fit.values - truth) > 4 * fit.standard_errors
    silent = not fit.remarks and bool(np.any(off & fit.determined))
    held |= ~np.isfinite(fit.standard_errors)
    return Outcome(fit.chi_squared**0.5, remarked, silent, held)


def of_notch(frequency: float, quality: float, deviation: float, seed: int) -> Outcome:
    frf = jq.frequency_response(notched(frequency, quality, deviation, seed))
    return outcome(jq.fit(jq.LaggedIntegrator(48.0, 0.024, 0.011), frf), TRUTH)


def of_plant(name: str, draws: int) -> list[Outcome]:
    plant, found = make(name), []
    for flown in plant.fly(np.arange(draws) + 5000):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", jq.records.RecordWarning)
            frf = jq.frequency_response(record(plant, flown))
        fit = jq.fit(start(plant), frf, free=plant.kind.free, tied=plant.kind.tied)
        found.append(outcome(fit, plant.truth))
    return found


def print_row(title: str, found: Sequence[Outcome], counted: Sequence[Outcome]) -> None:
    share = 100 * np.mean([one.remarked for one in counted]) if counted else np.nan
    silent, held = (100 * np.mean(part, axis=0) for part in list(zip(*found, strict=True))[2:])
    middle = np.median([one.misfit for one in found])
    cells = f"{len(found):6d}{middle:8.2f}{len(counted):9d}{share:12.1f}{silent:10.1f}"
    print(f"{title:34s}{cells}   held % {np.round(held, 1)}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--first", type=int, default=0, help="seed of a notch's first draw")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    titles = f"{'draws':>6s}{'misfit':>8s}{'counted':>9s}{'remarked %':>12s}{'silent %':>10s}"
    print(f"{'plant':34s}{titles}")
    for notch in NOTCHES:
        seeds = range(options.first, options.first + options.draws)
        found = [of_notch(*notch, seed) for seed in seeds]
        title = "notch {:g} rad/s, Q {:g}, noise {:g}".format(*notch)
        print_row(title, found, [one for one in found if one.misfit >= 1.5])
    for name in HEALTHY:
        found = of_plant(name, 5 * options.draws)
        print_row(name, found, found)


if __name__ == "__main__":
    main()
