"""Where a result comes from; and why a part of it is missing, which costs no other part."""

import hashlib
import platform
from collections.abc import Callable, Mapping
from datetime import datetime, UTC
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple, ParamSpec, TypeVar

from jaxquad._core import is_ours, marked_text, Message


_PACKAGES = ("jaxquad", "jax", "jaxlib", "numpy", "scipy", "equinox", "optimistix")
_BLOCK = 1 << 20  # bytes


class Source(NamedTuple):
    """A file from which a result was made; a folder counts as all files in it."""

    name: str
    size: int  # bytes
    sha256: str


class Provenance(NamedTuple):
    """Where a result comes from: files, command, settings, versions and date."""

    files: tuple[Source, ...]
    command: str  # that makes the result again
    settings: dict[str, str]
    versions: dict[str, str]
    date: str  # ISO 8601, UTC

    def content(self) -> Mapping[str, object]:
        """For `result.json`, see `jaxquad.report.write_results`."""
        return self._asdict() | {"files": [file._asdict() for file in self.files]}


def provenance(
    *paths: str | Path,
    command: str = "",
    settings: Mapping[str, object] | None = None,
    date: datetime | None = None,
) -> Provenance:
    """Hash files, and note the installed versions and the time.

    **Arguments:**

    - `paths`: the files or folders that a result was made from.
    - `command`: the command line that makes the result again.
    - `settings`: further facts by name.
    - `date`: now by default.

    **Raises:** OSError for a file that cannot be read.
    """
    moment = (date or datetime.now(UTC)).astimezone(UTC)
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    sizes = [sum(file.stat().st_size for file in _files(Path(path))) for path in paths]
    return Provenance(
        files=tuple(
            Source(Path(path).name, size, sha256_of(path))
            for path, size in zip(paths, sizes, strict=True)
        ),
        command=command,
        settings={name: str(value) for name, value in (settings or {}).items()},
        versions=versions,
        date=moment.isoformat(timespec="seconds"),
    )


def _files(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(file for file in path.rglob("*") if file.is_file())
    return [path]


def sha256_of(path: str | Path) -> str:
    """The SHA-256 of a file, or of all files in a folder by the order of their names.

    **Raises:** OSError for a file that cannot be read.
    """
    digest = hashlib.sha256()
    for part in _files(Path(path)):
        with part.open("rb") as file:
            while block := file.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()


def provenance_section(origin: Provenance) -> dict[str, object]:
    """Files, command, versions and date, for a page."""
    versions = ", ".join(f"{name} {text}" for name, text in origin.versions.items())
    facts = origin.settings | {"versions": versions, "date": origin.date}
    return {"files": origin.files, "command": origin.command, "facts": facts}


Arguments = ParamSpec("Arguments")
Part = TypeVar("Part")
FAILED = "failed"  # key of the reason, in what templates show instead of a section


class PageWarning(UserWarning):
    """A part of a result could not be computed; the rest is written."""

    def __init__(self, reason: str):
        super().__init__(Message(reason))


def reason_of(error: Exception) -> Message:
    """Why something could not be computed: the text of our errors, with the kind of all others."""
    text = " ".join(marked_text(error).split())
    if text and is_ours(type(error)):
        return Message(text)
    return Message(f"{type(error).__name__}{f': {text}' if text else ''}")


def attempt(
    compute: Callable[Arguments, Part], *args: Arguments.args, **named: Arguments.kwargs
) -> Part | dict[str, str]:
    """What `compute` returns, or the reason why it raised, which the page shows in its place."""
    try:
        return compute(*args, **named)
    except Exception as error:
        return {FAILED: reason_of(error)}
