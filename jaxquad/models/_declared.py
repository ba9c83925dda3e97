"""What fields of models declare of their numbers: units, and what these are to a fit."""

import dataclasses
import functools as ft
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

from jaxtyping import PyTree


class Scale(NamedTuple):
    """The unit of a coefficient: (output unit / input unit) / s^power, or 1 / s^power alone."""

    power: int
    of_ratio: bool = True


Unit = str | Callable[[PyTree, int], Scale]  # by the model, and by the index within an array


def unit(declared: Unit) -> dict[str, Unit]:
    """The metadata of a field whose numbers have this unit."""
    return {"unit": declared}


OPTIONAL = {"optional": True}  # metadata of a field that is no term of the model while it is 0
SIGNED = {"signed": True}  # metadata of a field whose numbers may cross 0 in a fit

_NAME = re.compile(r"([A-Za-z_][\w.]*)(?:\[(\d+)\])?.*")
_PER_SECOND = re.compile(r"(.*?)(?:/s(?:\^(\d+))?)?")


def parameter_units(
    model: PyTree, names: Sequence[str], *, output: str = "output", input: str = "input"
) -> tuple[str, ...]:
    """The units of numbers of a model, as its fields declare them.

    **Arguments:**

    - `model`: for instance `Fit.model`.
    - `names`: of its numbers, as `Fit.names`: `gain`, `numerator[0]`, `plant.lag`.
    - `output`, `input`: the units of the channels, or their names where those are not known.

    **Returns:** a text for each name, such as `rad/s^2 per N m`; empty where the model declares
    none.
    """
    units = []
    for name in names:
        owner, metadata = _declared(model, name)
        kind = metadata.get("unit", "")
        if not isinstance(kind, str):
            match = _NAME.fullmatch(name)
            power, of_ratio = kind(owner, int(match[2] or 0) if match else 0)
            if of_ratio:
                kind = f"{_over_seconds(output, power)} per {input}"
            else:
                kind = _over_seconds("1", power) if power else ""
        units.append(kind)
    return tuple(units)


def declares(model: PyTree, name: str, what: Literal["optional", "signed"]) -> bool:
    """Whether a number is no term of the model while it is 0, or may cross 0, as its field says."""
    return bool(_declared(model, name)[1].get(what))


def _declared(model: PyTree, name: str) -> tuple[PyTree, Mapping]:
    """The part of a model that has a number, and the metadata of its field there."""
    match = _NAME.fullmatch(name)
    *owners, leaf = match[1].split(".") if match else ("",)
    for owner in owners:
        model = vars(model).get(owner) if dataclasses.is_dataclass(model) else None
    return model, _metadata(type(model)).get(leaf, {})


@ft.lru_cache(maxsize=64)
def _metadata(kind: type) -> dict[str, Mapping]:
    fields = dataclasses.fields(kind) if dataclasses.is_dataclass(kind) else ()
    return {field.name: field.metadata for field in fields}


def _over_seconds(unit: str, power: int) -> str:
    """`rad/s` over s is `rad/s^2`."""
    match = _PER_SECOND.fullmatch(unit)
    if match and unit != match[1]:
        unit, power = match[1], power + int(match[2] or 1)
    return unit if power == 0 else f"{unit}/s" if power == 1 else f"{unit}/s^{power}"
