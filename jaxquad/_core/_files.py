"""Files that are whole or not there."""

import os
from pathlib import Path


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
    _sync(path.parent)
    return path


def _sync(folder: Path) -> None:
    """A new name is on the disk only once its folder is; Windows opens no folders."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
