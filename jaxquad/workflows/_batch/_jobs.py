"""One log of a batch: doing its job, and its result on the disk, whole or not there."""

import contextlib
import json
import re
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, IO, NamedTuple

from jaxquad._core import is_ours, write_file

from .._settings import IdentifySettings


class Job(NamedTuple):
    """One log to identify."""

    log: str  # path
    key: str  # of content and settings
    settings: IdentifySettings
    out: str  # folder of the batch


Content = dict[str, Any]  # what JSON can hold; "status" at least
Work = Callable[[Job], Mapping[str, object]]


def perform(work: Work, job: Job) -> Content:
    """Do one job and store its result; an error is a result, too.

    A ValueError says that the log cannot be used, which stays so. Other errors (no memory, no
    disk, a defect) are not stored: the next run tries again.
    """
    earlier = stored_result(job)  # by a process whose answer was lost
    if earlier is not None:
        return earlier
    start = time.monotonic()
    try:
        content = dict(work(job)) | _seconds_since(start)
        store_result(job, content)
    except Exception as error:
        content = failure(_message(error)) | _seconds_since(start)
        if isinstance(error, ValueError):
            with contextlib.suppress(OSError):
                store_result(job, content)
    return content


def failure(error: str) -> Content:
    """The result of a log that could not be used."""
    return {"status": "failed", "error": error}


def _seconds_since(start: float) -> Content:
    return {"seconds": round(time.monotonic() - start, 3)}


def _message(error: Exception) -> str:
    text = " ".join(str(error).split())
    if isinstance(error, ValueError | OSError) and text:
        return text
    return f"{type(error).__name__}: {text}"


_ONE_AT_A_TIME = threading.Lock()  # matplotlib and warnings belong to the process, not to a thread


def identify_log(job: Job) -> Content:
    """Identify one log; its report and figures go to `logs/` in the folder of the batch."""
    import matplotlib

    from jaxquad._compile import enable_compile_cache, share_programs
    from jaxquad._core import enable_x64

    from .._identify import identify  # here: a process with other work starts in half the time

    name = re.sub(r"[^\w.-]", "_", Path(job.log).stem)[:60]
    folder = Path(job.out) / "logs" / f"{name}-{job.key[:12]}"
    folder.mkdir(parents=True, exist_ok=True)
    with _ONE_AT_A_TIME, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        matplotlib.use("Agg")
        enable_x64()
        enable_compile_cache()
        found = identify(job.log, job.settings)
        found.write(folder)
    share_programs()  # Not only at the end: workers are killed.
    texts = [str(found)] if found.proposal is None else [str(found.proposal), str(found)]
    write_file(folder / "printed.txt", "\n\n".join(texts))
    ours = [each.message for each in caught if is_ours(each.category)]
    warned = list(dict.fromkeys(" ".join(str(each).split()) for each in ours))
    if warned:
        write_file(folder / "warnings.txt", "\n".join(warned))
    fit = found.fit
    numbers = zip(fit.names, fit.values, fit.standard_errors, fit.determined, strict=True)
    rows = [(name, *row) for name, *row in numbers] if fit.verdict.fitted else []
    rows += [(each.name, each.value, each.standard_error, True) for each in found.combinations]
    return {
        "status": "identified" if fit.identifiable else "not identifiable",
        "error": "" if fit.identifiable else fit.verdict.summary,
        "parameters": [_parameter(*row) for row in rows],
        "remarks": [*warned, *fit.remarks],
        "report": (folder / "report.html").relative_to(job.out).as_posix(),
    }


def _parameter(name: str, value: float, error: float, determined: bool) -> Content:
    """A table has no place for a mark: what is not determined has no number in it."""
    numbers = {"value": float(value), "standard_error": float(error)}
    return {"name": name} | (numbers if determined else dict.fromkeys(numbers))


def stored_result(job: Job) -> Content | None:
    """The result of an earlier run, or None; one that cannot be read counts as none."""
    try:
        content = json.loads(_path(job).read_text())
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) and content.get("key") == job.key else None


def store_result(job: Job, content: Mapping[str, object]) -> None:
    """Put a result on the disk."""
    text = json.dumps(dict(content) | {"key": job.key}, indent=1, allow_nan=False)
    write_file(_path(job), text)


def forget_result(job: Job) -> None:
    """Let a result be made again."""
    _path(job).unlink(missing_ok=True)


def _path(job: Job) -> Path:
    return Path(job.out) / "results" / f"{job.key}.json"


@contextlib.contextmanager
def locked(out: Path) -> Iterator[None]:
    """One batch at a time in a folder; a killed one leaves no lock, and its drafts are removed.

    Raises ValueError where another one runs.
    """
    out.mkdir(parents=True, exist_ok=True)
    with (out / ".lock").open("w") as file:
        _lock(file, out)
        for draft in (*out.glob("*.part"), *out.glob("results/*.part")):
            draft.unlink(missing_ok=True)
        yield


def _lock(file: IO[str], out: Path) -> None:
    try:
        import fcntl
    except ImportError:  # Windows: two batches in one folder do the same work twice, no harm.
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise ValueError(
            f"{out}: another batch is running in this folder: wait for it, or choose another one "
            "(--out)"
        ) from error
