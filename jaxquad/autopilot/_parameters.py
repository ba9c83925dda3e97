"""The firmwares' parameters: unit, default, documented range, and what is stored."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Literal, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxquad._core import Number
from jaxquad.records import AXES

from ._filters import Butterworth
from .ardupilot._law import ArduPilotAttitude, ArduPilotRate
from .betaflight._law import BetaflightADRC, BetaflightAngle, BetaflightPID
from .crazyflie._firmware import CrazyflieAttitude, CrazyflieRate
from .px4._firmware import PX4Attitude, PX4Rate


Firmware = Literal["betaflight", "px4", "ardupilot", "crazyflie"]


class Parameter(NamedTuple):
    """A parameter of a firmware, as its documentation has it.

    **Arguments:**

    - `name`, `unit`: as the firmware calls them.
    - `default`: of the firmware.
    - `low`, `high`: of the documented range; an infinity where none is documented.
    - `whole`: whether the firmware stores a whole number; else it is a single-precision one.
    - `field`, `axis`: of the law that it sets: ("p", 0); -1 for all axes.
    """

    name: str
    unit: str
    default: float
    low: float
    high: float
    whole: bool = False
    field: str = ""
    axis: int = -1


_INF = float("inf")
Range = tuple[Number, Number]


def _rows(
    names: Sequence[str], unit: str, defaults: Sequence[Number], ranges: tuple[Range, ...] | Range,
    field: str, *, whole: bool = False,
) -> list[Parameter]:  # fmt: skip
    """A parameter of each axis."""
    bounds = [(x, x) if isinstance(x, int | float) else x for x in ranges]
    if len(bounds) == 2:
        bounds = [(bounds[0][0], bounds[1][1])] * 3
    return [
        Parameter(name, unit, default, low, high, whole, field, axis)
        for axis, (name, default, (low, high)) in enumerate(
            zip(names, defaults, bounds, strict=True)
        )
    ]


def _betaflight() -> list[Parameter]:
    of = lambda start: [f"{start}_{axis}" for axis in AXES]
    byte, wide = (0, 250), (0, 1000)
    adrc: tuple[tuple[str, str, Number, Range], ...] = (
        ("adrc_gyro_lpf_hz", "Hz", 150, wide),
        ("adrc_td_hz", "Hz", 0, wide),
        ("adrc_hover_throttle", "%", 35, (5, 100)),
        ("adrc_sigma_decay", "0.1/s", 3, (0, 100)),
    )
    return [
        *_rows(of("p"), "", (45, 47, 45), byte, "p", whole=True),
        *_rows(of("i"), "", (80, 84, 80), byte, "i", whole=True),
        *_rows(of("d"), "", (30, 34, 0), byte, "d", whole=True),
        *_rows(of("f"), "", (120, 125, 120), wide, "f", whole=True),
        *_rows(of("d_max"), "", (40, 46, 0), byte, "d_max", whole=True),
        Parameter("angle_p_gain", "0.1/s", 50, 0, 200, True, "level"),
        Parameter("thrust_linear", "%", 0, 0, 150, True),
        *(Parameter(name, "Hz", default, *wide, True) for name, default in _BETAFLIGHT_FILTERS),
        *_rows(of("adrc_wc"), "rad/s", (60, 60, 60), (5, 300), "wc", whole=True),
        *_rows(of("adrc_wo"), "rad/s", (100, 100, 80), (10, 600), "wo", whole=True),
        *_rows(of("adrc_b0"), "deg/s^3", (2000, 2000, 2000), (100, 65535), "b0", whole=True),
        *(Parameter(name, unit, default, *bound, True) for name, unit, default, bound in adrc),
    ]  # fmt: skip


_BETAFLIGHT_FILTERS = (
    ("gyro_lpf1_dyn_min_hz", 250), ("gyro_lpf1_dyn_max_hz", 500), ("gyro_lpf2_static_hz", 500),
    ("dterm_lpf1_dyn_min_hz", 75), ("dterm_lpf1_dyn_max_hz", 150), ("dterm_lpf2_static_hz", 150),
    ("gyro_lpf1_static_hz", 250), ("dterm_lpf1_static_hz", 75),
    ("gyro_notch1_hz", 0), ("gyro_notch1_cutoff", 0), ("gyro_notch2_hz", 0),
    ("gyro_notch2_cutoff", 0),
)  # fmt: skip


def _px4() -> list[Parameter]:
    of = lambda end: [f"MC_{axis.upper()}RATE_{end}" for axis in AXES]
    above: Range = (0, _INF)
    return [
        *_rows(of("P"), "", (0.15, 0.15, 0.2), ((0.01, 0.5), (0.01, 0.6), (0, 0.6)), "p"),
        *_rows(of("I"), "1/s", (0.2, 0.2, 0.1), above, "i"),
        *_rows(of("D"), "s", (0.003, 0.003, 0), ((0, 0.01), above, above), "d"),
        *_rows(of("K"), "", (1, 1, 1), (0.01, 5), "k"),
        *_rows(of("FF"), "", (0, 0, 0), above, "ff"),
        *_rows([f"MC_{x}R_INT_LIM" for x in "RPY"], "", (0.3,) * 3, above, "integral_limit"),
        *_rows(
            [f"MC_{axis.upper()}_P" for axis in AXES], "1/s", (4, 4, 2.8),
            ((0, 12), (0, 12), (0, 5)), "attitude",
        ),
        *_rows(
            [f"MC_{axis.upper()}RATE_MAX" for axis in AXES], "deg/s", (220, 220, 200), (0, 1800), ""
        ),
        Parameter("MC_YAW_TQ_CUTOFF", "Hz", 2, 0, _INF, False, "torque_hz", 2),
        Parameter("IMU_GYRO_CUTOFF", "Hz", 40, 0, 1000, False, "gyro"),
        Parameter("IMU_DGYRO_CUTOFF", "Hz", 20, 0, 1000, False, "derivative_hz"),
        *(Parameter(f"IMU_GYRO_NF{k}_FRQ", "Hz", 0, 0, _INF) for k in (0, 1)),
        *(Parameter(f"IMU_GYRO_NF{k}_BW", "Hz", 20, 0, _INF) for k in (0, 1)),
        Parameter("IMU_GYRO_RATEMAX", "Hz", 400, 100, 2000, True),
        Parameter("THR_MDL_FAC", "", 0, 0, 1),
        Parameter("MC_AIRMODE", "", 0, 0, 2, True),
    ]  # fmt: skip


def _ardupilot() -> list[Parameter]:
    short = ("RLL", "PIT", "YAW")
    of = lambda end: [f"ATC_RAT_{axis}_{end}" for axis in short]
    two = lambda level, yaw: (level, level, yaw)
    return [
        *_rows(of("P"), "", (0.135, 0.135, 0.18), two((0.01, 0.5), (0.1, 2.5)), "p"),
        *_rows(of("I"), "1/s", (0.135, 0.135, 0.018), two((0.01, 2), (0.01, 1)), "i"),
        *_rows(of("D"), "s", (0.0036, 0.0036, 0), two((0, 0.05), (0, 0.02)), "d"),
        *_rows(of("FF"), "", (0, 0, 0), (0, 0.5), "ff"),
        *_rows(of("D_FF"), "s", (0, 0, 0), (0, 0.02), "d_ff"),
        *_rows(of("IMAX"), "", (0.5,) * 3, (0, 1), "integral_limit"),
        *_rows(of("FLTT"), "Hz", (20,) * 3, two((5, 100), (1, 50)), "target_hz"),
        *_rows(of("FLTE"), "Hz", (0, 0, 2.5), two((0, 100), (0, 20)), "error_hz"),
        *_rows(of("FLTD"), "Hz", (20,) * 3, two((5, 100), (5, 50)), "derivative_hz"),
        *_rows(of("SMAX"), "", (0,) * 3, (0, 200), ""),
        *_rows([f"ATC_ANG_{axis}_P" for axis in short], "1/s", (4.5,) * 3, (3, 12), "attitude"),
        Parameter("INS_GYRO_FILTER", "Hz", 20, 0, 256, True, "gyro"),
        Parameter("MOT_THST_EXPO", "", 0.65, -1, 1),
    ]


def _crazyflie() -> list[Parameter]:
    of = lambda end, group="pid_rate": [f"{group}.{axis}_{end}" for axis in AXES]
    free: Range = (-_INF, _INF)
    return [
        *_rows(of("kp"), "1/(deg/s)", (250, 250, 120), free, "kp"),
        *_rows(of("ki"), "1/deg", (500, 500, 16.7), free, "ki"),
        *_rows(of("kd"), "1/(deg/s^2)", (2.5, 2.5, 0), free, "kd"),
        *_rows(of("kff"), "1/(deg/s)", (0, 0, 0), free, "kff"),
        *_rows(of("kp", "pid_attitude"), "1/s", (6, 6, 6), free, "attitude"),
        *_rows(of("ki", "pid_attitude"), "1/s^2", (3, 3, 1), free, "attitude_ki"),
        *_rows(of("kd", "pid_attitude"), "", (0, 0, 0.35), free, "attitude_kd"),
        Parameter("pid_rate.rateFiltEn", "", 0, 0, 1, True),
        *_rows([f"pid_rate.om{x}FiltCut" for x in "xyz"], "Hz", (30,) * 3, (0, 250), ""),
    ]


def _frozen(rows: list[Parameter]) -> Mapping[str, Parameter]:
    return MappingProxyType({row.name: row for row in rows})


_TABLES: dict[Firmware, Mapping[str, Parameter]] = {
    "betaflight": _frozen(_betaflight()), "px4": _frozen(_px4()),
    "ardupilot": _frozen(_ardupilot()), "crazyflie": _frozen(_crazyflie()),
}  # fmt: skip
PARAMETERS: Mapping[Firmware, Mapping[str, Parameter]] = MappingProxyType(_TABLES)
"""The parameters of each firmware by name."""


def find_parameter(firmware: Firmware, name: str) -> Parameter:
    """The parameter of this name. Raises ValueError for one that is not in the table."""
    found = PARAMETERS[firmware].get(name)
    if found is None:
        near = [x for x in PARAMETERS[firmware] if x.lower()[:4] == name.lower()[:4]]
        raise ValueError(
            f"{name} is no parameter that is known of {firmware}"
            + (f": do you mean one of {', '.join(near[:6])}?" if near else ".")
        )
    return found


def store_parameters(firmware: Firmware, values: Mapping[str, Number]) -> dict[str, float]:
    """What the firmware stores of these values: whole numbers, or single precision.

    **Arguments:**

    - `values`: by the parameters' names.

    **Raises:**

    - `ValueError`: a name is unknown, or a value is not finite.
    """
    stored = {}
    for name, value in values.items():
        if not np.isfinite(value):
            raise ValueError(f"{name} is {value}: give a finite number.")
        row = find_parameter(firmware, name)
        stored[name] = float(np.rint(value)) if row.whole else float(np.float32(value))
    return stored


def check_ranges(firmware: Firmware, values: Mapping[str, Number]) -> tuple[str, ...]:
    """A sentence for each value beyond the range that the firmware documents."""
    found = []
    for name, value in values.items():
        row = find_parameter(firmware, name)
        if not row.low * (1 - 1e-6) <= value <= row.high * (1 + 1e-6):
            unit = f" {row.unit}" if row.unit else ""
            found.append(
                f"{name} is {value:g}{unit}, beyond its documented range of {row.low:g} to "
                f"{row.high:g}{unit}."
            )
    return tuple(found)


RateLaw = BetaflightPID | BetaflightADRC | PX4Rate | ArduPilotRate | CrazyflieRate
AngleLaw = BetaflightAngle | PX4Attitude | ArduPilotAttitude | CrazyflieAttitude
AnyLaw = RateLaw | AngleLaw
Law = TypeVar("Law", bound=AnyLaw)
_RATES: Mapping[type, Firmware] = {
    BetaflightPID: "betaflight", BetaflightADRC: "betaflight", PX4Rate: "px4",
    ArduPilotRate: "ardupilot", CrazyflieRate: "crazyflie",
}  # fmt: skip
_OUTER_FIELDS = {"attitude_ki": "ki", "attitude_kd": "kd", "level": "level"}


def firmware_of(law: AnyLaw) -> Firmware:
    """Which firmware a law is of."""
    return _RATES[type(_parts(law)[0])]


def list_parameters(law: AnyLaw, *, axes: Sequence[str] = AXES) -> dict[str, float]:
    """The parameters that a law amounts to, not rounded.

    Gains and filters of a law, and the angle loop's where it has one; parameters of all axes, such
    as a gyro filter, too. Not listed: Betaflight's filters, because their parameters are ranges
    over the throttle.

    **Arguments:**

    - `axes`: which of roll, pitch and yaw; of a law of one axis, which that is.

    **Raises:**

    - `ValueError`: an axis is unknown, or the law is of one axis and several are named.
    """
    if unknown := set(axes) - set(AXES):
        raise ValueError(f"axes has {', '.join(sorted(unknown))}: give some of {', '.join(AXES)}.")
    found = {}
    for row, value in _held(law):
        if row.axis >= 0 and AXES[row.axis] not in axes:
            continue
        if value.shape == (1,) and len(axes) != 1:
            raise ValueError("the law is of one axis: say which, as axes=['roll'].")
        wide = np.broadcast_to(value, (3,))
        found[row.name] = float(wide[max(row.axis, 0)])
    return found


def with_parameters(law: Law, values: Mapping[str, Number]) -> Law:
    """The law with these parameters, by name; others stay. A law of one axis takes any axis'.

    **Raises:**

    - `ValueError`: a parameter has no place in the law.
    """
    held = {row.name: row for row, _ in _held(law)}
    for name, value in values.items():
        if name not in held:
            raise ValueError(
                f"{name} has no place in a {type(law).__name__}: give one of {', '.join(held)}."
            )
        law = _set(law, held[name], value)
    return law


def _parts(law: AnyLaw) -> tuple[RateLaw, AngleLaw | None]:
    """The rate loop, and the angle loop around it."""
    return (law.rate, law) if isinstance(law, AngleLaw) else (law, None)


def _held(law: AnyLaw) -> Iterator[tuple[Parameter, np.ndarray]]:
    """The rows that have a place in a law, with what is there."""
    inner, outer = _parts(law)
    for row in PARAMETERS[_RATES[type(inner)]].values():
        if row.field == "gyro":
            low_passes = [x for x in inner.gyro.filters if isinstance(x, Butterworth)]
            if len(low_passes) == 1:
                yield row, np.asarray(low_passes[0].cutoff_hz)
        elif row.field == "d_max":
            if isinstance(inner, BetaflightPID) and inner.d_max is not None:
                yield row, np.asarray(inner.d_max.ceiling)
        elif _is_outer(row):
            name = _outer_field(row, outer)
            if outer is not None and name in _arrays(outer):
                yield row, np.asarray(_arrays(outer)[name])
        elif row.field in _arrays(inner):
            yield row, np.asarray(_arrays(inner)[row.field])


def _is_outer(row: Parameter) -> bool:
    return row.field.startswith("attitude") or row.field == "level"


def _outer_field(row: Parameter, outer: AngleLaw | None) -> str:
    """What an angle loop calls it."""
    return _OUTER_FIELDS.get(row.field, "kp" if isinstance(outer, CrazyflieAttitude) else "p")


def _arrays(law: AnyLaw) -> dict[str, Array]:
    values = {x.name: law.__dict__[x.name] for x in dataclasses.fields(law)}
    return {name: x for name, x in values.items() if isinstance(x, Array)}


def _set(law: Law, row: Parameter, value: Number) -> Law:
    inner, outer = _parts(law)
    if _is_outer(row):
        field = _outer_field(row, outer)
        return dataclasses.replace(law, **{field: _with_axis(_arrays(law)[field], row.axis, value)})
    changed = _set_rate(inner, row, value)
    whole = changed if outer is None else dataclasses.replace(law, rate=changed)
    assert isinstance(whole, type(law))
    return whole


def _set_rate(law: RateLaw, row: Parameter, value: Number):
    if row.field == "gyro":
        filters = tuple(
            dataclasses.replace(x, cutoff_hz=value) if isinstance(x, Butterworth) else x
            for x in law.gyro.filters
        )
        return dataclasses.replace(law, gyro=dataclasses.replace(law.gyro, filters=filters))
    if isinstance(law, BetaflightPID) and law.d_max is not None and row.field == "d_max":
        ceiling = _with_axis(law.d_max.ceiling, row.axis, value)
        return dataclasses.replace(law, d_max=dataclasses.replace(law.d_max, ceiling=ceiling))
    return dataclasses.replace(
        law, **{row.field: _with_axis(_arrays(law)[row.field], row.axis, value)}
    )


def _with_axis(now: Array, axis: int, value: Number) -> Array:
    """One axis changed, or all of them; the only one of a law of one axis."""
    one = jnp.asarray(value, now.dtype)
    if axis < 0 or now.shape == (1,):
        return jnp.full_like(now, one)
    return jnp.broadcast_to(now, (3,)).at[axis].set(one)
