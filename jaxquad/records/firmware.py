"""What the logs of a firmware mean: which channels are command, rate, set-point and throttle.

The file of a firmware takes from here what its `FirmwareLog` needs.
"""

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from ._channel import native_rate, Number
from ._firmwares import (
    axis_of_rate as axis_of_rate,
    channel_limit as channel_limit,
    firmware_log as firmware_log,
    firmware_names as firmware_names,
    is_setpoint as is_setpoint,
    register_log as register_log,
)
from ._log import (
    FEWEST as FEWEST,
    flattened as flattened,
    Log as Log,
    ReadError,
    RecordError,
    Signal,
    Signals as Signals,
    Table as Table,
)
from .formats import load_log, Reader as Reader


AXES: tuple[str, ...] = ("roll", "pitch", "yaw")
Mix = Mapping[str, float]
Point = Literal["", "rate", "mixer", "angle"]


class NumberedChirp(NamedTuple):
    """One of the chirps that a log holds."""

    number: int  # in the order of time, from 1
    axis: str  # empty where it turns none
    place: str  # what it was added to, in words
    point: Point
    start: float  # s
    stop: float
    low: float = 0.0  # Hz, 0 where the band is unknown
    high: float = 0.0

    def __str__(self) -> str:
        band = f", {self.low:.4g} .. {self.high:.4g} Hz" if 0 < self.low < self.high else ""
        span = f"t = {self.start:.6g} .. {self.stop:.6g} s"
        return f"{self.number}: {self.axis or 'no axis'}, {self.place}, {span}{band}"


class Selection(NamedTuple):
    """What a proposal is for: an axis, one of the log's chirps, a span of time; None: all."""

    axis: str | None = None
    chirp: int | None = None  # its number
    start: float | None = None  # s
    stop: float | None = None

    def part_of(self, chirp: NumberedChirp) -> NumberedChirp | None:
        """What the span leaves of a chirp."""
        start = chirp.start if self.start is None else max(chirp.start, self.start)
        stop = chirp.stop if self.stop is None else min(chirp.stop, self.stop)
        return chirp._replace(start=start, stop=stop) if start < stop else None


class Injection(NamedTuple):
    """A signal that was injected: when, and from which to which frequency (0: unknown)."""

    start: float  # s
    stop: float
    low: float = 0.0  # Hz
    high: float = 0.0


class Setup(NamedTuple):
    """The channels and excitation of one axis in a vehicle's log.

    `spans` are start and stop of all injections of the same kind, in the order of time; without an
    injection take-off and landing, None where the log begins or ends in flight. `injected_at` says
    where the reference enters the loop: at the set-point of the rate or of the angle, or at the
    mixer, behind the controller, whose logged output, the `command`, contains it all the same.
    `late_s` are channels whose value acts that long after its stamp, and is computed from
    measurements of that stamp.
    """

    axis: str
    command: Mix  # a weighted sum of channels
    rate: str
    reference: str = ""  # external signal; empty if there is none
    spans: tuple[tuple[float | None, float | None], ...] = ((None, None),)  # s
    band: tuple[float, float] | None = None  # Hz
    excitation: str = "no injected excitation found"
    remarks: tuple[str, ...] = ()
    hold: float | None = None  # s; of the command, where the log says it
    throttle: Mix = {}  # the collective, 0 to 1 but for PX4's sign; empty if it is not logged
    injected_at: Point = ""  # empty: nothing was injected, or it is not known
    late_s: Mapping[str, float] = {}
    chirps: tuple[NumberedChirp, ...] = ()  # all of the log, of any axis
    levelled: bool = False  # whether an angle loop of Betaflight is known to have been closed

    @property
    def longest(self) -> tuple[float | None, float | None]:
        """Start and stop of the longest of the spans, in s."""
        return max(self.spans, key=lambda span: (span[1] or 0.0) - (span[0] or 0.0))


def with_injections(setup: Setup, runs: Sequence[Injection], what: str) -> Setup:
    """The `setup` with what was injected and when: all `runs` of one kind."""
    swept = [run for run in runs if 0 < run.low < run.high]
    band = (min(r.low for r in swept), max(r.high for r in swept)) if swept else None
    lasted = " + ".join(f"{run.stop - run.start:.4g}" for run in runs)
    times = f"{len(runs)} times: " if len(runs) > 1 else ""
    span = ""
    if band:
        low, high = (2 * np.pi * end for end in band)
        span = f"{band[0]:.4g} .. {band[1]:.4g} Hz ({low:.3g} .. {high:.3g} rad/s), "
    return setup._replace(
        spans=tuple((run.start, run.stop) for run in runs),
        band=band,
        excitation=f"{what}, {times}{span}{lasted} s",
    )


def choose_chirps(chirps: Sequence[NumberedChirp], wanted: Selection) -> list[NumberedChirp]:
    """The chirp of that number, else the longest wanted one, and all on its axis at its place."""
    if wanted.chirp is not None:
        listed = "; ".join(map(str, chirps)) or "none"
        chirp = next((x for x in chirps if x.number == wanted.chirp), None)
        if chirp is None:
            raise RecordError(f"there is no chirp {wanted.chirp}. Chirps of this log: {listed}.")
        if wanted.axis not in (None, chirp.axis):
            raise RecordError(
                f"chirp {wanted.chirp} is not on the axis {wanted.axis}: leave one of them out. "
                f"Chirps of this log: {listed}."
            )
        part = wanted.part_of(chirp)
        if part is None:
            raise RecordError(
                f"chirp {wanted.chirp} lies outside the span of start and stop: leave them out. "
                f"Chirps of this log: {listed}."
            )
        return [part]
    inside = [part for chirp in chirps if (part := wanted.part_of(chirp))]
    turning = [chirp for chirp in inside if chirp.axis]
    candidates = [chirp for chirp in turning if wanted.axis in (None, chirp.axis)]
    candidates = candidates if turning else inside
    if not candidates:
        return []
    best = max(candidates, key=lambda chirp: chirp.stop - chirp.start)
    return [x for x in candidates if (x.axis, x.place) == (best.axis, best.place)]


def channel_rate(signals: Signals, name: str) -> float:
    """Samples per second, of a channel on a clock that the log knows."""
    clock = signals.clocks[signal_of(signals, name).clock]
    increasing = np.unique(clock[np.isfinite(clock)])
    return native_rate(increasing) if increasing.size > 1 else 0.0


def signal_of(signals: Signals, name: str) -> Signal:
    """The array that holds a channel."""
    array = name if name in signals.arrays else name.rpartition("[")[0]
    if array not in signals.arrays:
        raise RecordError(f"the log has no channel {name}.")
    return signals.arrays[array]


def values_of(signals: Signals, name: str) -> np.ndarray:
    """The values of a channel, empty where there is no such channel."""
    if name in signals.arrays:
        signal = signals.arrays[name]
        return np.asarray(signal.values, np.float64) * signal.scale
    array, _, column = name.rpartition("[")
    if array not in signals.arrays or signals.arrays[array].values.ndim != 2:
        return np.empty(0)
    signal, i = signals.arrays[array], int(column.rstrip("]"))
    inside = i < signal.values.shape[1]
    return np.asarray(signal.values[:, i], np.float64) * signal.scale if inside else np.empty(0)


def first_logged(signals: Signals, names: Sequence[str]) -> str:
    """The first of the channels that the log holds with enough samples, or an empty string."""
    return next((name for name in names if values_of(signals, name).size >= FEWEST), "")


def moves(signals: Signals, name: str) -> bool:
    """Whether a channel is logged and not constant."""
    values = values_of(signals, name)
    finite = values[np.isfinite(values)]
    return finite.size >= FEWEST and float(np.ptp(finite)) > 0


def most_active_axis(signals: Signals, rates: Mapping[str, str]) -> str:
    """The axis whose rate varies most; one of them has to have a name."""
    spread = {}
    for axis, name in rates.items():
        values = values_of(signals, name)
        finite = values[np.isfinite(values)]
        if name:
            spread[axis] = float(finite.std()) if finite.size else 0.0
    return max(spread, key=lambda axis: spread[axis])


_LONGEST = 0.1  # s, that a rate loop holds its command
_MOVING = 0.03  # of full deflection; corrections of a hover stay below
Spans = Sequence[tuple[float, float]]  # s


class Flight(NamedTuple):
    """One flight of a file, as `flights` lists it; it prints as one line."""

    number: int  # in the file, from 1; what `propose` takes as `flight`
    log: str  # what its channels begin with, `log2` for `log2.gyroADC[0]`; empty for a single one
    start: float  # s of the file's time
    stop: float
    throttle: tuple[float, float] | None  # lowest and highest, 0 to 1; None where it is not logged
    chirps: Mapping[str, float]  # seconds of injected sweeps, by axis
    sticks: Mapping[str, float]  # RMS of each about its mean, as a share of full deflection

    @property
    def duration(self) -> float:
        """In s."""
        return self.stop - self.start

    @property
    def excitation(self) -> str:
        """In words: the chirps, else how much the sticks move."""
        if self.chirps:
            return ", ".join(f"chirp on {axis} {time:.3g} s" for axis, time in self.chirps.items())
        if not self.sticks:
            return "sticks not logged"
        return "sticks " + ", ".join(f"{a} {100 * x:.0f} %" for a, x in self.sticks.items())

    def rank(self, axis: str | None) -> int:
        """2 with a chirp, 1 with sticks that move, else 0."""
        if axis in self.chirps or (axis is None and self.chirps):
            return 2
        sticks = self.sticks if axis is None else {axis: self.sticks.get(axis, 0.0)}
        return int(max(sticks.values(), default=0.0) > _MOVING)

    def __str__(self) -> str:
        throttle = "" if self.throttle is None else "throttle {:.2f} .. {:.2f}, ".format(
            *self.throttle
        )  # fmt: skip
        return f"flight {self.number}: {self.duration:.3g} s, {throttle}{self.excitation}"


def one_flight(log: Log) -> tuple[Flight, ...]:
    """All of the log."""
    clocks = [t.time for t in log.tables.values() if t.time is not None and t.time.size]
    if not clocks:
        return ()
    span = min(float(t[0]) for t in clocks), max(float(t[-1]) for t in clocks)
    return (Flight(1, "", *span, None, {}, {}),)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FirmwareLog:
    """What the channels of a firmware's logs mean; it needs no JAX.

    `setup` finds the channels of the axis that is wanted, and what excited it, and raises
    RecordError where the log lacks them. `hold` is for how long the loop holds its command in s,
    None where the log does not say it; with remarks.
    """

    name: str  # the `vehicle` of its logs
    title: str  # as people write it
    setup: Callable[[Log, Selection], Setup]
    rates: Sequence[str] = ()  # of roll, pitch and yaw: they show take-off, landing and crash
    setpoints: Sequence[str] = ()
    throttle: Sequence[tuple[str, float]] = ()  # factors to 0 .. 1; first what the motors had
    # The most that sticks and commands reach, by how the names of their channels begin.
    limits: Mapping[str, float] = dataclasses.field(default_factory=dict)
    hold: Callable[[Log], tuple[float | None, tuple[str, ...]]] = lambda log: (None, ())
    of_loop: tuple[str, ...] = ()  # how names of parameters begin whose change splits a log
    learned: tuple[str, ...] = ()  # those of them that the firmware itself changes
    settings: bool = True  # whether its logs hold parameters
    release: str = ""  # the parameter that is the version
    flights: Callable[[Log], tuple[Flight, ...]] = one_flight
    remarks_on: Callable[[Log, Setup, Spans], tuple[str, ...]] = lambda log, setup, spans: ()
    numbers_chirps: bool = False  # whether a proposal lists all chirps with their numbers
    gyro_cutoffs: tuple[str, ...] = ()  # one of these is in each log that tells the gyro's filters
    # Of its files, where no format of `jq.read` is theirs. For firmwares that are registered: those
    # of the package are not imported before a file is recognised, so theirs are in `formats`.
    reader: Reader | None = None


def hold_by_rate(log: Log, name: str) -> tuple[float | None, tuple[str, ...]]:
    """The period in s of a loop whose rate in Hz is a parameter, for `FirmwareLog.hold`."""
    rate = number_of(log, name)
    return (plausible_hold(1 / rate) if rate > 0 else None), ()


def plausible_hold(period: float) -> float | None:
    """A period in s, None for one that no rate loop has."""
    return period if 0 < period < _LONGEST else None


def number_of(log: Log, name: str, default: float = 0.0) -> float:
    """A parameter; the default for what is missing, or no finite number."""
    try:
        number = float(str(log.settings.get(name, default)))
    except ValueError:
        return default
    return number if np.isfinite(number) else default


def throttle_of(firmware: FirmwareLog, signals: Signals, *, wanted: bool = False) -> Mix:
    """The channel with what the motors had, else with what they were asked for (`wanted`)."""
    for name, factor in reversed(firmware.throttle) if wanted else firmware.throttle:
        logged = (x for x in signals.arrays if x == name or x.endswith(f".{name}"))
        full = next(logged, name)
        if first_logged(signals, [full]):
            return {full: factor}
    return {}


class Settings(NamedTuple):
    """Firmware and parameters of a log, as text."""

    vehicle: str  # ardupilot, px4 or betaflight
    version: tuple[int, ...]  # of the firmware, (4, 2, 0); empty where the log does not say
    values: Mapping[str, str]  # a Betaflight header's lines, ArduPilot's PARM, PX4's parameters


def read_settings(path: str | Path, *, log: str = "", at: Number | None = None) -> Settings:
    """Read the parameters that a log begins with.

    A parameter that was changed in flight has its value of the time `at`; by default its last one
    in ArduPilot's and PX4's logs, and its first one in Betaflight's, which say no more.

    **Arguments:**

    - `path`: a log of Betaflight, ArduPilot or PX4.
    - `log`: of a Betaflight file with several logs, which one: "log2".
    - `at`: in s of the log's own time, for logs of ArduPilot and PX4.

    **Returns:** the `Settings`.

    **Raises:**

    - `ReadError`: the file cannot be read, is of no autopilot, or holds no parameters.
    """
    content = load_log(path)
    later = [change for change in content.changes if at is not None and change.time > at]
    values = {**content.settings, **{change.name: change.before for change in reversed(later)}}
    if log:
        values = {
            k.removeprefix(f"{log} "): x for k, x in values.items() if k.startswith(f"{log} ")
        }
    firmware = firmware_log(content.vehicle)
    if firmware is None or not firmware.settings or not values:
        raise ReadError(
            f"{path}: the file holds no parameters of ArduPilot, PX4 or Betaflight"
            + (f" under {log!r}" if log else "")
            + ": give the log that the autopilot wrote, with its parameters logged."
        )
    text = values.get(firmware.release, content.firmware)
    match = re.search(r"(\d+)\.(\d+)(?:\.(\d+))?", text)
    if text.isdecimal():  # one byte each, as PX4 has them
        version = tuple(int(text) >> shift & 0xFF for shift in (24, 16, 8))
    else:
        version = tuple(int(part or 0) for part in match.groups()) if match else ()
    return Settings(content.vehicle, version, values)
