"""All logs of a folder: which wait for which result, the table of rows, and its summary."""

import csv
import hashlib
import io
import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from urllib.parse import quote

from jaxquad._core import __version__, available_cores, write_file

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
    folder: str | Path, settings: BatchSettings | None = None, *, out: str | Path | None = None,
    again: bool = False, work: Work = identify_log, listener: Listener | None = None,
) -> list[Row]:  # fmt: skip
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
    settings, folder = settings or BatchSettings(), Path(folder)
    out = Path(out or Path("results") / folder.resolve().name).absolute()
    logs = find_logs(folder, settings, out=out)
    timeout = settings.timeout
    if timeout is None and settings.scheduler is None:
        timeout = _TIMEOUT
    names = {log: log.relative_to(folder).as_posix() for log in logs}
    # Before the first log is read: settings that exclude each other stop the batch.
    settings_of = {log: settings.of(name) for log, name in names.items()}
    # Logs of equal content and settings share a result.
    waiting, results, rows = dict[str, list[Path]](), dict[str, Content](), dict[Path, Row]()

    def add_row(log: Path, key: str, content: Content) -> None:
        rows[log] = {"log": names[log]} | content | {"key": key}
        if listener is not None:
            listener(rows[log])

    def earlier_result(job: Job) -> Content | None:
        earlier = stored_result(job)
        if earlier is None or earlier.get("status") != "failed":
            return earlier
        limit = earlier.get("timeout")
        longer = limit is not None and (timeout is None or timeout > limit)
        if again or longer:
            job.stored.unlink(missing_ok=True)
            return None
        return earlier

    def jobs() -> Iterator[Job]:
        """What is left to do; a log is opened when its turn comes."""
        for log in logs:
            try:
                key = _key_of(log, settings_of[log])
            except OSError as error:
                add_row(log, "", failure(str(error)))
                continue
            if key in waiting:
                waiting[key].append(log)
                continue
            job = Job(str(log.absolute()), key, settings_of[log], str(out))
            result = results.get(key) or earlier_result(job)
            if result is not None:
                results[key] = result
                add_row(log, key, result)
            else:
                waiting[key] = [log]
                yield job

    with locked(out):
        if settings.scheduler is not None:
            done = perform_on_cluster(settings.scheduler, jobs(), work)
        else:
            done = perform_locally(jobs(), work, settings.workers or available_cores(), timeout)
        try:
            for job, content in done:
                results[job.key] = content
                for log in waiting.pop(job.key):
                    add_row(log, job.key, content)
        finally:
            sorted_rows = [rows[log] for log in logs if log in rows]
            _write_tables(out, sorted_rows)
            _write_summary(out, sorted_rows, title=folder.resolve().name)
    return sorted_rows


def _key_of(log: Path, settings: IdentifySettings) -> str:
    """By the log's content, its settings and the version of jaxquad, not by the log's name."""
    with log.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    parts = json.dumps([digest, settings.content(), __version__], sort_keys=True)
    return hashlib.sha256(parts.encode()).hexdigest()[:32]


_FIRST = ("log", "status")
_TEXTS = ("error", "report", "key")
_LAST = ("remarks", "seconds", *_TEXTS)


def _write_tables(out: Path, rows: Sequence[Row]) -> None:
    """Write `table.csv`, and `table.parquet` where pyarrow is installed."""
    flat = [_flattened(row) for row in rows]
    names = _columns(flat)

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
        if name not in (*_FIRST, *_TEXTS):
            numbers = [float(x) if isinstance(x, int | float) else None for x in values]
            return pa.array(numbers, pa.float64())
        texts = [x if x is None else str(x).encode("utf-8", "replace").decode() for x in values]
        return pa.array(texts, pa.string())

    buffer = io.BytesIO()
    pq.write_table(pa.table({name: column(name) for name in names}), buffer)
    write_file(out / "table.parquet", buffer.getvalue())


def _flattened(row: Row) -> Row:
    """One column for the value of each parameter and one for its standard error."""
    flat = {name: row.get(name) for name in (*_FIRST, *_LAST)}
    flat["remarks"] = len(row.get("remarks", ()))
    for parameter in row.get("parameters", ()):
        flat[parameter["name"]] = parameter["value"]
        flat[f"{parameter['name']} std.err."] = parameter["standard_error"]
    return flat


def _columns(flat: Sequence[Row]) -> list[str]:
    """The names of all parameters, between what identifies a log and what is said of it."""
    names = dict.fromkeys(name for row in flat for name in row)
    return [*_FIRST, *(n for n in names if n not in (*_FIRST, *_LAST)), *_LAST]


_STATES = ("failed", "not identifiable", "identified")  # what needs a look comes first


def _write_summary(out: Path, rows: Sequence[Row], *, title: str) -> None:
    """Write `summary.html`: the state of each log, with a link to its report."""
    from jaxquad.report import Cell, render_page, Table

    def cell(value: object) -> str:
        if value is None:
            return ""
        return f"{value:.5g}" if isinstance(value, int | float) else str(value)

    counts = Counter(row["status"] for row in rows)
    states = [state for state in (*_STATES, *sorted({*counts} - {*_STATES})) if counts[state]]
    parts = []
    for state in states:
        flat = [_flattened(row) for row in rows if row["status"] == state]
        heads = ["log", *(n for n in _columns(flat) if n not in (*_FIRST, *_TEXTS))]
        if failed := state == "failed":
            heads = ["log", "error", "seconds"]
        body = []
        for row in flat:
            link = Cell(str(row["log"]), link=quote(row["report"] or ""))
            body.append([link, *(cell(row.get(name)) for name in heads[1:])])
        table = Table(state.capitalize(), heads, body, texts=1 + failed)
        key = state.replace(" ", "-")
        parts.append({"key": key, "title": state.capitalize(), "table": table})
    counted = ", ".join(f"{counts[state]} {state}" for state in states)
    text = render_page(
        "summary.html", title=f"{title}: {counted}", folder=title, count=len(rows), counts=counted,
        parts=parts,
    )  # fmt: skip
    write_file(out / "summary.html", text)
