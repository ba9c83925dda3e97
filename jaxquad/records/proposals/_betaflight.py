"""Betaflight: PID sum, filtered gyro, set-point, and the chirp mode's debug channels."""

from collections.abc import Sequence

import numpy as np

from .._errors import RecordError
from .._log import flattened, Log, Table
from ._chirps import chirps
from ._proposal import (
    AXES,
    first_logged,
    Injection,
    most_active_axis,
    moves,
    Setup,
    values_of,
    with_injections,
)


_SELF_LEVELLING = 0b110  # ANGLE and HORIZON in the flight mode flags


def betaflight_setup(log: Log, axis: str | None) -> Setup:
    """The set-up for the longest chirp of a log that holds one flight.

    Without a chirp the reference is the set-point if flown in acro, else the stick.
    """
    prefix, table = _main_table(log)
    signals = flattened(log)
    rates = {each: first_logged(signals, [f"{prefix}gyroADC[{i}]"]) for i, each in enumerate(AXES)}
    if not any(rates.values()):
        raise RecordError("the log has no gyroADC.")
    sweeps = [each for each in chirps(table) if axis in (None, AXES[each.axis])]
    best = max(sweeps, key=lambda each: each.stop - each.start, default=None)
    axis = axis or (most_active_axis(signals, rates) if best is None else AXES[best.axis])
    i = AXES.index(axis)
    command = first_logged(signals, [f"{prefix}axisMixed[{i}]", f"{prefix}axisSum[{i}]"])
    if not command or not rates[axis]:
        raise RecordError(f"the log has no PID terms or no gyro for {axis}.")
    levelled = _levelled(log, prefix)
    remarks = [
        f"{rates[axis]} is measured after the gyro filters, which identify divides out where the "
        "log has their parameters"
    ]
    if best is not None:
        others = [each for each in sweeps if each.axis != best.axis]
        remarks += [
            f"another chirp on the set-point of {AXES[each.axis]}, "
            f"t = {each.start:.6g} .. {each.stop:.6g} s"
            for each in others
        ]
        alike = [Injection(*each[1:5]) for each in sweeps if each.axis == best.axis]
        setup = Setup(
            axis, {command: 1.0}, rates[axis], f"{prefix}{best.channel}", remarks=tuple(remarks),
            injected_at="rate", levelled=bool(levelled),
        )  # fmt: skip
        return with_injections(setup, alike, "chirp on the rate set-point")
    setpoint = first_logged(signals, [f"{prefix}setpoint[{i}]"])
    if setpoint and not moves(signals, setpoint):
        remarks.append(
            f"{setpoint} never moves, so nothing from outside excites {axis}: fly the chirp mode "
            f"(debug_mode = CHIRP), or stick pulses of different widths"
        )
        return Setup(axis, {command: 1.0}, rates[axis], remarks=tuple(remarks))
    if setpoint and levelled is False:
        remarks.append("flown in acro, where the set-point comes from the pilot only")
        return Setup(axis, {command: 1.0}, rates[axis], setpoint, remarks=tuple(remarks))
    if setpoint:
        remarks.append(
            f"self-levelling was on or is unknown: {setpoint} is then computed from the attitude, "
            f"contains feedback and cannot be the external reference"
        )
    stick = first_logged(signals, [f"{prefix}rcCommand[{i}]"])
    reference = stick if stick and np.ptp(values_of(signals, stick)) else ""
    return Setup(
        axis, {command: 1.0}, rates[axis], reference, remarks=tuple(remarks),
        levelled=bool(levelled),
    )  # fmt: skip


def _main_table(log: Log) -> tuple[str, Table]:
    """The main table of a log, and what precedes its channels."""
    main = {
        name: table
        for name, table in log.tables.items()
        if not name.endswith(("slow", "gps")) and table.time is not None and table.time.size
    }
    if not main:
        raise RecordError("the log has no main frames.")
    name, table = next(iter(main.items()))
    return f"{name}." if name else "", table


def _levelled(log: Log, prefix: str) -> bool | None:
    """Whether a self-levelling mode was on at any time; None where that is unknown."""
    flags = log.tables.get(f"{prefix}slow")
    modes = None if flags is None else flags.columns.get("flightModeFlags")
    if modes is None or not modes.size or modes.dtype.kind not in "iuf":
        return None
    return bool((modes.astype(np.int64) & _SELF_LEVELLING).any())


def saturation(log: Log, setup: Setup, spans: Sequence[tuple[float, float]]) -> tuple[str, ...]:
    """A remark on samples within the `spans` (s) where the firmware limits the PID sum."""
    name = "pidsum_limit_yaw" if setup.axis == "yaw" else "pidsum_limit"
    text = log.settings.get(name, "")
    prefix, table = _main_table(log)
    if not (text.isdecimal() and len(text) < 9) or table.time is None:
        return ()
    asked = f"{prefix}axisSum[{AXES.index(setup.axis)}]"
    command = values_of(flattened(log), asked)
    used = np.zeros(command.size, bool)
    for start, stop in spans:
        used |= (table.time >= start) & (table.time <= stop)
    beyond = int((np.abs(command[used]) > int(text)).sum())
    share = f"{beyond} of {used.sum()} samples of the command"
    return (f"{share} exceed {name} = {text}, where it saturates",) if beyond else ()
