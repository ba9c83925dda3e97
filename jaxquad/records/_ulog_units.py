"""Units of PX4 topics, which a ULog file does not hold: those that identification goes by."""

from collections.abc import Iterable


_RATES = ("roll", "pitch", "yaw")
_KNOWN = {
    "vehicle_angular_velocity": {"xyz": "rad/s", "xyz_derivative": "rad/s^2"},
    "vehicle_angular_acceleration": {"xyz": "rad/s^2"},
    "vehicle_rates_setpoint": dict.fromkeys(_RATES, "rad/s"),
    "vehicle_attitude": {"rollspeed": "rad/s", "pitchspeed": "rad/s", "yawspeed": "rad/s"},
    "vehicle_attitude_setpoint": {"roll_body": "rad", "pitch_body": "rad", "yaw_body": "rad"},
    "vehicle_acceleration": {"xyz": "m/s^2"},
    "sensor_combined": {"gyro_rad": "rad/s", "accelerometer_m_s2": "m/s^2"},
    "sensor_gyro": {"x": "rad/s", "y": "rad/s", "z": "rad/s"},
    "sensor_accel": {"x": "m/s^2", "y": "m/s^2", "z": "m/s^2"},
    "autotune_attitude_control_status": {"rate_sp": "rad/s"},
    "vehicle_local_position": dict.fromkeys("xyz", "m") | dict.fromkeys(("vx", "vy", "vz"), "m/s"),
    "vehicle_local_position_setpoint": dict.fromkeys("xyz", "m"),
}
_ENDINGS = {"_m_s2": "m/s^2", "_m_s": "m/s", "_rad": "rad", "_rad_s": "rad/s", "_v": "V", "_a": "A"}


def units_of(topic: str, columns: Iterable[str]) -> dict[str, str]:
    """The unit of each column whose unit is known, by topic or by the ending of its name."""
    known = dict(_KNOWN.get(topic, {}))
    for name in columns:
        for ending, unit in _ENDINGS.items():
            if name.endswith(ending):
                known.setdefault(name, unit)
    return known
