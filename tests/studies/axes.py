"""How often a log that holds another axis' command is remarked, and what the fit with it holds.

    python tests/studies/axes.py --draws 30

The rate of an axis (gain 40, lag .03 s, delay .01 s) answers to its own command and, by a coupling,
to that of another axis, behind a lag of .05 s. The log holds both; the input is the first alone.
One table, no file; seeds from 0. Every log goes through `jaxquad.workflows.identify`; what is
remarked is identified again with the other command.
"""

import argparse
import dataclasses
import tempfile
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from systems import Chirp, coloured

import jaxquad as jq
from jaxquad.workflows import identify, IdentifySettings


jq.enable_x64()
DT, FINE, TRUE = 0.004, 4, {"gain": 40.0, "lag": 0.03, "delay": 0.01}


class Setting(NamedTuple):
    """How the axes fly."""

    name: str
    coupling: float  # gain from the other command, to that from the axis' own
    alike: float = 0.0  # correlation of what moves the two axes
    excitation: str = "sweep"  # or sticks
    feedback: float = 0.0  # command per rad/s, of both axes
    noise: float = 0.05  # rad/s, of the gyros
    gust: float = 0.05  # of the command; the share `alike` of it is that of the other axis


SETTINGS = [
    Setting("healthy: .6-correlated, no coupling", 0.0, 0.6),
    Setting("healthy: .6-correlated sticks, no coupling", 0.0, 0.6, "sticks"),
    Setting("healthy: loops, .6-correlated, no coupling", 0.0, 0.6, "sweep", 0.1),
    Setting("healthy: loops, independent, coupling .05", 0.05, 0.0, "sweep", 0.1),
    Setting("healthy: loops, loud gusts on both, no coupling", 0.0, 0.9, "sticks", 0.1, gust=0.5),
    Setting(".6-correlated, coupling .05", 0.05, 0.6),
    Setting(".6-correlated, coupling .2, louder noise", 0.2, 0.6, noise=0.3, gust=0.2),
    Setting(".6-correlated sticks, coupling .05", 0.05, 0.6, "sticks"),
    Setting("loops, .6-correlated, coupling .05", 0.05, 0.6, "sweep", 0.1),
    Setting("loops, .6-correlated sticks, coupling .1", 0.1, 0.6, "sticks", 0.1),
    Setting(".3-correlated, coupling .1", 0.1, 0.3),
    Setting("the same sweep, coupling .05", 0.05, 1.0),
    Setting("loops, the same sweep, coupling .05", 0.05, 1.0, "sweep", 0.1),
]


def fly(setting: Setting, draws: int) -> dict[str, np.ndarray]:
    """The columns of logs (draws, samples)."""
    rng, time = np.random.default_rng(0), np.arange(round(46 / DT)) * DT
    colour = lambda corner: np.stack([coloured(rng, time.size, DT, corner) for _ in range(draws)])
    if setting.excitation == "sweep":
        mine = np.tile(Chirp(0.5, 60.0, 40.0)(time), (draws, 1))
        mine /= np.std(mine)
    else:
        mine = colour(12.0)
    rest = np.sqrt(1 - setting.alike**2)
    other = setting.alike * mine + rest * (colour(12.0) if rest else 0.0)
    gusts = setting.gust * np.stack([colour(2.0), colour(2.0)])
    gusts[1] = setting.alike * gusts[0] + rest * gusts[1]
    noise = setting.noise * rng.standard_normal((2, draws, time.size))
    wanted, step = np.stack([mine, other]), DT / FINE
    ago = int(np.ceil(TRUE["delay"] / DT))
    late = ago * DT - TRUE["delay"]
    motor, sluggish, rate = np.zeros((3, 2, draws))
    u, y = np.zeros((2, 2, draws, time.size))
    for k in range(time.size):
        y[..., k] = rate + noise[..., k]
        u[..., k] = wanted[..., k] - setting.feedback * y[..., k]
        for part in range(FINE):  # the held command of `delay` ago
            place = k - ago + (part >= FINE * (1 - late / DT))
            command = u[..., place] if place >= 0 else np.zeros((2, draws))
            share = step / TRUE["lag"]
            crossed = np.stack([sluggish[1], np.zeros(draws)])
            moment = command - (motor - command) * np.expm1(-share) / share
            rate += step * TRUE["gain"] * (moment + setting.coupling * crossed + gusts[..., k])
            motor = command + (motor - command) * np.exp(-share)
            sluggish = command + (sluggish - command) * np.exp(-step / 0.05)
    columns = {"roll_cmd": u[0], "pitch_cmd": u[1], "p": y[0], "q": y[1], "sweep": mine}
    return {"t": np.tile(time, (draws, 1))} | columns


def off(fit: jq.identify.Fit) -> float:
    """Of the gain, in standard errors."""
    return float((fit.values[0] - TRUE["gain"]) / fit.standard_errors[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=30)
    parser.add_argument("--only", type=int, nargs="*", default=range(len(SETTINGS)))
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", jq.records.RecordWarning)
    print(
        "setting | remarked, % | remarked as alike, % | gain off by errors (median) | "
        "with the other command: gain off (median), covered, %"
    )
    for setting in (SETTINGS[k] for k in arguments.only):
        columns, rows = fly(setting, arguments.draws), []
        with tempfile.TemporaryDirectory() as folder:
            for k in range(arguments.draws):
                path = Path(folder) / f"{k}.npz"
                np.savez(path, **{name: column[k] for name, column in columns.items()})
                reference = "sweep" if setting.feedback else None
                settings = IdentifySettings(
                    input="roll_cmd", output="p", reference=reference, hold="dt",
                    band_rad=(0.8, 50.0),
                )  # fmt: skip
                fit = identify(path, settings).fit
                told = [remark for remark in fit.remarks if "pitch_cmd" in remark]
                taken = [remark for remark in told if "--other-input" in remark]
                row = [bool(told), bool(told) and not taken, off(fit), np.nan, np.nan]
                if taken:
                    settings = dataclasses.replace(settings, other_inputs=("pitch_cmd",))
                    again = identify(path, settings).fit
                    low, high = again.interval("gain")
                    row[3:] = off(again), low <= TRUE["gain"] <= high
                rows.append(row)
        told, alike, before, after, covered = np.array(rows, float).T
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            print(
                f"{setting.name} | {100 * told.mean():.0f} | {100 * alike.mean():.0f} | "
                f"{np.median(before):+.1f} | {np.nanmedian(after):+.1f}, "
                f"{100 * np.nanmean(covered):.0f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
