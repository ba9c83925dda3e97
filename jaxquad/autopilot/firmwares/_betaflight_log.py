"""Betaflight logs: what their channels and chirps mean, and a simulated one with a known plant."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxquad._core import Number, write_file
from jaxquad.records import AXES, Flight, RecordError
from jaxquad.records.firmware import (
    FEWEST,
    FirmwareLog,
    first_logged,
    flattened,
    Injection,
    Log,
    most_active_axis,
    moves,
    number_of,
    plausible_hold,
    Selection,
    Setup,
    Table,
    values_of,
    with_injections,
)


_SELF_LEVELLING = 0b110  # ANGLE and HORIZON in the flight mode flags


def betaflight_setup(log: Log, wanted: Selection) -> Setup:
    """The set-up for the longest chirp of a log that holds one flight.

    Without a chirp the reference is the set-point if flown in acro, else the stick.
    """
    prefix, table = _main_table(log)
    signals, axis = flattened(log), wanted.axis
    rates = {x: first_logged(signals, [f"{prefix}gyroADC[{i}]"]) for i, x in enumerate(AXES)}
    if not any(rates.values()):
        raise RecordError("the log has no gyroADC.")
    sweeps = [(x, run) for x, run in chirps(table) if axis in (None, x)]
    best, _ = max(sweeps, key=lambda sweep: sweep[1].stop - sweep[1].start, default=("", None))
    axis = axis or best or most_active_axis(signals, rates)
    i = AXES.index(axis)
    command = first_logged(signals, [f"{prefix}axisMixed[{i}]", f"{prefix}axisSum[{i}]"])
    if not command or not rates[axis]:
        raise RecordError(f"the log has no PID terms or no gyro for {axis}.")
    slow = log.tables.get(f"{prefix}slow")
    modes = None if slow is None else slow.columns.get("flightModeFlags")
    levelled = None  # where it is not logged; else whether it was on at any time
    if modes is not None and modes.size and modes.dtype.kind in "iuf":
        levelled = bool((modes.astype(np.int64) & _SELF_LEVELLING).any())
    remarks = [
        f"{rates[axis]} is measured after the gyro filters, which identify divides out where the "
        "log has their parameters"
    ]
    setup = Setup(axis, {command: 1.0}, rates[axis], levelled=bool(levelled))
    with_reference = lambda channel: setup._replace(reference=channel, remarks=tuple(remarks))
    if best:
        remarks += [
            f"another chirp on the set-point of {x}, t = {run.start:.6g} .. {run.stop:.6g} s"
            for x, run in sweeps if x != best
        ]  # fmt: skip
        excitation = "chirp" if "chirp" in table.columns else "debug[3]"
        chirped = with_reference(f"{prefix}{excitation}")._replace(injected_at="rate")
        alike = [run for x, run in sweeps if x == best]
        return with_injections(chirped, alike, "chirp on the rate set-point")
    setpoint = first_logged(signals, [f"{prefix}setpoint[{i}]"])
    if setpoint and not moves(signals, setpoint):
        remarks.append(
            f"{setpoint} never moves, so nothing from outside excites {axis}: fly the chirp mode "
            f"(debug_mode = CHIRP), or stick pulses of different widths"
        )
        return with_reference("")._replace(levelled=False)
    if setpoint and levelled is False:
        remarks.append("flown in acro, where the set-point comes from the pilot only")
        return with_reference(setpoint)
    if setpoint:
        remarks.append(
            f"self-levelling was on or is unknown: {setpoint} is then computed from the attitude, "
            f"contains feedback and cannot be the external reference"
        )
    stick = first_logged(signals, [f"{prefix}rcCommand[{i}]"])
    return with_reference(stick if stick and np.ptp(values_of(signals, stick)) else "")


def _main_tables(log: Log) -> dict[str, Table]:
    """The tables of main frames by what precedes their channels, one for each arming."""
    return {
        f"{name}." if name else "": table
        for name, table in log.tables.items()
        if not name.endswith(("slow", "gps")) and table.time is not None and table.time.size
    }


def _main_table(log: Log) -> tuple[str, Table]:
    if not (tables := _main_tables(log)):
        raise RecordError("the log has no main frames.")
    return next(iter(tables.items()))


def saturation(log: Log, setup: Setup, spans: Sequence[tuple[float, float]]) -> tuple[str, ...]:
    """A remark on samples within the `spans` (s) where the firmware limits the PID sum."""
    name = "pidsum_limit_yaw" if setup.axis == "yaw" else "pidsum_limit"
    text = log.settings.get(name, "")
    prefix, table = _main_table(log)
    if not (text.isdecimal() and len(text) < 9) or table.time is None:
        return ()
    command = values_of(flattened(log), f"{prefix}axisSum[{AXES.index(setup.axis)}]")
    used = np.zeros(command.size, bool)
    for start, stop in spans:
        used |= (table.time >= start) & (table.time <= stop)
    beyond = int((np.abs(command[used]) > int(text)).sum())
    share = f"{beyond} of {used.sum()} samples of the command"
    return (f"{share} exceed {name} = {text}, where it saturates",) if beyond else ()


_SHORTEST = 1.0  # s
_MOST_EDGES = 10_000


def chirps(table: Table) -> list[tuple[str, Injection]]:
    """The sweeps in a log whose debug channels are those of debug mode CHIRP, and their axes.

    There, debug[1] is the axis (-1 when idle), debug[2] the frequency in 0.1 Hz and debug[3] the
    excitation (betaflight pull request 15113). The number of that mode depends on the version, so
    the data decide: a frequency that only rises while the axis stays the same. Earlier firmware
    has debug[0] alone, from which the reader makes the channel `chirp`.
    """
    debug = [table.columns.get(f"debug[{i}]") for i in range(4)]
    if table.time is None:
        return []
    if "chirp" in table.columns:
        return _chirps_of_phase(table, table.time)
    if any(x is None for x in debug):
        return []
    _, axis, tenths, excitation = (np.asarray(x, np.float64) for x in debug)
    active = np.where(tenths > 0, axis, -1)
    edges = np.flatnonzero(np.diff(active)) + 1
    if not np.isin(axis, (-1, 0, 1, 2)).all() or edges.size > _MOST_EDGES:
        return []
    sweeps = []
    for first, end in zip([0, *edges], [*edges, axis.size], strict=True):
        frequency, time = tenths[first:end] / 10, table.time[first:end]
        rises = (np.diff(frequency) >= 0).all() and frequency[-1] > frequency[0]
        moves = rises and np.ptp(excitation[first:end]) > 0
        if active[first] >= 0 and moves and time[-1] - time[0] >= _SHORTEST:
            ends = (*time[[0, -1]].tolist(), *frequency[[0, -1]].tolist())
            sweeps.append((AXES[int(active[first])], Injection(*ends)))
    return sweeps


_PAUSE = 0.2  # s of a phase of 0: another sweep; within one, single samples pass through 0
_DRIVEN = 0.1  # of its variance that a sweep explains, at least, in the set-point of its axis
_EDGE = 20  # of the samples of a sweep, one part: its begin and its end


def _chirps_of_phase(table: Table, time: np.ndarray) -> list[tuple[str, Injection]]:
    """The sweeps of a log that has their phase alone (debug[0], 5000 a radian).

    The axis is the one whose set-point is most coherent with the sweep, whatever its lead or lag.
    """
    phase = np.asarray(table.columns["debug[0]"], np.float64) / 5e3
    rows = np.flatnonzero(phase > 0)
    cuts = np.flatnonzero(np.diff(time[rows]) > _PAUSE) + 1
    sweeps = []
    for part in np.split(rows, cuts):
        if not part.size or time[part[-1]] - time[part[0]] < _SHORTEST:
            continue
        inside = slice(part[0], part[-1] + 1)
        wave, shares = np.exp(1j * phase[inside]) * (phase[inside] > 0), {}
        for i, axis in enumerate(AXES):
            if (setpoint := table.columns.get(f"setpoint[{i}]")) is not None:
                values = np.asarray(setpoint[inside], np.float64)
                values = np.nan_to_num(values - np.nanmean(values))
                if (power := float(np.mean(values**2))) > 0:
                    shares[axis] = 2 * abs(np.mean(values * wave.conj())) ** 2 / power
        axis = max(shares, key=lambda axis: shares[axis], default=None)
        if axis is None or not shares[axis] > _DRIVEN:
            continue
        # The phase is known modulo 2 pi; single steps are rounded, and those through 0 are wrong.
        speed = np.mod(np.diff(phase[inside]), 2 * np.pi) / np.diff(time[inside]) / (2 * np.pi)
        ends = max(1, speed.size // _EDGE)
        pieces = np.array_split(speed[:ends], max(1, ends // 50))
        low, high = np.min([np.median(x) for x in pieces]), np.median(speed[-ends:])
        start, stop = float(time[part[0]]), float(time[part[-1]])
        sweeps.append((axis, Injection(start, stop, max(float(low), 0.1), float(high))))
    return sweeps


_TOLERANCE = 0.05  # between the header's period and that of the stamps
_STRIDE = 256  # rows, over which stamps that jitter give a period


def command_hold(log: Log) -> tuple[float | None, tuple[str, ...]]:
    """The period of the rate loop in s, None where the log does not say it, and remarks.

    The header has it, and `loopIteration` counts the loops between two stamps: where they
    contradict each other by more than 5 %, the stamps are right.
    """
    # us, and loops of the gyro for one of the PID
    period = 1e-6 * number_of(log, "looptime") * number_of(log, "pid_process_denom", 1.0)
    stated, stamped = plausible_hold(period), None
    for table in log.tables.values():
        counter, time = table.columns.get("loopIteration"), table.time
        if counter is not None and time is not None:
            stride, loops = min(_STRIDE, time.size - 1), np.asarray(counter, np.float64)
            loops, time = (x[stride:] - x[:-stride] for x in (loops, time))
            good = (loops > 0) & (time > 0)
            if good.any():
                stamped = plausible_hold(float(np.median(time[good] / loops[good])))
            break
    if stated is None or stamped is None or abs(stamped / stated - 1) < _TOLERANCE:
        return stated, ()
    remark = (
        f"the header says a loop of {1e6 * stated:.6g} us (looptime, pid_process_denom), but the "
        f"time stamps say {1e6 * stamped:.6g} us for each loopIteration: the stamps are taken for "
        f"how long the command is held (--hold takes another)"
    )
    return float(f"{stamped:.6g}"), (remark,)


_FULL = 500.0  # of rcCommand


def flights_of(log: Log) -> tuple[Flight, ...]:
    """One for each arming that has enough samples for a record."""
    flights = []
    for prefix, table in _main_tables(log).items():
        if table.time is None or table.time.size < FEWEST:
            continue
        throttle, lasting = _scaled(table, "setpoint[3]"), {}
        for axis, run in chirps(table):
            lasting[axis] = lasting.get(axis, 0.0) + run.stop - run.start
        sticks = {axis: _scaled(table, f"rcCommand[{i}]") for i, axis in enumerate(AXES)}
        name = prefix.rstrip(".")
        flights.append(Flight(
            int(name.removeprefix("log")) if name else 1, name, float(table.time[0]),
            float(table.time[-1]),
            (float(throttle.min() / 1e3), float(throttle.max() / 1e3)) if throttle.size else None,
            lasting, {axis: float(np.std(x) / _FULL) for axis, x in sticks.items() if x.size},
        ))  # fmt: skip
    return tuple(flights)


def _scaled(table: Table, name: str) -> np.ndarray:
    """The finite values of a column; none where it is not logged."""
    finite = np.asarray(table.columns.get(name, ()), np.float64)
    return finite[np.isfinite(finite)] * table.scales.get(name, 1.0)


BETAFLIGHT = FirmwareLog(
    name="betaflight", title="Betaflight", setup=betaflight_setup,
    rates=[f"gyroADC[{i}]" for i in range(3)], setpoints=[f"setpoint[{i}]" for i in range(3)],
    throttle=(("collective", 1.0), ("setpoint[3]", 1e-3)), hold=command_hold,
    # A chirp is logged without its amplitude: 1000, or 1, is all of it.
    limits={
        "rcCommand": 500.0, "axisMixed": 500.0, "axisSum": 500.0, "debug[3]": 1e3, "chirp": 1.0,
    },
    release="Firmware revision", gyro_cutoffs=("gyro_lpf1_static_hz", "gyro_lowpass_hz"),
    flights=flights_of, remarks_on=saturation,
)  # fmt: skip


_LOOP_HZ, _LOGGED = 4000, 4  # PID loop; one of so many is logged. The gyro has twice its rate
_DT = 1 / _LOOP_HZ
_LIFT_OFF, _CHIRP, _END = 1.5, 3.0, 19.0  # s from the demo's start
_HOVER, _RISE = 0.3, 0.5  # throttle, s
_SWEEP = (0.5, 40.0, 15.0, 150.0)  # Hz, Hz, s, deg/s
_LAG, _LATE = 0.025, 2  # of the motors in s; of speed controllers and sensor, in PID loops
_NOISE, _GUST_TIME = 1.0, 0.3  # deg/s, s
_START_US = 6_500_000
_PT2_HZ = 5.0 * 1.553773974  # of the poles of anti-gravity's filter
_ARMED, _CHIRPING = 1, 1 | 1 << 6  # flightModeFlags: ARM, CHIRP

# Beyond the hold: the motors' part, and the gyro sample from the filters to the PID loop.
CHIRP_TRUTH: Mapping[str, float] = MappingProxyType(
    {"gain": 36.0, "lag": _LAG, "delay": (_LATE + 0.5) * _DT}
)


Loops = Float[np.ndarray, " loops"]


class _Axis(NamedTuple):
    gain: float  # true, deg/s^2 per unit of pidsum
    gust: float  # deg/s^2
    pid: tuple[int, int, int]
    sum_limit: int
    integral_factor: float
    p_lowpass_hz: float  # 0: off


_AXES = (
    _Axis(36.0, 250.0, (45, 80, 30), 500, 1.0, 0.0),
    _Axis(30.0, 200.0, (47, 84, 34), 500, 1.0, 0.0),
    _Axis(9.0, 100.0, (45, 80, 0), 400, 2.5, 100.0),
)
_SETTINGS = {
    "Firmware type": "Betaflight", "Firmware revision": "Betaflight 2026.6.0 (norevision) SITL",
    "Firmware date": "Jan 01 2026 00:00:00", "Craft name": "jaxquad demo", "I interval": _LOGGED,
    "P interval": 0, "gyro_scale": "0x3f800000", "motorOutput": "1055,2000", "acc_1G": 2048,
    "looptime": 125, "gyro_sync_denom": 1, "pid_process_denom": 2, "tpa_mode": 1, "tpa_rate": 65,
    "tpa_breakpoint": 1350, "tpa_low_rate": 20, "tpa_low_breakpoint": 1050, "tpa_low_always": 0,
    "mixer_type": "LEGACY",
    **{f"{name}PID": ",".join(map(str, axis.pid))
       for name, axis in zip(("roll", "pitch", "yaw"), _AXES, strict=True)},
    "levelPID": "50,75,75", "d_max": "40,46,0", "d_max_gain": 0, "d_max_advance": 35,
    "dterm_lpf1_type": 0, "dterm_lpf1_static_hz": 75, "dterm_lpf1_dyn_hz": "75,150",
    "dterm_lpf1_dyn_expo": 5, "dterm_lpf2_type": 0, "dterm_lpf2_static_hz": 150,
    "yaw_lowpass_hz": 100, "dterm_notch_hz": 0, "dterm_notch_cutoff": 0, "iterm_windup": 80,
    "iterm_relax": 1, "iterm_relax_type": 1, "iterm_relax_cutoff": 15, "pid_at_min_throttle": 1,
    "anti_gravity_gain": 80, "anti_gravity_cutoff_hz": 5, "anti_gravity_p_gain": 100,
    "ff_weight": "120,125,120", "feedforward_transition": 0, "pidsum_limit": 500,
    "pidsum_limit_yaw": 400, "chirp_lag_freq_hz": 3, "chirp_lead_freq_hz": 30,
    "chirp_amplitude_roll": int(_SWEEP[3]), "chirp_frequency_start_deci_hz": int(10 * _SWEEP[0]),
    "chirp_frequency_end_deci_hz": int(10 * _SWEEP[1]), "chirp_time_seconds": int(_SWEEP[2]),
    "gyro_lpf1_type": 0, "gyro_lpf1_static_hz": 250, "gyro_lpf1_dyn_hz": "250,500",
    "gyro_lpf1_dyn_expo": 5, "gyro_lpf2_type": 0, "gyro_lpf2_static_hz": 500,
    "gyro_notch_hz": "0,0", "gyro_notch_cutoff": "0,0", "motor_idle": 550, "debug_mode": 96,
    "features": 272629762, "blackbox_high_resolution": 0, "simplified_pids_mode": 2,
    "throttle_limit_type": 0, "throttle_boost": 5, "throttle_boost_cutoff": 15, "thrust_linear": 0,
}  # fmt: skip
_UNSIGNED = {"loopIteration", "time", "rcCommand[3]", *(f"motor[{i}]" for i in range(4))}


def write_chirp_log(
    path: str | Path, seed: int = 0, *, roll: tuple[int, int, int] = _AXES[0].pid
) -> Path:
    """Write a chirp on roll as Betaflight 2026.6 logs it; the same for the same seed.

    A 5-inch quadrotor with default gains and filters, or with other P, I and D of `roll`, rests on
    the ground, takes off, and is excited from 0.5 to 40 Hz in 15 s, in gusts and gyro noise. Gyro
    at 8 kHz, PID at 4 kHz, log at 1 kHz, in whole numbers. `CHIRP_TRUTH` has the plant of roll,
    gain e^(-delay s) / (s (lag s + 1)): gain in deg/s^2 per unit of pidsum, lag and delay in s.
    Order of events, scales and filters are those of docs/autopilots.md, "When each message is
    written".
    """
    axes = (_AXES[0]._replace(pid=roll), *_AXES[1:])
    columns, chirping = _fly(np.random.default_rng(seed), axes)
    rows = np.column_stack([np.full(chirping.size, ord("I")), *columns.values()])
    first, last = np.flatnonzero(chirping)[[0, -1]]
    slow = [_coded(np.array([[ord("S"), mode, 0, 0, 1, 1]])) for mode in (_ARMED, _CHIRPING)]
    frames = slow[0] + _coded(rows[:first]) + slow[1] + _coded(rows[first : last + 1])
    frames += slow[0] + _coded(rows[last + 1 :]) + b"E\xffEnd of log\0"
    joined, count = lambda numbers: ",".join(map(str, numbers)), len(columns)
    signs = [int(name not in _UNSIGNED) for name in columns]
    lines = {
        "Product": "Blackbox flight data recorder by Nicholas Sherlock", "Data version": 2,
        "Field I name": ",".join(columns), "Field I signed": joined(signs),
        "Field I predictor": joined([0] * count),
        "Field I encoding": joined([1 - sign for sign in signs]),
        "Field P predictor": joined([1] * count), "Field P encoding": joined([0] * count),
        "Field S name": "flightModeFlags,stateFlags,failsafePhase,rxSignalReceived,"
        "rxFlightChannelsValid",
        "Field S signed": "0,0,0,0,0", "Field S predictor": "0,0,0,0,0",
        "Field S encoding": "1,1,1,1,1", **_SETTINGS, "rollPID": joined(roll),
    }  # fmt: skip
    header = "".join(f"H {name}:{value}\n" for name, value in lines.items())
    return write_file(Path(path), header.encode() + frames)


def _fly(
    random: np.random.Generator, axes: Sequence[_Axis]
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The log's columns as coded integers, and where the chirp is on."""
    time = np.arange(round(_END * _LOOP_HZ)) * _DT
    throttle = _HOVER * np.clip((time - _LIFT_OFF) / _RISE, 0, 1)
    low, high, duration, amplitude = _SWEEP
    on = (time >= _CHIRP) & (time < _CHIRP + duration)
    frequency = np.where(on, low * (high / low) ** ((time - _CHIRP) / duration), 0.0)
    turns = 2 * np.pi * duration / np.log(high / low) * (frequency - low)
    phase = np.where(on, turns % (2 * np.pi), 0.0)
    excitation = on * np.cos(phase) * np.minimum(frequency, 1.0)
    # From chirp_lag_freq_hz 3 to chirp_lead_freq_hz 30, as the firmware makes it discrete.
    omega, share = 2 * np.pi * np.sqrt(3.0 * 30.0) * _DT, 3.0 / 30.0
    alpha = (12 - omega**2) / (6 * omega * np.sqrt(share))
    ahead, behind = [1 + alpha * share, 1 - alpha * share], [1 + alpha, 1 - alpha]
    setpoint = np.zeros((3, time.size))
    setpoint[0] = amplitude * _filtered(ahead, behind, excitation)
    now = slice(None, None, _LOGGED)
    flown = [_fly_axis(x, r, throttle, random) for x, r in zip(axes, setpoint, strict=True)]
    p, i, d, gyro, raw = np.stack(flown, axis=1)[:, :, now]
    roll, pitch, yaw = (p + i + d) / 1000
    # Of the mixer: throttle_boost 5, throttle_boost_cutoff 15.
    boosted = np.clip(throttle + 0.5 * (throttle - _low_passed(15.0, throttle)), 0, 1)[now]
    three = lambda name, rows: {f"{name}[{k}]": row for k, row in enumerate(rows)}
    # A quad X: rear right, front right, rear left, front left.
    mixed = (-roll + pitch + yaw, -roll - pitch - yaw, roll + pitch - yaw, roll - pitch + yaw)
    values = {
        "loopIteration": np.arange(time.size)[now],
        "time": _START_US + np.round(1e6 * time[now]),
        **three("axisP", p), **three("axisI", i), "axisD[0]": d[0], "axisD[1]": d[1],
        **three("axisF", np.zeros_like(p)), **three("rcCommand", np.zeros_like(p)),
        "rcCommand[3]": 1000 + 1000 * throttle[now], **three("setpoint", setpoint[:, now]),
        "setpoint[3]": 1000 * boosted, **three("gyroADC", gyro), **three("gyroUnfilt", raw),
        "debug[0]": 5000 * phase[now], "debug[1]": np.where(on[now], 0.0, -1),
        "debug[2]": 10 * frequency[now], "debug[3]": 1000 * excitation[now],
        **three("motor", [1055 + 945 * np.clip(boosted + x, 0, 1) for x in mixed]),
    }  # fmt: skip
    unsigned = np.array([name in _UNSIGNED for name in values])
    rounded = np.rint(np.stack(list(values.values()))).astype(np.int64)
    folded = np.where(unsigned[:, None], rounded, (rounded << 1) ^ (rounded >> 63))
    return dict(zip(values, folded, strict=True)), on[now]


def _share(cutoff_hz: float | np.ndarray, dt: float) -> float | np.ndarray:
    omega = 2 * np.pi * cutoff_hz * dt
    return omega / (1 + omega)


def _filtered(b: Sequence[Number], a: Sequence[Number], signal: np.ndarray) -> np.ndarray:
    from scipy.signal import lfilter  # here: reading a log does without it

    return np.asarray(lfilter(b, a, signal))


def _low_passed(cutoff_hz: float, signal: np.ndarray) -> np.ndarray:
    share = float(_share(cutoff_hz, _DT))
    return _filtered([share], [1.0, share - 1], signal)


def _fly_axis(
    axis: _Axis, setpoint: Loops, throttle: Loops, random: np.random.Generator
) -> Float[np.ndarray, "5 loops"]:
    """P, I, D, the gyro that the law takes and the newest raw gyro, loop by loop.

    In each loop the gyro is sampled twice: the PID runs after the first sample, on what the filters
    made of the samples before.
    """
    noise = _NOISE * random.standard_normal((setpoint.size, 2))
    hold = np.exp(-_DT / _GUST_TIME)
    shocks = axis.gust * np.sqrt(1 - hold**2) * random.standard_normal(setpoint.size)
    gusts = _filtered([1.0], [1.0, -hold], shocks)
    # TPA, anti-gravity, and dynamic low-passes of gyro and D act one loop later.
    previous = np.concatenate([throttle[:1], throttle[:-1]])
    before = np.concatenate([throttle[:1], previous[:-1]])
    # The throttle stays below tpa_breakpoint.
    low = 1 - 0.2 / 0.05 * (0.05 - previous)
    tpa = np.where(np.maximum.accumulate(previous) >= 0.05, 1.0, low)
    steps = np.rint(100 * previous) / 100
    curve = steps * (1 - steps) * 0.5 + steps
    gyro_share, d_share = (np.asarray(_share(hz * (1 + curve), _DT)) for hz in (250.0, 75.0))
    relax, boost = np.ones_like(setpoint), np.zeros_like(setpoint)
    if not axis.p_lowpass_hz:  # roll and pitch: iterm_relax RP, SETPOINT, and anti-gravity
        relax = np.maximum(0, 1 - np.abs(setpoint - _low_passed(15.0, setpoint)) / 40)
        moved = np.abs(previous - before) * _LOOP_HZ * (1 - previous) ** 2
        moved = moved * np.where(previous > before, 0.5 * (1 - previous), 1)
        boost = 80 * _low_passed(_PT2_HZ, _low_passed(_PT2_HZ, moved))
    kp, ki, kd = np.array([0.032029, 0.244381 * axis.integral_factor, 0.000529]) * axis.pid
    attenuated = 1 + boost / np.maximum(np.abs(setpoint) / 50, 1) * 0.0034
    inputs = (
        setpoint, noise[:, 0], noise[:, 1], gusts, throttle > 0, kp * attenuated,
        (ki + 0.34 * boost) * _DT * relax, kd * _LOOP_HZ * tpa, gyro_share, d_share,
    )  # fmt: skip
    ceiling, limit = 0.8 * axis.sum_limit, float(axis.sum_limit)
    step, gain = _DT / 2, axis.gain
    stay = float(np.exp(-step / _LAG))
    lagged = (1 - stay) * _LAG / step  # of a change, in the mean over a step
    second, d_second = float(_share(500.0, step)), float(_share(150.0, _DT))
    p_share = float(_share(axis.p_lowpass_hz, _DT)) if axis.p_lowpass_hz else 1.0
    rate = motor = fast = gyro = slow = slower = p = integral = 0.0
    waiting, rows = [0.0] * _LATE, []
    for r, first, last, gust, flying, kp, ki, kd, share, d_share in zip(
        *(x.tolist() for x in inputs), strict=True
    ):
        raw = rate + first
        fast += second * (raw - fast)
        error = r - gyro
        p += p_share * (kp * error - p)
        integral = min(max(integral + ki * error, -ceiling), ceiling) if flying else 0.0
        slow += d_share * (gyro - slow)
        change = d_second * (slow - slower)
        slower += change
        d = -kd * change
        rows.append((p, integral, d, gyro, raw))
        waiting.append(min(max(p + integral + d, -limit), limit))
        applied = waiting.pop(0)
        for half in (0, 1):  # the lag's exact mean over a step, in which its input is constant
            if flying:
                rate += step * (gain * (applied + (motor - applied) * lagged) + gust)
            motor = applied + (motor - applied) * stay
            if half == 0:
                fast += second * (rate + last - fast)
                gyro += share * (fast - gyro)
    return np.array(rows).T


def _coded(rows: Int[np.ndarray, "samples fields"]) -> bytes:
    """Seven bits a byte, the lowest first, the eighth where another byte follows."""
    shifted = rows[..., None] >> np.arange(0, 35, 7)
    written = (shifted > 0) | (np.arange(5) == 0)
    more = np.append(written[..., 1:], np.zeros_like(written[..., :1]), axis=-1)
    return ((shifted & 127) | (more << 7)).astype(np.uint8)[written].tobytes()
