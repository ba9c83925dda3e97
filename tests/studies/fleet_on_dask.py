"""A fleet on a Dask cluster of processes: core seconds per log, a worker's death, memory.

Short simulated sweeps of unequal lengths are identified as `fits/fleet.py --scheduler` does it. In
the middle a worker is killed. Prints the figures of docs/batch.md; the logs are kept in FOLDER.

python tests/studies/fleet_on_dask.py FOLDER --logs 1000 --workers 2
"""

import argparse
import os
import signal
import time
from pathlib import Path
from typing import Any

import dask.config
import distributed
import numpy as np
import psutil

import jaxquad as jq
from jaxquad.workflows import batch, BatchSettings, IdentifySettings


SETTINGS = IdentifySettings(input="u", output="q", band=(0.3, 5.0))
MIB = 2**20


def write_logs(folder: Path, count: int) -> None:
    """15 to 25 s at 100 Hz of 100 e^(-0.01 s) / (s (0.02 s + 1)), as CSV."""
    folder.mkdir(parents=True, exist_ok=True)
    model = jq.LaggedIntegrator(100.0, 0.02, 0.01).transfer_function()
    sweep = jq.sweep(1.0, 40.0, duration=25.0, sample_rate=100.0, amplitude=0.2)
    rate = np.asarray(jq.models.simulate_linear(model, sweep.signal, 0.01))
    random = np.random.default_rng(0)
    for k in range(count):
        n = int(random.integers(1500, 2500))
        noisy = rate[:n] + random.normal(0, 0.02, n)
        table = np.column_stack([sweep.time[:n], sweep.signal[:n], noisy])
        np.savetxt(folder / f"{k:04}.csv", table, delimiter=",", header="t,u,q", comments="")


class Watch:
    """Prints what the workers used, every `every` results; kills one at result number `fatal`."""

    def __init__(self, cluster: Any, every: int, fatal: int):
        self.cluster, self.every, self.fatal = cluster, every, fatal
        self.begin = time.monotonic()
        self.times: list[float] = []
        self.seconds: list[float] = []
        self.cores: dict[int, float] = {}

    def __call__(self, row: dict) -> None:
        self.times.append(time.monotonic() - self.begin)
        self.seconds.append(row["seconds"])
        count = len(self.times)
        if count % self.every and count != self.fatal:
            return
        # A nanny starts a new process for one that was killed.
        pids = [nanny.process.pid for nanny in self.cluster.workers.values()]
        processes = [psutil.Process(pid) for pid in pids if pid]
        for process in processes:
            used = process.cpu_times()
            self.cores[process.pid] = used.user + used.system
        memory = ", ".join(f"{x.memory_info().rss / MIB:.0f}" for x in processes)
        total = sum(self.cores.values())
        print(f"{count} logs, {self.times[-1]:.0f} s, {total:.0f} core s, {memory} MiB", flush=True)
        if count == self.fatal:
            os.kill(processes[0].pid, signal.SIGKILL)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--logs", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    folder, fatal = given.folder / "logs", given.logs // 2
    write_logs(folder, given.logs)
    # Its profiles of call stacks grow by 2.5 MiB a log, for an hour: docs/batch.md.
    dask.config.set({"distributed.worker.profile.enabled": False})
    local: Any = distributed.LocalCluster(
        n_workers=given.workers, threads_per_worker=1, dashboard_address=":0"
    )
    with local as cluster:
        watch = Watch(cluster, max(1, given.logs // 20), fatal)
        settings = BatchSettings(identify=SETTINGS, scheduler=cluster.scheduler_address)
        rows = batch(folder, settings, out=given.folder / "out", listener=watch)
    states = [row["status"] for row in rows]
    print({state: states.count(state) for state in sorted(set(states))})
    seconds, gaps = np.array(watch.seconds), np.diff(watch.times)
    soon = slice(fatal, fatal + 4 * given.workers)
    print(
        f"s of a log: median {np.median(seconds):.2f}, first {seconds[: given.workers].max():.1f}"
    )
    print(f"after the kill: slowest log {seconds[soon].max():.1f} s")
    print(f"s between results: median {np.median(gaps):.2f}, after the kill {gaps[soon].max():.1f}")


if __name__ == "__main__":
    main()
