"""Betaflight: PID sum, filtered gyro, set-point, and the chirp mode's debug channels."""

from typing import NamedTuple

import numpy as np

from .._errors import RecordError
from .._log import flattened, Log, Table
from ._proposal import (
    AXES,
    first_logged,
    Injection,
    most_active_axis,
    Setup,
    values_of,
    with_injections,
)


_AXES = (0, 1, 2)
_SHORTEST = 1.0  # s
_MOST_EDGES = 10_000


class Chirp(NamedTuple):
    """A sweep that Betaflight's chirp mode injected, on axis 0 (roll), 1 (pitch) or 2 (yaw)."""

    axis: int
    start: float  # s
    stop: float
    low: float  # Hz
    high: float


def chirps(table: Table) -> list[Chirp]:
    """The sweeps in a log whose debug channels are those of debug mode CHIRP.

    There, debug[1] is the axis (-1 when idle), debug[2] the frequency in 0.1 Hz and debug[3] the
    excitation (betaflight pull request 15113). The number of that mode depends on the version, so
    the data decide: a frequency that only rises while the axis stays the same.
    """
    debug = [table.columns.get(f"debug[{i}]") for i in range(4)]
    if table.time is None or any(each is None for each in debug):
        return []
    _, axis, tenths, excitation = (np.asarray(each, np.float64) for each in debug)
    active = np.where(tenths > 0, axis, -1)
    edges = np.flatnonzero(np.diff(active)) + 1
    if not np.isin(axis, (-1, *_AXES)).all() or edges.size > _MOST_EDGES:
        return []
    found = []
    for first, end in zip([0, *edges], [*edges, axis.size], strict=True):
        frequency, time = tenths[first:end] / 10, table.time[first:end]
        sweeps = (np.diff(frequency) >= 0).all() and frequency[-1] > frequency[0]
        moves = sweeps and np.ptp(excitation[first:end]) > 0
        if active[first] in _AXES and moves and time[-1] - time[0] >= _SHORTEST:
            ends = (float(time[0]), float(time[-1]), float(frequency[0]), float(frequency[-1]))
            found.append(Chirp(int(active[first]), *ends))
    return found


_SELF_LEVELLING = 0b110  # ANGLE and HORIZON in the flight mode flags


def betaflight_setup(log: Log, axis: str | None) -> Setup:
    """The set-up for the longest chirp of the longest log.

    Without a chirp the reference is the set-point if flown in acro, else the stick.
    """
    prefix, table = _longest(log)
    signals = flattened(log)
    rates = {each: first_logged(signals, [f"{prefix}gyroADC[{i}]"]) for i, each in enumerate(AXES)}
    if not any(rates.values()):
        raise RecordError("the log has no gyroADC.")
    sweeps = [each for each in chirps(table) if axis in (None, AXES[each.axis])]
    best = max(sweeps, key=lambda each: each.stop - each.start, default=None)
    axis = axis or (most_active_axis(signals, rates) if best is None else AXES[best.axis])
    i = AXES.index(axis)
    command = first_logged(signals, [f"{prefix}axisSum[{i}]"])
    if not command or not rates[axis]:
        raise RecordError(f"the log has no PID terms or no gyro for {axis}.")
    remarks = [
        f"{rates[axis]} is measured after the gyro filters, which identify divides out where the "
        "log has their parameters"
    ]
    remarks += _limited(log, prefix, axis, values_of(signals, command))
    if best is not None:
        others = [each for each in sweeps if each.axis != best.axis]
        remarks += [
            f"another chirp on the set-point of {AXES[each.axis]}, "
            f"t = {each.start:.6g} .. {each.stop:.6g} s"
            for each in others
        ]
        alike = [Injection(*each[1:]) for each in sweeps if each.axis == best.axis]
        setup = Setup(
            axis, {command: 1.0}, rates[axis], f"{prefix}debug[3]", remarks=tuple(remarks)
        )
        return with_injections(setup, alike, "chirp on the rate set-point")
    setpoint = first_logged(signals, [f"{prefix}setpoint[{i}]"])
    if setpoint and not np.ptp(values_of(signals, setpoint)):
        remarks.append(f"{setpoint} rests, so there is no external reference")
        return Setup(axis, {command: 1.0}, rates[axis], remarks=tuple(remarks))
    if setpoint and not _levelled(log, prefix):
        remarks.append("flown in acro, where the set-point comes from the pilot only")
        return Setup(axis, {command: 1.0}, rates[axis], setpoint, remarks=tuple(remarks))
    if setpoint:
        remarks.append(
            f"self-levelling was on or is unknown: {setpoint} is then computed from the attitude, "
            f"contains feedback and cannot be the external reference"
        )
    stick = first_logged(signals, [f"{prefix}rcCommand[{i}]"])
    reference = stick if stick and np.ptp(values_of(signals, stick)) else ""
    return Setup(axis, {command: 1.0}, rates[axis], reference, remarks=tuple(remarks))


def _longest(log: Log) -> tuple[str, Table]:
    """The main table of the longest log in the file, and what precedes its channels."""
    main = {
        name: table
        for name, table in log.tables.items()
        if not name.endswith(("slow", "gps")) and table.time is not None and table.time.size
    }
    if not main:
        raise RecordError("the log has no main frames.")
    name = max(main, key=lambda each: np.ptp(np.asarray(main[each].time)))
    return f"{name}." if name else "", main[name]


def _levelled(log: Log, prefix: str) -> bool:
    """Whether a self-levelling mode was on at any time; where that is unknown, it counts as on."""
    flags = log.tables.get(f"{prefix}slow")
    modes = None if flags is None else flags.columns.get("flightModeFlags")
    if modes is None or not modes.size or modes.dtype.kind not in "iuf":
        return True
    return bool((modes.astype(np.int64) & _SELF_LEVELLING).any())


def _limited(log: Log, prefix: str, axis: str, command: np.ndarray) -> list[str]:
    """A remark on samples where the firmware limits the PID sum."""
    name = "pidsum_limit_yaw" if axis == "yaw" else "pidsum_limit"
    text = log.settings.get(f"{prefix.rstrip('.')} {name}".lstrip(), "")
    beyond = int((np.abs(command) > int(text)).sum()) if text.isdecimal() and len(text) < 9 else 0
    share = f"{beyond} of {command.size} samples of the command"
    return [f"{share} exceed {name} = {text}, where it saturates"] if beyond else []
