"""All logs of a folder: which wait for which result, the table of rows, and its summary."""

import csv
import hashlib
import io
import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from urllib.parse import quote

from jaxquad._core import available_cores, write_file

from ._batch_workers import (
    Content,
    failure,
    identify_log,
    Job,
    locked,
    perform_locally,
    perform_on_cluster,
    stored_result,
    Work,
)
from ._settings import BatchSettings, IdentifySettings


_TIMEOUT = 1800.0  # s, for one log on this machine
Row = Content  # "log", "key", and what the work returned
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
    files = {path for glob in settings.logs for path in folder.glob(glob) if path.is_file()}
    hidden = lambda path: any(part.startswith(".") for part in path.relative_to(folder).parts)
    logs = [path for path in files if not hidden(path)]
    if out is not None and (results := Path(out).resolve()).is_relative_to(folder.resolve()):
        logs = [path for path in logs if not path.resolve().is_relative_to(results)]
    if not logs:
        raise ValueError(f"{folder}: no file matches {', '.join(settings.logs)} (key logs)")
    return sorted(logs)


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
            rows = [fleet.rows[log] for log in logs if log in fleet.rows]
            write_tables(out, rows)
            write_summary(out, rows, title=Path(folder).resolve().name)
    return rows


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
        self.logs, self.out, self.again, self.listener = logs, out, again, listener
        self.timeout = settings.timeout
        if self.timeout is None and settings.scheduler is None:
            self.timeout = _TIMEOUT
        self.names = {log: log.relative_to(folder).as_posix() for log in logs}
        # Before the first log is read: settings that exclude each other stop the batch.
        self.settings = {log: settings.of(name) for log, name in self.names.items()}
        self.waiting: dict[str, list[Path]] = {}
        self.results: dict[str, Content] = {}
        self.rows: dict[Path, Row] = {}

    def jobs(self) -> Iterator[Job]:
        """What is left to do; a log is opened when its turn comes."""
        for log in self.logs:
            settings = self.settings[log]
            try:
                job = Job(str(log.absolute()), key_of(log, settings), settings, str(self.out))
            except OSError as error:
                self._add_row(log, "", failure(str(error)))
                continue
            if job.key in self.waiting:
                self.waiting[job.key].append(log)
                continue
            result = self.results.get(job.key) or self._earlier_result(job)
            if result is not None:
                self.results[job.key] = result
                self._add_row(log, job.key, result)
            else:
                self.waiting[job.key] = [log]
                yield job

    def answered(self, job: Job, content: Content) -> None:
        """Note the result of a job for all logs that wait for it."""
        self.results[job.key] = content
        for log in self.waiting.pop(job.key):
            self._add_row(log, job.key, content)

    def _earlier_result(self, job: Job) -> Content | None:
        earlier = stored_result(job)
        if earlier is None or earlier.get("status") != "failed":
            return earlier
        limit = earlier.get("timeout")
        longer = limit is not None and (self.timeout is None or self.timeout > limit)
        if self.again or longer:
            job.stored.unlink(missing_ok=True)
            return None
        return earlier

    def _add_row(self, log: Path, key: str, content: Content) -> None:
        row: Row = {"log": self.names[log]} | content | {"key": key}
        self.rows[log] = row
        if self.listener is not None:
            self.listener(row)


def key_of(log: Path, settings: IdentifySettings) -> str:
    """By the log's content, its settings and the version of jaxquad, not by the log's name."""
    with log.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    parts = json.dumps([digest, settings.content(), version("jaxquad")], sort_keys=True)
    return hashlib.sha256(parts.encode()).hexdigest()[:32]


_FIRST = ("log", "status")
_LAST = ("remarks", "seconds", "error", "report", "key")


def write_tables(out: Path, rows: Sequence[Row]) -> None:
    """Write `table.csv`, and `table.parquet` where pyarrow is installed."""
    flat = [flattened(row) for row in rows]
    names = columns(flat)

    def cell(value: object) -> object:
        """What a spreadsheet would take for a formula becomes a text."""
        risky = isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r")
        return f"'{value}" if risky else value

    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, names, restval="")
    writer.writeheader()
    writer.writerows({name: cell(row.get(name)) for name in names} for row in flat)
    write_file(out / "table.csv", text.getvalue())
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        return

    def column(name: str) -> pa.Array:
        values = [row.get(name) for row in flat]
        if name not in (*_FIRST, "error", "report", "key"):
            numbers = [float(x) if isinstance(x, int | float) else None for x in values]
            return pa.array(numbers, pa.float64())
        encoded = [x if x is None else str(x).encode("utf-8", "replace") for x in values]
        return pa.array([x if x is None else x.decode() for x in encoded], pa.string())

    buffer = io.BytesIO()
    pq.write_table(pa.table({name: column(name) for name in names}), buffer)
    write_file(out / "table.parquet", buffer.getvalue())


def flattened(row: Row) -> Row:
    """One column for the value of each parameter and one for its standard error."""
    flat = {name: row.get(name) for name in (*_FIRST, *_LAST)}
    flat["remarks"] = len(row.get("remarks", ()))
    for parameter in row.get("parameters", ()):
        flat[parameter["name"]] = parameter["value"]
        flat[f"{parameter['name']} std.err."] = parameter["standard_error"]
    return flat


def columns(flat: Sequence[Row]) -> list[str]:
    """The names of all parameters, between what identifies a log and what is said of it."""
    names = dict.fromkeys(name for row in flat for name in row)
    return [*_FIRST, *(n for n in names if n not in (*_FIRST, *_LAST)), *_LAST]


_STATES = ("failed", "not identifiable", "identified")  # what needs a look comes first


def write_summary(out: Path, rows: Sequence[Row], *, title: str) -> Path:
    """Write `summary.html`: the state of each log, with a link to its report."""
    from jaxquad.report import Cell, render_page, Table

    def cell(value: object) -> str:
        if value is None:
            return ""
        return f"{value:.5g}" if isinstance(value, int | float) else str(value)

    counts = Counter(row["status"] for row in rows)
    parts = []
    states = [*_STATES, *sorted(set(counts) - set(_STATES))]
    for state in (state for state in states if counts[state]):
        flat = [flattened(row) for row in rows if row["status"] == state]
        numbers = [n for n in columns(flat) if n not in (*_FIRST, "error", "report", "key")]
        failed = state == "failed"
        heads = ["log", "error", "seconds"] if failed else ["log", *numbers]
        body = [
            [
                Cell(str(row["log"]), link=quote(row["report"] or "")),
                *(cell(row.get(name)) for name in heads[1:]),
            ]
            for row in flat
        ]
        table = Table(state.capitalize(), heads, body, texts=1 + failed)
        part = {"key": state.replace(" ", "-"), "title": state.capitalize(), "table": table}
        parts.append(part)
    counted = ", ".join(f"{counts[state]} {state}" for state in states if counts[state])
    text = render_page(
        "summary.html", title=f"{title}: {counted}", folder=title, count=len(rows), counts=counted,
        parts=parts,
    )  # fmt: skip
    return write_file(out / "summary.html", text)
