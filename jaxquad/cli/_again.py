"""The command that made a result, from the result."""

import argparse
import hashlib
import shlex
from pathlib import Path
from typing import Any

from . import _identify


def options_again(content: dict[str, Any], log: Path | None) -> argparse.Namespace:
    """The options by which `jaxquad identify` made a stored result; `log` says where it lies now.

    Raises ValueError where the log has changed since, or is gone.
    """
    origin = content["provenance"]
    words = shlex.split(origin["command"])
    if words[:2] != ["jaxquad", "identify"]:
        raise ValueError(f"the result was not made by jaxquad identify, but by {words[:2]}")
    options = options_of(words[1:])
    options.file = log or options.file
    paths = [options.file, *([options.verify] if options.verify else [])]
    for path, known in zip(paths, origin["files"], strict=True):
        _check(path, known["sha256"])
    return options


def options_of(words: list[str]) -> argparse.Namespace:
    """The options of `identify ...`."""
    parser = argparse.ArgumentParser(prog="jaxquad")
    _identify.add(parser.add_subparsers())
    return parser.parse_args(words)


def _check(path: Path, wanted: str) -> None:
    if path.is_dir():
        return
    try:
        with path.open("rb") as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError as error:
        raise ValueError(f"{path}: the log is gone: say where it is with --log") from error
    if found != wanted:
        raise ValueError(
            f"{path}: not the log that was identified (its SHA-256 is {found[:12]}...)"
        )
