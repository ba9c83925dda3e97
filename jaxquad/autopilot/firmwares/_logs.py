"""What the channels of PX4, ArduPilot and the Crazyflie mean: command, rate, reference, chirps."""

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
    moves,
    number_of,
    NumberedChirp,
    Point,
    Selection,
    Setup,
    values_of,
    with_injections,
)


_STATES = {2: "roll", 4: "pitch", 6: "yaw"}  # of autotune
_BREAK = 1.0  # s without it: another run
_ACRO = 10  # of vehicle_status.nav_state
_RATE_SETPOINT = "vehicle_rates_setpoint"
_AUTOTUNE = "autotune_attitude_control_status"
_STICKS = {
    "roll": ("manual_control_setpoint.roll", "manual_control_setpoint.y"),
    "pitch": ("manual_control_setpoint.pitch", "manual_control_setpoint.x"),
    "yaw": ("manual_control_setpoint.yaw", "manual_control_setpoint.r"),
}


def px4_setup(log: Log, wanted: Selection) -> Setup:
    """The set-up for autotune's excitation; without it, with the set-point if flown in acro."""
    signals, axis = flattened(log), wanted.axis
    names = ("vehicle_angular_velocity.xyz", "sensor_combined.gyro_rad")
    rates = {
        x: first_logged(signals, [f"{name}[{i}]" for name in names]) for i, x in enumerate(AXES)
    }
    if not any(rates.values()):
        raise RecordError(
            "the log has no vehicle_angular_velocity. Choose a logging profile that has it."
        )
    tuned: dict[str, list[Injection]] = {}  # of each axis, all runs of it
    table = log.tables.get(_AUTOTUNE)
    if table is not None and table.time is not None and {"state", "rate_sp"} <= set(table.columns):
        state = table.columns["state"]
        for number, x in _STATES.items() if state.ndim == 1 else ():
            rows = np.flatnonzero(state == number)
            cuts = np.flatnonzero((np.diff(rows) > 1) & (np.diff(table.time[rows]) > _BREAK)) + 1
            parts = [part for part in np.split(rows, cuts) if part.size > 1]
            if parts and axis in (None, x):
                ends = (table.time[part[[0, -1]]].tolist() for part in parts)
                tuned[x] = [Injection(start, stop) for start, stop in ends]
    if tuned:
        axis = max(tuned, key=lambda x: max(run.stop - run.start for run in tuned[x]))
    axis = axis or most_active_axis(signals, rates)
    i = AXES.index(axis)
    command = first_logged(
        signals, [f"vehicle_torque_setpoint.xyz[{i}]", f"actuator_controls_0.control[{i}]"]
    )
    if not command or not rates[axis]:
        raise RecordError(
            f"the log has no torque set-point (vehicle_torque_setpoint) or no rate for {axis}."
        )
    if axis in tuned:
        reference = f"{_AUTOTUNE}.rate_sp[{i}]"
        setup = Setup(axis, {command: 1.0}, rates[axis], reference, injected_at="rate")
        return with_injections(setup, tuned[axis], "autotune's steps on the rate set-point")
    setpoint, status = f"{_RATE_SETPOINT}.{axis}", log.tables.get("vehicle_status")
    states = None if status is None else status.columns.get("nav_state")
    always_acro = states is not None and states.size > 0 and bool((states == _ACRO).all())
    if always_acro and moves(signals, setpoint):
        remark = "flown in acro throughout, where the rate set-point comes from the pilot only"
        return Setup(axis, {command: 1.0}, rates[axis], setpoint, remarks=(remark,))
    remarks = [
        f"{setpoint} is computed by the attitude loop: it contains feedback and cannot be the "
        f"external reference",
        "for an external reference, fly Acro throughout the log, or inject a sweep and log it",
    ]
    stick = first_logged(signals, _STICKS[axis])
    if stick and moves(signals, stick):
        remarks.append(
            f"in manual flight the stick is not affected by feedback: use --reference {stick} if "
            f"it moved enough"
        )
    return Setup(axis, {command: 1.0}, rates[axis], remarks=tuple(remarks))


PX4 = FirmwareLog(
    name="px4", title="PX4", setup=px4_setup,
    rates=[f"vehicle_angular_velocity.xyz[{i}]" for i in range(3)],
    setpoints=[f"{_RATE_SETPOINT}.{x}" for x in AXES],
    limits={"manual_control_setpoint": 1.0, "vehicle_torque_setpoint": 1.0},
    throttle=(("vehicle_thrust_setpoint.xyz[2]", -1.0), ("actuator_controls_0.control[3]", 1.0)),
    hold=lambda log: hold_by_rate(log, "IMU_GYRO_RATEMAX"),
    of_loop=("MC_", "IMU_GYRO_", "IMU_DGYRO_", "THR_MDL_FAC", "CA_", "PWM_", "DSHOT_"),
    release="ver_sw_release", gyro_cutoffs=("IMU_GYRO_CUTOFF",),
)  # fmt: skip


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
_SHORTEST = 2.0  # s
_FLY = "fly the SystemID mode with SID_AXIS 10 (roll), 11 (pitch) or 12 (yaw)"


def ardupilot_setup(log: Log, wanted: Selection) -> Setup:
    """The set-up for the chirps that are wanted; else for the loop without one.

    In each loop the rate controller and the motors' output come first, then the flight mode, which
    computes the next set-point and the next value of the chirp, then the logging. So of one stamp,
    RATE.x and RATE.xOut belong together, while RATE.xDes and SIDD.Targ act in the next loop; and
    RATE.xOut contains the chirp that is added at the mixer (docs/autopilots.md).
    """
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


ARDUPILOT = FirmwareLog(
    name="ardupilot", title="ArduPilot", setup=ardupilot_setup,
    rates=[f"RATE.{x}" for x in "RPY"], setpoints=[f"RATE.{x}Des" for x in "RPY"],
    limits={f"RATE.{x}Out": 1.0 for x in "RPY"},
    throttle=(("RATE.AOut", 1.0), ("CTUN.ThO", 1.0)),
    hold=lambda log: hold_by_rate(log, "SCHED_LOOP_RATE"),
    of_loop=(
        "ATC_", "INS_GYRO_", "INS_HNTC", "MOT_", "SCHED_LOOP_RATE", "PSC_", "FSTRATE_",
    ),
    learned=("MOT_THST_HOVER",),  # in flight, and stored at the end of it: the hover's throttle
    numbers_chirps=True, gyro_cutoffs=("INS_GYRO_FILTER",),
)  # fmt: skip


_MOTORS = {"roll": (-1, -1, 1, 1), "pitch": (-1, 1, 1, -1), "yaw": (-1, 1, -1, 1)}
_SLOW_STAMPS = 85 / 84  # by which rates of the micro-SD deck's stamps are too high
_NOMINAL = (50, 100, 125, 200, 250, 333.333, 400, 500, 800, 1000)  # Hz
_NEAR = 0.004  # events come late or are lost


def crazyflie_setup(log: Log, wanted: Selection) -> Setup:
    """Of a Crazyflie, for the axis that moves most; its firmware has no chirp and no reference."""
    signals = flattened(log)
    prefixes = [f"{name}." if name else "" for name in log.tables]
    rates = {
        x: first_logged(
            signals, [f"{p}{name}" for p in prefixes for name in (f"gyro.{k}", f"controller.r_{x}")]
        )
        for x, k in zip(AXES, "xyz", strict=True)
    }
    if not any(rates.values()):
        raise RecordError("the log has no gyro.x, gyro.y, gyro.z or controller.r_roll, ...")
    axis = wanted.axis or most_active_axis(signals, rates)
    command: dict[str, float] = {}
    for prefix in prefixes:
        motors = [f"{prefix}motor.m{i}" for i in range(1, 5)]
        if moves(signals, name := f"{prefix}controller.cmd_{axis}"):
            command = {name: 1.0}
        elif all(moves(signals, motor) for motor in motors):
            command = dict(zip(motors, map(float, _MOTORS[axis]), strict=True))
        if command:
            break
    if not rates[axis] or not command:
        raise RecordError(
            f"the log has no command (controller.cmd_{axis}, or motor.m1 .. m4) or no rate for "
            f"{axis}."
        )
    remarks = [
        "no channel of the stock firmware can be the external reference: the rate set-points are "
        "computed by the attitude loop and contain feedback",
        "for an external reference, log a signal that your own code injects, and name it with "
        "--reference",
    ]
    hertz = channel_rate(signals, rates[axis])
    nominal = next((x for x in _NOMINAL if abs(hertz / x / _SLOW_STAMPS - 1) < _NEAR), None)
    if nominal is not None:
        remarks.append(
            f"the time stamps say {hertz:.5g} Hz, 85/84 of {nominal:.6g} Hz: firmware before "
            f"August 2026 wrote them that much slow, so that the gain to a rate is 1.2 % too high, "
            f"lag and delay 1.2 % too short. Where the log is of such firmware, --time-factor "
            f"1.0119 corrects it"
        )
    targets = (f"{prefix}ctrltarget.{axis}" for prefix in prefixes)
    if target := next((x for x in targets if moves(signals, x)), ""):
        remarks.append(
            f"in manual flight the pilot's {target} is not affected by feedback: use --reference "
            f"{target}"
        )
    if len(command) > 1:
        remarks.append(
            "the motor commands are not linear in thrust: where the thrust curve is known, use "
            "powers (--input 'NAME=0.1*a^2')"
        )
    return Setup(axis, command, rates[axis], remarks=tuple(remarks))


CRAZYFLIE = FirmwareLog(
    name="crazyflie", title="Crazyflie", setup=crazyflie_setup,
    rates=[f"gyro.{x}" for x in "xyz"],
    throttle=(("controller.cmd_thrust", 1 / 65535), ("stabilizer.thrust", 1 / 65535)),
    settings=False,
)  # fmt: skip
