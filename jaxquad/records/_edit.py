import functools as ft
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from ._clock import window
from ._errors import RecordError
from ._record import as_tuple, Record
from ._repair import within


Channels = Float[np.ndarray, "samples channels"]
_ROLES = ("input", "output", "reference")


def trim(
    record: Record, start: float | int | None = None, stop: float | int | None = None
) -> Record:
    """The part of a record from `start` to `stop`.

    **Arguments:**

    - `record`: a `Record`.
    - `start`, `stop`: first and last time in s of the record's own time, both included; `None` is
        the end of the record.

    **Returns:** a `Record` with the same channels.

    **Raises:**

    - `RecordError`: where the range leaves the record or holds fewer than 16 samples.
    """
    kept = window(record.time, start, stop)
    return _rebuilt(record, record.time[kept], lambda channels: channels[kept])


def detrend(record: Record, *, order: Literal[0, 1] = 0) -> Record:
    """Subtract the mean or the least-squares line from every channel.

    **Arguments:**

    - `record`: a `Record`.
    - `order`: 0 for the mean, 1 for the line.

    **Returns:** a `Record` with the same channels.

    **Raises:**

    - `RecordError`: for another `order`.
    """
    if order not in (0, 1):
        raise RecordError(f"order is {order}: use 0 to remove the mean, 1 to remove a line.")
    centred = np.linspace(-1.0, 1.0, record.samples)[:, None]

    def flatten(channels: Channels) -> Channels:
        level = channels - channels.mean(axis=0)
        slope = (centred * level).sum(axis=0) / (centred**2).sum()
        return level - order * slope * centred

    return _rebuilt(record, record.time, flatten)


def select(
    record: Record,
    *,
    inputs: str | Sequence[str],
    outputs: str | Sequence[str],
    references: str | Sequence[str] = (),
) -> Record:
    """Assign new roles to channels, and drop the others.

    **Arguments:**

    - `record`: a `Record`.
    - `inputs`, `outputs`, `references`: names of channels of the record, whatever their role was.

    **Returns:** a `Record` of the named channels, with their units. Its `hold` is known where every
    input was one before.

    **Raises:**

    - `RecordError`: for a name that the record lacks or that is given twice.
    """
    roles = [as_tuple(names) for names in (inputs, outputs, references)]
    hold = _hold_of(record, roles[0])
    return _assembled(record, roles, record.channel, record.unit, hold)


def mix(
    record: Record,
    name: str,
    weights: Mapping[str, float | int],
    *,
    role: Literal["input", "output", "reference"] = "input",
) -> Record:
    """Add a channel that is a weighted sum of others, such as a roll command of four motors.

    **Arguments:**

    - `record`: a `Record`.
    - `name`: of the new channel.
    - `weights`: channel name -> weight.
    - `role`: what the new channel is.

    **Returns:** the `Record` with one channel more. Its unit is that of the summed channels where
    they agree, else unknown.

    **Raises:**

    - `RecordError`: for no weight, a weight that is not finite, a channel that the record lacks, or
        a `name` that it has.

    !!! Example

        ```python
        record = jq.records.mix(record, "roll", {"m1": -1, "m2": -1, "m3": 1, "m4": 1})
        ```
    """
    if role not in _ROLES:
        raise RecordError(f"role is {role!r}: use one of {', '.join(_ROLES)}.")
    column = combine(name, weights, record.channel)
    shared = {record.unit(source) for source in weights}
    unit = shared.pop() if len(shared) == 1 else ""
    roles = [record.input_names, record.output_names, record.reference_names]
    roles[_ROLES.index(role)] += (name,)
    hold = _hold_of(record, weights) if role == "input" else record.hold
    return _assembled(
        record,
        roles,
        lambda each: column if each == name else record.channel(each),
        lambda each: unit if each == name else record.unit(each),
        hold,
    )


def combine(
    name: str,
    weights: Mapping[str, float | int],
    values: Callable[[str], Float[np.ndarray, " samples"]],
) -> Float[np.ndarray, " samples"]:
    """The weighted sum that makes the channel `name`; a single weight of 1 changes no bit."""
    if not weights:
        raise RecordError(f"the sum {name!r} is empty: give it channels and their weights.")
    for source, weight in weights.items():
        if not np.isfinite(weight):
            raise RecordError(
                f"the weight of {source!r} in the sum {name!r} is {weight}: use a finite number."
            )
    return ft.reduce(np.add, (weight * values(source) for source, weight in weights.items()))


def _hold_of(record: Record, sources: Iterable[str]) -> float | None:
    """The hold of channels as inputs: known of the record's own inputs alone."""
    return record.hold if set(sources) <= set(record.input_names) else None


def _assembled(
    record: Record,
    roles: Sequence[tuple[str, ...]],
    values: Callable[[str], Float[np.ndarray, " samples"]],
    unit: Callable[[str], str],
    hold: float | None,
) -> Record:
    blocks = [
        np.stack([values(name) for name in names], axis=1)
        if names
        else np.empty((record.samples, 0))
        for names in roles
    ]
    units = [[unit(name) for name in names] for names in roles]
    return Record(
        record.time,
        *blocks,
        input_names=roles[0],
        output_names=roles[1],
        reference_names=roles[2],
        input_units=units[0],
        output_units=units[1],
        reference_units=units[2],
        source=record.source,
        hold=hold,
        time_unit="s",
        repaired=record.repaired,
    )


def _rebuilt(
    record: Record,
    time: Float[np.ndarray, " kept"],
    change: Callable[[Channels], Float[np.ndarray, "kept channels"]],
) -> Record:
    return Record(
        time,
        change(record.inputs),
        change(record.outputs),
        change(record.references),
        input_names=record.input_names,
        output_names=record.output_names,
        reference_names=record.reference_names,
        input_units=record.input_units,
        output_units=record.output_units,
        reference_units=record.reference_units,
        source=record.source,
        hold=record.hold,
        time_unit="s",
        repaired=within(record.repaired, time[0], time[-1]),
    )
