"""Where a result comes from: the files, the versions, and the command that makes it again."""

import hashlib
import platform
from collections.abc import Mapping
from datetime import datetime, UTC
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple


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
    return Provenance(
        files=tuple(_source(Path(path)) for path in paths),
        command=command,
        settings={name: str(value) for name, value in (settings or {}).items()},
        versions=_versions(),
        date=moment.isoformat(timespec="seconds"),
    )


def _source(path: Path) -> Source:
    return Source(path.name, sum(each.stat().st_size for each in _files(path)), sha256_of(path))


def _files(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(each for each in path.rglob("*") if each.is_file())
    return [path]


def sha256_of(path: str | Path) -> str:
    """The SHA-256 of a file, or of all files in a folder by the order of their names.

    **Raises:** OSError for a file that cannot be read.
    """
    digest = hashlib.sha256()
    for each in _files(Path(path)):
        with each.open("rb") as file:
            while block := file.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def provenance_section(known: Provenance) -> dict[str, object]:
    """Files, command, versions and date, for a page."""
    versions = ", ".join(f"{name} {text}" for name, text in known.versions.items())
    facts = known.settings | {"versions": versions, "date": known.date}
    return {"files": known.files, "command": known.command, "facts": facts}
