"""ArduPilot: RATE holds set-points, rates and outputs, SIDD and SIDS the injected chirp.

In each loop the rate controller and the motors' output come first, then the flight mode, which
computes the next set-point and the next value of the chirp, then the logging. So of one stamp,
RATE.x and RATE.xOut belong together, while RATE.xDes and SIDD.Targ act in the next loop; and
RATE.xOut contains the chirp that is added at the mixer (docs/autopilots.md).
"""

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
    number_of,
    NumberedChirp,
    Point,
    Selection,
    Setup,
    values_of,
    with_injections,
)


_LETTERS: dict[str, str] = dict(zip(AXES, "RPY", strict=True))


_SHAPED = (1, 2, 3)  # SID_AXIS of chirps that pass the input shaping
_WHERE: tuple[tuple[tuple[int, ...], str, Point], ...] = (  # three are roll, pitch and yaw
    (_SHAPED, "the pilot's angle set-point", "angle"),
    ((4, 5, 6), "the angle set-point of the attitude loop", "angle"),
    ((7, 8, 9), "the rate set-point", "rate"),
    ((10, 11, 12), "the mixer", "mixer"),
    ((13,), "the thrust", ""),
    ((14, 15), "the measured position", ""),
    ((16, 17), "the measured velocity", ""),
    ((18, 19), "the velocity set-point", ""),
)
_PLACES: dict[int, tuple[str, Point]] = {  # by SID_AXIS: what the chirp is added to
    axis: (f"{words} (SID_AXIS {axis})", point) for axes, words, point in _WHERE for axis in axes
}
_BREAK = 1.0  # s without SIDD: another run
_SHORTEST = 2.0  # s
_FLY = "fly the SystemID mode with SID_AXIS 10 (roll), 11 (pitch) or 12 (yaw)"


def ardupilot_setup(log: Log, wanted: Selection) -> Setup:
    """The set-up for the chirps that are wanted; else for the loop without one."""
    signals = flattened(log)
    rates = {x: first_logged(signals, [f"RATE.{_LETTERS[x]}"]) for x in AXES}
    name = log.firmware.partition(" ")[0].removeprefix("APM:")
    if not any(rates.values()) and name and "Copter" not in name:
        use = ""
        if {"PIDR", "PIDP"} <= set(log.tables):
            use = (
                ". Its PIDR, PIDP and PIDY hold the rate (Act) and its set-point (Tar): name them "
                "yourself, such as --input roll=PIDR.P+PIDR.I+PIDR.D+PIDR.FF --output PIDR.Act"
            )
        raise RecordError(
            f"the log is of {log.firmware}, and only multicopters (ArduCopter) log RATE messages, "
            f"from which channels are proposed{use}."
        )
    if not any(rates.values()):
        raise RecordError(
            "the log has no RATE messages. Set LOG_BITMASK to log fast attitude (ATTITUDE_FAST)."
        )
    chirps = _chirps(log)
    if chosen := choose_chirps(chirps, wanted):
        setup = _chirped(log, chosen)
    else:
        axis = wanted.axis or most_active_axis(signals, rates)
        letter = _LETTERS[axis]
        command = f"RATE.{letter}Out"
        if not rates[axis] or values_of(signals, command).size == 0:
            raise RecordError(f"the log has no {command} or no RATE.{letter}.")
        remarks = [
            f"RATE.{letter}Des is computed by the attitude loop: it contains feedback and cannot "
            f"be the external reference",
            f"for an external reference, {_FLY}",
        ]
        stick = f"RCIN.C{AXES.index(axis) + 1 if axis != 'yaw' else 4}"
        if {"RCIN.C1", stick} <= signals.arrays.keys():
            remarks.append(
                f"the stick ({stick}, {channel_rate(signals, stick):.3g} Hz) is not affected by "
                f"feedback: use --reference {stick} if it moved enough"
            )
        setup = Setup(axis, {command: 1.0}, rates[axis], remarks=tuple(remarks))
    # What the flight mode computes acts in the next loop, behind the rate controller, unless that
    # has a thread of its own (FSTRATE_ENABLE).
    late, loop_hz = {}, number_of(log, "SCHED_LOOP_RATE")
    if loop_hz > 0 and not number_of(log, "FSTRATE_ENABLE"):
        late = {f"{setup.rate}Des": 1 / loop_hz}
        late |= {setup.reference: 1 / loop_hz} if setup.injected_at else {}
    return setup._replace(chirps=tuple(chirps), late_s=late)


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
        # SID_AXIS and band from the SIDS message before the run, else from the parameters.
        announced = log.tables.get("SIDS")
        number, low, high = (
            number_of(log, name) for name in ("SID_AXIS", "SID_F_START_HZ", "SID_F_STOP_HZ")
        )
        if announced is not None and announced.time is not None:
            columns = [announced.columns.get(name) for name in ("Ax", "FSt", "FSp")]
            before = np.flatnonzero(announced.time <= begin + _BREAK)
            if before.size and all(x is not None for x in columns):
                number, low, high = (_number(x[before[-1]]) for x in columns if x is not None)
        if int(number) in _PLACES and end - begin >= _SHORTEST:
            place, point = _PLACES[int(number)]
            axis = AXES[(int(number) - 1) % 3] if point else ""
            chirps.append(NumberedChirp(len(chirps) + 1, axis, place, point, begin, end, low, high))
    return chirps


def _number(value: object) -> float:
    """0 for what is no finite number."""
    try:
        return number if np.isfinite(number := float(str(value))) else 0.0
    except ValueError:
        return 0.0


def _chirped(log: Log, chirps: list[NumberedChirp]) -> Setup:
    """The set-up for chirps into one place, where they have RATE messages."""
    _, axis, place, point, *_ = first = chirps[0]
    if not axis:
        raise RecordError(
            f"the chirp of t = {first.start:.6g} .. {first.stop:.6g} s went into {place}, which "
            f"turns no axis: {_FLY}, or say which other part to use (start, stop)."
        )
    rate, remarks = f"RATE.{_LETTERS[axis]}", []
    if place in (_PLACES[number][0] for number in _SHAPED):
        remarks.append("the chirp passes the input shaping, which is nonlinear for large steps")
    remarks.append(
        f"{rate} is measured after the gyro filter, which identify divides out where the log has "
        "its parameters"
    )
    short = {"roll": "RLL", "pitch": "PIT", "yaw": "YAW"}[axis]
    harmful = [f"ATC_RAT_{short}_I", "ATC_RATE_FF_ENAB"]
    if on := [f"{name} = {log.settings[name]}" for name in harmful if number_of(log, name)]:
        why = "set to 0 during a sweep, because they change it at low frequencies"
        remarks.append(f"{', '.join(on)}: {why}")
    clocks = [x for name in ("RATE", "SIDD") if (x := log.tables[name].time) is not None]
    opens, ends = max(float(x[0]) for x in clocks), min(float(x[-1]) for x in clocks)
    logged = [
        Injection(max(chirp.start, opens), min(chirp.stop, ends), chirp.low, chirp.high)
        for chirp in chirps if max(chirp.start, opens) < min(chirp.stop, ends)
    ]  # fmt: skip
    if not logged:
        raise RecordError(
            f"the log has no RATE messages during the chirp at t = {first.start:.6g} s."
        )
    command, remarks = {f"{rate}Out": 1.0}, tuple(remarks)
    setup = Setup(axis, command, rate, "SIDD.Targ", remarks=remarks, injected_at=point)
    return with_injections(setup, logged, f"SystemID chirp into {place}")


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
