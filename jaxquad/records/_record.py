import warnings

import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ._clock import check_increasing, check_uniform, FEWEST
from ._errors import RecordError, RecordWarning
from ._names import as_names, as_units, check_distinct, Names, unknown_name


class Record(eqx.Module):
    """Uniformly sampled inputs, outputs and references of one run.

    **Arguments:**

    - `time`: time stamps in s, uniform within 2 % of a sample; at least 16.
    - `inputs`, `outputs`: shape `(samples, channels)`, or `(samples,)` for a single channel.
    - `references`: likewise; external signals that no feedback changes, such as an injected sweep.
        A record may have none.
    - `input_names`, `output_names`, `reference_names`: by default `u`, `y`, `r`, with numbers from
        1 where there are several.
    - `input_units`, `output_units`, `reference_units`: empty where unknown.
    - `source`: where the data come from, such as a path.

    **Raises:**

    - `RecordError`: for arrays of unequal length, NaN, time stamps that are not uniform, and names
        that occur twice. A channel that never changes gives a `RecordWarning`.
    """

    time: Float[np.ndarray, " samples"]  # s
    inputs: Float[np.ndarray, "samples inputs"]
    outputs: Float[np.ndarray, "samples outputs"]
    references: Float[np.ndarray, "samples references"]
    input_names: tuple[str, ...] = eqx.field(static=True)
    output_names: tuple[str, ...] = eqx.field(static=True)
    reference_names: tuple[str, ...] = eqx.field(static=True)
    input_units: tuple[str, ...] = eqx.field(static=True)
    output_units: tuple[str, ...] = eqx.field(static=True)
    reference_units: tuple[str, ...] = eqx.field(static=True)
    source: str = eqx.field(static=True)

    def __init__(
        self,
        time: ArrayLike,
        inputs: ArrayLike,
        outputs: ArrayLike,
        references: ArrayLike | None = None,
        *,
        input_names: Names = None,
        output_names: Names = None,
        reference_names: Names = None,
        input_units: Names = None,
        output_units: Names = None,
        reference_units: Names = None,
        source: str = "",
    ):
        self.time = _stamps(time)
        rows = self.time.size
        self.inputs = _columns("inputs", inputs, rows)
        self.outputs = _columns("outputs", outputs, rows)
        none = np.empty((rows, 0))
        self.references = none if references is None else _columns("references", references, rows)
        self.input_names = as_names(input_names, "u", self.inputs.shape[1])
        self.output_names = as_names(output_names, "y", self.outputs.shape[1])
        self.reference_names = as_names(reference_names, "r", self.references.shape[1])
        self.input_units = as_units(input_units, self.input_names)
        self.output_units = as_units(output_units, self.output_names)
        self.reference_units = as_units(reference_units, self.reference_names)
        self.source = source
        _check_channels(self)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all channels: inputs, outputs, references."""
        return self.input_names + self.output_names + self.reference_names

    @property
    def samples(self) -> int:
        return self.time.size

    @property
    def duration(self) -> float:
        """Time from the first to the last sample, in s."""
        return float(self.time[-1] - self.time[0])

    @property
    def dt(self) -> float:
        """Sample interval in s."""
        return self.duration / (self.samples - 1)

    @property
    def sample_rate(self) -> float:
        """Samples per second, in Hz."""
        return (self.samples - 1) / self.duration

    def channel(self, name: str) -> Float[np.ndarray, " samples"]:
        """The values of one channel, whatever its role."""
        return _each_channel(self)[_position(self, name)]

    def unit(self, name: str) -> str:
        """The unit of one channel, empty where unknown."""
        units = self.input_units + self.output_units + self.reference_units
        return units[_position(self, name)]

    def __str__(self) -> str:
        roles = ("inputs", "outputs", "references")
        names = (self.input_names, self.output_names, self.reference_names)
        lines = [
            f"Record {self.source}".rstrip(),
            f"  {self.samples} samples, {self.duration:.6g} s at {self.sample_rate:.6g} Hz "
            f"(t = {self.time[0]:.6g} .. {self.time[-1]:.6g} s)",
        ]
        for role, members in zip(roles, names, strict=True):
            texts = [f"{name} [{self.unit(name)}]" if self.unit(name) else name for name in members]
            lines.append(f"  {role}: {', '.join(texts) or 'none'}")
        return "\n".join(lines)


def _each_channel(record: Record) -> list[Float[np.ndarray, " samples"]]:
    return [*record.inputs.T, *record.outputs.T, *record.references.T]


def _position(record: Record, name: str) -> int:
    if name not in record.names:
        raise RecordError(unknown_name(name, record.names))
    return record.names.index(name)


def _stamps(time: ArrayLike) -> Float[np.ndarray, " samples"]:
    stamps = _float64("time", time)
    if stamps.ndim != 1:
        raise RecordError(f"time has shape {stamps.shape}: give one value for each sample.")
    if stamps.size < FEWEST:
        raise RecordError(f"{stamps.size} samples: a record needs at least {FEWEST}.")
    check_increasing("time", stamps)
    check_uniform(stamps)
    return stamps


def _columns(role: str, values: ArrayLike, rows: int) -> Float[np.ndarray, "samples channels"]:
    array = _float64(role, values)
    array = array[:, None] if array.ndim == 1 else array
    if array.ndim != 2:
        raise RecordError(f"{role} has shape {array.shape}: it must be (samples, channels).")
    if array.shape[0] != rows:
        hint = "Transpose it." if array.shape[1] == rows else "Cut or resample one of the two."
        raise RecordError(
            f"{role} has {array.shape[0]} rows for {rows} time stamps; the shape must be "
            f"(samples, channels). {hint}"
        )
    if array.shape[1] == 0 and role != "references":
        raise RecordError(f"{role} has no channel: a record needs at least one input and output.")
    return array


def _float64(label: str, values: ArrayLike) -> np.ndarray:
    if np.iscomplexobj(values):
        raise RecordError(f"{label} is complex: a record holds real numbers.")
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise RecordError(f"{label} is not an array of numbers: {error}.") from error


def _check_channels(record: Record) -> None:
    check_distinct(record.names)
    for name, values in zip(record.names, _each_channel(record), strict=True):
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise RecordError(
                f"channel {name!r} holds {np.isnan(values).sum()} NaN and "
                f"{np.isinf(values).sum()} inf, the first at t = {record.time[bad[0]]:.6g} s. "
                f"Choose a range without them (start=, stop=; --start, --stop), or repair them."
            )
        if np.ptp(values) == 0:
            warnings.warn(
                f"channel {name!r} is constant at {values[0]:.6g}: nothing can be identified from "
                f"it. Check that it was excited and logged.",
                RecordWarning,
                stacklevel=4,
            )
