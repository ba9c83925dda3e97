"""Numbers of laws: one for all axes, or one for each of them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float


Numbers = Float[np.ndarray, "..."]  # [] or [axes]


def as_numbers(given: ArrayLike | Sequence[Any]) -> Numbers:
    """In double precision, outside JAX: members are drawn before anything is compiled."""
    return np.asarray(given, dtype=float)


def as_numbers_or_none(given: ArrayLike | Sequence[Any] | None) -> Numbers | None:
    return None if given is None else as_numbers(given)


def row(value: Numbers) -> Float[np.ndarray, "axes 1"]:
    """`value` as a column that broadcasts over members."""
    return np.atleast_1d(value)[:, None]


def number(value: Numbers) -> str:
    """For a table: one number, or one for each axis."""
    return "/".join(f"{float(x):.4g}" for x in np.atleast_1d(value))


def check_finite(**values: Numbers) -> None:
    """Raise ValueError for the first of the named values that is not finite."""
    for name, value in values.items():
        if not np.all(np.isfinite(value)):
            raise ValueError(f"{name} is {number(value)}: a law needs finite numbers")


def check_above_zero(remedy: str, **values: Numbers) -> None:
    """Raise ValueError for the first of the named values that is not above 0 and finite."""
    for name, value in values.items():
        if not np.all((value > 0) & np.isfinite(value)):
            raise ValueError(f"{name} is {number(value)}, but it must be above 0: {remedy}")


def check_axes(**values: Numbers) -> None:
    """Raise ValueError for values of more than one dimension, or of different numbers of axes."""
    shapes = {name: value.shape for name, value in values.items()}
    if any(len(shape) > 1 for shape in shapes.values()) or len(set(shapes.values()) - {()}) > 1:
        text = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise ValueError(
            f"a law's numbers have the shapes {text}: give one for all axes, or one for each axis"
        )


def check_ends(low: Numbers, high: Numbers) -> None:
    """Raise ValueError unless low < high, both finite."""
    check_axes(low=low, high=high)
    check_finite(low=low, high=high)
    if not np.all(low < high):
        raise ValueError(
            f"a law from {number(low)} to {number(high)} is empty: give low < high, and a plain "
            "number for what does not vary"
        )


def from_end_to_end(count: int) -> Float[np.ndarray, " count"]:
    """Shares of the probability for a grid that holds both ends of a range."""
    return np.linspace(0.0, 1.0, count) if count > 1 else np.array([0.5])
