"""How often a local misfit is remarked, what its intervals hold, and how often a right model is.

    python tests/studies/misfit.py --draws 40

K e^(-tau s) / (s (T s + 1)) is fitted by the defaults to sweeps of plants that have a notch as
well, and the healthy plants of `plants.py` are fitted with their own models.
Counted are records whose misfit is 1.5 random errors or more; `held` are 95 % intervals of the
remarked records that hold the truth.
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
    remarked = any(remark.kind == "misfit" for remark in fit.remarks)
    return Outcome(fit.chi_squared**0.5, remarked, held | ~np.isfinite(fit.standard_errors))


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
    remarked = [each for each in counted if each.remarked]
    share = 100 * len(remarked) / max(len(counted), 1)
    held = 100 * np.mean([each.held for each in remarked], axis=0) if remarked else np.nan
    middle = np.median([each.misfit for each in found])
    cells = f"{len(found):6d}{middle:8.2f}{len(counted):9d}{share:10.1f}"
    print(f"{title:34s}{cells}   held {np.round(held, 0)}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=40)
    draws = parser.parse_args().draws
    jax.config.update("jax_enable_x64", True)
    print(f"{'plant':34s}{'draws':>6s}{'misfit':>8s}{'counted':>9s}{'remarked %':>10s}")
    for frequency, quality, deviation in NOTCHES:
        found = [of_notch(frequency, quality, deviation, seed) for seed in range(draws)]
        title = f"notch {frequency:g} rad/s, Q {quality:g}, noise {deviation:g}"
        print_row(title, found, [each for each in found if each.misfit >= 1.5])
    for name in HEALTHY:
        found = of_plant(name, 5 * draws)
        print_row(name, found, found)


if __name__ == "__main__":
    main()
