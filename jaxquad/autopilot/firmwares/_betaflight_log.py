"""Betaflight: PID sum, filtered gyro, set-point, and the chirp mode's debug channels."""

from collections.abc import Sequence

import numpy as np

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


LOG = FirmwareLog(
    name="betaflight", title="Betaflight", setup=betaflight_setup,
    rates=[f"gyroADC[{i}]" for i in range(3)], setpoints=[f"setpoint[{i}]" for i in range(3)],
    throttle=(("collective", 1.0), ("setpoint[3]", 1e-3)), hold=command_hold,
    release="Firmware revision", gyro_cutoffs=("gyro_lpf1_static_hz", "gyro_lowpass_hz"),
    flights=flights_of, remarks_on=saturation,
)  # fmt: skip
