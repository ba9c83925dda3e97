"""ArduPilot: RATE holds set-points, rates and outputs, SIDD and SIDS the injected chirp.

In each loop the rate controller and the motors' output come first, then the flight mode, which
computes the next set-point and the next value of the chirp, then the logging. So of one stamp,
RATE.x and RATE.xOut belong together, while RATE.xDes and SIDD.Targ act in the next loop; and
RATE.xOut contains the chirp that is added at the mixer (docs/autopilots.md).
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxquad.records import AXES, RecordError
from jaxquad.records.firmware import (
    channel_rate,
    choose_chirps,
    FirmwareLog,
    first_logged,
    flattened,
    hold_by_rate,
    Injection,
    Log,
    most_active_axis,
    NumberedChirp,
    Point,
    Selection,
    Setup,
    Signals,
    Table,
    values_of,
    with_injections,
)


_LETTERS: dict[str, str] = dict(zip(AXES, "RPY", strict=True))


class _Place(NamedTuple):
    """What the chirp is added to."""

    words: str
    point: Point


_ANGLE = _Place("the pilot's angle set-point", "angle")
_RECOVERY = _Place("the angle set-point of the attitude loop", "angle")
_RATE, _MIXER = _Place("the rate set-point", "rate"), _Place("the mixer", "mixer")
_SHAPED = (1, 2, 3)  # SID_AXIS of chirps that pass the input shaping
_PLACES: Mapping[int, _Place] = {  # by SID_AXIS, of which each three are roll, pitch and yaw
    **dict.fromkeys(_SHAPED, _ANGLE),
    **dict.fromkeys((4, 5, 6), _RECOVERY),
    **dict.fromkeys((7, 8, 9), _RATE),
    **dict.fromkeys((10, 11, 12), _MIXER),
    13: _Place("the thrust", ""),
    **dict.fromkeys((14, 15), _Place("the measured position", "")),
    **dict.fromkeys((16, 17), _Place("the measured velocity", "")),
    **dict.fromkeys((18, 19), _Place("the velocity set-point", "")),
}
_BREAK = 1.0  # s without SIDD: another run
_SHORTEST = 2.0  # s
_FLY = "fly the SystemID mode with SID_AXIS 10 (roll), 11 (pitch) or 12 (yaw)"


def ardupilot_setup(log: Log, wanted: Selection) -> Setup:
    """The set-up for the chirps that are wanted; else for the loop without one."""
    signals = flattened(log)
    rates = {x: first_logged(signals, [f"RATE.{_LETTERS[x]}"]) for x in AXES}
    if not any(rates.values()):
        raise RecordError(_without_rates(log))
    chirps = _chirps(log)
    chosen = choose_chirps(chirps, wanted)
    if chosen:
        setup = _chirped(log, chosen)
    else:
        setup = _without_chirp(signals, wanted.axis or most_active_axis(signals, rates), rates)
    return setup._replace(chirps=tuple(chirps), late_s=_late_channels(log, setup))


def _without_rates(log: Log) -> str:
    """Why a log without RATE messages is none to identify, and what to do."""
    name = log.firmware.partition(" ")[0].removeprefix("APM:")
    if name and "Copter" not in name:
        use = ""
        if {"PIDR", "PIDP"} <= set(log.tables):
            use = (
                ". Its PIDR, PIDP and PIDY hold the rate (Act) and its set-point (Tar): name them "
                "yourself, such as --input roll=PIDR.P+PIDR.I+PIDR.D+PIDR.FF --output PIDR.Act"
            )
        return (
            f"the log is of {log.firmware}, and only multicopters (ArduCopter) log RATE messages, "
            f"from which channels are proposed{use}."
        )
    return "the log has no RATE messages. Set LOG_BITMASK to log fast attitude (ATTITUDE_FAST)."


def _chirps(log: Log) -> list[NumberedChirp]:
    """All chirps of a log: each to the last value that is not 0, for SIDD goes on after it."""
    table = log.tables.get("SIDD")
    if table is None or table.time is None or "Targ" not in table.columns or not table.time.size:
        return []
    target = np.asarray(table.columns["Targ"], np.float64)
    again = np.diff(table.time) > _BREAK
    if "Time" in table.columns:  # since the mode began
        again |= np.diff(np.asarray(table.columns["Time"], np.float64)) < 0
    chirps = []
    for rows in np.split(np.arange(target.size), np.flatnonzero(again) + 1):
        active = rows[target[rows] != 0]
        if not active.size:
            continue
        begin, end = float(table.time[rows[0]]), float(table.time[active[-1]])
        number, low, high = _announced(log.tables.get("SIDS"), log, begin)
        if number in _PLACES and end - begin >= _SHORTEST:
            point, place = _PLACES[number].point, _place_of(number)
            axis = AXES[(number - 1) % 3] if point else ""
            chirps.append(NumberedChirp(len(chirps) + 1, axis, place, point, begin, end, low, high))
    return chirps


def _place_of(number: int) -> str:
    return f"{_PLACES[number].words} (SID_AXIS {number})"


def _announced(table: Table | None, log: Log, begin: float) -> tuple[int, float, float]:
    """SID_AXIS and band from the SIDS message before the run, else from the parameters."""
    if table is not None and table.time is not None and {"Ax", "FSt", "FSp"} <= set(table.columns):
        before = np.flatnonzero(table.time <= begin + _BREAK)
        if before.size:
            row = (table.columns[name][before[-1]] for name in ("Ax", "FSt", "FSp"))
            number, low, high = map(_number, row)
            return int(number), low, high
    names = ("SID_AXIS", "SID_F_START_HZ", "SID_F_STOP_HZ")
    number, low, high = (_number(log.settings.get(name)) for name in names)
    return int(number), low, high


def _number(value: object) -> float:
    """0 for what is no finite number."""
    try:
        number = float(str(value))
    except ValueError:
        return 0.0
    return number if np.isfinite(number) else 0.0


def _chirped(log: Log, chirps: list[NumberedChirp]) -> Setup:
    """The set-up for chirps into one place, where they have RATE messages."""
    _, axis, place, point, *_ = first = chirps[0]
    if not axis:
        raise RecordError(
            f"the chirp of t = {first.start:.6g} .. {first.stop:.6g} s went into {place}, which "
            f"turns no axis: {_FLY}, or say which other part to use (start, stop)."
        )
    rate, remarks = f"RATE.{_LETTERS[axis]}", []
    if place in map(_place_of, _SHAPED):
        remarks.append("the chirp passes the input shaping, which is nonlinear for large steps")
    remarks.append(
        f"{rate} is measured after the gyro filter, which identify divides out where the log has "
        "its parameters"
    )
    remarks += _gains(log, axis)
    logged = [part for chirp in chirps if (part := _common(log, chirp))]
    if not logged:
        raise RecordError(
            f"the log has no RATE messages during the chirp at t = {first.start:.6g} s."
        )
    command, remarks = {f"{rate}Out": 1.0}, tuple(remarks)
    setup = Setup(axis, command, rate, "SIDD.Targ", remarks=remarks, injected_at=point)
    return with_injections(setup, logged, f"SystemID chirp into {place}")


def _common(log: Log, chirp: NumberedChirp) -> Injection | None:
    """Where RATE and SIDD overlap within the chirp."""
    clocks = [log.tables[name].time for name in ("RATE", "SIDD")]
    first = max(float(clock[0]) for clock in clocks if clock is not None)
    last = min(float(clock[-1]) for clock in clocks if clock is not None)
    start, stop = max(chirp.start, first), min(chirp.stop, last)
    return Injection(start, stop, chirp.low, chirp.high) if start < stop else None


def _late_channels(log: Log, setup: Setup) -> Mapping[str, float]:
    """One loop for what the flight mode computes, behind the rate controller.

    Where the rate controller has a thread of its own (FSTRATE_ENABLE) that is not so.
    """
    rate = _number(log.settings.get("SCHED_LOOP_RATE"))
    if rate <= 0 or _number(log.settings.get("FSTRATE_ENABLE")):
        return {}
    return dict.fromkeys(
        (f"{setup.rate}Des", *((setup.reference,) if setup.injected_at else ())), 1 / rate
    )


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
        f"for an external reference, {_FLY}",
    ]
    if "RCIN.C1" in signals.arrays:
        stick = f"RCIN.C{AXES.index(axis) + 1 if axis != 'yaw' else 4}"
        if stick in signals.arrays:
            remarks.append(
                f"the stick ({stick}, {channel_rate(signals, stick):.3g} Hz) is not affected by "
                f"feedback: use --reference {stick} if it moved enough"
            )
    return Setup(axis, {command: 1.0}, rates[axis], remarks=tuple(remarks))


LOG = FirmwareLog(
    name="ardupilot", title="ArduPilot", setup=ardupilot_setup,
    rates=[f"RATE.{x}" for x in "RPY"], setpoints=[f"RATE.{x}Des" for x in "RPY"],
    throttle=(("RATE.AOut", 1.0), ("CTUN.ThO", 1.0)),
    hold=lambda log: hold_by_rate(log, "SCHED_LOOP_RATE"),
    of_loop=(
        "ATC_", "INS_GYRO_", "INS_HNTC", "MOT_", "SCHED_LOOP_RATE", "PSC_", "FSTRATE_",
    ),
    learned=("MOT_THST_HOVER",),  # in flight, and stored at the end of it: the hover's throttle
    numbers_chirps=True, gyro_cutoffs=("INS_GYRO_FILTER",),
)  # fmt: skip
