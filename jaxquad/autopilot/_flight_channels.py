"""What a proposal reads of a flight beside the record: gyros, set-point, terms, motors."""

import dataclasses
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad._core import Message, Number
from jaxquad.identify import KnownFilter, MeasuredChain
from jaxquad.records import (
    AXES,
    channels,
    Proposal,
    read_segments,
    read_settings,
    ReadError,
    Record,
    RecordError,
    RecordWarning,
    Settings as LogSettings,
)

from ._firmware import firmware_named, HOVER, OuterLoop, Span
from ._identified import RecordSettings
from ._law import FlownLoop, RateLoop
from ._parameters import change_filters, flown_loop
from ._rate_loops import gains_of, parameters_of


Samples = Float[np.ndarray, " samples"]


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


def channel_prefix(proposal: Proposal) -> str:
    """What the channels of a flight begin with in a file with several."""
    log, axis = firmware_named(proposal.vehicle).log, AXES.index(proposal.setup.axis)
    rate = log.rates[axis] if axis < len(log.rates) else ""
    full = proposal.setup.rate
    return full.removesuffix(rate) if rate and full.endswith(f".{rate}") else ""


def read_channels(
    path: Path, proposal: Proposal, settings: RecordSettings, values: Mapping[str, str]
) -> FlightChannels:
    """Of the longest analysed part. Raises RecordError without a rate or its set-point."""
    firmware, prefix = firmware_named(proposal.vehicle), channel_prefix(proposal)
    setup, axis = proposal.setup, AXES.index(proposal.setup.axis)
    filtered = [f"{prefix}{name}" for name in firmware.log.rates]
    setpoint = f"{prefix}{firmware.log.setpoints[axis]}"
    names, span = firmware.channels(prefix, axis), _span(settings)
    log = _LoggedChannels(path, frozenset(channel.name for channel in channels(path)))
    median = lambda name: _median(_read(log, [name], span).get(name), name, (None, None))
    unfiltered = names.unfiltered or firmware.unfiltered_gyro(log.names, values, median)
    injected = {setup.reference: 1.0} if setup.injected_at == "mixer" else {}
    wanted = [*filtered, *unfiltered, *names.terms, *names.motors, setpoint, setup.reference]
    wanted += [*names.output, *names.stick, *names.mixed, *names.slewed, *injected]
    records = _read(log, [*wanted, *setup.throttle], span)
    rates, rate = records.get(filtered[axis]), filtered[axis]
    if rates is None or setpoint not in records:
        raise RecordError(f"{path} holds no {rate} or no {setpoint} of the analysed part")
    at_rate = lambda name, read=Record.channel: np.interp(
        rates.time, records[name].time, read(records[name], name)
    )
    sum_at = lambda mix: (
        np.sum([weight * at_rate(name) for name, weight in mix.items()], axis=0)
        if mix and all(name in records for name in mix) else None
    )  # fmt: skip
    raw = records.get(unfiltered[axis]) if unfiltered else None
    motors = [name for name in names.motors if name in records]
    output, mixed, stick = sum_at(names.output), sum_at(names.mixed), sum_at(names.stick)
    limit = firmware.output_limit(values, axis)
    external = not injected and setup.reference != setpoint and setup.reference in records
    return FlightChannels(
        rates=tuple(at_rate(name, _in_radians) for name in filtered if name in records),
        dt=rates.dt, setpoint=at_rate(setpoint, _in_radians), axis=axis,
        start=float(rates.time[0]),
        unfiltered=() if raw is None else tuple(
            _in_radians(raw, name) for name in unfiltered if name in raw.names
        ),
        unfiltered_dt=0.0 if raw is None else raw.dt,
        averaged=firmware.averages_gyro,
        terms={
            key: at_rate(name)
            for key, name in zip("PIDF", names.terms, strict=False) if name in records
        },
        output=output, injected=sum_at(injected),
        not_carried=None if output is None or mixed is None
        else mixed - np.clip(output, -limit, limit),
        reference=at_rate(setup.reference) if external else None,
        motors=np.stack([at_rate(x) for x in motors], axis=1) if motors else None,
        motor_ends=firmware.motor_ends(values), throttle=sum_at(setup.throttle),
        stick=None if stick is None else firmware.stick_throttle(stick, values),
        slewed=sum_at(names.slewed), late=setup.late_s.get(setpoint, 0.0),
        resolution=firmware.resolution(values),
        names=(rate, "" if raw is None else unfiltered[axis]),
        tracked_hz=_tracked(log, firmware.tracked_channels(), span),
    )  # fmt: skip


class _LoggedChannels(NamedTuple):
    """A log and the names of all its channels."""

    path: Path
    names: frozenset[str]


def _tracked(
    log: _LoggedChannels, patterns: Mapping[int, str], span: Span
) -> dict[int, tuple[float, ...]]:
    """The median speeds in Hz that the log holds, of those that turn."""
    tracked: dict[int, tuple[float, ...]] = {}
    for mode, pattern in patterns.items():
        names = sorted(name for name in log.names if re.fullmatch(pattern, name))
        records = _read(log, names, (None, None)) if names else {}
        medians = [_median(record, name, span) / 60 for name, record in records.items()]
        if turning := tuple(speed for speed in medians if speed > 0):
            tracked[mode] = turning
    return tracked


def _median(record: Record | None, name: str, span: Span) -> float:
    """Within a span; 0 without samples there."""
    if record is None:
        return 0.0
    low, high = (end if x is None else x for x, end in zip(span, (-np.inf, np.inf), strict=True))
    inside = record.channel(name)[(record.time >= low) & (record.time <= high)]
    return float(np.median(inside)) if inside.size else 0.0


def _span(settings: RecordSettings) -> Span:
    if not settings.segments:
        return settings.start, settings.stop
    ends = [(-np.inf if a is None else a, np.inf if b is None else b) for a, b in settings.segments]
    low, high = max(ends, key=lambda part: part[1] - part[0])
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
    records: dict[str, Record] = {}
    for group in tables.values():
        first = {"the first one": {group[0]: 1.0}}  # a record has an input
        outputs = {name: {name: 1.0} for name in group}
        try:
            with warnings.catch_warnings():  # of axes that rest
                warnings.simplefilter("ignore", RecordWarning)
                parts = read_segments(log.path, [span], inputs=first, outputs=outputs)
        except RecordError:  # too few samples in this span, or missing ones
            continue
        records |= dict.fromkeys(group, max(parts, key=lambda part: part.samples))
    return records


def _in_radians(record: Record, name: str) -> Samples:
    """A rate in rad/s."""
    degrees = record.unit(name) == "deg/s"
    return np.radians(record.channel(name)) if degrees else record.channel(name)


@dataclasses.dataclass(frozen=True)
class FlownAutopilot:
    """The rate loop of a log: firmware, version, law and what of it is not modelled.

    `loop` is the law with what moves in flight, `law` that at one throttle. `values` are the log's
    own parameters, `throttle` is where Betaflight's dynamic filters and TPA and ArduPilot's notches
    are taken, and `tracked_hz` what other notches of the latter followed. `angle` is the angle loop
    around the rate loop, None where the firmware has none. `filters` are those of the gyro, by the
    parameters, or as measured where the law lacks some of them; `filters_text` says which.
    """

    firmware: str
    version: tuple[int, ...]
    axis: int
    loop: FlownLoop
    law: RateLoop
    parameters: Mapping[str, float]
    unmodelled: tuple[Message, ...]
    values: Mapping[str, str] = dataclasses.field(default_factory=dict)
    throttle: float = 0.3
    tracked_hz: Mapping[int, Sequence[float]] = dataclasses.field(default_factory=dict)
    angle: OuterLoop | None = None
    filters: tuple[KnownFilter, ...] = ()
    filters_text: str = ""

    @property
    def measured(self) -> tuple[KnownFilter, ...] | None:
        """The gyro's filters as measured; None where they are those of the law."""
        return self.filters if any(isinstance(x, MeasuredChain) for x in self.filters) else None

    def with_filters(self, parameters: Mapping[str, Number]) -> RateLoop:
        """The law as it is read from a log with these cutoffs and notches."""
        values = change_filters(self.firmware, self.values, parameters)
        return flown_loop(
            self.firmware, values, self.version, throttle=self.throttle, tracked_hz=self.tracked_hz
        ).law

    def at(self, throttle: float) -> "FlownAutopilot":
        """The same at another throttle, which moves cutoffs, notches and TPA of some firmwares."""
        if not firmware_named(self.firmware).follows_throttle:
            return self
        there = dataclasses.replace(self, throttle=throttle)
        return dataclasses.replace(there, law=there.with_filters({}))

    @property
    def old(self) -> dict[str, float]:
        """P, I and D of the axis by the firmware's names."""
        return parameters_of(self.law, self.axis, gains_of(self.law, self.axis))


def settings_of(path: Path, proposal: Proposal) -> LogSettings:
    """The log's own parameters, of the part that is proposed."""
    prefix = channel_prefix(proposal).rstrip(".")
    return read_settings(path, log=prefix, at=proposal.setup.start)


def read_flown(
    path: Path, proposal: Proposal, throttle: float | None,
    tracked_hz: Mapping[int, Sequence[float]],
) -> FlownAutopilot:  # fmt: skip
    """The loop that flew. Raises ValueError where the log does not hold its gains."""
    setup, logged = proposal.setup, settings_of(path, proposal)
    axis, firmware = AXES.index(setup.axis), firmware_named(proposal.vehicle)
    values = firmware.with_hold(logged.values, setup.hold)
    throttle = HOVER if throttle is None else throttle
    loop = firmware.flown_loop(values, logged.version, throttle=throttle, tracked_hz=tracked_hz)
    loop = firmware.levelled(loop) if setup.levelled else loop
    if not np.any(gains_of(loop.law, axis) > 0):
        raise ValueError(
            f"{path}: P, I and D of {setup.axis} are all 0, so there is no rate loop to tune"
        )
    dt = loop.law.interval()
    return FlownAutopilot(
        proposal.vehicle, tuple(logged.version), axis, loop, loop.law, loop.parameters(),
        loop.unmodelled, values, throttle, tracked_hz,
        firmware.angle_loop(logged.values, axis, dt, levelled=setup.levelled),
    )  # fmt: skip
