"""The flights of a file: a flash chip holds one log for each arming."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .._clock import FEWEST
from .._errors import RecordError
from .._log import Log, Table
from ..formats import load_log
from ._chirps import Chirp, chirps
from ._proposal import AXES


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
        return self._rank(axis) > 0

    def _rank(self, axis: str | None) -> int:
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
_FULL = 500.0  # of rcCommand


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
    return list(flights_of(load_log(path)))


def flights_of(log: Log) -> tuple[Flight, ...]:
    """Those that have enough samples for a record."""
    if log.vehicle != "betaflight":
        clocks = [t.time for t in log.tables.values() if t.time is not None and t.time.size]
        if not clocks:
            return ()
        span = min(float(t[0]) for t in clocks), max(float(t[-1]) for t in clocks)
        return (Flight(1, "", *span, None, {}, {}),)
    tables = {
        name: table
        for name, table in log.tables.items()
        if not name.endswith(("slow", "gps")) and table.time is not None
    }
    return tuple(
        _flight(name, table, table.time)
        for name, table in tables.items()
        if table.time is not None and table.time.size >= FEWEST
    )


def _flight(name: str, table: Table, time: np.ndarray) -> Flight:
    number = int(name.removeprefix("log")) if name else 1
    throttle = _scaled(table, "setpoint[3]")
    ends = None if throttle is None else (throttle.min() / 1e3, throttle.max() / 1e3)
    sticks = {axis: _scaled(table, f"rcCommand[{i}]") for i, axis in enumerate(AXES)}
    return Flight(
        number, name, float(time[0]), float(time[-1]),
        None if ends is None else (float(ends[0]), float(ends[1])), _durations(chirps(table)),
        {axis: float(np.std(x) / _FULL) for axis, x in sticks.items() if x is not None},
    )  # fmt: skip


def _durations(sweeps: Sequence[Chirp]) -> dict[str, float]:
    lasting: dict[str, float] = {}
    for sweep in sweeps:
        axis = AXES[sweep.axis]
        lasting[axis] = lasting.get(axis, 0.0) + sweep.stop - sweep.start
    return lasting


def _scaled(table: Table, name: str) -> np.ndarray | None:
    values = table.columns.get(name)
    if values is None:
        return None
    finite = np.asarray(values, np.float64)
    finite = finite[np.isfinite(finite)] * table.scales.get(name, 1.0)
    return finite if finite.size else None


def choose_flight(log: Log, axis: str | None, number: int | None) -> tuple[Log, tuple[str, ...]]:
    """The log of one flight, and a remark on the choice where the file holds several.

    By default the longest with a chirp, without one the longest with sticks that move, else the
    longest. Channels keep their names in the file; settings have the names of a single log. Raises
    RecordError for a number that the file does not have.
    """
    every = flights_of(log)
    if not every and number is None:
        return log, ()
    if number is None:
        chosen = max(every, key=lambda each: (each._rank(axis), each.duration))
    else:
        chosen = next((each for each in every if each.number == number), None)
    if chosen is None:
        listed = "; ".join(map(str, every)) or "none"
        raise RecordError(
            f"flight is {number}, but the file holds: {listed}. Choose one («flight=»)."
        )
    if not chosen.log:
        return log, ()
    others = "; ".join(str(each) for each in every if each is not chosen)
    reason = "" if number is not None else f", {_reason(chosen, axis)}"
    remark = f"{chosen} is used{reason}; others of this file (--flight N): {others or 'none'}"
    return _log_of(log, chosen.log), (remark,)


def _reason(chosen: Flight, axis: str | None) -> str:
    on = f" on {axis}" if axis else ""
    longest = "the longest"
    kinds = (f"{longest}, as none is excited{on}", f"{longest} with sticks that move{on}")
    return (*kinds, f"{longest} with a chirp{on}")[chosen._rank(axis)]


def _log_of(log: Log, name: str) -> Log:
    """The tables and settings of one log of a file alone."""
    tables = {
        key: table for key, table in log.tables.items() if key == name or key.startswith(f"{name}.")
    }
    settings = {
        key.removeprefix(f"{name} "): text
        for key, text in log.settings.items()
        if key.startswith(f"{name} ")
    }
    return dataclasses.replace(log, tables=tables, settings=settings)
