import json
from collections.abc import Mapping
from pathlib import Path

from jaxquad._core import plain_content, write_file


Json = Mapping[str, object]


def write_json(path: str | Path, content: Json) -> Path:
    """Write a JSON file, whole or not at all.

    **Arguments:**

    - `path`: its folders are made as needed.
    - `content`: arrays included; numbers that are not finite become null.

    **Returns:** the path.

    **Raises:** TypeError for what JSON cannot hold.
    """
    return write_file(path, json.dumps(plain_content(content), indent=2, allow_nan=False) + "\n")
