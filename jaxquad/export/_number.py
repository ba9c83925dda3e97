from collections.abc import Iterable
from typing import Any, Literal

import numpy as np


Precision = Literal["float", "double"]
_TYPES = {"float": np.float32, "double": np.float64}


def type_of(precision: Precision) -> type[np.floating[Any]]:
    """NumPy's name of a C type. Raises ValueError for another."""
    if precision not in _TYPES:
        raise ValueError(f'precision is {precision!r}: choose "float" or "double".')
    return _TYPES[precision]


def number(value: Any, name: str, precision: Precision) -> str:
    """A C constant that reads back as the same number; FLT_MAX or DBL_MAX for infinity.

    Raises ValueError for nan and for what a float cannot hold.
    """
    kind = type_of(precision)
    with np.errstate(over="ignore", under="ignore"):
        held = kind(value)
    if np.isnan(value) or (np.isinf(held) and not np.isinf(value)) or (held == 0 and value != 0):
        raise ValueError(f"{name} is {value}, which no {precision} of C holds: look at the gains.")
    if np.isinf(held):
        most = "FLT_MAX" if precision == "float" else "DBL_MAX"
        return most if held > 0 else f"-{most}"
    text = str(held)  # the shortest that reads back
    text = text if any(mark in text for mark in ".e") else f"{text}.0"
    return text + "f" * (precision == "float")


def braced(values: Iterable[str]) -> str:
    return "{" + ", ".join(values) + "}"
