"""How often a nonlinear actuator is remarked, and a linear one, from the record of one sweep.

    python tests/studies/nonlinearity.py --draws 100

Open loop (an integrator in white noise, a mode in coloured noise) and closed loop (a lagged
integrator under proportional feedback with gusts, with and without the reference). The command is
what is recorded; the actuator is linear, has a deadband of 15 %, or saturates at 80 % of the
sweep's amplitude. The start frequency and the noise differ between draws.
"""

import argparse
from collections.abc import Callable

import numpy as np
from result_files import write
from scipy import signal

import jaxquad as jq


jq.enable_x64()
DT = 0.02
OMEGA = np.geomspace(1.0, 12.0, 60)
ACTUATORS = {
    "linear": lambda u: u,
    "deadband 15 %": lambda u: np.sign(u) * np.maximum(np.abs(u) - 0.15, 0),
    "saturation at 80 %": lambda u: np.clip(u, -0.8, 0.8),
}
Actuator = Callable[[np.ndarray], np.ndarray]


def sweep(rng: np.random.Generator, seconds: float = 60.0) -> np.ndarray:
    t = np.arange(round(seconds / DT)) * DT
    low, high = np.exp(rng.uniform(np.log([0.4, 12.0]), np.log([0.8, 16.0])))
    growth = np.log(high / low)
    fade = np.clip(t, 0, 1) * np.clip(seconds - t, 0, 1)
    wave = fade * np.sin(low * seconds / growth * (np.exp(growth * t / seconds) - 1))
    return np.concatenate([wave, np.zeros(150)])


def open_loop(plant: tuple, level: float, pole: float):
    """Through a continuous plant, in noise of this level and colour (pole of its filter)."""

    def fly(actuator: Actuator, rng: np.random.Generator) -> jq.Record:
        u = sweep(rng)
        y = np.asarray(signal.lfilter(*signal.bilinear(*plant, fs=1 / DT), actuator(u)))
        noise = np.asarray(signal.lfilter([1.0], [1.0, -pole], rng.standard_normal(u.size)))
        return jq.Record(DT * np.arange(u.size), u, y + level * np.std(y) * noise / np.std(noise))

    return fly


def closed_loop(gust: float, *, named: bool):
    """A lagged integrator under proportional feedback; `named` says whether the sweep is given."""

    def fly(actuator: Actuator, rng: np.random.Generator) -> jq.Record:
        r = sweep(rng)
        wind = np.asarray(signal.lfilter([0.2], [1.0, -0.98], rng.standard_normal(r.size)))
        sensor = 0.005 * rng.standard_normal(r.size)
        u, y, rate, lagged = np.zeros(r.size), np.zeros(r.size), 0.0, 0.0
        for k in range(r.size):
            y[k] = rate + sensor[k]
            u[k] = r[k] - 0.3 * y[k]
            lagged += 0.3 * (float(actuator(u[k])) - lagged)
            rate += DT * 5 * (lagged + gust * wind[k])
        return jq.Record(DT * np.arange(r.size), u, y, r if named else None)

    return fly


RECORDS = {
    "integrator, white noise": open_loop(([5.0], [0.05, 1.0, 0.0]), 0.05, 0.0),
    "mode, coloured noise": open_loop(([40.0], [1.0, 4.0, 25.0]), 0.1, 0.96),
    "closed loop, reference": closed_loop(0.05, named=True),
    "closed loop, no reference": closed_loop(0.05, named=False),
}


def remarked(fly, actuator: Actuator, draws: int) -> float:
    """Share of records in per cent."""
    count = 0
    for seed in range(draws):
        record = fly(actuator, np.random.default_rng(seed))
        found = jq.frequency_response(record, OMEGA)
        count += any("not linear" in remark for remark in found.remarks)
    return 100 * count / draws


COLUMNS = ["record", *(f"{name}, % remarked" for name in ACTUATORS)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=100)
    draws, rows = parser.parse_args().draws, []
    print(" | ".join(COLUMNS))
    for name, fly in RECORDS.items():
        rows.append([name, *(remarked(fly, each, draws) for each in ACTUATORS.values())])
        print(" | ".join(f"{x:.3g}" if isinstance(x, float) else x for x in rows[-1]), flush=True)
    text = f"{draws} records each, seeds from 0; wanted: 2 % at most, 90 % at least."
    command = f"python tests/studies/nonlinearity.py --draws {draws}"
    write("nonlinearity", {"title": "Nonlinear actuators", "command": command, "text": text,
                           "columns": COLUMNS, "rows": rows})  # fmt: skip


if __name__ == "__main__":
    main()
