"""Tables of responses that were measured elsewhere: columns, and the properties of an `idfrd`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float

from jaxquad._core import concrete_values, is_traced
from jaxquad.records import read_struct, ReadError

from ._estimators import Grid, Pairs, Responses


FrequencyUnit = Literal["rad/s", "Hz"]


@runtime_checkable
class HasFrequencyData(Protocol):
    """A `FrequencyResponseData` of python-control: outputs, inputs, frequencies."""

    @property
    def omega(self) -> np.ndarray: ...  # rad/s

    @property
    def frdata(self) -> np.ndarray: ...

    @property
    def dt(self) -> float | bool | None: ...  # s

    @property
    def input_labels(self) -> Sequence[str]: ...

    @property
    def output_labels(self) -> Sequence[str]: ...


_LEAST = 1e-6  # random error: a response without any would count infinitely


def on_host(x: Any) -> np.ndarray:
    """The values, of what `jax.grad` traces too."""
    return np.asarray(concrete_values(x, "FrequencyResponse.from_table"))


def as_grid(omega: Float[ArrayLike, "..."], unit: FrequencyUnit) -> Grid:
    """Frequencies in rad/s. Raises ValueError for a row that is none."""
    if unit not in ("rad/s", "Hz"):
        raise ValueError(f"frequency_unit is {unit!r}: give 'rad/s' or 'Hz'")
    grid = np.asarray(omega, float) * (2 * np.pi if unit == "Hz" else 1.0)
    if grid.ndim != 1:
        raise ValueError(f"omega has the shape {grid.shape}: give one row of frequencies")
    if not (np.all(np.isfinite(grid)) and np.all(grid > 0) and np.all(np.diff(grid) > 0)):
        raise ValueError(f"omega must be finite, above 0 and rising: sort the table, in {unit}")
    return grid


def as_responses(
    grid: Grid,
    response: Complex[ArrayLike, "..."] | None,
    magnitude_db: Float[ArrayLike, "..."] | None,
    phase_deg: Float[ArrayLike, "..."] | None,
) -> Complex[Array | np.ndarray, "frequencies outputs inputs"]:
    """Complex numbers of all pairs. Raises ValueError for none, two kinds or what is not finite."""
    polar = magnitude_db, phase_deg
    if (response is None) != all(x is not None for x in polar) or (
        response is not None and any(x is not None for x in polar)
    ):
        raise ValueError(
            "a table needs its response, one of two: complex numbers (response), or magnitude_db= "
            "with phase_deg="
        )
    xp = _library(response, *polar)
    if response is None:
        db, phase = xp.asarray(magnitude_db, float), xp.asarray(phase_deg, float)
        response = 10 ** (db / 20) * xp.exp(1j * xp.radians(phase))
    values = xp.asarray(response, complex)
    values = values[:, None, None] if values.ndim == 1 else values
    if values.ndim != 3 or len(values) != grid.size:
        raise ValueError(
            f"omega has the shape {grid.shape} and the response {values.shape}: give as "
            "many complex numbers, or (frequencies, outputs, inputs)"
        )
    finite = np.isfinite(on_host(values)).all(axis=(1, 2))
    if not np.all(finite):
        first = grid[int(np.argmin(finite))]
        raise ValueError(f"the response is not finite at {first:.4g} rad/s: leave that row out")
    return values


def random_errors(
    values: Complex[Array | np.ndarray, "frequencies outputs inputs"],
    coherence: Float[ArrayLike, "..."] | None,
    averages: float | int | None,
    random_error: Float[ArrayLike, "..."] | None,
) -> tuple[Pairs | Array, Pairs | Array]:
    """Coherence and relative random error of all numbers. Raises ValueError as `from_table`."""
    xp = _library(values, coherence, random_error)

    def of_each(name: str, numbers: ArrayLike) -> Array | np.ndarray:
        """A number, one for each frequency, or one for each pair, as all of the response."""
        array = xp.asarray(numbers, float)
        array = array[:, None, None] if array.ndim == 1 else array
        try:
            return xp.broadcast_to(array, values.shape).copy()
        except ValueError:
            raise ValueError(
                f"{name} has the shape {np.shape(numbers)} and the response {values.shape}: give "
                "one number, one for each frequency, or one for each number of the response"
            ) from None

    if (coherence is None) == (random_error is None):
        raise ValueError(
            "a table needs its errors, without which there are no intervals: give coherence= with "
            "averages=, or random_error=, the relative standard error of the magnitude (0.02 for "
            "2 %)"
        )
    if coherence is not None and averages is None:
        raise ValueError(
            "a coherence tells the error only with the number of windows that it is from: give "
            "averages= (for overlapping windows about the record's length over a window's)"
        )
    averages = 1 if averages is None else averages
    if not averages > 0:
        raise ValueError(f"averages is {averages}: give how many windows were averaged, 1 or more")
    if coherence is not None:
        coherent = of_each("coherence", coherence)
        low, high = on_host(coherent).min(), on_host(coherent).max()
        if not 0 < low <= high <= 1:
            ends = f"{low:.4g} to {high:.4g}"
            raise ValueError(f"the coherence runs from {ends}: give numbers above 0, up to 1")
        return coherent, xp.maximum(xp.sqrt((1 - coherent) / (2 * averages * coherent)), _LEAST)
    assert random_error is not None
    error = of_each("random_error", random_error)
    low = on_host(error).min()
    if not low > 0:
        raise ValueError(
            f"the random error is {low:.4g} at its least: give it above 0, 0.02 for 2 %"
        )
    return 1 / (1 + 2 * averages * error**2), xp.maximum(error, _LEAST)


def _library(*numbers: object) -> Any:
    """NumPy, or that of JAX for what it traces."""
    if not is_traced(numbers):
        return np
    import jax.numpy as jnp

    return jnp


def channel_names(kind: str, chosen: Sequence[str], letter: str, count: int) -> tuple[str, ...]:
    """Those of the user, or a letter with numbers. Raises ValueError for too many or too few."""
    names = tuple(chosen) or tuple(f"{letter}{k}" for k in range(count))
    if len(names) != count:
        raise ValueError(f"{kind} has {len(names)} names and the response {count} channels")
    return names


_SAVE = "s = get(g); save('g.mat', 's', '-v7')"
_RADIANS = {"rad/s": 1.0, "rad/TimeUnit": 1.0, "Hz": 2 * np.pi, "cycles/TimeUnit": 2 * np.pi}


class StoredTable(NamedTuple):
    """What the properties of an `idfrd` say."""

    omega: Grid  # rad/s
    response: Responses
    random_error: Pairs | None  # None without `CovarianceData`
    input_names: tuple[str, ...]  # empty where MATLAB has none
    output_names: tuple[str, ...]
    dt: float  # s, 0 for a continuous one
    hold: float | None  # s


def read_idfrd(path: str | Path, variable: str | None) -> StoredTable:
    """`FrequencyResponse.from_idfrd`, without errors that the caller gives."""
    names = frozenset(("ResponseData", "Frequency"))
    fields = read_struct(path, names, variable=variable, save=_SAVE)
    unit, second = (str(fields.get(x, "")) for x in ("FrequencyUnit", "TimeUnit"))
    if unit not in ("", *_RADIANS) or second not in ("", "seconds"):
        raise ValueError(
            f"{path}: FrequencyUnit is {unit!r} and TimeUnit {second!r}: in MATLAB, "
            "g = chgFreqUnit(g, 'rad/s') and g = chgTimeUnit(g, 'seconds') first"
        )
    late = [x for x in ("InputDelay", "OutputDelay", "IODelay") if np.any(_numbers(fields, x))]
    if late:
        raise ValueError(
            f"{path}: {late[0]} is not 0, and ResponseData lacks it: in MATLAB, "
            "g = absorbDelay(g) first"
        )
    omega = np.atleast_1d(_numbers(fields, "Frequency")) * _RADIANS[unit or "rad/s"]
    inputs, outputs = (_texts(fields, x) for x in ("InputName", "OutputName"))
    shape = max(len(outputs), 1), max(len(inputs), 1), omega.size
    response, covariance = np.asarray(fields["ResponseData"]), _numbers(fields, "CovarianceData")
    for label, size in (("ResponseData", response.size), ("CovarianceData", covariance.size / 4)):
        if size != np.prod(shape) and (size or label == "ResponseData"):
            raise ReadError(
                f"{path}: {label} has {size:g} responses, and OutputName, InputName and Frequency "
                f"ask for {' x '.join(map(str, shape))}: save all properties, {_SAVE}"
            )
    response, error = np.moveaxis(response.reshape(shape).astype(complex), -1, 0), None
    if covariance.size:  # of the real and the imaginary part
        power = np.trace(covariance.reshape(*shape, 2, 2), axis1=3, axis2=4)
        error = np.sqrt(0.5 * np.moveaxis(power, -1, 0)) / np.abs(response)
    dt = max(float(np.sum(_numbers(fields, "Ts"))), 0.0)
    kinds = set(_texts(fields, "InterSample"))
    hold = {"zoh": dt, "bl": 0.0}.get(kinds.pop()) if dt and len(kinds) == 1 else None
    named = lambda texts: tuple(texts) if all(texts) else ()
    return StoredTable(omega, response, error, named(inputs), named(outputs), dt, hold)


def _numbers(fields: Mapping[str, Any], name: str) -> np.ndarray:
    """An array of numbers; empty where there is none."""
    return np.asarray(fields.get(name, ()), float)


def _texts(fields: Mapping[str, Any], name: str) -> list[str]:
    """The texts of a cell; empty ones are arrays without elements."""
    cells = np.atleast_1d(np.asarray(fields.get(name, ()), object))
    return ["" if np.size(text) == 0 else str(text) for text in cells]
