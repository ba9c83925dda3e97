import functools as ft
from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from ._clock import window
from ._errors import RecordError
from ._names import as_tuple
from ._record import Record


Channels = Float[np.ndarray, "samples channels"]
_ROLES = ("input", "output", "reference")


def trim(
    record: Record, start: float | int | None = None, stop: float | int | None = None
) -> Record:
    """The part from `start` to `stop`, both in s of the record's own time and included.

    Raises RecordError if that leaves the record's range or fewer than 16 samples.
    """
    kept = window(record.time, start, stop)
    return _rebuilt(record, record.time[kept], lambda channels: channels[kept])


def detrend(record: Record, *, order: Literal[0, 1] = 0) -> Record:
    """Every channel less its mean (`order` 0) or its least-squares line (`order` 1)."""
    if order not in (0, 1):
        raise RecordError(f"order {order}: 0 takes away the mean, 1 the line.")
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
    """Give the named channels, whatever their role was, new roles; drop the others."""
    roles = [as_tuple(names) for names in (inputs, outputs, references)]
    return _assembled(record, roles, record.channel, record.unit)


def mix(
    record: Record,
    name: str,
    weights: Mapping[str, float | int],
    *,
    role: Literal["input", "output", "reference"] = "input",
) -> Record:
    """Add the channel `name`, a weighted sum of others, such as motors to a roll command.

    Its unit is that of the summed channels where they agree, else unknown.
    """
    if role not in _ROLES:
        raise RecordError(f"role {role!r}: it is one of {', '.join(_ROLES)}.")
    column = combine(name, weights, record.channel)
    shared = {record.unit(source) for source in weights}
    unit = shared.pop() if len(shared) == 1 else ""
    roles = [record.input_names, record.output_names, record.reference_names]
    roles[_ROLES.index(role)] += (name,)
    return _assembled(
        record,
        roles,
        lambda each: column if each == name else record.channel(each),
        lambda each: unit if each == name else record.unit(each),
    )


def combine(
    name: str,
    weights: Mapping[str, float | int],
    values: Callable[[str], Float[np.ndarray, " samples"]],
) -> Float[np.ndarray, " samples"]:
    """The weighted sum that makes the channel `name`; a lone weight of 1 changes no bit."""
    if not weights:
        raise RecordError(f"the mix {name!r} is empty: give it channels with their weights.")
    for source, weight in weights.items():
        if not np.isfinite(weight):
            raise RecordError(f"the mix {name!r} weighs {source!r} by {weight}: use a number.")
    return ft.reduce(np.add, (weight * values(source) for source, weight in weights.items()))


def _assembled(
    record: Record,
    roles: Sequence[tuple[str, ...]],
    values: Callable[[str], Float[np.ndarray, " samples"]],
    unit: Callable[[str], str],
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
    )
