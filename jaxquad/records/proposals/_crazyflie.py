"""Crazyflie: the controller's commands or the motors, and the gyro; there is no chirp mode."""

from .._errors import RecordError
from .._log import flattened, Log, Signals
from ._proposal import AXES, first_logged, most_active_axis, moves, Setup


_MOTORS = {"roll": (-1, -1, 1, 1), "pitch": (-1, 1, 1, -1), "yaw": (-1, 1, -1, 1)}
_GYRO: dict[str, str] = dict(zip(AXES, "xyz", strict=True))


def crazyflie_setup(log: Log, axis: str | None) -> Setup:
    """The set-up for the axis that moves most; the log of the stock firmware has no reference."""
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
