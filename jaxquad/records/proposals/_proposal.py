import shlex
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .._clock import FEWEST, native_rate
from .._errors import RecordError
from .._log import flattened, Log, SettingChange, Signals
from ._hold import command_hold
from ._selection import NumberedChirp, Point


AXES: tuple[str, ...] = ("roll", "pitch", "yaw")
SLOW = 100  # Hz: a command or rate logged more slowly does not resolve the actuator
Mix = Mapping[str, float]


class Injection(NamedTuple):
    """A signal that was injected: when, and from which to which frequency (0: unknown)."""

    start: float  # s
    stop: float
    low: float = 0.0  # Hz
    high: float = 0.0


class Setup(NamedTuple):
    """The channels and excitation of one axis in a vehicle's log.

    `start` and `stop` are those of the longest injection, `segments` those of all injections of the
    same kind, in the order of time. Without an injection `start` and `stop` are take-off and
    landing, None where the log begins or ends in flight. `injected_at` says where the reference
    enters the loop: at the set-point of the rate or of the angle, or at the mixer, behind the
    controller, whose logged output, the `command`, contains it all the same. `late_s` are channels
    whose value acts that long after its stamp, and is computed from measurements of that stamp.
    """

    axis: str
    command: Mix  # a weighted sum of channels
    rate: str
    reference: str = ""  # external signal; empty if there is none
    start: float | None = None  # s
    stop: float | None = None
    band: tuple[float, float] | None = None  # Hz
    excitation: str = "no injected excitation found"
    remarks: tuple[str, ...] = ()
    segments: tuple[tuple[float, float], ...] = ()  # s
    hold: float | None = None  # s; of the command, where the log says it
    throttle: Mix = {}  # the collective, 0 to 1 but for PX4's sign; empty if it is not logged
    injected_at: Point = ""  # empty: nothing was injected, or it is not known
    late_s: Mapping[str, float] = {}
    chirps: tuple[NumberedChirp, ...] = ()  # all of the log, of any axis
    levelled: bool = False  # whether an angle loop of Betaflight is known to have been closed


class Proposal(NamedTuple):
    """How to identify an axis from a log: a starting point to be checked.

    `jq.read(proposal.path, **proposal.options)` reads the record. Where several injections were
    found it is that of the longest; replace `start` and `stop` by each of `proposal.segments` for
    the others. `str(proposal)` gives the reasons and the command line.
    """

    path: str
    vehicle: str
    setup: Setup
    sample_rate: float  # Hz, the lowest of the channels' own
    units: Mapping[str, str]
    changes: tuple[SettingChange, ...] = ()  # of the loop's parameters, in flight

    @property
    def options(self) -> dict[str, Any]:
        """The keyword arguments of `read`."""
        setup = self.setup
        return {
            "inputs": {self._command_name: dict(setup.command)},
            "outputs": setup.rate,
            "references": setup.reference or None,
            "sample_rate": self.sample_rate,
            "start": setup.start,
            "stop": setup.stop,
            "hold": setup.hold,
        }

    @property
    def options_with_throttle(self) -> dict[str, Any]:
        """`options` with a second input "throttle", as `jq.identify.gain_over_throttle` wants it.

        Raises RecordError where the log has no collective.
        """
        if not self.setup.throttle:
            raise RecordError(
                f"{self.path} holds no collective: log the throttle, or name a channel yourself."
            )
        options = self.options
        both = {**options["inputs"], "throttle": dict(self.setup.throttle)}
        return {**options, "inputs": both}

    @property
    def segments(self) -> tuple[tuple[float, float], ...]:
        """Start and stop of all injections of the same kind, else of the flight, in s.

        Empty where neither was found.
        """
        setup = self.setup
        if setup.segments or setup.start is None or setup.stop is None:
            return setup.segments
        return ((setup.start, setup.stop),)

    @property
    def command_line(self) -> str:
        """`jaxquad identify ...`, quoted for a shell."""
        setup = self.setup
        words = ["jaxquad", "identify", self.path, "--input", self._mix, "--output", setup.rate]
        words += ["--reference", setup.reference] if setup.reference else []
        words += ["--rate", f"{self.sample_rate:.6g}"]
        words += ["--hold", f"{setup.hold:.6g}"] if setup.hold else []
        if len(self.segments) > 1:
            spans = [f"{start:.12g}:{stop:.12g}" for start, stop in self.segments]
            words += [word for span in spans for word in ("--segment", span)]
        else:
            words += ["--start", f"{setup.start:.12g}"] if setup.start is not None else []
            words += ["--stop", f"{setup.stop:.12g}"] if setup.stop is not None else []
        words += ["--band", *(f"{f:.3g}" for f in setup.band)] if setup.band else []
        return shlex.join(words)

    @property
    def _command_name(self) -> str:
        single = list(self.setup.command.values()) == [1.0]
        return next(iter(self.setup.command)) if single else self.setup.axis

    @property
    def _mix(self) -> str:
        if self._command_name in self.setup.command:
            return self._command_name
        terms = (
            f"{'-' if weight < 0 else '+'}{'' if abs(weight) == 1 else f'{abs(weight):.9g}*'}{name}"
            for name, weight in self.setup.command.items()
        )
        return f"{self.setup.axis}={''.join(terms).removeprefix('+')}"

    @property
    def _listed_chirps(self) -> list[str]:
        """All chirps of the log, where there is a choice; those that are used have a star."""
        used = lambda chirp: any(
            start < chirp.stop and chirp.start < stop for start, stop in self.segments
        )
        chirps = self.setup.chirps
        if len(chirps) < 2 and all(map(used, chirps)):
            return []
        lines = [f"    {'*' if used(chirp) else ' '} {chirp}" for chirp in chirps]
        return ["  chirps of this log (* used; --chirp N chooses one):", *lines]

    def __str__(self) -> str:
        setup = self.setup
        none = "none (feedback biases the direct estimate; the joint one needs a reference)"
        lines = [
            f"Proposal for the {setup.axis} axis of {self.path} ({self.vehicle})",
            f"  excitation: {setup.excitation}",
            *self._listed_chirps,
            f"  command: {self._mix}",
            f"  rate: {setup.rate} [{self.units.get(setup.rate) or 'unit unknown'}]",
            f"  external reference: {setup.reference or none}",
            *([f"  the command is held for {1e3 * setup.hold:.4g} ms"] if setup.hold else []),
            *(f"  ! {remark}" for remark in setup.remarks),
            f"  {self.command_line}",
        ]
        return "\n".join(lines)


def with_injections(setup: Setup, runs: Sequence[Injection], what: str) -> Setup:
    """The `setup` with what was injected and when: all `runs` of one kind."""
    best = max(runs, key=lambda run: run.stop - run.start)
    known = [run for run in runs if 0 < run.low < run.high]
    band = (min(r.low for r in known), max(r.high for r in known)) if known else None
    lasted = " + ".join(f"{run.stop - run.start:.4g}" for run in runs)
    times = f"{len(runs)} times: " if len(runs) > 1 else ""
    swept = ""
    if band:
        low, high = (2 * np.pi * end for end in band)
        swept = f"{band[0]:.4g} .. {band[1]:.4g} Hz ({low:.3g} .. {high:.3g} rad/s), "
    return setup._replace(
        start=best.start,
        stop=best.stop,
        band=band,
        excitation=f"{what}, {times}{swept}{lasted} s",
        segments=tuple((run.start, run.stop) for run in runs) if len(runs) > 1 else (),
    )


def complete(path: str, log: Log, setup: Setup) -> Proposal:
    """The proposal, with the rates and units of the channels that the set-up names."""
    signals = flattened(log)
    names = [*setup.command, setup.rate, *filter(None, (setup.reference,))]
    rates = {name: channel_rate(signals, name) for name in names}
    if min(rates.values()) <= 0:
        raise RecordError(
            f"the time stamps of {min(rates, key=lambda name: rates[name])} do not increase."
        )
    slow = [f"{name} {rate:.3g} Hz" for name, rate in rates.items() if rate < SLOW]
    remarks = setup.remarks
    if slow:
        remarks += (
            f"logged slowly: {', '.join(slow)}. Lag and delay of the actuators are visible only at "
            f"higher rates: choose a faster logging profile",
        )
    units = {name: array_of(signals, name)[1] for name in names}
    rate = float(f"{min(rates.values()):.3g}")
    hold, doubts = command_hold(log)
    setup = setup._replace(
        remarks=(*remarks, *doubts), hold=hold, throttle=throttle_of(log, signals)
    )
    changes = tuple(
        change
        for change in log.changes
        if change.name.startswith(_OF_LOOP) and change.name not in _LEARNED
    )
    return Proposal(path, log.vehicle, _split(setup, changes, signals), rate, units, changes)


_OF_LOOP = (
    "ATC_", "INS_GYRO_", "INS_HNTC", "MOT_", "SCHED_LOOP_RATE", "PSC_", "FSTRATE_",
    "MC_", "IMU_GYRO_", "IMU_DGYRO_", "THR_MDL_FAC", "CA_", "PWM_", "DSHOT_",
)  # fmt: skip
_LEARNED = ("MOT_THST_HOVER",)  # in flight, and stored at the end of it: the hover's throttle
_SHOWN = 4  # changes in a remark
_SHORTEST = 2.0  # s of a part worth a record


def _split(setup: Setup, changes: Sequence[SettingChange], signals: Signals) -> Setup:
    """The set-up of what was flown longest without a change of the loop's parameters."""
    clock = signals.clocks[signals.arrays[array_of(signals, setup.rate)[0]].clock]
    begin, end = float(np.min(clock)), float(np.max(clock))
    spans = [
        (begin if start is None else start, end if stop is None else stop)
        for start, stop in setup.segments or ((setup.start, setup.stop),)
    ]
    first, last = min(start for start, _ in spans), max(stop for _, stop in spans)
    inside = [change for change in changes if first < change.time < last]
    if not inside:
        return setup
    parts = _parts(spans, sorted({change.time for change in inside}))
    said = f"parameters of the loop changed in flight: {_in_words(inside)}"
    if not parts:
        remark = f"{said}; no part of {_SHORTEST:g} s has the same ones"
        return setup._replace(remarks=(*setup.remarks, remark))
    lasting: dict[int, float] = {}
    for number, (a, b) in parts:
        lasting[number] = lasting.get(number, 0.0) + b - a
    regime = max(lasting, key=lambda number: lasting[number])
    alike = tuple(each for number, each in parts if number == regime)
    start, stop = max(alike, key=lambda each: each[1] - each[0])
    others = ", ".join(f"{a:.6g} .. {b:.6g} s" for number, (a, b) in parts if number != regime)
    rest = f" (others: {others})" if others else ""
    remark = f"{said}; split there, what lasted longest with the same ones is taken{rest}"
    return setup._replace(
        start=start,
        stop=stop,
        segments=alike if len(alike) > 1 else (),
        remarks=(*setup.remarks, remark),
    )


def _parts(
    spans: Sequence[tuple[float, float]], cuts: Sequence[float]
) -> list[tuple[int, tuple[float, float]]]:
    """What the cuts leave of the spans, each with the number of cuts before it."""
    limits = zip([-np.inf, *cuts], [*cuts, np.inf], strict=True)
    found = [
        (number, (max(start, low), min(stop, high)))
        for number, (low, high) in enumerate(limits)
        for start, stop in spans
    ]
    return [(number, (a, b)) for number, (a, b) in found if b - a >= _SHORTEST]


def _in_words(changes: Sequence[SettingChange]) -> str:
    more = f" and {len(changes) - _SHOWN} more" if len(changes) > _SHOWN else ""
    return f"{', '.join(map(str, changes[:_SHOWN]))}{more}"


_THROTTLES: Mapping[str, tuple[tuple[str, float], ...]] = {  # channel, its factor to 0 .. 1
    "ardupilot": (("RATE.AOut", 1.0), ("CTUN.ThO", 1.0)),
    "px4": (("vehicle_thrust_setpoint.xyz[2]", -1.0), ("actuator_controls_0.control[3]", 1.0)),
    "betaflight": (("collective", 1.0), ("setpoint[3]", 1e-3)),
    "crazyflie": (("controller.cmd_thrust", 1 / 65535), ("stabilizer.thrust", 1 / 65535)),
}


def throttle_of(log: Log, signals: Signals, *, asked: bool = False) -> Mix:
    """The collective of the vehicle, where the log of one flight has it.

    It is what the motors had, where that is known; with `asked` what they were asked for.
    """
    names = _THROTTLES.get(log.vehicle, ())
    for name, factor in reversed(names) if asked else names:
        logged = (each for each in signals.arrays if each == name or each.endswith(f".{name}"))
        full = next(logged, name)
        if first_logged(signals, [full]):
            return {full: factor}
    return {}


def channel_rate(signals: Signals, name: str) -> float:
    """Samples per second, of a channel on a clock that the log knows."""
    clock = signals.clocks[signals.arrays[array_of(signals, name)[0]].clock]
    increasing = np.unique(clock[np.isfinite(clock)])
    return native_rate(increasing) if increasing.size > 1 else 0.0


def array_of(signals: Signals, name: str) -> tuple[str, str]:
    """The array that holds a channel, and its unit."""
    array = name if name in signals.arrays else name.rpartition("[")[0]
    if array not in signals.arrays:
        raise RecordError(f"the log has no channel {name}.")
    return array, signals.arrays[array].unit


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
    spread = {axis: _spread(values_of(signals, name)) for axis, name in rates.items() if name}
    return max(spread, key=lambda axis: spread[axis])


def _spread(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.std()) if finite.size else 0.0
