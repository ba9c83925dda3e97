"""Results on disk, each whole or not there: what a killed batch resumes from."""

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple


class Job(NamedTuple):
    """One log to identify."""

    log: str  # path
    key: str  # of content and settings
    settings: Mapping[str, Any]
    out: str  # folder of the batch


def kept(job: Job) -> dict[str, Any] | None:
    """The result of an earlier run, or None; one that cannot be read counts as none."""
    try:
        content = json.loads(_path(job).read_text())
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) and content.get("key") == job.key else None


def keep(job: Job, content: Mapping[str, Any]) -> None:
    """Put a result on the disk."""
    text = json.dumps(dict(content) | {"key": job.key}, indent=1, allow_nan=False)
    write_whole(_path(job), text.encode())


def forget(job: Job) -> None:
    """Let a result be made again."""
    _path(job).unlink(missing_ok=True)


def write_whole(path: Path, content: bytes) -> None:
    """All of it, on the disk when this returns; or, if the process dies, none of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.name}.{os.getpid()}.part")
    with draft.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(draft, path)
    _sync(path.parent)


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


def _lock(file: Any, out: Path) -> None:
    try:
        import fcntl
    except ImportError:  # Windows: two batches in one folder do the same work twice, no harm.
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise ValueError(f"{out}: another batch runs there: wait for it, or set --out") from error


def _path(job: Job) -> Path:
    return Path(job.out) / "results" / f"{job.key}.json"


def _sync(folder: Path) -> None:
    """A new name is on the disk only once its folder is; Windows opens no folders."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
