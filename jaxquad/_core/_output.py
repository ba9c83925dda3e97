"""What leaves the package: files that are whole or not there, JSON, and stages that are told."""

import logging
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np


STAGES = logging.getLogger("jaxquad.stages")


def announce(stage: str) -> None:
    """Log what begins now, at level INFO; the command line shows it on stderr."""
    STAGES.info(stage)


def write_file(path: str | Path, content: str | bytes) -> Path:
    """Write a file whole or not at all; it is on the disk when this returns.

    **Arguments:**

    - `path`: its folders are made as needed.
    - `content`: a text is encoded as UTF-8; what cannot be becomes a question mark.

    **Returns:** the path.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with draft.open("wb") as file:
            file.write(content.encode("utf-8", "replace") if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
    if os.name != "nt":  # a new name is on the disk only once its folder is
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    return path


@runtime_checkable
class _AsArray(Protocol):
    """NumPy's and JAX's arrays and scalars."""

    def __array__(self) -> np.ndarray: ...


def plain_content(value: object) -> Any:
    """JSON's own types, with null for what is not finite."""
    if isinstance(value, float):  # first what there is most of: a protocol takes 20 times as long
        return float(value) if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, Mapping):
        return {str(key): plain_content(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_content(item) for item in value]
    if isinstance(value, _AsArray):
        return plain_content(np.asarray(value).tolist())
    return value
