import dataclasses
import re
from collections.abc import Callable, Sequence
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


def _unit_of(model: PyTree, name: str, output: str, input: str) -> str:
    found = _NAME.fullmatch(name)
    *owners, leaf = found[1].split(".") if found else ("",)
    for owner in owners:
        model = vars(model).get(owner) if dataclasses.is_dataclass(model) else None
    if not dataclasses.is_dataclass(model):
        return ""
    declared = {field.name: field.metadata.get("unit", "") for field in dataclasses.fields(model)}
    kind = declared.get(leaf, "")
    if isinstance(kind, str):
        return kind
    scale = kind(model, int(found[2] or 0) if found else 0)
    if scale.of_ratio:
        return f"{_over_seconds(output, scale.power)} per {input}"
    return _over_seconds("1", scale.power) if scale.power else ""


def _over_seconds(unit: str, power: int) -> str:
    """`rad/s` over s is `rad/s^2`."""
    found = _PER_SECOND.fullmatch(unit)
    base, own = (found[1], int(found[2] or 1) if unit != found[1] else 0) if found else (unit, 0)
    total = own + power
    return base if total == 0 else f"{base}/s" if total == 1 else f"{base}/s^{total}"
