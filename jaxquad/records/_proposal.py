"""Which channels of an axis a log proposes, when its vehicle flies, the flights of a file."""

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad._core import marked_text

from ._firmwares import firmware_log, firmware_names
from ._log import flattened, Log, printable, RecordError, SettingChange, Signals
from .firmware import (
    AXES,
    channel_rate,
    Flight,
    one_flight,
    Selection,
    Setup,
    signal_of,
    throttle_of,
    values_of,
)
from .formats import load_log


SLOW = 100  # Hz: a command or rate logged more slowly does not resolve the actuator


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
        setup, (start, stop) = self.setup, self.setup.longest
        return {
            "inputs": {self._command_name: dict(setup.command)},
            "outputs": setup.rate,
            "references": setup.reference or None,
            "sample_rate": self.sample_rate,
            "start": start,
            "stop": stop,
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
        return tuple((a, b) for a, b in self.setup.spans if a is not None and b is not None)

    @property
    def command_line(self) -> str:
        """`jaxquad identify ...`, quoted for a shell."""
        setup, (start, stop) = self.setup, self.setup.longest
        words = ["jaxquad", "identify", self.path, "--input", self._mix, "--output", setup.rate]
        words += ["--reference", setup.reference] if setup.reference else []
        words += ["--rate", f"{self.sample_rate:.6g}"]
        words += ["--hold", f"{setup.hold:.6g}"] if setup.hold else []
        if len(self.segments) > 1:
            spans = [f"{a:.12g}:{b:.12g}" for a, b in self.segments]
            words += [word for span in spans for word in ("--segment", span)]
        else:
            words += ["--start", f"{start:.12g}"] if start is not None else []
            words += ["--stop", f"{stop:.12g}"] if stop is not None else []
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

    def __str__(self) -> str:
        setup, chirps = self.setup, self.setup.chirps
        none = "none (feedback biases the direct estimate; the joint one needs a reference)"
        used = [any(a < x.stop and x.start < b for a, b in self.segments) for x in chirps]
        listed = []
        if len(chirps) > 1 or not all(used):
            listed.append("  chirps of this log (* used; --chirp N chooses one):")
            marks = ("*" if is_used else " " for is_used in used)
            listed += [f"    {mark} {x}" for mark, x in zip(marks, chirps, strict=True)]
        lines = [
            f"Proposal for the {setup.axis} axis of {self.path} ({self.vehicle})",
            f"  excitation: {setup.excitation}",
            *listed,
            f"  command: {self._mix}",
            f"  rate: {setup.rate} [{self.units.get(setup.rate) or 'unit unknown'}]",
            f"  external reference: {setup.reference or none}",
            *([f"  the command is held for {1e3 * setup.hold:.4g} ms"] if setup.hold else []),
            *(f"  ! {remark}" for remark in setup.remarks),
            f"  {self.command_line}",
        ]
        return "\n".join(lines)


def flights(path: str | Path) -> list[Flight]:
    """List the flights that a file holds.

    A Betaflight file from a flash chip holds one for each arming. Logs of other vehicles count as
    one flight.

    **Arguments:**

    - `path`: a log of an autopilot.

    **Returns:** a `Flight` for each, in the order of the file.

    **Raises:**

    - `ReadError`: where the file is missing, damaged or of an unknown format.
    """
    return list(_flights_of(load_log(path)))


def _flights_of(log: Log) -> tuple[Flight, ...]:
    firmware = firmware_log(log.vehicle)
    return one_flight(log) if firmware is None else firmware.flights(log)


def propose(
    path: str | Path, *, axis: str | None = None, chirp: int | None = None,
    flight: int | None = None, start: float | int | None = None, stop: float | int | None = None,
) -> Proposal:  # fmt: skip
    """Propose which channels of an autopilot's log are command, rate and external reference.

    Injected excitation is found, with its time and band: ArduPilot's SystemID mode, PX4's
    autotune, Betaflight's chirp mode. A set-point that an outer loop computes contains feedback,
    and is never proposed as the external reference. Without injected excitation the proposal is of
    the time in flight: what comes before take-off and after landing or a crash is left out.

    **Arguments:**

    - `path`: a log of ArduPilot, PX4, Betaflight or Crazyflie.
    - `axis`: `"roll"`, `"pitch"` or `"yaw"`; by default that of the longest injected excitation,
        else the one that moves most.
    - `chirp`: the number, from 1, of one of the chirps that the proposal of an ArduPilot log lists;
        by default the longest one, with all others on its axis at its place.
    - `flight`: the number of the flight in a file with several, as `flights` lists them; by default
        the longest with a chirp, else the longest with sticks that move, else the longest.
    - `start`, `stop`: in s, instead of what the log says: the ends of the injected excitation, or
        take-off and landing; only ArduPilot's chirps between them are taken.

    **Returns:** a `Proposal`, which prints its reasons and the command line.

    **Raises:**

    - `ReadError`: where the file is missing, damaged or of an unknown format.
    - `RecordError`: where the log lacks the channels of the axis, or the chirp.
    """
    if axis is not None and axis not in AXES:
        raise RecordError(f"axis is {axis!r}: use one of {', '.join(AXES)}.")
    log = load_log(path)
    firmware = firmware_log(log.vehicle)
    if firmware is None:
        names = ", ".join(firmware_names())
        raise RecordError(
            f"{path}: not a log of a known autopilot ({names}), so the meaning of its channels is "
            "unknown. jaxquad identify takes it all the same: list them (jaxquad channels"
            "«, jq.records.channels») and «name inputs, outputs and references yourself»."
        )
    if chirp is not None and not firmware.numbers_chirps:
        raise RecordError(
            f"{path}: the chirps of {log.vehicle} have no numbers: leave `chirp` out, and give the "
            "time (`start`, `stop`) of the one to use."
        )
    try:
        low, high = (None if end is None else float(end) for end in (start, stop))
        log, choice = _choose_flight(log, axis, flight)
        setup = firmware.setup(log, Selection(axis, chirp, low, high))
        setup = _in_flight(log, setup, low, high)
        signals = flattened(log)
        names = [*setup.command, setup.rate, *filter(None, (setup.reference,))]
        rates = {name: channel_rate(signals, name) for name in names}
        if min(rates.values()) <= 0:
            raise RecordError(
                f"the time stamps of {min(rates, key=lambda name: rates[name])} do not increase."
            )
        remarks = (*choice, *setup.remarks)
        if slow := [f"{name} {rate:.3g} Hz" for name, rate in rates.items() if rate < SLOW]:
            remarks += (
                f"logged slowly: {', '.join(slow)}. Lag and delay of the actuators are visible "
                f"only at higher rates: choose a faster logging profile",
            )
        hold, doubts = firmware.hold(log)
        changes = tuple(
            change
            for change in log.changes
            if change.name.startswith(firmware.of_loop) and change.name not in firmware.learned
        )
        setup = setup._replace(
            remarks=(*remarks, *doubts), hold=hold, throttle=throttle_of(firmware, signals)
        )
        setup = _split(setup, changes, signals)
        used = [
            (-np.inf if start is None else start, np.inf if stop is None else stop)
            for start, stop in setup.spans
        ]
        setup = setup._replace(remarks=(*setup.remarks, *firmware.remarks_on(log, setup, used)))
        units = {name: signal_of(signals, name).unit for name in names}
        rate = float(f"{min(rates.values()):.3g}")
        return Proposal(str(path), log.vehicle, setup, rate, units, changes)
    except RecordError as error:
        raise RecordError(f"{path}: {marked_text(error)}") from error
    # A log may call anything by the names that its vehicle uses.
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise RecordError(
            f"{path}: the channels are not those that {log.vehicle} logs "
            f"({type(error).__name__}: {printable(str(error))}). Name inputs, outputs and "
            f"references yourself."
        ) from error


def _choose_flight(log: Log, axis: str | None, number: int | None) -> tuple[Log, tuple[str, ...]]:
    """The log of one flight, with the names of a single log, and a remark on the choice."""
    every = _flights_of(log)
    if not every and number is None:
        return log, ()
    if number is None:
        chosen = max(every, key=lambda flight: (flight.rank(axis), flight.duration))
    else:
        chosen = next((flight for flight in every if flight.number == number), None)
    if chosen is None:
        listed = "; ".join(map(str, every)) or "none"
        raise RecordError(
            f"flight is {number}, but the file holds: {listed}. Choose one («flight=»)."
        )
    if not (name := chosen.log):
        return log, ()
    on = f" on {axis}" if axis else ""
    kinds = (f", as none is excited{on}", f" with sticks that move{on}", f" with a chirp{on}")
    reason = "" if number is not None else f", the longest{kinds[chosen.rank(axis)]}"
    others = "; ".join(str(flight) for flight in every if flight is not chosen)
    remark = f"{chosen} is used{reason}; others of this file (--flight N): {others or 'none'}"
    tables = {k: t for k, t in log.tables.items() if k == name or k.startswith(f"{name}.")}
    settings = {
        key.removeprefix(f"{name} "): text
        for key, text in log.settings.items()
        if key.startswith(f"{name} ")
    }
    return dataclasses.replace(log, tables=tables, settings=settings), (remark,)


_SHOWN = 4  # changes in a remark
_SHORTEST = 2.0  # s of a part worth a record, of a flight, and of windows at rest that count


def _split(setup: Setup, changes: Sequence[SettingChange], signals: Signals) -> Setup:
    """The set-up of what was flown longest without a change of the loop's parameters."""
    clock = signals.clocks[signal_of(signals, setup.rate).clock]
    begin, end = float(np.min(clock)), float(np.max(clock))
    spans = [
        (begin if start is None else start, end if stop is None else stop)
        for start, stop in setup.spans
    ]
    first, last = min(start for start, _ in spans), max(stop for _, stop in spans)
    inside = [change for change in changes if first < change.time < last]
    if not inside:
        return setup
    more = f" and {len(inside) - _SHOWN} more" if len(inside) > _SHOWN else ""
    said = f"parameters of the loop changed in flight: {', '.join(map(str, inside[:_SHOWN]))}{more}"
    cuts = sorted({change.time for change in inside})
    limits = zip([-np.inf, *cuts], [*cuts, np.inf], strict=True)
    parts = [  # of the spans between the cuts, with the number of cuts before
        (number, (max(start, low), min(stop, high)))
        for number, (low, high) in enumerate(limits)
        for start, stop in spans
    ]
    parts = [(number, (a, b)) for number, (a, b) in parts if b - a >= _SHORTEST]
    if not parts:
        remark = f"{said}; no part of {_SHORTEST:g} s has the same ones"
        return setup._replace(remarks=(*setup.remarks, remark))
    lasting: dict[int, float] = {}
    for number, (a, b) in parts:
        lasting[number] = lasting.get(number, 0.0) + b - a
    regime = max(lasting, key=lambda number: lasting[number])
    others = ", ".join(f"{a:.6g} .. {b:.6g} s" for number, (a, b) in parts if number != regime)
    rest = f" (others: {others})" if others else ""
    remark = f"{said}; split there, what lasted longest with the same ones is taken{rest}"
    alike = tuple(span for number, span in parts if number == regime)
    return setup._replace(spans=alike, remarks=(*setup.remarks, remark))


_WINDOW = 0.25  # s
_IDLE = 0.05  # of the throttle
_REST = 2.0  # times what the gyro shows at rest; propellers that lift shake it more
_LOST = 300.0  # deg/s RMS between set-point and rate: more than any manoeuvre that a loop follows


def _in_flight(log: Log, setup: Setup, start: float | None, stop: float | None) -> Setup:
    """From take-off to landing or crash, or `start` to `stop` (s), which cut what was injected."""
    ends = setup._replace(spans=((start, stop),))
    injected = [(a, b) for a, b in setup.spans if a is not None and b is not None]
    if injected:
        low, high = (-np.inf if start is None else start), (np.inf if stop is None else stop)
        cut = ((max(a, low), min(b, high)) for a, b in injected)
        inside = tuple((a, b) for a, b in cut if a < b)
        return setup._replace(spans=inside) if inside else ends
    if start is not None and stop is not None:
        return ends
    (begin, end), (before, after), remarks = _flown_span(log)
    if (end is not None and start is not None and start >= end) or (
        begin is not None and stop is not None and stop <= begin
    ):
        return ends
    cut = (before if start is None else "", after if stop is None else "")
    left_out = " and ".join(filter(None, cut))
    said = f"left out, as no flight: {left_out}; --start and --stop take others"
    return setup._replace(
        spans=((begin if start is None else start, end if stop is None else stop),),
        remarks=(*setup.remarks, *remarks, *((said,) if left_out else ())),
    )


Ends = tuple[float | None, float | None]  # s, of flight; None: the log begins, ends in flight
_UNKNOWN = (None, None), ("", ""), ()


def _flown_span(log: Log) -> tuple[Ends, tuple[str, str], tuple[str, ...]]:
    """Take-off and landing or crash, what lies before and after, and remarks.

    Flight is a window of 0.25 s with the throttle above 5 % in which the gyro moves twice as much
    as at its quietest without. Only the ends of a log are cut: a dive without throttle is flight.
    """
    signals, firmware = flattened(log), firmware_log(log.vehicle)
    if firmware is None:
        return _UNKNOWN

    def logged(name: str) -> str:
        """The full name of a channel in a log of one flight; empty where it is not logged."""
        full = next((x for x in signals.arrays if x == name or x.endswith(f".{name}")), name)
        return full if values_of(signals, full).size else ""

    clock = lambda name: signals.clocks.get(signal_of(signals, name).clock)
    throttle = throttle_of(firmware, signals, wanted=True)
    names = [name for rate in firmware.rates if (name := logged(rate))]
    time = clock(names[0]) if throttle and names else None
    if time is None or not time.size or not np.isfinite(time).all():
        return _UNKNOWN
    begin, end = float(time[0]), float(time[-1])
    count = int((end - begin) / _WINDOW)
    if not (begin < end and _SHORTEST / _WINDOW <= count < 1_000_000):
        return _UNKNOWN

    def mean(name: str, values: np.ndarray) -> Float[np.ndarray, " windows"]:
        """Of values on the clock of a channel, by windows; NaN where one holds none."""
        time = clock(name)
        if time is None or time.size != values.size:
            return np.full(count, np.nan)
        place = np.floor((time - begin) / _WINDOW)
        good = np.isfinite(values) & np.isfinite(place) & (place >= 0) & (place < count)
        rows = place[good].astype(int)
        number = np.bincount(rows, minlength=count)
        total = np.bincount(rows, weights=values[good], minlength=count)
        return np.divide(total, number, out=np.full(count, np.nan), where=number > 0)

    collective = sum(factor * mean(x, values_of(signals, x)) for x, factor in throttle.items())
    powered = np.nan_to_num(np.asarray(collective)) > _IDLE
    if not powered.any():
        remark = f"the throttle stays below {100 * _IDLE:.0f} %: the log seems to hold no flight"
        return *_UNKNOWN[:2], (remark,)
    # The gyro shows more than at rest; everywhere where the log does not show rest.
    power = np.zeros(count)
    controlled = np.ones(count, bool)  # where no rate is far from its set-point
    for i, name in enumerate(names):
        values = values_of(signals, name)
        variance = mean(name, values**2) - mean(name, values) ** 2
        power += np.nan_to_num(np.maximum(variance, 0.0))
        setpoint = logged(firmware.setpoints[i]) if i < len(firmware.setpoints) else ""
        times = clock(name), clock(setpoint) if setpoint else None
        if times[0] is None or times[1] is None:
            continue
        factor = 180 / np.pi if signal_of(signals, name).unit == "rad/s" else 1.0
        wanted = np.interp(times[0], times[1], values_of(signals, setpoint))
        square = mean(name, (factor * (values - wanted)) ** 2)
        controlled &= ~(np.nan_to_num(square) > _LOST**2)
    under_power = np.flatnonzero(powered)
    rest = np.delete(power, slice(under_power[0], under_power[-1] + 1))
    flying = powered
    if rest.size * _WINDOW >= _SHORTEST / 4:
        flying = powered & (power > _REST**2 * np.quantile(rest, 0.1))
    controlled &= flying
    # From the first two windows of flight to the last two.
    first = np.flatnonzero(flying[:-1] & flying[1:])
    last = np.flatnonzero(controlled[:-1] & controlled[1:])
    if not first.size or not last.size or (last[-1] + 2 - first[0]) * _WINDOW < _SHORTEST:
        return _UNKNOWN
    begins, ends = int(first[0]), int(last[-1]) + 2
    start = begin + begins * _WINDOW if begins > 0 else None
    stop = begin + ends * _WINDOW if ends + 1 < count else None
    kind = "a crash" if flying[ends:].any() else "landed"
    before = "" if start is None else f"t = {begin:.6g} .. {start:.6g} s (on the ground)"
    after = "" if stop is None else f"t = {stop:.6g} .. {end:.6g} s ({kind})"
    return (start, stop), (before, after), ()
