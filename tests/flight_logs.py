"""Whole logs of flights that were made, for the tests: a chirp or autotune from 22 to 30 s."""

import struct
from typing import Any

import numpy as np
from log_writers import crazyflie_log, DataFlash, structured, ULog


RATE_HZ = 400
TIME = 20.0 + np.arange(12 * RATE_HZ) / RATE_HZ
CHIRP = np.sin(2 * np.pi * (0.5 * (TIME - 22) + 0.5 * (TIME - 22) ** 2))
IN_RUN = (TIME >= 22) & (TIME < 30)
WAVE = np.sin(5 * TIME)
AFTER = 0.4  # s for which SIDD goes on behind a chirp
COLLECTIVE = 0.4 + 0.2 * np.sin(0.5 * TIME)  # throttle, 0 to 1


def ardupilot(
    folder, place, *, sidd=True, gain="0", runs=((22, 30, 8.0),), changes=(), collective="",
    changed="ATC_RAT_RLL_P", gyros=(), core=None, settings=(),
):  # fmt: skip
    """A log with chirps of 0.5 Hz up to so many, from and to so many seconds.

    As the firmware does it, a chirp acts one loop after it is logged, SIDD goes on after it with
    zeros, and the output contains what is added at the mixer. `runs` are start, stop and highest
    frequency, and the SID_AXIS if it is not `place`. `changes` are pairs of a time in s and a value
    of the parameter `changed`, which begins at 0.135.
    `gyros` are the instances of GYR, whose rate about x is that number and a wave, and `core` is
    XKF4.PI. `collective` is "RATE.AOut", at 400 Hz, "CTUN.ThO", at 10 Hz, or none.
    """
    log = DataFlash()
    log.define("SIDS", "QBfff", "TimeUS,Ax,Mag,FSt,FSp", units="s----", mults="F----")
    log.define("SIDD", "Qfff", "TimeUS,Time,Targ,F", units="s---", mults="F---")
    beside = int(collective == "RATE.AOut")
    log.define(
        "RATE", "Qfffffffff" + beside * "f", "TimeUS,RDes,R,ROut,PDes,P,POut,YDes,Y,YOut"
        + beside * ",AOut", units="skk-kk-kk-" + beside * "-", mults="F---------" + beside * "-",
    )  # fmt: skip
    log.define("CTUN", "Qff", "TimeUS,ThI,ThO", units="s--", mults="F00")
    log.write("PARM", 0, b"SID_AXIS", float(place))
    log.write("PARM", 0, b"ATC_RAT_PIT_I", float(gain))
    log.write("PARM", 0, changed.encode(), 0.135)
    log.write("PARM", 0, b"SCHED_LOOP_RATE", float(RATE_HZ))
    for name, value in settings:
        log.write("PARM", 0, name.encode(), value)
    log.define("GYR", "QBfff", "TimeUS,I,GyrX,GyrY,GyrZ", units="s#EEE", mults="F----")
    log.define("XKF4", "QBB", "TimeUS,C,PI", units="s#-", mults="F--")
    before, outputs = 0.0, dict.fromkeys((10, 11, 12), 0.0)
    for k, t in enumerate(np.round(TIME * 1e6).astype(int).tolist()):
        run = next((run for run in runs if run[0] <= TIME[k] < run[1] + AFTER), None)
        axis = place if run is None else (*run, place)[3]
        outputs = dict.fromkeys(outputs, 0.0) | {axis: before}
        before = 0.0
        if sidd and run:
            if TIME[k - 1] < run[0]:
                log.write("SIDS", t - 10, axis, 0.2, 0.5, run[2])
            before = float(CHIRP[k]) if TIME[k] < run[1] else 0.0
            log.write("SIDD", t, float(TIME[k]) - run[0], before, 1.0)
        for when, value in changes:
            if TIME[k - 1] < when <= TIME[k]:
                log.write("PARM", t, changed.encode(), value)
                log.write("PARM", t, b"LOG_BITMASK", 1e3 * value)
        w = float(WAVE[k])
        for number in gyros:
            log.write("GYR", t + number, number, number + w, w, w)
        if core is not None and k % 40 == 0:
            log.write("XKF4", t + 5, 0, core)
        last = beside * (float(COLLECTIVE[k]),)
        roll, pitch, yaw = (outputs[axis] for axis in (10, 11, 12))
        log.write(
            "RATE", t + 30, w, 2 * w, 0.1 * w + roll, w, 3 * w, 0.2 * w + pitch, w, w, w + yaw,
            *last,
        )  # fmt: skip
        if collective == "CTUN.ThO" and k % 40 == 0:
            log.write("CTUN", t + 35, 0.9, float(COLLECTIVE[k]))
    path = folder / "log.bin"
    path.write_bytes(log.content)
    return path


def px4(folder, *, state: Any = 0, nav_state=15, change: float | None = None):
    """A log of 12 s; MC_ROLLRATE_P goes from 0.15 to 0.2 at the time `change`."""
    log = ULog()
    log.info("float MC_ROLLRATE_P", struct.pack("<f", 0.15), kind="P")
    log.define("vehicle_angular_velocity:uint64_t timestamp;float[3] xyz;")
    log.define("vehicle_torque_setpoint:uint64_t timestamp;float[3] xyz;")
    log.define("vehicle_rates_setpoint:uint64_t timestamp;float roll;float pitch;float yaw;")
    log.define(
        "autotune_attitude_control_status:uint64_t timestamp;float[3] rate_sp;uint8_t state;"
    )
    log.define("vehicle_status:uint64_t timestamp;uint8_t nav_state;")
    names = ("vehicle_angular_velocity", "vehicle_torque_setpoint", "vehicle_rates_setpoint",
             "autotune_attitude_control_status", "vehicle_status")  # fmt: skip
    stamps = np.round(TIME * 1e6).astype("<u8")
    xyz = np.stack([WAVE, 2 * WAVE, 0.1 * WAVE], axis=1).astype("<f4")
    states = np.where(IN_RUN, state, 0)
    clock = {"timestamp": ("<u8", stamps)}
    tables = [
        clock | {"xyz": ("(3,)<f4", xyz)},
        clock | {"xyz": ("(3,)<f4", xyz)},
        clock | {name: ("<f4", xyz[:, i]) for i, name in enumerate(("roll", "pitch", "yaw"))},
        clock | {"rate_sp": ("(3,)<f4", xyz), "state": ("u1", states)},
        clock | {"nav_state": ("u1", np.full(stamps.size, nav_state))},
    ]
    for number, (name, table) in enumerate(zip(names, tables, strict=True)):
        log.subscribe(number, name)
        rows = structured(table)
        late = rows.size if change is None else int(np.searchsorted(TIME, change))
        log.write_rows(number, rows[:late])
        if change is not None and name == names[-1]:
            log.info("float MC_ROLLRATE_P", struct.pack("<f", 0.2), kind="P")
        log.write_rows(number, rows[late:])
    (folder / "log.ulg").write_bytes(log.content)
    return folder / "log.ulg"


def crazyflie(folder, collective):
    """A log at 400 Hz of a command, a rate and a collective of that name, in their own units."""
    names = ("controller.cmd_roll", "gyro.x", collective)
    kind = (0xFFFF, "fixedFrequency", [(name, "f") for name in names])
    columns = zip(3e4 * WAVE, 100 * WAVE, 65535 * COLLECTIVE, strict=True)
    stamps = np.round(1e6 * TIME).astype(int).tolist()
    events = [(0, stamp, values) for stamp, values in zip(stamps, columns, strict=True)]
    (folder / "log00").write_bytes(crazyflie_log([kind], events))
    return folder / "log00"
