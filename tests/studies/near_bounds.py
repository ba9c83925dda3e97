"""Parameters at or near zero in records of much noise: what is printed of them, against the truth.

    python tests/studies/near_bounds.py --draws 60

An interval, or a limit of what may be zero, is printed of each parameter that counts as determined;
a number and its error of each sum; and a limit beside what is not determined. A miss, with a remark
or without, is off by more than four of its claimed errors, each of them 1 / 1.96 of the interval's
side there; a limit, by as many beyond the value. Seeds are fixed; draws that are there already are
not repeated.
"""

import argparse
import json
import os
from pathlib import Path
from typing import NamedTuple


os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")

import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from jaxtyping import Array, Float  # noqa: E402

import jaxquad as jq  # noqa: E402


jq.enable_x64()  # before numbers are made

ROOT = Path(__file__).parents[2]
FINE = 8  # steps of a plant between two samples, where its input is not held
FAR = 4.0  # claimed errors


def as_number(x: float) -> Array:
    return jnp.asarray(x, float)


class Rate(eqx.Module):
    """gain (lead s + 1) e^(-delay s) / ((s + damping) (lag s + 1))."""

    gain: Float[Array, ""] = eqx.field(converter=as_number)
    lag: Float[Array, ""] = eqx.field(converter=as_number)
    delay: Float[Array, ""] = eqx.field(converter=as_number)
    lead: Float[Array, ""] = eqx.field(converter=as_number, default=0.0)
    damping: Float[Array, ""] = eqx.field(converter=as_number, default=0.0)

    def frequency_response(self, omega: Float[Array, " frequencies"]) -> Array:
        s = 1j * omega
        late = self.gain * (self.lead * s + 1) * jnp.exp(-self.delay * s)
        return (late / ((s + self.damping) * (self.lag * s + 1)))[:, None, None]


class Case(NamedTuple):
    truth: Rate
    start: Rate
    free: tuple[str, ...]
    band: tuple[float, float]  # rad/s
    rate: float  # Hz
    noise: tuple[float, ...]  # of the output; the draws take turns
    held: bool = True  # else a smooth input


_LAGGED = ("gain", "lag", "delay")
_START = Rate(30.0, 0.02, 0.02)
CASES = {
    "lag and delay": Case(
        Rate(40.0, 0.03, 0.01), _START, _LAGGED, (0.4, 60.0), 100.0, (0.3, 0.4, 0.5)
    ),
    "no lag": Case(Rate(40.0, 0.0, 0.02), _START, _LAGGED, (0.4, 60.0), 100.0, (0.05, 0.1, 0.3)),
    "no delay": Case(Rate(40.0, 0.03, 0.0), _START, _LAGGED, (0.4, 60.0), 100.0, (0.05, 0.1, 0.3)),
    "small lead": Case(
        Rate(100.0, 0.0, 0.008, 0.004), Rate(100.0, 0.004, 0.01, 0.006), (*_LAGGED, "lead"),
        (20.0, 140.0), 500.0, (0.02, 0.05, 0.1), held=False,
    ),
    "no lead": Case(
        Rate(40.0, 0.03, 0.01, 0.0), Rate(30.0, 0.02, 0.02, 0.01), (*_LAGGED, "lead"),
        (0.4, 60.0), 100.0, (0.02, 0.05, 0.1),
    ),
    "small damping": Case(
        Rate(40.0, 0.03, 0.01, 0.0, 0.02), Rate(30.0, 0.02, 0.01, 0.0, 0.1), (*_LAGGED, "damping"),
        (0.4, 60.0), 100.0, (0.05, 0.1, 0.3),
    ),
}  # fmt: skip


def measured(case: Case, seed: int) -> jq.spectra.FrequencyResponse:
    """The response that the default estimator finds in a sweep of 40 s."""
    fine = 1 if case.held else FINE
    sweep = jq.sweep(*case.band, duration=40.0, sample_rate=fine * case.rate, amplitude=0.1)
    truth, dt = case.truth, 1 / case.rate
    below = np.polymul([float(truth.lag), 1.0], [1.0, float(truth.damping)])
    above = float(truth.gain) * np.array([float(truth.lead), 1.0])
    delay = float(truth.delay) - (0.0 if case.held else dt / fine / 2)  # a step is late by half
    plant = jq.TransferFunction(np.trim_zeros(above, "f"), np.trim_zeros(below, "f"), delay=delay)
    clean = np.asarray(jq.models.simulate_linear(plant, sweep.signal, dt / fine))[::fine]
    noise = case.noise[seed % len(case.noise)]
    output = clean + np.random.default_rng(seed).normal(0, noise, clean.size)
    names = {"input_names": ("u",), "output_names": ("q",), "hold": dt if case.held else None}
    command = np.asarray(sweep.signal)[::fine]
    time = np.arange(command.size) * dt
    return jq.frequency_response(jq.Record(time, command[:, None], output[:, None], **names))


def claimed(value: float, ends: tuple[float, float], truth: float) -> float:
    """The error that the interval's side towards the truth claims."""
    return max(ends[1] - value if truth > value else value - ends[0], 1e-12) / 1.96


def draw(case: Case, seed: int) -> dict:
    """What is printed, with the truth of each, and by how many claimed errors it is off."""
    fit = jq.fit(case.start, measured(case, seed), free=case.free)
    truths = {name: float(getattr(case.truth, name)) for name in case.free}
    bounds = {bound.name: bound.limit for bound in fit.verdict.bounds}
    row = {"seed": seed, "kind": fit.verdict.kind, "marked": list(fit.verdict.undetermined)}
    row["remarks"], row["printed"] = len(fit.remarks), []
    for k, (name, truth) in enumerate(truths.items()):
        value, error = float(fit.values[k]), float(fit.standard_errors[k])
        if name in bounds:
            error = (bounds[name] - value) / 1.645
            inside = truth <= bounds[name]
        elif fit.determined[k]:
            low, high = fit.interval(name)
            inside, error = low <= truth <= high, claimed(value, (low, high), truth)
        else:
            continue
        kind = "limit" if name in bounds else "interval"
        row["printed"].append([name, kind, inside, (truth - value) / error, value, error])
    for one in fit.combinations:
        truth = float(eval(one.name, {}, truths)) if one.sum_of else None
        if truth is None:
            continue
        low, high = one.interval
        error = claimed(one.value, (low, high), truth)
        off = (truth - one.value) / error
        row["printed"].append([one.name, "sum", low <= truth <= high, off, one.value, error])
    total = lambda model: model.lag + model.delay - model.lead
    truth = float(total(case.truth))
    try:
        one = fit.derived(total)
        off = (truth - one.value) / claimed(one.value, one.interval, truth)
        row["derived"] = [one.interval[0] <= truth <= one.interval[1], off]
    except ValueError as error:
        row["derived"] = str(error)
    return row


def printed(name: str, rows: list[dict]) -> str:
    """One line of the table."""
    shown = [one for row in rows for one in row["printed"]]
    parts = []
    for kind in ("interval", "limit", "sum"):
        mine = [one[2] for one in shown if one[1] == kind]
        parts.append(f"{100 * np.mean(mine):5.1f} of {len(mine):3d}" if mine else f"{'-':>12}")
    derived = [row["derived"] for row in rows]
    sums = [one[0] for one in derived if not isinstance(one, str)]
    share = f"{100 * np.mean(sums):5.1f} of {len(sums):3d}" if sums else f"{'-':>12}"
    # A value below its limit by far is no miss.
    misses = sum(one[3] > FAR or (one[1] != "limit" and one[3] < -FAR) for one in shown)
    marked = 100 * np.mean([bool(row["marked"]) for row in rows])
    remarked = 100 * np.mean([row["remarks"] > 0 for row in rows])
    cells = [f"{name:14} {len(rows):4d} {marked:9.0f} {remarked:9.0f}", *parts, share]
    return "  ".join([*cells, f"{misses:6d}"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=60)
    parser.add_argument("--first", type=int, default=0, help="seed of the first draw")
    parser.add_argument("--case", action="append", choices=list(CASES))
    parser.add_argument("--raw", type=Path, default=ROOT / "results" / "studies" / "near_bounds")
    given = parser.parse_args()
    given.raw.mkdir(parents=True, exist_ok=True)
    lines = []
    for name in given.case or list(CASES):
        path, rows = given.raw / f"{name.replace(' ', '-')}.jsonl", []
        if path.exists():
            rows = [json.loads(line) for line in path.read_text().splitlines()]
        there = {row["seed"]: row for row in rows}
        for seed in range(given.first, given.first + given.draws):
            if seed not in there:
                there[seed] = draw(CASES[name], seed)
                with path.open("a") as file:
                    file.write(json.dumps(there[seed], default=lambda x: x.item()) + "\n")
        lines.append(printed(name, list(there.values())))
    heads = ("interval, %", "limit, %", "sum, %", "derived, %")
    print(f"{'plant':14} {'n':>4} {'marked, %':>9} {'remark, %':>9}  ", end="")
    print("  ".join(f"{head:>12}" for head in heads), " misses")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
