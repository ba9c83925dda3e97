import hashlib
import json
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ._settings import Settings


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
