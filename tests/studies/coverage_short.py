"""Coverage of 95 % intervals by the measured noise of short records, by t and by normal quantiles.

    python tests/studies/coverage_short.py --draws 200

Sweeps of 10, 20 and 66 s through one mode with a delay; three inputs at once of 20 and 66 s
through three lags; a multisine of few periods. White noise, default estimator (`Periodic` for the
multisine), default grid and cost.
"""

import argparse
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from result_files import write
from scipy.special import stdtrit

import jaxquad as jq


jq.enable_x64()
DT = 0.02


class Case(NamedTuple):
    """How one record is made and fitted, and what is true."""

    name: str
    identify: Callable[[np.random.Generator], jq.identify.Fit]
    truth: np.ndarray
    share: int = 1  # a draw of which costs as much as this many of one input


def sweep(seconds: float, low: float, high: float) -> np.ndarray:
    t = np.arange(round(seconds / DT)) * DT
    growth = np.log(high / low)
    fade = np.clip(t, 0, 1) * np.clip(seconds - t, 0, 1)
    wave = fade * np.sin(low * seconds / growth * (np.exp(growth * t / seconds) - 1))
    return np.concatenate([wave, np.zeros(100)])


def passed(model, u: np.ndarray, *, periodic: bool = False) -> np.ndarray:
    """The response of a model to band-limited inputs (samples, inputs)."""
    count = len(u) if periodic else 4 * len(u)
    omega = 2 * np.pi * np.fft.rfftfreq(count, DT)
    response = np.asarray(model.frequency_response(jnp.asarray(omega[1:])))
    response = np.concatenate([np.real(response[:1]) + 0j, response])
    turned = np.einsum("foi,fi->fo", response, np.fft.rfft(u, count, axis=0))
    return np.fft.irfft(turned, count, axis=0)[: len(u)]


MODE = jq.TransferFunction(numerator=[100.0], denominator=[1.0, 5.0, 25.0], delay=0.04)
MODE_START = jq.TransferFunction(numerator=[90.0], denominator=[1.0, 4.0, 30.0], delay=0.05)
MODE_FREE = ("numerator[0]", "denominator[1]", "denominator[2]", "delay")
MODE_TRUTH = np.array([100.0, 5.0, 25.0, 0.04])


def one_input(seconds: float) -> Case:
    u = sweep(seconds, 4 * np.pi / seconds, 25.0)
    y = passed(MODE, u[:, None])[:, 0]
    time = np.arange(u.size) * DT

    def identify(rng: np.random.Generator) -> jq.identify.Fit:
        record = jq.Record(time, u, y + 0.3 * np.std(y) * rng.standard_normal(y.size), hold=0.0)
        return jq.fit(MODE_START, jq.frequency_response(record), free=MODE_FREE)

    return Case(f"1 input, {seconds:g} s", identify, MODE_TRUTH)


LAGS = jq.StateSpace(
    F=[[-3.0, 1.0, 0.5], [0.8, -5.0, 1.0], [0.5, 1.2, -8.0]],
    G=[[6.0, 1.0, 0.5], [1.0, 8.0, 1.0], [0.5, 1.0, 10.0]],
    H0=np.eye(3),
)
LAGS_FREE = tuple(f"{leaf}[{k}][{k}]" for leaf in "FG" for k in range(3))
LAGS_TRUTH = np.array([-3.0, -5.0, -8.0, 6.0, 8.0, 10.0])


def three_inputs(seconds: float) -> Case:
    samples = round(seconds / DT)
    omega = 2 * np.pi * np.fft.rfftfreq(samples, DT)
    inside = (omega > 0.8) & (omega < 25)
    phases = np.random.default_rng(1).uniform(size=(omega.size, 3))
    u = np.fft.irfft(inside[:, None] * np.exp(2j * np.pi * phases), samples, axis=0)
    u, time = u / u.std(axis=0), np.arange(samples) * DT
    y = passed(LAGS, u)

    def identify(rng: np.random.Generator) -> jq.identify.Fit:
        noise = 0.1 * np.std(y, axis=0) * rng.standard_normal(y.shape)
        return jq.fit(
            LAGS, jq.frequency_response(jq.Record(time, u, y + noise, hold=0.0)), free=LAGS_FREE
        )

    return Case(f"3 inputs, {seconds:g} s", identify, LAGS_TRUTH, share=5)


def few_periods(periods: int, lines: int) -> Case:
    samples = 500
    omega = 2 * np.pi * np.fft.rfftfreq(samples, DT)
    used = np.unique(np.round(np.geomspace(1, 40, lines)).astype(int))
    spectrum = np.zeros(omega.size, complex)
    spectrum[used] = np.exp(2j * np.pi * np.random.default_rng(2).uniform(size=used.size))
    wave = np.fft.irfft(spectrum, samples)
    u = np.tile(wave / wave.std(), periods)
    y, time = passed(MODE, u[:, None], periodic=True)[:, 0], np.arange(u.size) * DT

    def identify(rng: np.random.Generator) -> jq.identify.Fit:
        record = jq.Record(time, u, y + 0.3 * np.std(y) * rng.standard_normal(y.size), hold=0.0)
        spectra = jq.spectra.Periodic(samples * DT, discard=0)
        return jq.fit(MODE_START, jq.frequency_response(record, estimator=spectra), free=MODE_FREE)

    return Case(f"{periods} periods of 10 s, {used.size} lines", identify, MODE_TRUTH)


def cases() -> list[Case]:
    return [
        *(one_input(seconds) for seconds in (10.0, 20.0, 66.0)),
        *(three_inputs(seconds) for seconds in (20.0, 66.0)),
        few_periods(4, 20),
        few_periods(4, 8),
    ]


def row(case: Case, draws: int) -> list[object]:
    """Coverage in per cent over all parameters, by both quantiles; freedom; claimed / scatter."""
    draws //= case.share
    fits = [case.identify(np.random.default_rng(seed)) for seed in range(draws)]
    values, errors = (np.array([getattr(f, name) for f in fits])
                      for name in ("values", "noise_standard_errors"))  # fmt: skip
    freedom = np.array([f.degrees_of_freedom for f in fits])
    away = np.abs(values - case.truth) / errors
    by_t = 100 * np.mean(away < stdtrit(np.minimum(freedom, 1e6), 0.975), axis=0)
    by_normal = 100 * np.mean(away < 1.96)
    ratio = np.median(np.sqrt(np.mean(errors**2, axis=0)) / np.std(values, axis=0))
    remarked = 100 * np.mean([bool(f.remarks) for f in fits])
    return [
        case.name,
        draws,
        by_normal,
        by_t.mean(),
        by_t.min(),
        np.median(freedom),
        ratio,
        remarked,
    ]


COLUMNS = [
    "record", "draws", "normal, %", "t, %", "t, worst parameter, %", "degrees of freedom",
    "claimed / scatter", "with remarks, %",
]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--case", type=int, help="number of one case; nothing is written")
    given = parser.parse_args()
    print(" | ".join(COLUMNS))
    rows = []
    for case in cases() if given.case is None else [cases()[given.case]]:
        rows.append(row(case, given.draws))
        print(" | ".join(f"{x:.3g}" if isinstance(x, float) else str(x) for x in rows[-1]))
    if given.case is None:
        text = "95 % intervals by the measured noise, a fifth of the draws with three inputs."
        command = f"python tests/studies/coverage_short.py --draws {given.draws}"
        write("coverage_short", {"title": "Short records", "command": command, "text": text,
                                 "columns": COLUMNS, "rows": rows})  # fmt: skip


if __name__ == "__main__":
    main()
