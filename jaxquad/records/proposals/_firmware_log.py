"""What the logs of a firmware mean: which channels are command, rate, set-point and throttle."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from .._log import Log, Signals
from ..formats import Reader
from ._setup import first_logged, Mix, Selection, Setup


_LONGEST = 0.1  # s, that a rate loop holds its command
Spans = Sequence[tuple[float, float]]  # s


class Flight(NamedTuple):
    """One flight of a file, as `flights` lists it; it prints as one line.

    **Arguments:**

    - `number`: in the file, from 1; what `propose` takes as `flight`.
    - `log`: what its channels begin with, `log2` for `log2.gyroADC[0]`; empty for a single one.
    - `start`, `stop`: s of the file's time.
    - `throttle`: lowest and highest, 0 to 1; None where it is not logged.
    - `chirps`: seconds of injected sweeps, by axis.
    - `sticks`: how much each stick moves, RMS about its mean as a share of full deflection.
    """

    number: int
    log: str
    start: float
    stop: float
    throttle: tuple[float, float] | None
    chirps: Mapping[str, float]
    sticks: Mapping[str, float]

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

    def is_excited(self, axis: str | None = None) -> bool:
        """Whether a chirp or the sticks excite the `axis`, by default any axis."""
        return self.rank(axis) > 0

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


_MOVING = 0.03  # of full deflection; corrections of a hover stay below


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

    **Attributes:**

    - `name`: the `vehicle` of its logs; `title`: as people write it.
    - `setup`: the channels of the axis that is wanted, and what excited it; raises RecordError
      where the log lacks them.
    - `rates`, `setpoints`: of roll, pitch and yaw, by which take-off, landing and crash are seen.
    - `throttle`: channels with their factors to 0 .. 1, what the motors had first, what they were
      asked for last.
    - `hold`: for how long the loop holds its command in s, None where the log does not say it; and
      remarks.
    - `of_loop`: how the names of the loop's parameters begin, whose change in flight splits a log;
      `learned`: which of them the firmware itself changes.
    - `settings`: whether its logs hold parameters; `release`: which of them is the version.
    - `flights`: those of a file; `remarks_on`: what to say of the part that is used.
    - `numbers_chirps`: whether a proposal lists all chirps with their numbers.
    - `gyro_cutoffs`: parameters, one of which is in each log that tells the gyro's filters.
    - `reader`: of its files, where no format of `jq.read` is theirs.
    """

    name: str
    title: str
    setup: Callable[[Log, Selection], Setup]
    rates: Sequence[str] = ()
    setpoints: Sequence[str] = ()
    throttle: Sequence[tuple[str, float]] = ()
    hold: Callable[[Log], tuple[float | None, tuple[str, ...]]] = lambda log: (None, ())
    of_loop: tuple[str, ...] = ()
    learned: tuple[str, ...] = ()
    settings: bool = True
    release: str = ""
    flights: Callable[[Log], tuple[Flight, ...]] = one_flight
    remarks_on: Callable[[Log, Setup, Spans], tuple[str, ...]] = lambda log, setup, spans: ()
    numbers_chirps: bool = False
    gyro_cutoffs: tuple[str, ...] = ()
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
    """The collective of the vehicle, where the log of one flight has it.

    It is what the motors had, where that is known; with `wanted` what they were asked for.
    """
    for name, factor in reversed(firmware.throttle) if wanted else firmware.throttle:
        logged = (x for x in signals.arrays if x == name or x.endswith(f".{name}"))
        full = next(logged, name)
        if first_logged(signals, [full]):
            return {full: factor}
    return {}
