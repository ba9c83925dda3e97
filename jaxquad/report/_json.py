import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ._results import _plain


def write_json(path: str | Path, content: Mapping[str, Any]) -> Path:
    """Write `content`, arrays included, to `path`, whole or not at all; returns the path.

    Numbers that are not finite are null: JSON has no nan. Folders are made as needed. Raises
    TypeError for what JSON cannot hold.
    """
    path = Path(path)
    text = json.dumps(_plain(content), indent=2, allow_nan=False) + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.name}.{os.getpid()}.part")
    draft.write_text(text)
    return draft.replace(path)
