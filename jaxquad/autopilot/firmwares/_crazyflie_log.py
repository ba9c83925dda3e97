"""Crazyflie: PID outputs or motor commands, and the gyro."""

from jaxquad.records import AXES, RecordError
from jaxquad.records.firmware import (
    channel_rate,
    FirmwareLog,
    first_logged,
    flattened,
    Log,
    most_active_axis,
    moves,
    Selection,
    Setup,
)


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


LOG = FirmwareLog(
    name="crazyflie", title="Crazyflie", setup=crazyflie_setup,
    rates=[f"gyro.{x}" for x in "xyz"],
    throttle=(("controller.cmd_thrust", 1 / 65535), ("stabilizer.thrust", 1 / 65535)),
    settings=False,
)  # fmt: skip
