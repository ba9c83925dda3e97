import contextlib
import time
from collections.abc import Callable, Mapping
from typing import Any

from ._store import Job, keep, kept


Content = dict[str, Any]  # what JSON can hold; "status" at least
Work = Callable[[Job], Mapping[str, Any]]


def perform(work: Work, job: Job) -> Content:
    """Do one job and keep its result; an error is a result, too.

    A ValueError says that the log cannot be used, which stays so. Other errors (no memory, no
    disk, a defect) are not kept: the next run tries again.
    """
    earlier = kept(job)  # by a process whose answer was lost
    if earlier is not None:
        return earlier
    start = time.monotonic()
    try:
        content = dict(work(job)) | _since(start)
        keep(job, content)
    except Exception as error:
        content = failed(_words(error)) | _since(start)
        if isinstance(error, ValueError):
            with contextlib.suppress(OSError):
                keep(job, content)
    return content


def _since(start: float) -> Content:
    return {"seconds": round(time.monotonic() - start, 3)}


def failed(error: str) -> Content:
    """The result of a log that could not be used."""
    return {"status": "failed", "error": error}


def _words(error: Exception) -> str:
    text = " ".join(str(error).split())
    if isinstance(error, ValueError | OSError) and text:
        return text
    return f"{type(error).__name__}: {text}"
