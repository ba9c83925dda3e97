"""A command held for a sample: what a fit makes of it with the hold, and without.

    python tests/studies/hold.py --draws 200

An independent simulation by scipy's matrix exponential, delays as fractions of a sample. The record
says how long its command is held, or does not.
"""

import argparse
import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from result_files import write
from scipy.linalg import expm

import jaxquad as jq


jq.enable_x64()
DT, LENGTH, REST = 0.02, 60.0, 5.0  # s


class Setting(NamedTuple):
    """K w^2 e^(-delay s) / (s^2 + 2 zeta w s + w^2), or K e^(-delay s) / (s + pole)."""

    title: str
    model: jq.TransferFunction
    free: tuple[str, ...]
    noise: float  # standard deviation over that of the output


def mode(omega: float, zeta: float, delay: float) -> jq.TransferFunction:
    return jq.TransferFunction([omega**2], [1.0, 2 * zeta * omega, omega**2], delay)


ALL = ("numerator[0]", "denominator[1]", "denominator[2]")
SETTINGS = (
    Setting("mode at 20 rad/s, damping .05", mode(20.0, 0.05, 0.0), ALL, 0.01),
    Setting("second order at 6 rad/s, noise at -50 dB", mode(6.0, 0.7, 0.0), ALL, 10 ** (-50 / 20)),
    Setting("the same with a delay of .031 s", mode(6.0, 0.7, 0.031), (*ALL, "delay"), 0.01),
    Setting(
        "3 / (s + 2)", jq.TransferFunction([3.0], [1.0, 2.0]), ("numerator[0]", "denominator[1]"),
        0.01,
    ),
)  # fmt: skip


def flown(model: jq.TransferFunction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, held sweep and exact output."""
    time = DT * np.arange(int((LENGTH + REST) / DT))
    low, high = 0.3, 30.0  # rad/s
    phase = low * (LENGTH / np.log(high / low)) * (np.exp(time / LENGTH * np.log(high / low)) - 1)
    u = np.where(time < LENGTH, np.sin(phase), 0.0)
    return time, u, _held_output(model, u)


def _held_output(model: jq.TransferFunction, u: np.ndarray) -> np.ndarray:
    below = np.asarray(model.denominator)
    order, late = below.size - 1, float(model.delay) / DT
    A = np.eye(order, k=1)
    A[-1] = -below[:0:-1]
    B = np.zeros((order, 1))
    B[-1] = np.asarray(model.numerator)[-1]
    whole = int(late)

    def over(share: float) -> tuple[np.ndarray, np.ndarray]:
        block = np.zeros((order + 1, order + 1))
        block[:order] = np.concatenate([A, B], axis=1) * DT * share
        step = expm(block)
        return step[:order, :order], step[:order, order]

    (before, new), (_, old) = over(1 - late + whole), over(late - whole)
    step = over(1.0)[0]
    padded = np.concatenate([np.zeros(whole + 1), u])
    state, y = np.zeros(order), np.zeros(u.size)
    for k in range(u.size):
        y[k] = state[0]
        state = step @ state + new * padded[k + 1] + before @ old * padded[k]
    return y


class Outcome(NamedTuple):
    """Errors over claimed ones, whether the interval holds the truth, whether there are remarks."""

    scaled: np.ndarray
    inside: np.ndarray
    remarked: bool


def fits(setting: Setting, draws: int) -> tuple[list[Outcome], list[Outcome]]:
    """Of each draw, with the hold said and without: the same response, fitted in two ways."""
    time, u, y = flown(setting.model)
    rng, said, silent = np.random.default_rng(20), [], []
    for _ in range(draws):
        noisy = y + rng.normal(0, setting.noise * np.std(y), y.size)
        response = jq.frequency_response(jq.Record(time, u, noisy, hold=DT))
        said.append(_outcome(setting, response))
        silent.append(_outcome(setting, dataclasses.replace(response, hold=None)))
    return said, silent


def _outcome(setting: Setting, response: jq.spectra.FrequencyResponse) -> Outcome:
    fit = jq.fit(setting.model, response, free=setting.free)
    truth = np.array([_value(setting.model, name) for name in setting.free])
    ends = np.array([fit.interval(name) for name in setting.free])
    inside = (ends[:, 0] <= truth) & (truth <= ends[:, 1])
    return Outcome((fit.values - truth) / fit.standard_errors, inside, bool(fit.remarks))


def _value(model: jq.TransferFunction, name: str) -> float:
    leaf, _, index = name.partition("[")
    values = jnp.atleast_1d(getattr(model, leaf))
    return float(values[int(index.rstrip("]") or 0)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--only", type=int, help="one setting, nothing is written")
    given = parser.parse_args()
    rows = []
    chosen = SETTINGS if given.only is None else SETTINGS[given.only : given.only + 1]
    for setting in chosen:
        for hold, found in zip(("said", "not said"), fits(setting, given.draws), strict=True):
            scaled, inside, remarked = (np.array(part) for part in zip(*found, strict=True))
            for k, name in enumerate(setting.free):
                rows.append(
                    [
                        setting.title, hold, name,
                        100 * inside[:, k].mean(), scaled[:, k].mean(), scaled[:, k].std(),
                        100 * remarked.mean(),
                    ]
                )  # fmt: skip
                print(*rows[-1], flush=True)
    if given.only is None:
        write("hold", {
            "title": "The hold of a command",
            "command": f"python tests/studies/hold.py --draws {given.draws}",
            "text": f"A command held for {DT} s, a sweep from .3 to 30 rad/s in {LENGTH:g} s, "
            f"{REST:g} s of rest, white noise; {given.draws} draws of each.",
            "columns": ["plant", "hold", "parameter", "coverage %", "bias / claimed",
                        "scatter / claimed", "with remarks %"],
            "rows": rows,
        })  # fmt: skip


if __name__ == "__main__":
    main()
