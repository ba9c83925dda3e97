"""What a proposal reads of a flight: gyros, set-point, terms, motors, and the loop that flew."""

import dataclasses
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from jaxquad._core import Number
from jaxquad.identify import Fit, KnownFilter, measured_chain
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
from ._law import FlownLoop, RateLoop
from ._parameters import flown_loop, gains_of, parameters_of


Samples = Float[np.ndarray, " samples"]
_AT_END = 0.002  # of a motor's range
_RESTS = np.radians(5.0)  # rad/s, of the set-point: less identifies nothing


@runtime_checkable
class RecordSettings(Protocol):
    """Which part of a log is identified, in s, and in which band, in Hz; None: all of it."""

    @property
    def segments(self) -> Sequence[tuple[float, float]]: ...
    @property
    def start(self) -> float | None: ...
    @property
    def stop(self) -> float | None: ...
    @property
    def band(self) -> tuple[float, float] | None: ...
    def content(self) -> dict[str, Any]: ...


@runtime_checkable
class IdentifiedPlant(Protocol):
    """A log's plant up to what the gyro's filters are given, as `jq.workflows.identify` has it."""

    @property
    def paths(self) -> tuple[Path, ...]: ...
    @property
    def settings(self) -> RecordSettings: ...
    @property
    def records(self) -> tuple[Record, ...]: ...
    @property
    def fit(self) -> Fit: ...
    @property
    def band(self) -> tuple[float, float]: ...  # rad/s


@dataclasses.dataclass(frozen=True)
class FlightChannels:
    """Channels of the analysed part of a log; those that are not in it are empty.

    Rates are in rad/s; all but the unfiltered ones are on `dt`.
    """

    rates: tuple[Samples, ...]  # behind the gyro's filters, of roll, pitch and yaw
    dt: float  # s
    setpoint: Samples  # of the axis in rad/s
    axis: int = 0  # 0 for roll
    start: float = 0.0  # s, of the first sample
    unfiltered: tuple[Float[np.ndarray, " raw_samples"], ...] = ()  # before the gyro's filters
    unfiltered_dt: float = 0.0  # s
    averaged: bool = False  # whether the unfiltered rate is the mean over its sample
    terms: Mapping[str, Samples] = dataclasses.field(default_factory=dict)  # P, I, D, F of the law
    output: Samples | None = None  # of the law, with an injection into the mixer
    injected: Samples | None = None  # that alone
    not_carried: Samples | None = None  # what the motors made of the output, less that in its limit
    reference: Samples | None = None  # what no feedback computes, beside the set-point
    motors: Float[np.ndarray, "samples motors"] | None = None
    motor_ends: tuple[float, float] = (0.0, 1.0)  # lowest and highest command
    throttle: Samples | None = None  # 0 to 1
    stick: Samples | None = None  # likewise what filters and TPA follow, where that is another one
    slewed: Samples | None = None  # by which P and D were lowered (ArduPilot's SMAX)
    late: float = 0.0  # s after its stamp at which the set-point acts
    resolution: tuple[float, float] = (0.0, 0.0)  # steps of logged rates (rad/s), and of terms
    names: tuple[str, str] = ("", "")  # of the gyro's channels, filtered and unfiltered
    # Medians of what notches follow, by INS_HNTCH_MODE: of motors (3), of RPM sensors (2, 5).
    tracked_hz: Mapping[int, tuple[float, ...]] = dataclasses.field(default_factory=dict)

    @property
    def middle(self) -> float | None:
        """The median throttle, at which filters that follow it are taken."""
        if self.throttle is None and self.stick is None:
            return None
        return float(np.clip(np.median(self.followed), 0.01, 1.0))

    @property
    def followed(self) -> Samples:
        """The throttle that filters and TPA follow at each sample; `HOVER` where none is logged."""
        if self.stick is not None:
            return self.stick
        return np.full(len(self.setpoint), HOVER) if self.throttle is None else self.throttle

    @property
    def rests(self) -> bool:
        """Whether nothing excites the axis: its set-point is still, and nothing is injected."""
        injected = self.injected is not None and np.any(self.injected)
        return bool(not injected and np.std(self.setpoint) <= _RESTS)

    @property
    def rest_text(self) -> str:
        """In words, that the axis `rests`, and when: other parts of the log may have moved it."""
        stop = self.start + (len(self.setpoint) - 1) * self.dt
        return f"you did not move {AXES[self.axis]} from {self.start:.3g} to {stop:.3g} s"

    @property
    def limited(self) -> Samples:
        """At each sample, 1 where a motor is at an end of its range, else 0."""
        if self.motors is None:
            return np.zeros(len(self.setpoint))
        low, high = self.motor_ends
        near = _AT_END * (high - low)
        return np.any((self.motors <= low + near) | (self.motors >= high - near), axis=1) * 1.0


def read_channels_if_any(
    path: Path, proposal: Proposal, settings: RecordSettings, values: Mapping[str, str]
) -> FlightChannels | None:
    """Of the longest analysed part; None without a rate and its set-point there.

    The record has what identification needs, and says what is missing.
    """
    firmware, prefix = firmware_named(proposal.vehicle), _channel_prefix(proposal)
    setup, axis, span = proposal.setup, AXES.index(proposal.setup.axis), _span(settings)
    filtered = [f"{prefix}{name}" for name in firmware.log.rates]
    setpoint, rate = f"{prefix}{firmware.log.setpoints[axis]}", filtered[axis]
    names = firmware.channels(prefix, axis, values)
    injected = {setup.reference: 1.0} if setup.injected_at == "mixer" else {}
    try:
        logged = frozenset(channel.name for channel in channels(path))
        median = lambda x: _median(_read(path, logged, [x], span).get(x), x, (None, None))
        unfiltered = names.unfiltered or firmware.unfiltered_gyro(logged, values, median)
        wanted = [*filtered, *unfiltered, *names.terms, *names.motors, setpoint, setup.reference]
        wanted += [*names.output, *names.stick, *names.mixed, *names.slewed, *injected]
        records = _read(path, logged, [*wanted, *setup.throttle], span)
        tracked_hz: dict[int, tuple[float, ...]] = {}
        for mode, pattern in names.tracked.items():
            turned = sorted(name for name in logged if re.fullmatch(pattern, name))
            speeds = _read(path, logged, turned, (None, None)).items()
            medians = [_median(record, name, span) / 60 for name, record in speeds]
            if turning := tuple(speed for speed in medians if speed > 0):
                tracked_hz[mode] = turning
    except (ReadError, RecordError):
        return None
    if rate not in records or setpoint not in records:
        return None
    rates = records[rate]
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
    limit, (low, high) = names.output_limit, names.stick_ends
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
        motor_ends=names.motor_ends, throttle=sum_at(setup.throttle),
        stick=None if stick is None else np.clip((stick - low) / (high - low), 0.0, 1.0),
        slewed=sum_at(names.slewed), late=setup.late_s.get(setpoint, 0.0),
        resolution=names.resolution,
        names=(rate, "" if raw is None else unfiltered[axis]), tracked_hz=tracked_hz,
    )  # fmt: skip


def _channel_prefix(proposal: Proposal) -> str:
    """What the channels of a flight begin with in a file with several."""
    log, axis = firmware_named(proposal.vehicle).log, AXES.index(proposal.setup.axis)
    rate = log.rates[axis] if axis < len(log.rates) else ""
    full = proposal.setup.rate
    return full.removesuffix(rate) if rate and full.endswith(f".{rate}") else ""


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


def _read(
    path: Path, logged: frozenset[str], names: Sequence[str], span: Span
) -> dict[str, Record]:
    """For each channel that the log has the record of its table, on that table's clock.

    Where samples are missing it is the longest part without a gap.
    """
    tables: dict[str, list[str]] = {}
    for name in dict.fromkeys(names):
        if name in logged:
            kind = name.rpartition(".")[0].partition("[")[0]  # instances have clocks alike
            tables.setdefault(kind, []).append(name)
    records: dict[str, Record] = {}
    for group in tables.values():
        first = {"the first one": {group[0]: 1.0}}  # a record has an input
        outputs = {name: {name: 1.0} for name in group}
        try:
            with warnings.catch_warnings():  # of axes that rest
                warnings.simplefilter("ignore", RecordWarning)
                parts = read_segments(path, [span], inputs=first, outputs=outputs)
        except RecordError:  # too few samples in this span, or missing ones
            continue
        records |= dict.fromkeys(group, max(parts, key=lambda part: part.samples))
    return records


def _in_radians(record: Record, name: str) -> Samples:
    degrees = record.unit(name) == "deg/s"
    return np.radians(record.channel(name)) if degrees else record.channel(name)


@dataclasses.dataclass(frozen=True)
class FlownAutopilot:
    """The rate loop of a log: firmware, version, law and what of it is not modelled."""

    firmware: str
    version: tuple[int, ...]
    axis: int
    loop: FlownLoop  # with what moves in flight
    law: RateLoop  # at one throttle
    values: Mapping[str, str]  # the log's own parameters
    throttle: float  # at which Betaflight's dynamic filters and TPA, ArduPilot's notches are taken
    flight: FlightChannels | None
    angle: OuterLoop | None  # around the rate loop; None where the firmware has none
    filters: tuple[KnownFilter, ...]  # of the gyro, or as measured where the law lacks some
    filters_text: str  # which of both

    def with_filters(self, parameters: Mapping[str, Number]) -> RateLoop:
        """The law as it is read from a log with these cutoffs and notches."""
        values = firmware_named(self.firmware).change_filters(self.values, parameters)
        tracked = None if self.flight is None else self.flight.tracked_hz
        return flown_loop(
            self.firmware, values, self.version, throttle=self.throttle, tracked_hz=tracked
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
    prefix = _channel_prefix(proposal).rstrip(".")
    return read_settings(path, log=prefix, at=proposal.setup.longest[0])


def read_flown(
    path: Path, proposal: Proposal, settings: RecordSettings, throttle: float | None = None
) -> FlownAutopilot:
    """The loop that flew, at a throttle or at the flight's median one, and the flight's channels.

    Raises ValueError where the log does not hold its gains.
    """
    setup, logged = proposal.setup, settings_of(path, proposal)
    axis, firmware = AXES.index(setup.axis), firmware_named(proposal.vehicle)
    flight = read_channels_if_any(path, proposal, settings, logged.values)
    if throttle is None and flight is not None:
        throttle = flight.middle
    throttle = HOVER if throttle is None else throttle
    values = firmware.with_hold(logged.values, setup.hold)
    tracked = {} if flight is None else flight.tracked_hz
    loop = firmware.flown_loop(values, logged.version, throttle=throttle, tracked_hz=tracked)
    if setup.levelled:
        loop = dataclasses.replace(loop, law=loop.law.levelled())
    if not np.any(gains_of(loop.law, axis) > 0):
        raise ValueError(
            f"{path}: P, I and D of {setup.axis} are all 0, so there is no rate loop to tune"
        )
    angle = firmware.angle_loop(logged.values, axis, loop.law.dt, levelled=setup.levelled)
    filters, text = best_filters(loop, flight, axis)
    return FlownAutopilot(
        proposal.vehicle, tuple(logged.version), axis, loop, loop.law, values, throttle, flight,
        angle, filters, text,
    )  # fmt: skip


_SHOWN = 10.0  # Hz, of the delay in print


def best_filters(
    loop: FlownLoop, flight: FlightChannels | None, axis: int
) -> tuple[tuple[KnownFilter, ...], str]:
    """As measured where notches follow motors or spectrum, else those of the parameters."""
    chains = tuple(chain for chain in loop.law.gyro_chains() if chain.filters)
    hidden = [text for text in loop.unmodelled if text.kind == "notch"]
    missing = "" if not hidden else f" (not {'; '.join(text.partition(':')[0] for text in hidden)})"
    if hidden and flight is not None and len(flight.unfiltered) > axis and not flight.averaged:
        unfiltered, filtered = flight.unfiltered[axis], flight.rates[axis]
        try:
            if len(unfiltered) != len(filtered):
                raise ValueError("both rates have other instants")
            measured = measured_chain(
                unfiltered, filtered, flight.dt, filters=chains,
                names=(flight.names[1], flight.names[0]),
                reference=flight.setpoint if np.ptp(flight.setpoint) > 0 else None,
            )  # fmt: skip
            return (measured,), f"the gyro's filters are divided out, {measured.description}"
        except ValueError as error:
            missing = f"{missing[:-1]}, which could not be measured: {error})"
    if not chains:
        return (), f"the gyro has no filter that is known{missing}"
    words = ", ".join(filter.in_words() for chain in chains for filter in chain.filters)
    late = sum(float(chain.delay_ms([_SHOWN])[0]) for chain in chains)
    text = f"the gyro's filters, {words}{missing}, are divided out: {late:.2g} ms at {_SHOWN:g} Hz"
    return chains, text
