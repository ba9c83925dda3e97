"""Values as JSON holds them."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from jaxquad._core import write_file


Json = Mapping[str, object]


@runtime_checkable
class _AsArray(Protocol):
    """NumPy's and JAX's arrays and scalars."""

    def __array__(self) -> np.ndarray: ...


def plain_content(value: object) -> Any:
    """JSON's own types, with null for what is not finite."""
    if isinstance(value, _AsArray):
        return plain_content(np.asarray(value).tolist())
    if isinstance(value, Mapping):
        return {str(key): plain_content(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_content(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def write_json(path: str | Path, content: Json) -> Path:
    """Write a JSON file, whole or not at all.

    **Arguments:**

    - `path`: its folders are made as needed.
    - `content`: arrays included; numbers that are not finite become null.

    **Returns:** the path.

    **Raises:** TypeError for what JSON cannot hold.
    """
    return write_file(path, json.dumps(plain_content(content), indent=2, allow_nan=False) + "\n")
