"""PX4: torque set-points, angular velocity, and the steps of autotune."""

import numpy as np

from jaxquad.records import AXES, RecordError
from jaxquad.records.firmware import (
    FirmwareLog,
    first_logged,
    flattened,
    hold_by_rate,
    Injection,
    Log,
    most_active_axis,
    moves,
    Selection,
    Setup,
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
        "for an external reference, run autotune, or inject a sweep and log it",
    ]
    stick = first_logged(signals, _STICKS[axis])
    if stick and moves(signals, stick):
        remarks.append(
            f"in manual flight the stick is not affected by feedback: use --reference {stick} if "
            f"it moved enough"
        )
    return Setup(axis, {command: 1.0}, rates[axis], remarks=tuple(remarks))


LOG = FirmwareLog(
    name="px4", title="PX4", setup=px4_setup,
    rates=[f"vehicle_angular_velocity.xyz[{i}]" for i in range(3)],
    setpoints=[f"{_RATE_SETPOINT}.{x}" for x in AXES],
    throttle=(("vehicle_thrust_setpoint.xyz[2]", -1.0), ("actuator_controls_0.control[3]", 1.0)),
    hold=lambda log: hold_by_rate(log, "IMU_GYRO_RATEMAX"),
    of_loop=("MC_", "IMU_GYRO_", "IMU_DGYRO_", "THR_MDL_FAC", "CA_", "PWM_", "DSHOT_"),
    release="ver_sw_release", gyro_cutoffs=("IMU_GYRO_CUTOFF",),
)  # fmt: skip
