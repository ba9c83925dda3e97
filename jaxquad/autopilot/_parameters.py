"""The firmwares' parameters: what is stored of them, and their places in a law."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad._core import Number
from jaxquad.records import AXES
from jaxquad.records.firmware import firmware_names

from ._filters import Butterworth
from ._firmware import firmware_named, Parameter
from ._law import AngleLoop, FirmwareLoop, FlownLoop, RateLoop


Law = TypeVar("Law", bound=FirmwareLoop)


class _Tables(Mapping[str, Mapping[str, Parameter]]):
    def __iter__(self) -> Iterator[str]:
        return iter(firmware_names())

    def __len__(self) -> int:
        return len(firmware_names())

    def __getitem__(self, name: str) -> Mapping[str, Parameter]:
        if name not in firmware_names():
            raise KeyError(name)
        return firmware_named(name).parameters


PARAMETERS: Mapping[str, Mapping[str, Parameter]] = _Tables()
"""The parameters of each firmware by name."""


def find_parameter(firmware: str, name: str) -> Parameter:
    """The parameter of this name. Raises ValueError for one that is not in the table."""
    row = PARAMETERS[firmware].get(name)
    if row is None:
        near = [x for x in PARAMETERS[firmware] if x.lower()[:4] == name.lower()[:4]]
        raise ValueError(
            f"{name} is no parameter that is known of {firmware}"
            + (f": do you mean one of {', '.join(near[:6])}?" if near else ".")
        )
    return row


def store_parameters(firmware: str, values: Mapping[str, Number]) -> dict[str, float]:
    """What the firmware stores of values by their names: whole numbers, or single precision.

    **Raises:**

    - `ValueError`: a name is unknown, or a value is not finite.
    """
    stored = {}
    for name, value in values.items():
        if not np.isfinite(value):
            raise ValueError(f"{name} is {value}: give a finite number.")
        row = find_parameter(firmware, name)
        stored[name] = float(np.rint(value)) if row.integer else float(np.float32(value))
    return stored


def check_ranges(firmware: str, values: Mapping[str, Number]) -> tuple[str, ...]:
    """A sentence for each value beyond the range that the firmware documents."""
    beyond = []
    for name, value in values.items():
        row = find_parameter(firmware, name)
        unit = f" {row.unit}" if row.unit else ""
        if not row.low * (1 - 1e-6) <= value <= row.high * (1 + 1e-6):
            beyond.append(
                f"{name} is {value:g}{unit}, beyond its documented range of {row.low:g} to "
                f"{row.high:g}{unit}."
            )
    return tuple(beyond)


def firmware_of(law: FirmwareLoop) -> str:
    """Which firmware a law is of."""
    return _rate_loop(law).firmware


def list_parameters(law: FirmwareLoop, *, axes: Sequence[str] = AXES) -> dict[str, float]:
    """The parameters that a law amounts to, not rounded: gains, filters, those of an angle loop.

    Parameters of all axes, such as a gyro filter, are listed, too. Not listed: Betaflight's
    filters, because their parameters are ranges over the throttle.

    **Arguments:**

    - `axes`: which of roll, pitch and yaw; of a law of one axis, which that is.

    **Raises:**

    - `ValueError`: an axis is unknown, or the law is of one axis and several are named.
    """
    if unknown := set(axes) - set(AXES):
        raise ValueError(f"axes has {', '.join(sorted(unknown))}: give some of {', '.join(AXES)}.")
    listed = {}
    for row, value in _places(law):
        if row.axis >= 0 and AXES[row.axis] not in axes:
            continue
        if value.shape == (1,) and len(axes) != 1:
            raise ValueError("the law is of one axis: say which, as axes=['roll'].")
        wide = np.broadcast_to(value, (3,))
        listed[row.name] = float(wide[max(row.axis, 0)])
    return listed


def with_parameters(law: Law, values: Mapping[str, Number]) -> Law:
    """The law with these parameters, by name; others stay. A law of one axis takes any axis'.

    **Raises:**

    - `ValueError`: a parameter has no place in the law.
    """
    places = dict(_places(law))
    rows = {row.name: row for row in places}
    for name, value in values.items():
        if name not in rows:
            raise ValueError(
                f"{name} has no place in a {type(law).__name__}: give one of {', '.join(rows)}."
            )
        row, flown = rows[name], _value_at(law, rows[name].field)
        assert isinstance(flown, Array)
        changed = jnp.asarray(value, flown.dtype)
        if row.field != "gyro":  # one axis, or all of them; the only one of a law of one axis
            one = row.axis < 0 or flown.shape == (1,)
            wide = jnp.broadcast_to(flown, (3,))
            changed = jnp.full_like(flown, changed) if one else wide.at[row.axis].set(changed)
        law = _replaced(law, row.field, changed)
    return law


def _rate_loop(law: FirmwareLoop) -> RateLoop:
    inner = law.rate if isinstance(law, AngleLoop) else law
    assert isinstance(inner, RateLoop)
    return inner


def _places(law: FirmwareLoop) -> Iterator[tuple[Parameter, Array]]:
    """The rows that have a place in a law, with what is there."""
    for row in PARAMETERS[firmware_of(law)].values():
        value = _value_at(law, row.field)
        if isinstance(value, Array):
            yield row, value


def _value_at(law: object, field: str) -> object:
    """Of the angle loop, the gyro's only low-pass, or the rate loop; None where there is none."""
    if field.startswith("angle."):
        outer, field = law if isinstance(law, AngleLoop) else None, field.removeprefix("angle.")
        return vars(outer).get(field) if outer is not None else None
    if isinstance(law, FirmwareLoop):
        law = _rate_loop(law)
        if field == "gyro":
            low_passes = [x for x in law.gyro.filters if isinstance(x, Butterworth)]
            return low_passes[0].cutoff_hz if len(low_passes) == 1 else None
    first, _, rest = field.partition(".")
    part = vars(law).get(first)
    return _value_at(part, rest) if rest and part is not None else part


def _replaced(law: Law, field: str, value: Array) -> Law:
    """The law with another value at a field."""
    if field.startswith("angle."):
        return dataclasses.replace(law, **{field.removeprefix("angle."): value})
    if isinstance(law, AngleLoop):
        return dataclasses.replace(law, rate=_replaced(law.rate, field, value))
    if field == "gyro" and isinstance(law, RateLoop):
        filters = tuple(
            dataclasses.replace(x, cutoff_hz=value) if isinstance(x, Butterworth) else x
            for x in law.gyro.filters
        )
        return dataclasses.replace(law, gyro=dataclasses.replace(law.gyro, filters=filters))
    first, _, rest = field.partition(".")
    part = _replaced(vars(law)[first], rest, value) if rest else value
    return dataclasses.replace(law, **{first: part})


def flown_loop(
    firmware: str,
    values: Mapping[str, str],
    version: Sequence[int] = (),
    *,
    throttle: float = 0.3,
    tracked_hz: Mapping[int, Sequence[float]] | None = None,
) -> FlownLoop:
    """The rate loop of the parameters of a log.

    **Arguments:**

    - `values`, `version`: as `jq.records.read_settings` returns them.
    - `throttle`: 0 to 1, at which Betaflight's dynamic cutoffs and ArduPilot's notches are.
    - `tracked_hz`: as in `ardupilot_loop`.

    **Raises:**

    - `ValueError`: a gain is missing.
    """
    return firmware_named(firmware).flown_loop(
        values, version, throttle=throttle, tracked_hz=tracked_hz or {}
    )


def change_filters(
    firmware: str, values: Mapping[str, str], parameters: Mapping[str, Number]
) -> dict[str, str]:
    """The values of a log as they would be with other cutoffs and notches, by their names.

    **Raises:**

    - `ValueError`: Betaflight's header has no line for one of them.
    """
    return firmware_named(firmware).change_filters(values, parameters)


FIELDS = ("p", "i", "d")
Gains = Float[np.ndarray, " gains"]


def names_by_field(firmware: str, axis: int) -> dict[str, str]:
    """The parameters of one axis, by the field of the law that each sets."""
    return {row.field: row.name for row in PARAMETERS[firmware].values() if row.axis == axis}


def gains_of(law: RateLoop, axis: int) -> Gains:
    """P, I and D of one axis."""
    return np.array([float(np.broadcast_to(vars(law)[name], (3,))[axis]) for name in FIELDS])


def gains_in(law: RateLoop, axis: int, parameters: Mapping[str, Number]) -> Gains:
    """P, I and D of parameters; those that are not named stay."""
    gains, names = gains_of(law, axis), names_by_field(law.firmware, axis)
    for k, field in enumerate(FIELDS):
        gains[k] = parameters.get(names.get(field, ""), gains[k])
    return gains


def parameters_of(law: RateLoop, axis: int, gains: Gains) -> dict[str, float]:
    """The parameters that stand for these gains; a ceiling of D rises with D."""
    names = names_by_field(law.firmware, axis)
    flown = zip(FIELDS, gains, gains_of(law, axis), strict=True)
    values = {names[field]: float(gain) for field, gain, old in flown if old > 0}
    if (ceiling := law.d_ceiling(axis)) > 1:
        values[names["d_max.ceiling"]] = ceiling * float(gains[2])
    return store_parameters(law.firmware, values)


def ceiling_in(law: RateLoop, axis: int, designs: Sequence[Mapping[str, Number]]) -> float:
    """The most by which D can rise in flight under one of these stored sets of parameters."""
    name, most = names_by_field(law.firmware, axis).get("d_max.ceiling", ""), law.d_ceiling(axis)
    for design in designs:
        base = gains_in(law, axis, design)[2]
        if (top := design.get(name)) and base > 0:
            most = max(most, float(top / base))
    return most
