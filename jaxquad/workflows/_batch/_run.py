import hashlib
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ._cluster import performed_on
from ._identify_log import identify_log
from ._perform import Content, failed, Work
from ._pool import performed
from ._settings import Settings
from ._store import forget, Job, kept, locked
from ._tables import Row, write_summary, write_tables


def planned(folder: str | Path, settings: Settings, *, out: str | Path | None = None) -> list[Path]:
    """The logs of a fleet, sorted by name; none is opened.

    Hidden files and what lies in `out` are left out. Raises ValueError where there are none.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder of logs")
    found = {path for glob in settings.logs for path in folder.glob(glob) if path.is_file()}
    kept = [path for path in found if not _hidden(path.relative_to(folder))]
    if out is not None and Path(out).resolve().is_relative_to(folder.resolve()):
        own = Path(out).resolve()
        kept = [path for path in kept if not path.resolve().is_relative_to(own)]
    if not kept:
        raise ValueError(f"{folder}: no file matches {', '.join(settings.logs)}: mend logs =")
    return sorted(kept)


def key_of(log: Path, settings: Mapping[str, Any]) -> str:
    """By the log's content, its settings and the version of jaxquad, not by the log's name."""
    with log.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    parts = json.dumps([digest, dict(settings), version("jaxquad")], sort_keys=True)
    return hashlib.sha256(parts.encode()).hexdigest()[:32]


def _hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


Listener = Callable[[Row], None]


def run_batch(
    folder: str | Path,
    settings: Settings,
    *,
    out: str | Path,
    work: Work = identify_log,
    workers: int | None = None,
    scheduler: str | None = None,
    again: bool = False,
    timeout: float | int | None = None,
    listener: Listener | None = None,
) -> list[Row]:
    """Identify all logs of a fleet; returns a row for each, by the order of their names.

    Results are kept in `out` under a key of the log's content, its settings and jaxquad's version,
    each as soon as it is there and whole or not at all: a batch that was killed goes on where it
    was when it is started again. A log that cannot be used is a row with its error, and stops no
    other one; with `again`, such logs are tried again. `out` gets `table.csv`, `table.parquet`
    where pyarrow is installed, `summary.html` and a folder for each result.

    `workers` local processes share the work (by default one for each core), or the workers of the
    Dask cluster at `scheduler`, such as tcp://10.0.0.1:8786, which need the same paths. `work` maps
    a `Job` to what JSON can hold, "status" at least; it has to be importable where it runs.
    `listener` gets each row as it comes in. A log that takes longer than `timeout` s (by default
    that of the settings, else no limit) has failed; a longer limit tries it again.
    Raises ValueError where there is no log, another batch runs in `out`, no scheduler, and for a
    limit on a cluster, whose workers are not ours to kill.
    """
    timeout = settings.timeout if timeout is None else timeout
    _check(timeout, scheduler)
    count = _cores() if workers is None else workers
    if count < 1:
        raise ValueError(f"workers is {count}: give at least 1")
    out = Path(out).absolute()
    logs = planned(folder, settings, out=out)
    with locked(out):
        fleet = _Fleet(Path(folder), settings, out, again, timeout, listener)
        jobs = fleet.jobs(logs)
        here = lambda: performed(jobs, work, count, timeout)
        done = performed_on(scheduler, jobs, work) if scheduler else here()
        try:
            for job, content in done:
                fleet.answered(job, content)
        finally:
            rows = fleet.rows(logs)
            write_tables(out, rows)
            write_summary(out, rows, title=Path(folder).resolve().name)
    return rows


def _check(timeout: float | int | None, scheduler: str | None) -> None:
    if timeout is not None and not 0 < timeout < math.inf:
        raise ValueError(f"timeout is {timeout}: give a number of s above 0")
    if timeout is not None and scheduler:
        raise ValueError("timeout is for processes of this machine: leave it out with a scheduler")


class _Fleet:
    """Which logs wait for which result; logs of equal content and settings share one."""

    def __init__(
        self, folder: Path, settings: Settings, out: Path, again: bool,
        timeout: float | int | None, listener: Listener | None,
    ):  # fmt: skip
        self.folder, self.settings, self.out, self.again = folder, settings, out, again
        self.timeout, self.listener = timeout, listener
        self.waiting: dict[str, list[Path]] = {}
        self.found: dict[str, Content] = {}
        self.known: dict[Path, Row] = {}

    def jobs(self, logs: list[Path]) -> Iterator[Job]:
        """What is left to do; a log is opened when its turn comes."""
        for log in logs:
            try:
                job = self._job(log)
            except OSError as error:
                self._row(log, "", failed(str(error)))
                continue
            if job.key in self.found:
                self._row(log, job.key, self.found[job.key])
            elif job.key in self.waiting:
                self.waiting[job.key].append(log)
            elif (earlier := self._kept(job)) is not None:
                self.found[job.key] = earlier
                self._row(log, job.key, earlier)
            else:
                self.waiting[job.key] = [log]
                yield job

    def answered(self, job: Job, content: Content) -> None:
        self.found[job.key] = content
        for log in self.waiting.pop(job.key):
            self._row(log, job.key, content)

    def rows(self, logs: list[Path]) -> list[Row]:
        return [self.known[log] for log in logs if log in self.known]

    def _job(self, log: Path) -> Job:
        settings = self.settings.of(log.relative_to(self.folder).as_posix())
        return Job(str(log.absolute()), key_of(log, settings), settings, str(self.out))

    def _kept(self, job: Job) -> Content | None:
        earlier = kept(job)
        if earlier is None or earlier.get("status") != "failed":
            return earlier
        had = earlier.get("timeout")
        longer = had is not None and (self.timeout is None or self.timeout > had)
        if self.again or longer:
            forget(job)
            return None
        return earlier

    def _row(self, log: Path, key: str, content: Content) -> None:
        name = log.relative_to(self.folder).as_posix()
        row: dict[str, Any] = {"log": name} | content | {"key": key}
        self.known[log] = row
        if self.listener is not None:
            self.listener(row)


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
