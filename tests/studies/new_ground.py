"""Plants that nobody chose: drawn at random, simulated without the library, fitted by defaults.

    python tests/studies/new_ground.py --plants 1000

Every run draws fresh plants and prints its seed; `--seed` repeats a run, and continues one that was
stopped. `--only 17` shows one plant of a seed: its settings, its truth and its fit. `TEXT` states
the distribution. Two processes share the plants by their structures.
"""

import argparse
import collections
import json
import multiprocessing
import os
import secrets
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path


# One thread for each process, before NumPy and JAX start.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[_name] = "1"

import numpy as np  # noqa: E402
from healthy import drawn, ROOT, state_of_sources  # noqa: E402
from healthy_table import printed  # noqa: E402
from new_ground_plants import draw, identify, judge, STRUCTURES  # noqa: E402
from result_files import write  # noqa: E402

import jaxquad as jq  # noqa: E402


TEXT = (
    "Each plant is drawn anew: its structure, one of twelve with equal probability (a lag behind "
    "0 to 2 integrators, with or without damping; transfer functions of order 2 to 4 with up to "
    "two zeros and up to one integrator), a sample time of .002 to .05 s, a record of 1200, 2400 "
    "or 4800 samples, a band whose upper end is .15 to .6 rad per sample and 8 to 60 times its "
    "lower one, real poles within the band, pairs with a damping of .03 to .95 (as often as two "
    "real poles), zeros up to twice the band (one of five in the right half plane), lags of 1/3 "
    "to 5 over the band's end, a delay of 0 to 5 samples, and a gain of either sign. The "
    "excitation is a sweep, a multisine, a PRBS or doublets with equal probability; one open-loop "
    "sweep or multisine of three is not held between samples. Half of the records, and all of two "
    "integrators, are flown in a loop with a P, PI or PD controller at a random crossover, the "
    "excitation added to set-point or command, from the steady state under noise; where no such "
    "loop settles within a tenth of the record with |S| below 4, all is drawn again. Noise of 1 "
    "to 50 % of the output's deviation is white, first-order below a corner within the band, or "
    "half of each, and is fed back. Ranges are logarithmic, but for delays. The true structure is "
    "fitted by default options; each gain, pole, zero, damping and delay starts up to a factor 2 "
    "off. A silent miss is a printed number without a mark that is more than 4 claimed errors off "
    "in a fit without a remark; a claimed error is 1 / 1.96 of the interval's side there."
)
FAR = 4.0  # claimed errors


def run(seed: int, numbers: range, worker: int, workers: int, path: Path) -> None:
    """The plants of some structures that are still missing, one line each."""
    jq.enable_x64()
    done = {row["plant"] for row in drawn(path)}
    for number in numbers:
        if number in done:
            continue
        setting = draw(seed, number)
        titles = [structure.title for structure in STRUCTURES]
        if titles.index(str(setting.labels["structure"])) % workers != worker:
            continue
        row = {"plant": number, "labels": setting.labels} | judge(setting)
        with path.open("a") as file:
            file.write(json.dumps(row) + "\n")


def is_silent(row: dict) -> bool:
    return not row["remarks"] and any(abs(off) > FAR for _, off, _ in row["numbers"])


def table(rows: list[dict], seed: int) -> list[dict]:
    count = len(rows)
    command = f"python tests/studies/new_ground.py --plants {count} --seed {seed}"
    groups = {"all": rows}
    for key in ("loop", "order", "noise", "colour", "excitation", "hold", "length", "structure"):
        values = sorted({row["labels"][key] for row in rows}, key=lambda v: (key, str(v)))
        groups |= {v: [row for row in rows if row["labels"][key] == v] for v in values}
    body = []
    for title, some in groups.items():
        off = np.array([off for row in some for _, off, _ in row["numbers"]])
        inside = np.array([inside for row in some for _, _, inside in row["numbers"]])
        near = off[np.abs(off) < FAR]
        share = lambda test, some=some: 100 * float(np.mean([bool(test(row)) for row in some]))
        body.append(
            [
                title, len(some), off.size,
                *((100 * inside.mean(), near.mean(), near.std()) if near.size else 3 * [None]),
                share(lambda row: any(abs(off) > FAR for _, off, _ in row["numbers"])),
                share(is_silent), share(lambda row: not row["numbers"]),
                share(lambda row: row["numbers"] and row["kind"] != "identifiable"),
                share(lambda row: row["remarks"]), share(lambda row: row["of_response"]),
            ]
        )  # fmt: skip
    misses = []
    for row in filter(is_silent, rows):
        name, off, _ = max(row["numbers"], key=lambda number: abs(number[1]))
        labels = row["labels"]
        keys = ("structure", "controller", "excitation", "hold", "length", "colour")
        words = "; ".join(str(labels[key]) for key in keys)
        misses.append(
            [row["plant"], f"{words}; level {100 * labels['level']:.2g} %", name, off,
             row["misfit"], ", ".join(row["undetermined"]) or "none"]
        )  # fmt: skip
    kinds = collections.Counter(
        kind for row in rows for kind in {text.partition(":")[0] for text in row["remarks"]}
    )
    said = ", ".join(f"{kind or 'other'} {n}" for kind, n in kinds.most_common())
    return [
        {
            "title": "New ground",
            "command": command,
            "text": f"Seed {seed}, {count} plants. {TEXT}",
            "columns": ["category", "plants", "printed numbers", "coverage %", "bias / claimed",
                        "scatter / claimed", "plants with a number beyond 4 errors %",
                        "silent misses %", "nothing determined %", "partly determined %",
                        "with remarks of the fit %", "with remarks of the response %"],
            "rows": body,
            "notes": ["Bias and scatter are those of numbers within 4 claimed errors.",
                      "Wanted: silent misses of at most .2 % of plants.",
                      f"Plants with remarks, by kind: {said or 'none'}."],
        },
        {
            "title": "New ground: silent misses",
            "command": command,
            "text": "`--only` with a plant's number, and the same seed, shows it.",
            "columns": ["plant", "setting", "worst number", "off / claimed", "misfit",
                        "not determined"],
            "rows": misses,
        },
    ]  # fmt: skip


def show(seed: int, number: int) -> None:
    """One plant, in full."""
    jq.enable_x64()
    setting = draw(seed, number)
    print(
        f"seed {seed}, plant {number}",
        *(f"  {k}: {v}" for k, v in setting.labels.items()),
        sep="\n",
    )
    print(
        "  true:",
        ", ".join(f"{n} {v:.5g}" for n, v in zip(setting.names, setting.truth, strict=True)),
    )
    print("  start:", setting.start())
    response, fit = identify(setting)
    print(response, fit, sep="\n")
    for name, off, inside in judge(setting)["numbers"]:
        print(f"  {name}: {off:+.2f} claimed errors{'' if inside else ', outside'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plants", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=secrets.randbelow(10**6))
    parser.add_argument("--only", type=int, help="one plant, in full; nothing is written")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--raw", type=Path, default=ROOT / "results" / "studies")
    given = parser.parse_args()
    print(f"seed {given.seed}", flush=True)
    if given.only is not None:
        return show(given.seed, given.only)
    raw = given.raw / state_of_sources("new_ground_plants", "systems")
    raw.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(given.raw / "compiled"))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.05")
    paths = [raw / f"new_ground-{given.seed}-{k}.jsonl" for k in range(given.workers)]
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(given.workers, spawn) as pool:
        some = range(given.plants)
        jobs = [
            pool.submit(run, given.seed, some, k, given.workers, p) for k, p in enumerate(paths)
        ]
        for job in jobs:
            job.result()
    rows = [row for path in paths for row in drawn(path) if row["plant"] < given.plants]
    tables = table(sorted(rows, key=lambda row: row["plant"]), given.seed)
    print(printed(tables))
    print(write("new_ground", tables))


if __name__ == "__main__":
    main()
