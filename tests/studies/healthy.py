"""What a user gets without options from healthy records: coverage, scatter, bias, efficiency.

    python tests/studies/healthy.py --draws 1200

Every plant of `plants.py`, its default estimator, default grid and default cost, beside scipy, the
Cramer-Rao bound, and the estimate of the same records that attains it. Draws are kept under
`--raw`, by the state of the package's sources, and a run that was stopped continues there. The
table goes to results/healthy.json when every plant ran.
"""

import argparse
import hashlib
import json
import multiprocessing
import os
import time
import warnings
from concurrent.futures import as_completed, ProcessPoolExecutor
from pathlib import Path


# One thread for each process, before NumPy and JAX start.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[_name] = "1"
_ONE = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
os.environ.setdefault("XLA_FLAGS", _ONE)

import jax  # noqa: E402
import numpy as np  # noqa: E402
from bounds import efficient  # noqa: E402
from by_scipy import fit as fit_by_scipy  # noqa: E402
from healthy_table import as_tables, printed  # noqa: E402
from plants import Flown, make, MAKERS, Plant, record, start  # noqa: E402
from result_files import write  # noqa: E402

import jaxquad as jq  # noqa: E402


ROOT = Path(__file__).parents[2]
COMMAND = "python tests/studies/healthy.py --draws {}"
HALF = ("three-inputs",)  # plants of which half as many draws are made: each costs several times
LONG = ("two-inputs", "three-inputs", "closed-setpoint", "closed-input")  # these start first
AT_ONCE = 20  # runs that are simulated side by side


def by_scipy(plant: Plant, flown: Flown) -> dict:
    """One record through scipy."""
    values, errors = fit_by_scipy(plant, flown)
    return {"scipy": values, "scipy_error": errors}


def identify(plant: Plant, flown: Flown) -> dict:
    """One record through the defaults."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", jq.records.RecordWarning)
        response = jq.frequency_response(record(plant, flown))
    kind = plant.kind
    fit = jq.fit(start(plant), response, free=kind.free, tied=kind.tied)
    return {
        "values": fit.values,
        "noise_error": fit.noise_standard_errors,
        "error": fit.standard_errors,
        "noise_interval": [fit.interval(name, model_error=False) for name in kind.names],
        "interval": [fit.interval(name) for name in kind.names],
        "determined": fit.determined,
        "misfit": fit.chi_squared**0.5,
        "remarks": list(fit.remarks),
    }


def _tried(plant: Plant, flown: Flown) -> dict:
    """A fit that diverged raises: it counts as one that determines nothing."""
    try:
        return identify(plant, flown)
    except ValueError as error:
        unknown = np.full(plant.truth.size, np.nan)
        keys = ("values", "noise_error", "error", "noise_interval", "interval")
        return dict.fromkeys(keys, unknown) | {
            "determined": np.zeros(plant.truth.size, bool),
            "misfit": np.nan,
            "remarks": [f"ValueError: {error}"],
        }


def run(name: str, seeds: list[int], raw: Path) -> float:
    """Draw the seeds that are still missing; CPU seconds."""
    began = time.process_time()
    jax.config.update("jax_enable_x64", True)
    plant = make(name)
    path, kept = raw / f"{name}.jsonl", raw.parent / of_scipy() / f"{name}.jsonl"
    kept.parent.mkdir(parents=True, exist_ok=True)
    missing = sorted(set(seeds) - {row["seed"] for row in drawn(path)})
    theirs, best = {row["seed"]: row for row in drawn(kept)}, efficient(plant)
    for at in range(0, len(missing), AT_ONCE):
        some = missing[at : at + AT_ONCE]
        for seed, flown in zip(some, plant.fly(np.array(some)), strict=True):
            if seed not in theirs:
                theirs[seed] = {"seed": seed} | by_scipy(plant, flown)
                _append(kept, theirs[seed])
            row = theirs[seed] | {"efficient": best.errors(flown)} | _tried(plant, flown)
            _append(path, row)
        spent = time.process_time() - began
        print(f"{name}: {at + len(some)} of {len(missing)}, {spent:.0f} CPU s", flush=True)
    return time.process_time() - began


def _append(path: Path, row: dict) -> None:
    with path.open("a") as file:
        file.write(json.dumps(row, default=np.ndarray.tolist) + "\n")


def drawn(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def state_of_sources(*studies: str) -> str:
    """The folder of draws: those of another package, or of other flights, do not count."""
    return _digest(
        [*sorted((ROOT / "jaxquad").rglob("*.py")), *_own(*(studies or ("healthy", "bounds")))]
    )


def of_scipy() -> str:
    """The folder of what does not depend on the package."""
    return f"scipy-{_digest(_own('by_scipy'))}"


def _own(*names: str) -> list[Path]:
    """Files of this folder, with those of what is flown."""
    return [Path(__file__).parent / f"{name}.py" for name in (*names, "plants", "systems")]


def _digest(paths: list[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _of(name: str, seeds: list[int]) -> list[int]:
    return seeds[: len(seeds) // 2] if name in HALF else seeds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=1200)
    parser.add_argument("--first", type=int, default=0, help="seed of the first draw")
    parser.add_argument("--plant", action="append", choices=list(MAKERS))
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--raw", type=Path, default=ROOT / "results" / "studies")
    given = parser.parse_args()
    raw = given.raw / state_of_sources()
    raw.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(given.raw / "compiled"))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.05")
    names = given.plant or list(MAKERS)
    seeds = list(range(given.first, given.first + given.draws))
    order = sorted(names, key=lambda name: name not in LONG)
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(given.workers, spawn, max_tasks_per_child=1) as pool:
        jobs = {pool.submit(run, name, _of(name, seeds), raw): name for name in order}
        for job in as_completed(jobs):
            print(f"{jobs[job]}: done, {job.result():.0f} CPU s", flush=True)
    rows = {
        name: [r for r in drawn(raw / f"{name}.jsonl") if r["seed"] in _of(name, seeds)]
        for name in names
    }
    plants = {name: make(name) for name in names}
    bounds = {name: efficient(plant).bound for name, plant in plants.items()}
    tables = as_tables(plants, rows, bounds, COMMAND.format(given.draws))
    print(printed(tables))
    if names == list(MAKERS):
        print(write("healthy", tables))


if __name__ == "__main__":
    main()
