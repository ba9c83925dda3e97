import dataclasses
import functools as ft
from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from ._channel import within
from ._clock import Number, Times, window
from ._errors import RecordError
from ._record import as_tuple, assemble, Record


Channels = Float[np.ndarray, "samples channels"]
_ROLES = ("input", "output", "reference")


def trim(record: Record, start: Number | None = None, stop: Number | None = None) -> Record:
    """The part of a record from `start` to `stop`.

    **Arguments:**

    - `record`: a `Record`.
    - `start`, `stop`: first and last time in s of the record's own time, both included; `None` is
        the end of the record.

    **Returns:** a `Record` with the same channels.

    **Raises:**

    - `RecordError`: where the range leaves the record or holds fewer than 16 samples.
    """
    span = window(record.time, start, stop)
    time = record.time[span]
    return dataclasses.replace(
        record,
        time=time,
        inputs=record.inputs[span],
        outputs=record.outputs[span],
        references=record.references[span],
        time_unit="s",
        repaired=within(record.repaired, time[0], time[-1]),
    )


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

    return dataclasses.replace(
        record,
        inputs=flatten(record.inputs),
        outputs=flatten(record.outputs),
        references=flatten(record.references),
        time_unit="s",
    )


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
    hold = record.hold if set(roles[0]) <= set(record.input_names) else None
    return assemble(
        record.time,
        roles,
        record.channel,
        record.unit,
        source=record.source,
        hold=hold,
        repaired=record.repaired,
    )


def mix(
    record: Record,
    name: str,
    weights: Mapping[str, Number],
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
    unknown_hold = role == "input" and not set(weights) <= set(record.input_names)
    return assemble(
        record.time,
        roles,
        lambda channel: column if channel == name else record.channel(channel),
        lambda channel: unit if channel == name else record.unit(channel),
        source=record.source,
        hold=None if unknown_hold else record.hold,
        repaired=record.repaired,
    )


def combine(
    name: str,
    weights: Mapping[str, Number],
    values: Callable[[str], Times],
) -> Times:
    """The weighted sum that makes the channel `name`; a single weight of 1 changes no bit."""
    if not weights:
        raise RecordError(f"the sum {name!r} is empty: give it channels and their weights.")
    for source, weight in weights.items():
        if not np.isfinite(weight):
            raise RecordError(
                f"the weight of {source!r} in the sum {name!r} is {weight}: use a finite number."
            )
    return ft.reduce(np.add, (weight * values(source) for source, weight in weights.items()))
