import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

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
    return tuple(_unit_of(model, name, output, input) for name in names)


def is_optional(model: PyTree, name: str) -> bool:
    """Whether a number of a model is no term of it while it is 0, as its field declares."""
    return bool(_declared(model, name)[1].get("optional"))


def _declared(model: PyTree, name: str) -> tuple[PyTree, Mapping]:
    """The part of a model that has a number, and the metadata of its field there."""
    match = _NAME.fullmatch(name)
    *owners, leaf = match[1].split(".") if match else ("",)
    for owner in owners:
        model = vars(model).get(owner) if dataclasses.is_dataclass(model) else None
    fields = dataclasses.fields(model) if dataclasses.is_dataclass(model) else ()
    return model, {field.name: field.metadata for field in fields}.get(leaf, {})


def _unit_of(model: PyTree, name: str, output: str, input: str) -> str:
    owner, declared = _declared(model, name)
    kind = declared.get("unit", "")
    if isinstance(kind, str):
        return kind
    match = _NAME.fullmatch(name)
    scale = kind(owner, int(match[2] or 0) if match else 0)
    if scale.of_ratio:
        return f"{_over_seconds(output, scale.power)} per {input}"
    return _over_seconds("1", scale.power) if scale.power else ""


def _over_seconds(unit: str, power: int) -> str:
    """`rad/s` over s is `rad/s^2`."""
    match = _PER_SECOND.fullmatch(unit)
    base, own = (match[1], int(match[2] or 1) if unit != match[1] else 0) if match else (unit, 0)
    total = own + power
    return base if total == 0 else f"{base}/s" if total == 1 else f"{base}/s^{total}"
