"""Frequency responses that were measured elsewhere: a table, or python-control's FRD."""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import ArrayLike, Complex, Float


Pairs = Float[np.ndarray, "frequencies outputs inputs"]


@runtime_checkable
class HasFrequencyData(Protocol):
    """A `FrequencyResponseData` of python-control: outputs, inputs, frequencies."""

    @property
    def omega(self) -> np.ndarray: ...  # rad/s

    @property
    def frdata(self) -> np.ndarray: ...


class Table(NamedTuple):
    """A measured response and what its errors are."""

    omega: Float[np.ndarray, " frequencies"]  # rad/s
    response: Complex[np.ndarray, "frequencies outputs inputs"]
    coherence: Pairs
    random_error: Pairs


_LEAST = 1e-6  # random error: a response without any would count infinitely


def read_table(
    omega: Float[ArrayLike, " frequencies"] | HasFrequencyData,
    response: Complex[ArrayLike, "frequencies ..."] | None,
    coherence: Float[ArrayLike, "..."] | None,
    random_error: Float[ArrayLike, "..."] | None,
    averages: float | int,
) -> Table:
    """The numbers of `FrequencyResponse.from_table`, which raises what this does."""
    if isinstance(omega, HasFrequencyData):
        if response is not None:
            raise ValueError("give a FrequencyResponseData alone, or omega and response")
        omega, response = np.asarray(omega.omega), np.moveaxis(np.asarray(omega.frdata), -1, 0)
    elif response is None:
        raise ValueError("a table needs its response: give omega and as many complex numbers")
    grid, values = _require_table(omega, response)
    if (coherence is None) == (random_error is None):
        raise ValueError(
            "a table needs its errors, one of two: coherence= with averages=, or random_error=, "
            "the relative standard error of the magnitude (0.02 for 2 %)"
        )
    if not averages > 0:
        raise ValueError(f"averages is {averages}: give how many windows were averaged, 1 or more")
    if coherence is not None:
        coherent = _like("coherence", coherence, values)
        if not np.all((coherent > 0) & (coherent <= 1)):
            ends = f"{coherent.min():.4g} to {coherent.max():.4g}"
            raise ValueError(f"the coherence runs from {ends}: give numbers above 0, up to 1")
        error = np.sqrt((1 - coherent) / (2 * averages * coherent))
    else:
        assert random_error is not None
        error = _like("random_error", random_error, values)
        if not np.all(error > 0):
            raise ValueError(
                f"the random error is {error.min():.4g} at its least: give it above 0, 0.02 for 2 %"
            )
        coherent = 1 / (1 + 2 * averages * error**2)
    return Table(grid, values, coherent, np.maximum(error, _LEAST))


def _require_table(
    omega: ArrayLike, response: ArrayLike
) -> tuple[Float[np.ndarray, " frequencies"], Complex[np.ndarray, "frequencies outputs inputs"]]:
    grid, values = np.asarray(omega, float), np.asarray(response, complex)
    values = values[:, None, None] if values.ndim == 1 else values
    if grid.ndim != 1 or values.ndim != 3 or len(values) != grid.size:
        raise ValueError(
            f"omega has the shape {grid.shape} and the response {np.shape(response)}: give one "
            "row of frequencies, and as many complex numbers or (frequencies, outputs, inputs)"
        )
    if not (np.all(np.isfinite(grid)) and np.all(grid > 0) and np.all(np.diff(grid) > 0)):
        raise ValueError("omega must be finite, above 0 and rising: sort the table, in rad/s")
    if not np.all(np.isfinite(values)):
        first = grid[int(np.argmin(np.isfinite(values).all(axis=(1, 2))))]
        raise ValueError(f"the response is not finite at {first:.4g} rad/s: leave that row out")
    return grid, values


def _like(name: str, numbers: ArrayLike, values: np.ndarray) -> Pairs:
    """A number, one for each frequency, or one for each pair, as all of a response."""
    array = np.asarray(numbers, float)
    array = array[:, None, None] if array.ndim == 1 else array
    try:
        return np.broadcast_to(array, values.shape).copy()
    except ValueError:
        raise ValueError(
            f"{name} has the shape {np.shape(numbers)} and the response {values.shape}: give one "
            "number, one for each frequency, or one for each number of the response"
        ) from None
