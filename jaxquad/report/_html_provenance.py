"""Where a result comes from: the files, the versions, and the command that makes it again."""

import hashlib
import platform
from collections.abc import Mapping
from datetime import datetime, UTC
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

from ._html_fit import definitions
from ._html_text import element, given, Html, items, joined, section


_PACKAGES = ("jaxquad", "jax", "jaxlib", "numpy", "scipy", "equinox", "optimistix")
_BLOCK = 1 << 20  # bytes


class Source(NamedTuple):
    """One file that a result rests on; of a folder, all files in it by the order of their names."""

    name: str
    size: int  # bytes
    sha256: str


class Provenance(NamedTuple):
    """Where a result comes from."""

    files: tuple[Source, ...]
    command: str  # that makes the result again
    settings: dict[str, str]
    versions: dict[str, str]
    date: str  # ISO 8601, UTC

    def content(self) -> dict[str, Any]:
        """For `result.json`, see `jaxquad.report.write_results`."""
        return self._asdict() | {"files": [file._asdict() for file in self.files]}


def provenance(
    *paths: str | Path,
    command: str = "",
    settings: Mapping[str, Any] | None = None,
    date: datetime | None = None,
) -> Provenance:
    """Hash the files at `paths`, note the installed versions and the time (now, if not given).

    Raises OSError for a file that cannot be read.
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
    files = [path]
    if path.is_dir():
        files = sorted(each for each in path.rglob("*") if each.is_file())
    digest, size = hashlib.sha256(), 0
    for each in files:
        with each.open("rb") as file:
            while block := file.read(_BLOCK):
                digest.update(block)
                size += len(block)
    return Source(path.name, size, digest.hexdigest())


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def provenance_section(known: Provenance) -> Html:
    files = [
        joined(given(file.name), f", {file.size} bytes, SHA-256 ", element("code", file.sha256))
        for file in known.files
    ]
    command = element("pre", known.command, css="wrap")
    again = (element("h3", "To make it again"), command) if known.command else ()
    facts = known.settings | {
        "versions": ", ".join(f"{name} {text}" for name, text in known.versions.items()),
        "date": known.date,
    }
    return section(
        "provenance", "Provenance", items(files) if files else "", *again, definitions(facts)
    )
