"""Values as JSON holds them."""

import math
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np


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
