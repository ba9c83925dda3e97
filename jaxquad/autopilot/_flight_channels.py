"""What a proposal reads of a flight beside the record: gyros, set-point, terms, motors."""

import dataclasses
import functools as ft
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

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

from ._identified import RecordSettings
from ._parameters import Firmware


Samples = Float[np.ndarray, " samples"]
Span = tuple[float | None, float | None]  # s; None: from the beginning, to the end
_TERMS = ("P", "I", "D", "F")
HOVER = 0.3  # of the throttle, where a log does not hold it


@dataclasses.dataclass(frozen=True)
class FlightChannels:
    """Channels of the analysed part of a log; those that are not in it are empty.

    **Attributes:**

    - `rates`: behind the gyro's filters, of roll, pitch and yaw, in rad/s, on `dt`.
    - `unfiltered`: before them, on `unfiltered_dt`.
    - `setpoint`: of the axis in rad/s, on `dt`.
    - `axis`: 0 for roll; `start`: the time of the first sample in s.
    - `terms`: "P", "I", "D" and "F" of the axis, in the firmware's units, on `dt`; `output`: what
        the law gave, with an injection into the mixer; `injected`: that alone.
    - `not_carried`: what the motors made of the law's output, less that output within its limit;
        None where the log does not show it.
    - `reference`: what no feedback computes, where the log has it beside the set-point.
    - `motors`: a column each, on `dt`; `motor_ends`: lowest and highest command.
    - `throttle`: 0 to 1, on `dt`; `stick`: likewise what the filters and TPA follow, where that is
        another one.
    - `slewed`: by which P and D were lowered (ArduPilot's SMAX); None where the log does not say.
    - `late`: s after its stamp at which the set-point acts.
    - `resolution`: steps in which set-point and rates are logged, in rad/s, and the terms; 0 where
        they are not rounded.
    - `names`: of the gyro's channels, filtered and unfiltered.
    - `tracked_hz`: medians of what ArduPilot's harmonic notches follow, by INS_HNTCH_MODE: the
        speeds of the motors (3) and of RPM sensors (2, 5).
    """

    rates: tuple[Samples, ...]
    dt: float
    setpoint: Samples
    axis: int = 0
    start: float = 0.0
    unfiltered: tuple[Float[np.ndarray, " raw_samples"], ...] = ()
    unfiltered_dt: float = 0.0
    averaged: bool = False  # whether the unfiltered rate is the mean over its sample
    terms: Mapping[str, Samples] = dataclasses.field(default_factory=dict)
    output: Samples | None = None
    injected: Samples | None = None
    not_carried: Samples | None = None
    reference: Samples | None = None
    motors: Float[np.ndarray, "samples motors"] | None = None
    motor_ends: tuple[float, float] = (0.0, 1.0)
    throttle: Samples | None = None
    stick: Samples | None = None
    slewed: Samples | None = None
    late: float = 0.0
    resolution: tuple[float, float] = (0.0, 0.0)
    names: tuple[str, str] = ("", "")
    tracked_hz: Mapping[int, tuple[float, ...]] = dataclasses.field(default_factory=dict)

    @property
    def middle(self) -> float | None:
        """The median throttle, at which filters that follow it are taken."""
        if self.throttle is None and self.stick is None:
            return None
        return float(np.clip(np.median(self.followed), 0.01, 1.0))

    @property
    def count(self) -> int:
        """Of samples on `dt`."""
        return len(self.setpoint)

    @property
    def followed(self) -> Samples:
        """The throttle that filters and TPA follow at each sample; `HOVER` where none is logged."""
        if self.stick is not None:
            return self.stick
        return np.full(self.count, HOVER) if self.throttle is None else self.throttle

    @property
    def limited(self) -> Samples:
        """At each sample, 1 where a motor is at an end of its range, else 0."""
        if self.motors is None:
            return np.zeros(self.count)
        low, high = self.motor_ends
        near = _AT_END * (high - low)
        return np.any((self.motors <= low + near) | (self.motors >= high - near), axis=1) * 1.0

    @property
    def mixer_range(self) -> Samples | None:
        """Highest less lowest motor, over what a motor can be."""
        if self.motors is None:
            return None
        low, high = self.motor_ends
        return (self.motors.max(axis=1) - self.motors.min(axis=1)) / (high - low)


_AT_END = 0.002  # of a motor's range


def read_channels_if_any(
    path: Path, proposal: Proposal, settings: RecordSettings, values: Mapping[str, str]
) -> FlightChannels | None:
    """None where they cannot be read: the record has what identification needs, and says so."""
    try:
        return read_channels(path, proposal, settings, values)
    except (ReadError, RecordError):
        return None


def read_channels(
    path: Path, proposal: Proposal, settings: RecordSettings, values: Mapping[str, str]
) -> FlightChannels:
    """Of the longest analysed part. Raises RecordError without a rate or its set-point."""
    firmware, prefix = _firmware(proposal), proposal.setup.rate.rpartition("gyroADC")[0]
    axis = AXES.index(proposal.setup.axis)
    names = _NAMES[firmware](prefix, axis)
    log = _LoggedChannels(path, frozenset(channel.name for channel in channels(path)))
    if firmware == "ardupilot":
        names = names._replace(unfiltered=_ardupilot_gyro(log, values, _span(settings)))
    throttle, injected = proposal.setup.throttle, _injected(proposal)
    wanted = [*names.filtered, *names.unfiltered, *names.terms, *names.motors, names.setpoint]
    external = proposal.setup.reference
    wanted += [*names.output, *names.stick, *names.mixed, *names.slewed, *injected, external]
    found = _read(log, [*wanted, *throttle], _span(settings))
    rates, rate = found.get(names.filtered[axis]), names.filtered[axis]
    if rates is None or names.setpoint not in found:
        raise RecordError(f"{path} holds no {rate} or no {names.setpoint} of the analysed part")
    on_its_clock = lambda name: np.interp(rates.time, found[name].time, _values(found[name], name))
    at_rate = lambda name: np.interp(rates.time, found[name].time, found[name].channel(name))
    sum_at = lambda mix: _mixed(mix, found, at_rate)
    raw = found.get(names.unfiltered[axis]) if names.unfiltered else None
    motors = [name for name in names.motors if name in found]
    return FlightChannels(
        rates=tuple(on_its_clock(name) for name in names.filtered if name in found),
        dt=rates.dt,
        setpoint=on_its_clock(names.setpoint),
        axis=axis, start=float(rates.time[0]),
        unfiltered=() if raw is None else tuple(
            _values(raw, name) for name in names.unfiltered if name in raw.names
        ),
        unfiltered_dt=0.0 if raw is None else raw.dt,
        averaged=firmware == "px4",
        terms={
            key: at_rate(name)
            for key, name in zip(_TERMS, names.terms, strict=False) if name in found
        },
        output=sum_at(names.output), injected=sum_at(injected),
        not_carried=_not_carried(sum_at(names.output), sum_at(names.mixed), axis, values),
        reference=None if injected or external == names.setpoint or external not in found
        else at_rate(external),
        motors=np.stack([at_rate(x) for x in motors], axis=1) if motors else None,
        motor_ends=_motor_ends(firmware, values),
        throttle=sum_at(throttle), stick=_stick(sum_at(names.stick), firmware, values),
        slewed=sum_at(names.slewed), late=proposal.setup.late_s.get(names.setpoint, 0.0),
        resolution=_resolution(firmware, values),
        names=(rate, "" if raw is None else names.unfiltered[axis]),
        tracked_hz=_tracked(log, _span(settings)) if firmware == "ardupilot" else {},
    )  # fmt: skip


_SPEEDS = {
    3: re.compile(r"ESC(\[\d+\])?\.RPM"), 2: re.compile(r"RPM(\.rpm1|\[0\]\.RPM)"),
    5: re.compile(r"RPM(\.rpm2|\[1\]\.RPM)"),
}  # fmt: skip


class _LoggedChannels(NamedTuple):
    """A log and the names of all its channels."""

    path: Path
    names: frozenset[str]


def _tracked(log: _LoggedChannels, span: Span) -> dict[int, tuple[float, ...]]:
    """The median speeds in Hz that the log holds, of those that turn."""
    found: dict[int, tuple[float, ...]] = {}
    for mode, pattern in _SPEEDS.items():
        names = sorted(name for name in log.names if pattern.fullmatch(name))
        records = _read(log, names, (None, None)) if names else {}
        medians = [_median(record, name, span) / 60 for name, record in records.items()]
        if turning := tuple(each for each in medians if each > 0):
            found[mode] = turning
    return found


def _median(record: Record, name: str, span: Span) -> float:
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
    output: Mapping[str, float]
    stick: Mapping[str, float] = MappingProxyType({})
    mixed: Mapping[str, float] = MappingProxyType({})
    slewed: Mapping[str, float] = MappingProxyType({})


def _betaflight_names(prefix: str, axis: int) -> _Names:
    return _Names(
        [f"{prefix}gyroADC[{k}]" for k in range(3)],
        [f"{prefix}gyroUnfilt[{k}]" for k in range(3)],
        f"{prefix}setpoint[{axis}]",
        [f"{prefix}axis{x}[{axis}]" for x in _TERMS],
        [f"{prefix}motor[{k}]" for k in range(8)],
        {f"{prefix}axisSum[{axis}]": 1.0},
        {f"{prefix}rcCommand[3]": 1.0},
        {f"{prefix}axisMixed[{axis}]": 1.0},
    )


def _px4_names(prefix: str, axis: int) -> _Names:
    return _Names(
        [f"vehicle_angular_velocity.xyz[{k}]" for k in range(3)],
        [f"sensor_combined.gyro_rad[{k}]" for k in range(3)],
        f"vehicle_rates_setpoint.{AXES[axis]}",
        [],
        [f"actuator_motors.control[{k}]" for k in range(4)],
        {f"vehicle_torque_setpoint.xyz[{axis}]": 1.0},
    )


def _ardupilot_names(prefix: str, axis: int) -> _Names:
    return _Names(
        [f"RATE.{letter}" for letter in "RPY"],
        [],
        f"RATE.{'RPY'[axis]}Des",
        [f"PID{'RPY'[axis]}.{x}" for x in ("P", "I", "D", "FF")],
        [f"RCOU.C{k}" for k in range(1, 5)],
        {f"RATE.{'RPY'[axis]}Out": 1.0},
        slewed={f"PID{'RPY'[axis]}.Dmod": 1.0},
    )


_POST, _BOTH = 4, 8  # of INS_RAW_LOG_OPT: behind the filters, or before and behind them
_GYROS = re.compile(r"(GYR(\d|\[\d\])?)\.GyrX")


def _ardupilot_gyro(log: _LoggedChannels, values: Mapping[str, str], span: Span) -> list[str]:
    """The gyro before its filters that flew, else the first; none where it is logged behind them.

    Its messages are GYR[0], in older logs GYR1 or GYR. Where both kinds are logged, those behind
    the filters have the higher numbers.
    """
    options = int(_number(values, "INS_RAW_LOG_OPT", 0.0))
    tables = [hit[1] for name in log.names if (hit := _GYROS.fullmatch(name))]
    if not tables or (options & _POST and not options & _BOTH):
        return []
    used = f"GYR[{_gyro_in_use(log, values, span)}]"
    table = used if used in tables else min(tables)
    return [f"{table}.Gyr{letter}" for letter in "XYZ"]


def _gyro_in_use(log: _LoggedChannels, values: Mapping[str, str], span: Span) -> int:
    """The IMU of the filter that flew (XKF4.PI): each of them has one of EK3_IMU_MASK."""
    name = "XKF4[0].PI"
    records = _read(log, [name], span)
    mask = int(_number(values, "EK3_IMU_MASK", 3.0))
    imus = [i for i in range(8) if mask >> i & 1]
    core = int(np.median(records[name].channel(name))) if name in records else 0
    return imus[core] if core < len(imus) else 0


_NAMES: Mapping[Firmware, Callable[[str, int], _Names]] = {
    "betaflight": _betaflight_names, "px4": _px4_names, "ardupilot": _ardupilot_names,
}  # fmt: skip


def _firmware(proposal: Proposal) -> Firmware:
    known: dict[str, Firmware] = {"betaflight": "betaflight", "px4": "px4"}
    return known.get(proposal.vehicle, "ardupilot")


def _span(settings: RecordSettings) -> Span:
    if not settings.segments:
        return settings.start, settings.stop
    ends = [(-np.inf if a is None else a, np.inf if b is None else b) for a, b in settings.segments]
    low, high = max(ends, key=lambda each: each[1] - each[0])
    return (low if np.isfinite(low) else None), (high if np.isfinite(high) else None)


def _read(log: _LoggedChannels, names: Sequence[str], span: Span) -> dict[str, Record]:
    """For each channel that the log has the record of its table, on that table's clock.

    Where samples are missing it is the longest part without a gap.
    """
    tables: dict[str, list[str]] = {}
    for name in dict.fromkeys(names):
        if name in log.names:
            kind = name.rpartition(".")[0].partition("[")[0]  # instances have clocks alike
            tables.setdefault(kind, []).append(name)
    found: dict[str, Record] = {}
    for group in tables.values():
        first = {"the first one": {group[0]: 1.0}}  # a record has an input
        outputs = {name: {name: 1.0} for name in group}
        try:
            with warnings.catch_warnings():  # of axes that rest
                warnings.simplefilter("ignore", RecordWarning)
                parts = read_segments(log.path, [span], inputs=first, outputs=outputs)
        except RecordError:  # too few samples in this span, or missing ones
            continue
        found |= dict.fromkeys(group, max(parts, key=lambda part: part.samples))
    return found


def _values(record: Record, name: str) -> Samples:
    """Rates in rad/s."""
    degrees = record.unit(name) == "deg/s"
    return np.radians(record.channel(name)) if degrees else record.channel(name)


def _motor_ends(firmware: Firmware, values: Mapping[str, str]) -> tuple[float, float]:
    if firmware == "betaflight":
        low, high = (float(x) for x in values.get("motorOutput", "48,2047").split(",")[:2])
        return low, high
    if firmware == "px4":
        return 0.0, 1.0
    number = ft.partial(_number, values)
    low, high = number("MOT_PWM_MIN", 1000.0), number("MOT_PWM_MAX", 2000.0)
    share = lambda part: low + part * (high - low)
    return share(number("MOT_SPIN_MIN", 0.15)), share(number("MOT_SPIN_MAX", 0.95))


def _number(values: Mapping[str, str], name: str, default: float) -> float:
    return float(values.get(name, default))


def _mixed(
    mix: Mapping[str, float], found: Mapping[str, Record], at: Callable[[str], Samples]
) -> Samples | None:
    if not mix or any(name not in found for name in mix):
        return None
    return np.sum([weight * at(name) for name, weight in mix.items()], axis=0)


def _injected(proposal: Proposal) -> Mapping[str, float]:
    """What was added to the command behind the law."""
    return {"SIDD.Targ": 1.0} if proposal.setup.injected_at == "mixer" else {}


def _stick(
    command: Samples | None, firmware: Firmware, values: Mapping[str, str]
) -> Samples | None:
    """Betaflight's throttle before its boost, 0 to 1; a limit of the throttle is another one."""
    if command is None or firmware != "betaflight" or float(values.get("throttle_limit_type", 0)):
        return None
    return np.clip((command - 1000) / 1000, 0.0, 1.0)


def _not_carried(
    output: Samples | None, mixed: Samples | None, axis: int, values: Mapping[str, str]
) -> Samples | None:
    if output is None or mixed is None:
        return None
    name, usual = ("pidsum_limit_yaw", 400.0) if axis == 2 else ("pidsum_limit", 500.0)
    limit = _number(values, name, usual)
    return mixed - np.clip(output, -limit, limit)


def _resolution(firmware: Firmware, values: Mapping[str, str]) -> tuple[float, float]:
    if firmware != "betaflight":
        return 0.0, 0.0
    finer = float(values.get("blackbox_high_resolution", 0)) > 0
    return np.radians(0.1 if finer else 1.0), 1.0
