"""What a proposal reads of a flight beside the record: gyros, set-point, terms, motors."""

import dataclasses
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad.control.autopilots import Firmware
from jaxquad.records import (
    AXES,
    channels,
    Proposal,
    read_segments,
    ReadError,
    Record,
    RecordError,
    RecordWarning,
)

from .._settings import IdentifySettings


Samples = Float[np.ndarray, " samples"]
_TERMS = ("P", "I", "D", "F")
HOVER = 0.3  # of the throttle, where a log does not hold it


@dataclasses.dataclass(frozen=True)
class FlightChannels:
    """Channels of the analysed part of a log; those that are not in it are empty.

    **Attributes:**

    - `rates`: behind the gyro's filters, of roll, pitch and yaw, in rad/s, on `dt`.
    - `unfiltered`: before them, on `unfiltered_dt`.
    - `setpoint`: of the axis in rad/s, on `dt`.
    - `terms`: "P", "I", "D" and "F" of the axis, in the firmware's units.
    - `motors`: a column each; `motor_ends`: lowest and highest command.
    - `throttle`: 0 to 1.
    - `names`: of the gyro's channels, filtered and unfiltered.
    - `tracked_hz`: medians of what ArduPilot's harmonic notches follow, by INS_HNTCH_MODE: the
        speeds of the motors (3) and of RPM sensors (2, 5).
    """

    rates: tuple[Samples, ...]
    dt: float
    setpoint: Samples
    unfiltered: tuple[Samples, ...] = ()
    unfiltered_dt: float = 0.0
    averaged: bool = False  # whether the unfiltered rate is the mean over its sample
    terms: Mapping[str, Samples] = dataclasses.field(default_factory=dict)
    motors: Float[np.ndarray, "samples motors"] | None = None
    motor_ends: tuple[float, float] = (0.0, 1.0)
    throttle: Samples | None = None
    names: tuple[str, str] = ("", "")
    tracked_hz: Mapping[int, tuple[float, ...]] = dataclasses.field(default_factory=dict)

    @property
    def middle(self) -> float | None:
        """The median throttle, at which filters that follow it are taken."""
        if self.throttle is None:
            return None
        return float(np.clip(np.median(self.throttle), 0.01, 1.0))


def read_channels_if_any(
    path: Path, proposal: Proposal, settings: IdentifySettings, values: Mapping[str, str]
) -> FlightChannels | None:
    """None where they cannot be read: the record has what identification needs, and says so."""
    try:
        return read_channels(path, proposal, settings, values)
    except (ReadError, RecordError):
        return None


def read_channels(
    path: Path, proposal: Proposal, settings: IdentifySettings, values: Mapping[str, str]
) -> FlightChannels:
    """Of the longest analysed part. Raises RecordError without a rate or its set-point."""
    firmware, prefix = _firmware(proposal), proposal.setup.rate.rpartition("gyroADC")[0]
    axis = AXES.index(proposal.setup.axis)
    names = _NAMES[firmware](prefix, axis)
    throttle = proposal.setup.throttle
    wanted = [*names.filtered, *names.unfiltered, *names.terms, *names.motors, names.setpoint]
    found = _read(path, [*wanted, *throttle], _span(settings))
    rates, rate = found.get(names.filtered[axis]), names.filtered[axis]
    if rates is None or names.setpoint not in found:
        raise RecordError(f"{path} holds no {rate} or no {names.setpoint} of the analysed part")
    on_its_clock = lambda name: np.interp(rates.time, found[name].time, _values(found[name], name))
    raw = found.get(names.unfiltered[axis])
    motors = [name for name in names.motors if name in found]
    return FlightChannels(
        rates=tuple(on_its_clock(name) for name in names.filtered if name in found),
        dt=rates.dt,
        setpoint=on_its_clock(names.setpoint),
        unfiltered=() if raw is None else tuple(
            _values(raw, name) for name in names.unfiltered if name in raw.names
        ),
        unfiltered_dt=0.0 if raw is None else raw.dt,
        averaged=firmware == "px4",
        terms={
            key: found[name].channel(name)
            for key, name in zip(_TERMS, names.terms, strict=False) if name in found
        },
        motors=np.stack([found[x].channel(x) for x in motors], axis=1) if motors else None,
        motor_ends=_motor_ends(firmware, values),
        throttle=_mixed(found, throttle),
        names=(rate, "" if raw is None else names.unfiltered[axis]),
        tracked_hz=_tracked(path, _span(settings)) if firmware == "ardupilot" else {},
    )  # fmt: skip


_SPEEDS = {
    3: re.compile(r"ESC(\[\d+\])?\.RPM"), 2: re.compile(r"RPM(\.rpm1|\[0\]\.RPM)"),
    5: re.compile(r"RPM(\.rpm2|\[1\]\.RPM)"),
}  # fmt: skip


def _tracked(path: Path, span: tuple[float | None, float | None]) -> dict[int, tuple[float, ...]]:
    """The median speeds in Hz that the log holds, of those that turn."""
    held = [each.name for each in channels(path)]
    found: dict[int, tuple[float, ...]] = {}
    for mode, pattern in _SPEEDS.items():
        names = [name for name in held if pattern.fullmatch(name)]
        records = _read(path, names, (None, None)) if names else {}
        medians = [_median(record, name, span) / 60 for name, record in records.items()]
        if turning := tuple(each for each in medians if each > 0):
            found[mode] = turning
    return found


def _median(record: Record, name: str, span: tuple[float | None, float | None]) -> float:
    """Within a span; 0 without samples there."""
    low, high = (end if x is None else x for x, end in zip(span, (-np.inf, np.inf), strict=True))
    inside = record.channel(name)[(record.time >= low) & (record.time <= high)]
    return float(np.median(inside)) if inside.size else 0.0


class _Names(NamedTuple):
    filtered: Sequence[str]
    unfiltered: Sequence[str]
    setpoint: str
    terms: Sequence[str]
    motors: Sequence[str]


def _betaflight_names(prefix: str, axis: int) -> _Names:
    return _Names(
        [f"{prefix}gyroADC[{k}]" for k in range(3)],
        [f"{prefix}gyroUnfilt[{k}]" for k in range(3)],
        f"{prefix}setpoint[{axis}]",
        [f"{prefix}axis{x}[{axis}]" for x in _TERMS],
        [f"{prefix}motor[{k}]" for k in range(8)],
    )


def _px4_names(prefix: str, axis: int) -> _Names:
    return _Names(
        [f"vehicle_angular_velocity.xyz[{k}]" for k in range(3)],
        [f"sensor_combined.gyro_rad[{k}]" for k in range(3)],
        f"vehicle_rates_setpoint.{AXES[axis]}",
        [],
        [f"actuator_motors.control[{k}]" for k in range(4)],
    )


def _ardupilot_names(prefix: str, axis: int) -> _Names:
    return _Names(
        [f"RATE.{letter}" for letter in "RPY"],
        [f"GYR.Gyr{letter}" for letter in "XYZ"],
        f"RATE.{'RPY'[axis]}Des",
        [f"PID{'RPY'[axis]}.{x}" for x in ("P", "I", "D", "FF")],
        [f"RCOU.C{k}" for k in range(1, 5)],
    )


_NAMES: Mapping[Firmware, Callable[[str, int], _Names]] = {
    "betaflight": _betaflight_names, "px4": _px4_names, "ardupilot": _ardupilot_names,
}  # fmt: skip


def _firmware(proposal: Proposal) -> Firmware:
    known: dict[str, Firmware] = {"betaflight": "betaflight", "px4": "px4"}
    return known.get(proposal.vehicle, "ardupilot")


def _span(settings: IdentifySettings) -> tuple[float | None, float | None]:
    if not settings.segments:
        return settings.start, settings.stop
    ends = [(-np.inf if a is None else a, np.inf if b is None else b) for a, b in settings.segments]
    low, high = max(ends, key=lambda each: each[1] - each[0])
    return (low if np.isfinite(low) else None), (high if np.isfinite(high) else None)


def _read(
    path: Path, names: Sequence[str], span: tuple[float | None, float | None]
) -> dict[str, Record]:
    """For each channel that the log has the record of its table, on that table's clock.

    Where samples are missing it is the longest part without a gap.
    """
    held = {each.name for each in channels(path)}
    tables: dict[str, list[str]] = {}
    for name in dict.fromkeys(names):
        if name in held:
            tables.setdefault(name.partition("[")[0].rpartition(".")[0], []).append(name)
    found: dict[str, Record] = {}
    for group in tables.values():
        first = {"the first one": {group[0]: 1.0}}  # a record has an input
        outputs = {name: {name: 1.0} for name in group}
        try:
            with warnings.catch_warnings():  # of axes that rest
                warnings.simplefilter("ignore", RecordWarning)
                parts = read_segments(path, [span], inputs=first, outputs=outputs)
        except RecordError:  # too few samples in this span, or missing ones
            continue
        found |= dict.fromkeys(group, max(parts, key=lambda part: part.samples))
    return found


def _values(record: Record, name: str) -> Samples:
    """Rates in rad/s."""
    degrees = record.unit(name) == "deg/s"
    return np.radians(record.channel(name)) if degrees else record.channel(name)


def _motor_ends(firmware: Firmware, values: Mapping[str, str]) -> tuple[float, float]:
    number = lambda name, default: float(values.get(name, default))
    if firmware == "betaflight":
        low, high = (float(x) for x in values.get("motorOutput", "48,2047").split(",")[:2])
        return low, high
    if firmware == "px4":
        return 0.0, 1.0
    low, high = number("MOT_PWM_MIN", 1000.0), number("MOT_PWM_MAX", 2000.0)
    share = lambda part: low + part * (high - low)
    return share(number("MOT_SPIN_MIN", 0.15)), share(number("MOT_SPIN_MAX", 0.95))


def _mixed(found: Mapping[str, Record], mix: Mapping[str, float]) -> Samples | None:
    if not mix or any(name not in found for name in mix):
        return None
    total = np.zeros(())
    for name, weight in mix.items():
        total = total + weight * found[name].channel(name)
    return total
