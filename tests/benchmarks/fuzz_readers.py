"""Damage files of every kind in every way, and see that reading them only ever raises ReadError.

    python tests/benchmarks/fuzz_readers.py --cases 100000 --workers 2

A case is read (perhaps with remarks), refused by the reader itself, or caught by the net around
it. Another exception, a crash, more than 5 s or more than 3 GB of memory is BAD: its kind, seed
and number are printed, and `--kind K --seed S --number N` repeats it. HDF5, Parquet and bags are
read in a process of its own, which starts too slowly for so many cases: here its code runs in the
worker, and where that hangs or crashes the case is `killed`, as it would be outside.
"""

import argparse
import io
import mmap
import os
import resource
import runpy
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path


sys.path.insert(0, str(Path(__file__).parent.parent))

import numpy as np
from hostile_files import damaged, sound_files

from jaxquad.records import channels, propose, ReadError, RecordError


CASES = 500  # of one kind and one seed
OUTCOMES = ("read", "refused", "net", "killed", "BAD")
ISOLATED = ("hdf5", "parquet", "mcap", "db3")
SLOW = 5  # s
MEMORY = 3 * 2**30  # bytes above what the worker has


def main() -> int:
    parser = argparse.ArgumentParser(description="Damage files, and read them.")
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", action="append", help="only this kind; may be repeated")
    parser.add_argument("--number", type=int, help="only this case, in this process")
    options = parser.parse_args()
    warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)  # The workers leave JAX alone.
    files = sound_files()
    kinds = options.kind or list(files)
    if options.number is not None:
        print(_outcome(*files[kinds[0]], _case(kinds[0], options.seed, options.number)))
        return 0
    seeds = range(options.seed, options.seed - (-options.cases // (CASES * len(kinds))))
    jobs = [(kind, seed, 0) for seed in seeds for kind in kinds]
    totals = {kind: Counter() for kind in kinds}
    begin = time.perf_counter()
    running: dict[int, _Job] = {}
    while jobs or running:
        while jobs and len(running) < options.workers:
            job = _Job(*jobs.pop(0), files)
            running[job.process] = job
        process, status = os.wait()
        job = running.pop(process)
        totals[job.kind] += job.counts()
        if status:  # It died of the case that it had begun.
            verdict = "killed" if job.kind in ISOLATED else "BAD"
            where = f"{job.kind} seed {job.seed} case {job.begun()}"
            print(f"{verdict} {where}: {_death(status)}", flush=True)
            totals[job.kind][verdict] += 1
            jobs.insert(0, (job.kind, job.seed, job.begun() + 1))
    _print(totals, time.perf_counter() - begin)
    return int(any(counts["BAD"] for counts in totals.values()))


class _Job:
    """A forked worker that counts its outcomes in memory shared with this process."""

    def __init__(self, kind: str, seed: int, first: int, files: dict[str, tuple[str, bytes]]):
        self.kind, self.seed = kind, seed
        self.shared = mmap.mmap(-1, 64)
        self.process = os.fork()
        if not self.process:
            _work(kind, seed, first, files, self.shared)
            os._exit(0)

    def counts(self) -> Counter[str]:
        return Counter(
            dict(
                zip(OUTCOMES, struct.unpack_from(f"{len(OUTCOMES)}I", self.shared, 4), strict=True)
            )
        )

    def begun(self) -> int:
        return struct.unpack_from("I", self.shared)[0]


def _work(
    kind: str, seed: int, first: int, files: dict[str, tuple[str, bytes]], shared: mmap.mmap
) -> None:
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY, held + MEMORY))
    name, content = files[kind]
    subprocess.run = _in_this_process
    counts = Counter()
    for number in range(first, CASES):
        struct.pack_into("I", shared, 0, number)
        signal.setitimer(signal.ITIMER_REAL, SLOW)  # Its signal ends the process.
        outcome, text = _outcome(name, content, _case(kind, seed, number))
        signal.setitimer(signal.ITIMER_REAL, 0)
        counts[outcome] += 1
        struct.pack_into(f"{len(OUTCOMES)}I", shared, 4, *(counts[each] for each in OUTCOMES))
        if outcome == "BAD":
            print(f"BAD {kind} seed {seed} case {number}: {text}", flush=True)


def _in_this_process(command: list[str], **unused: object) -> subprocess.CompletedProcess:
    """What the child process of a reader would write."""
    stream = io.BytesIO()
    *_, script, name, path, limit = command
    runpy.run_path(script)["answer"](name, path, int(limit), stream)
    return subprocess.CompletedProcess(command, 0, stream.getvalue(), b"")


def _case(kind: str, seed: int, number: int) -> np.random.Generator:
    return np.random.default_rng([seed, number, *kind.encode()])


def _outcome(name: str, content: bytes, rng: np.random.Generator) -> tuple[str, str]:
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(folder) / name
        path.write_bytes(damaged(content, rng))
        try:
            channels(path)
            _propose(path)
        except ReadError as error:
            return "net" if "cannot be read as " in str(error) else "refused", str(error)
        except RecordError as error:
            return "BAD", f"RecordError: {error}"
        except Exception:
            return "BAD", traceback.format_exc()
    return "read", ""


def _propose(path: Path) -> None:
    try:
        str(propose(path))
    except RecordError as error:
        assert "the channels are not those that" not in str(error), error


def _death(status: int) -> str:
    number = os.waitstatus_to_exitcode(status)
    return "slow" if number == -signal.SIGALRM else f"exit {number}"


def _print(totals: dict[str, Counter[str]], seconds: float) -> None:
    print(f"{'kind':16}", *(f"{outcome:>9}" for outcome in OUTCOMES))
    for kind, counts in totals.items():
        print(f"{kind:16}", *(f"{counts[outcome]:9d}" for outcome in OUTCOMES))
    cases = sum(sum(counts.values()) for counts in totals.values())
    print(f"{cases} cases in {seconds:.0f} s")


if __name__ == "__main__":
    sys.exit(main())
