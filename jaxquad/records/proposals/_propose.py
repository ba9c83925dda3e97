from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxquad._core import marked_text

from .._errors import printable, RecordError
from .._log import flattened, Log, Signals
from ..formats import load_log
from ._ardupilot import ardupilot_setup
from ._betaflight import betaflight_setup, saturation
from ._flights import choose_flight
from ._flown_span import in_flight
from ._proposal import (
    AXES,
    channel_rate,
    complete,
    first_logged,
    most_active_axis,
    moves,
    Proposal,
    Setup,
)
from ._px4 import px4_setup
from ._selection import Selection


_MOTORS = {"roll": (-1, -1, 1, 1), "pitch": (-1, 1, 1, -1), "yaw": (-1, 1, -1, 1)}
_GYRO: dict[str, str] = dict(zip(AXES, "xyz", strict=True))


def crazyflie_setup(log: Log, axis: str | None) -> Setup:
    """Of a Crazyflie, for the axis that moves most; its firmware has no chirp and no reference."""
    signals = flattened(log)
    prefixes = [f"{name}." if name else "" for name in log.tables]
    found = {
        each: next(filter(None, (_rate(signals, prefix, each) for prefix in prefixes)), "")
        for each in AXES
    }
    if not any(found.values()):
        raise RecordError("the log has no gyro.x, gyro.y, gyro.z or controller.r_roll, ...")
    axis = axis or most_active_axis(signals, found)
    command = next(filter(None, (_command(signals, prefix, axis) for prefix in prefixes)), None)
    if not found[axis] or command is None:
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
    remarks += _slow_stamps(signals, found[axis])
    target = next(
        (f"{p}ctrltarget.{axis}" for p in prefixes if moves(signals, f"{p}ctrltarget.{axis}")), ""
    )
    if target:
        remarks.append(
            f"in manual flight the pilot's {target} is not affected by feedback: use --reference "
            f"{target}"
        )
    if len(command) > 1:
        remarks.append(
            "the motor commands are not linear in thrust: where the thrust curve is known, use "
            "powers (--input 'NAME=0.1*a^2')"
        )
    return Setup(axis, command, found[axis], remarks=tuple(remarks))


_SLOW_STAMPS = 85 / 84  # by which rates of the micro-SD deck's stamps are too high
_NOMINAL = (50, 100, 125, 200, 250, 333.333, 400, 500, 800, 1000)  # Hz
_NEAR = 0.004  # events come late or are lost


def _slow_stamps(signals: Signals, rate: str) -> list[str]:
    """A remark where the rate of the log is that of stamps which run 84/85 slow."""
    hertz = channel_rate(signals, rate)
    nominal = next((x for x in _NOMINAL if abs(hertz / x / _SLOW_STAMPS - 1) < _NEAR), None)
    if nominal is None:
        return []
    return [
        f"the time stamps say {hertz:.5g} Hz, 85/84 of {nominal:.6g} Hz: firmware before August "
        f"2026 wrote them that much slow, so that the gain to a rate is 1.2 % too high, lag and "
        f"delay 1.2 % too short. Where the log is of such firmware, --time-factor 1.0119 corrects "
        f"it"
    ]


def _rate(signals: Signals, prefix: str, axis: str) -> str:
    names = [f"{prefix}gyro.{_GYRO[axis]}", f"{prefix}controller.r_{axis}"]
    return first_logged(signals, names)


def _command(signals: Signals, prefix: str, axis: str) -> dict[str, float] | None:
    name = f"{prefix}controller.cmd_{axis}"
    if moves(signals, name):
        return {name: 1.0}
    motors = [f"{prefix}motor.m{i}" for i in range(1, 5)]
    if not all(moves(signals, motor) for motor in motors):
        return None
    return dict(zip(motors, map(float, _MOTORS[axis]), strict=True))


_SETUPS: Mapping[str, Callable[[Log, Selection], Setup]] = {
    "ardupilot": ardupilot_setup,
    "px4": lambda log, wanted: px4_setup(log, wanted.axis),
    "betaflight": lambda log, wanted: betaflight_setup(log, wanted.axis),
    "crazyflie": lambda log, wanted: crazyflie_setup(log, wanted.axis),
}
_NUMBERED = ("ardupilot",)  # whose chirps are listed with numbers


_USED_PART: Mapping[str, Callable[[Log, Setup, Sequence[tuple[float, float]]], tuple[str, ...]]] = {
    "betaflight": saturation
}  # remarks that depend on the part that is used


def propose(
    path: str | Path,
    *,
    axis: str | None = None,
    chirp: int | None = None,
    flight: int | None = None,
    start: float | int | None = None,
    stop: float | int | None = None,
) -> Proposal:
    """Propose which channels of an autopilot's log are command, rate and external reference.

    Injected excitation is found, with its time and band: ArduPilot's SystemID mode, PX4's
    autotune, Betaflight's chirp mode. A set-point that an outer loop computes contains feedback,
    and is never proposed as the external reference. Without injected excitation the proposal is of
    the time in flight: what comes before take-off and after landing or a crash is left out.

    **Arguments:**

    - `path`: a log of ArduPilot, PX4, Betaflight or Crazyflie.
    - `axis`: `"roll"`, `"pitch"` or `"yaw"`; by default that of the longest injected excitation,
        else the one that moves most.
    - `chirp`: the number, from 1, of one of the chirps that the proposal of an ArduPilot log lists;
        by default the longest one, with all others on its axis at its place.
    - `flight`: the number of the flight in a file with several, as `flights` lists them; by default
        the longest with a chirp, else the longest with sticks that move, else the longest.
    - `start`, `stop`: in s, instead of what the log says: the ends of the injected excitation, or
        take-off and landing; only ArduPilot's chirps between them are taken.

    **Returns:** a `Proposal`, which prints its reasons and the command line.

    **Raises:**

    - `ReadError`: where the file is missing, damaged or of an unknown format.
    - `RecordError`: where the log lacks the channels of the axis, or the chirp.
    """
    if axis is not None and axis not in AXES:
        raise RecordError(f"axis is {axis!r}: use one of {', '.join(AXES)}.")
    log = load_log(path)
    if log.vehicle not in _SETUPS:
        raise RecordError(
            f"{path}: not a log of a known autopilot ({', '.join(_SETUPS)}), so the meaning of its "
            f"channels is unknown. jaxquad identify takes it all the same: list them (jaxquad "
            f"channels«, jq.records.channels») and «name inputs, outputs and references yourself»."
        )
    if chirp is not None and log.vehicle not in _NUMBERED:
        raise RecordError(
            f"{path}: the chirps of {log.vehicle} have no numbers: leave `chirp` out, and give "
            "the time (`start`, `stop`) of the one to use."
        )
    try:
        low, high = (None if end is None else float(end) for end in (start, stop))
        return _proposed(str(path), log, Selection(axis, chirp, low, high), flight)
    except RecordError as error:
        raise RecordError(f"{path}: {marked_text(error)}") from error
    # A log may call anything by the names that its vehicle uses.
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise RecordError(
            f"{path}: the channels are not those that {log.vehicle} logs "
            f"({type(error).__name__}: {printable(str(error))}). Name inputs, outputs and "
            f"references yourself."
        ) from error


def _proposed(path: str, log: Log, wanted: Selection, flight: int | None) -> Proposal:
    log, choice = choose_flight(log, wanted.axis, flight)
    setup = in_flight(log, _SETUPS[log.vehicle](log, wanted), wanted.start, wanted.stop)
    proposal = complete(path, log, setup._replace(remarks=(*choice, *setup.remarks)))
    setup = proposal.setup
    used = [
        (-np.inf if start is None else start, np.inf if stop is None else stop)
        for start, stop in setup.segments or ((setup.start, setup.stop),)
    ]
    further = _USED_PART.get(log.vehicle, lambda *_: ())(log, setup, used)
    return proposal._replace(setup=setup._replace(remarks=(*setup.remarks, *further)))
