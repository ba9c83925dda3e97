"""ArduPilot: RATE holds set-points, rates and outputs, SIDD and SIDS the injected chirp."""

import functools as ft
from typing import NamedTuple

import numpy as np

from .._errors import RecordError
from .._log import flattened, Log, Signals, Table
from ._proposal import (
    AXES,
    channel_rate,
    first_logged,
    Injection,
    most_active_axis,
    Setup,
    values_of,
    with_injections,
)


_LETTERS: dict[str, str] = dict(zip(AXES, "RPY", strict=True))
_PLACES = {
    **dict.fromkeys((1, 2, 3), "the pilot's angle set-point"),
    **dict.fromkeys((4, 5, 6), "the angle set-point of the attitude loop"),
    **dict.fromkeys((7, 8, 9), "the rate set-point"),
    **dict.fromkeys((10, 11, 12), "the mixer"),
}
_MIXER = (10, 11, 12)
_BREAK = 1.0  # s without SIDD: another run
_SHORTEST = 2.0  # s


class _Run(NamedTuple):
    """One chirp: where it went (SID_AXIS), when, and from which to which frequency (0: unknown)."""

    place: int
    start: float  # s
    stop: float
    low: float  # Hz
    high: float


def ardupilot_setup(log: Log, axis: str | None) -> Setup:
    """The set-up for the longest chirp, on the `axis` if given; else for the loop without one."""
    signals = flattened(log)
    rates = {each: first_logged(signals, [f"RATE.{_LETTERS[each]}"]) for each in AXES}
    if not any(rates.values()):
        raise RecordError(
            "the log has no RATE messages. Set LOG_BITMASK to log fast attitude (ATTITUDE_FAST)."
        )
    runs = [run for run in _runs(log, signals) if axis in (None, _axis(run))]
    if not runs:
        return _without_chirp(signals, axis or most_active_axis(signals, rates), rates)
    best = max(runs, key=lambda run: run.stop - run.start)
    alike = [run for run in runs if run.place == best.place]
    remarks = [
        f"another chirp into {_PLACES[run.place]} ({_axis(run)}), "
        f"t = {run.start:.6g} .. {run.stop:.6g} s"
        for run in runs
        if run not in alike
    ]
    return _chirped(log, best, alike, remarks)


def _axis(run: _Run) -> str:
    return AXES[(run.place - 1) % 3]


def _runs(log: Log, signals: Signals) -> list[_Run]:
    table = log.tables.get("SIDD")
    if table is None or table.time is None or "Targ" not in table.columns or not table.time.size:
        return []
    edges = np.flatnonzero(np.diff(table.time) > _BREAK) + 1
    starts, stops = [0, *edges.tolist()], [*(edges - 1).tolist(), table.time.size - 1]
    runs = []
    for first, last in zip(starts, stops, strict=True):
        begin, end = float(table.time[first]), float(table.time[last])
        place, low, high = _announced(log.tables.get("SIDS"), log, begin)
        if place in _PLACES and end - begin >= _SHORTEST:
            runs.append(_Run(place, begin, end, low, high))
    return runs


def _announced(table: Table | None, log: Log, begin: float) -> tuple[int, float, float]:
    """Place and band from the SIDS message before the run, else from the parameters."""
    if table is not None and table.time is not None and {"Ax", "FSt", "FSp"} <= set(table.columns):
        before = np.flatnonzero(table.time <= begin + _BREAK)
        if before.size:
            row = (table.columns[name][before[-1]] for name in ("Ax", "FSt", "FSp"))
            place, low, high = (_number(each) for each in row)
            return int(place), low, high
    names = ("SID_AXIS", "SID_F_START_HZ", "SID_F_STOP_HZ")
    place, low, high = (_number(log.settings.get(name)) for name in names)
    return int(place), low, high


def _number(value: object) -> float:
    """0 for what is no finite number."""
    try:
        number = float(str(value))
    except ValueError:
        return 0.0
    return number if np.isfinite(number) else 0.0


def _chirped(log: Log, run: _Run, alike: list[_Run], remarks: list[str]) -> Setup:
    """The set-up for all chirps into the place of `run` that have RATE messages."""
    axis = _axis(run)
    letter = _LETTERS[axis]
    command = {f"RATE.{letter}Out": 1.0}
    if run.place in _MIXER:
        command["SIDD.Targ"] = 1.0
        remarks.append(
            "the chirp is added after the controller, so the command is the sum of the two"
        )
    if run.place <= 3:
        remarks.append("the chirp passes the input shaping, which is nonlinear for large steps")
    rate = f"RATE.{letter}"
    remarks.append(
        f"{rate} is measured after the gyro filter, which identify divides out where the log has "
        "its parameters"
    )
    remarks += _gains(log, axis)
    found = [each for each in map(ft.partial(_common, log), alike) if each]
    if not found:
        raise RecordError(
            f"the log has no RATE messages during the chirp at t = {run.start:.6g} s."
        )
    what = f"SystemID chirp into {_PLACES[run.place]} (SID_AXIS {run.place})"
    setup = Setup(axis, command, rate, "SIDD.Targ", remarks=tuple(remarks))
    return with_injections(setup, found, what)


def _common(log: Log, run: _Run) -> Injection | None:
    """Where RATE and SIDD overlap within the run."""
    clocks = [log.tables[name].time for name in ("RATE", "SIDD")]
    first = max(float(clock[0]) for clock in clocks if clock is not None)
    last = min(float(clock[-1]) for clock in clocks if clock is not None)
    start, stop = max(run.start, first), min(run.stop, last)
    return Injection(start, stop, run.low, run.high) if start < stop else None


def _gains(log: Log, axis: str) -> list[str]:
    """A remark on parameters that counteract the sweep at low frequencies."""
    short = {"roll": "RLL", "pitch": "PIT", "yaw": "YAW"}[axis]
    harmful = (f"ATC_RAT_{short}_I", "ATC_RATE_FF_ENAB")
    on = [f"{name} = {log.settings[name]}" for name in harmful if _number(log.settings.get(name))]
    why = "set to 0 during a sweep, because they change it at low frequencies"
    return [f"{', '.join(on)}: {why}"] if on else []


def _without_chirp(signals: Signals, axis: str, rates: dict[str, str]) -> Setup:
    letter = _LETTERS[axis]
    command = f"RATE.{letter}Out"
    if not rates[axis] or values_of(signals, command).size == 0:
        raise RecordError(f"the log has no {command} or no RATE.{letter}.")
    remarks = [
        f"RATE.{letter}Des is computed by the attitude loop: it contains feedback and cannot be "
        f"the external reference",
        "for an external reference, fly the SystemID mode (SID_AXIS 10 to 12)",
    ]
    if "RCIN.C1" in signals.arrays:
        stick = f"RCIN.C{AXES.index(axis) + 1 if axis != 'yaw' else 4}"
        if stick in signals.arrays:
            remarks.append(
                f"the stick ({stick}, {channel_rate(signals, stick):.3g} Hz) is not affected by "
                f"feedback: use --reference {stick} if it moved enough"
            )
    return Setup(axis, {command: 1.0}, rates[axis], remarks=tuple(remarks))
