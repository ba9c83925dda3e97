import shlex
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .._errors import RecordError
from .._log import flattened, Log, SettingChange, Signals
from ._firmware_log import FirmwareLog, throttle_of
from ._setup import array_of, channel_rate, Setup


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


def complete(path: str, log: Log, firmware: FirmwareLog, setup: Setup) -> Proposal:
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
    hold, doubts = firmware.hold(log)
    setup = setup._replace(
        remarks=(*remarks, *doubts), hold=hold, throttle=throttle_of(firmware, signals)
    )
    changes = tuple(
        change
        for change in log.changes
        if change.name.startswith(firmware.of_loop) and change.name not in firmware.learned
    )
    return Proposal(path, log.vehicle, _split(setup, changes, signals), rate, units, changes)


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
    alike = tuple(span for number, span in parts if number == regime)
    start, stop = max(alike, key=lambda span: span[1] - span[0])
    others = ", ".join(f"{a:.6g} .. {b:.6g} s" for number, (a, b) in parts if number != regime)
    rest = f" (others: {others})" if others else ""
    remark = f"{said}; split there, what lasted longest with the same ones is taken{rest}"
    return setup._replace(
        start=start,
        stop=stop,
        segments=alike if len(alike) > 1 else (),
        remarks=(*setup.remarks, remark),
    )
