import hashlib
import json
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path

from jaxquad._core import available_cores

from .._settings import IdentifySettings
from ._jobs import (
    Content,
    failure,
    forget_result,
    identify_log,
    Job,
    locked,
    stored_result,
    Work,
)
from ._settings import BatchSettings
from ._tables import Row, write_summary, write_tables
from ._workers import perform_locally, perform_on_cluster


TIMEOUT = 1800.0  # s, for one log on this machine
Listener = Callable[[Row], None]


def find_logs(
    folder: str | Path, settings: BatchSettings, *, out: str | Path | None = None
) -> list[Path]:
    """The logs of a folder that a batch identifies, sorted by name; none is opened.

    Hidden files and files in `out` are left out.

    **Raises:** ValueError where there are none.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder of logs")
    found = {path for glob in settings.logs for path in folder.glob(glob) if path.is_file()}
    logs = [path for path in found if not _is_hidden(path.relative_to(folder))]
    if out is not None and Path(out).resolve().is_relative_to(folder.resolve()):
        own = Path(out).resolve()
        logs = [path for path in logs if not path.resolve().is_relative_to(own)]
    if not logs:
        raise ValueError(f"{folder}: no file matches {', '.join(settings.logs)} (key logs)")
    return sorted(logs)


def _is_hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def batch(
    folder: str | Path,
    settings: BatchSettings | None = None,
    *,
    out: str | Path | None = None,
    again: bool = False,
    work: Work = identify_log,
    listener: Listener | None = None,
) -> list[Row]:
    """Identify all logs of a folder, as `jaxquad batch` does.

    Each result is stored in `out` as soon as it is there, under a key of the log's content, its
    settings and jaxquad's version: a batch that was killed continues where it was when it is
    started again. A log that cannot be used is a row with its error, and stops no other one.

    **Arguments:**

    - `folder`: where the logs are.
    - `settings`: which logs, how to identify them, and by how many processes.
    - `out`: the folder of the results, by default results/NAME of `folder`. It gets `table.csv`,
      `table.parquet` where pyarrow is installed, `summary.html`, and a folder for each log.
    - `again`: whether logs that failed in an earlier run are tried again.
    - `work`: what is done with each `Job`. It returns what JSON can hold, "status" at least, and
      has to be importable in another process.
    - `listener`: is called with each row as it comes in.

    **Returns:** a row for each log, sorted by name.

    **Raises:** ValueError where there is no log, where settings exclude each other, where another
    batch runs in `out`, and where no scheduler answers.
    """
    settings = settings or BatchSettings()
    out = Path(out or Path("results") / Path(folder).resolve().name).absolute()
    logs = find_logs(folder, settings, out=out)
    fleet = _Fleet(Path(folder), logs, settings, out, again, listener)
    with locked(out):
        jobs = fleet.jobs()
        if settings.scheduler is not None:
            done = perform_on_cluster(settings.scheduler, jobs, work)
        else:
            done = perform_locally(jobs, work, settings.workers or available_cores(), fleet.timeout)
        try:
            for job, content in done:
                fleet.answered(job, content)
        finally:
            rows = fleet.rows()
            write_tables(out, rows)
            write_summary(out, rows, title=Path(folder).resolve().name)
    return rows


def key_of(log: Path, settings: IdentifySettings) -> str:
    """By the log's content, its settings and the version of jaxquad, not by the log's name."""
    with log.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    parts = json.dumps([digest, settings.content(), version("jaxquad")], sort_keys=True)
    return hashlib.sha256(parts.encode()).hexdigest()[:32]


class _Fleet:
    """Which logs wait for which result; logs of equal content and settings share one."""

    def __init__(
        self,
        folder: Path,
        logs: list[Path],
        settings: BatchSettings,
        out: Path,
        again: bool,
        listener: Listener | None,
    ):
        self.folder, self.logs, self.out, self.again = folder, logs, out, again
        self.listener = listener
        self.timeout = settings.timeout
        if self.timeout is None and settings.scheduler is None:
            self.timeout = TIMEOUT
        # Before the first log is read: settings that exclude each other stop the batch.
        self.settings = {log: settings.of(self._name(log)) for log in logs}
        self.waiting: dict[str, list[Path]] = {}
        self.found: dict[str, Content] = {}
        self.known: dict[Path, Row] = {}

    def jobs(self) -> Iterator[Job]:
        """What is left to do; a log is opened when its turn comes."""
        for log in self.logs:
            try:
                job = self._job(log)
            except OSError as error:
                self._add_row(log, "", failure(str(error)))
                continue
            if job.key in self.found:
                self._add_row(log, job.key, self.found[job.key])
            elif job.key in self.waiting:
                self.waiting[job.key].append(log)
            elif (earlier := self._earlier_result(job)) is not None:
                self.found[job.key] = earlier
                self._add_row(log, job.key, earlier)
            else:
                self.waiting[job.key] = [log]
                yield job

    def answered(self, job: Job, content: Content) -> None:
        """Note the result of a job for all logs that wait for it."""
        self.found[job.key] = content
        for log in self.waiting.pop(job.key):
            self._add_row(log, job.key, content)

    def rows(self) -> list[Row]:
        return [self.known[log] for log in self.logs if log in self.known]

    def _name(self, log: Path) -> str:
        return log.relative_to(self.folder).as_posix()

    def _job(self, log: Path) -> Job:
        settings = self.settings[log]
        return Job(str(log.absolute()), key_of(log, settings), settings, str(self.out))

    def _earlier_result(self, job: Job) -> Content | None:
        earlier = stored_result(job)
        if earlier is None or earlier.get("status") != "failed":
            return earlier
        limit = earlier.get("timeout")
        longer = limit is not None and (self.timeout is None or self.timeout > limit)
        if self.again or longer:
            forget_result(job)
            return None
        return earlier

    def _add_row(self, log: Path, key: str, content: Content) -> None:
        row: Row = {"log": self._name(log)} | content | {"key": key}
        self.known[log] = row
        if self.listener is not None:
            self.listener(row)
