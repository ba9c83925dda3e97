"""What the motors of a Betaflight quadrotor made of each axis' command.

Thrust grows faster than a motor's command, and behind the motor's lag. A motor at an end of its
range, or two axes at once, therefore make another torque than the sum of the PID terms says.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float


_QUAD_X = {  # by motor: rear right, front right, rear left, front left
    0: (-1.0, -1.0, 1.0, 1.0),
    1: (1.0, -1.0, 1.0, -1.0),
    2: (1.0, -1.0, -1.0, 1.0),  # or the other way, with reversed motors
}
_CURVE = 0.5  # of thrust = (1 - curve) t + curve t^2, as propellers have it (0.4 to 0.6)
_LAGS = np.geomspace(0.008, 0.12, 24)  # s, of motors
_USUAL_LAG = 0.03  # s
_BAND = (1.0, 25.0)  # Hz, where the lag is looked for
_SHOWN = 0.5  # of the rate's acceleration that the command explains, for a lag to be seen
_LEVEL = 0.04  # of the throttle, over which the motors' mean is taken
_ARMED = 0.02  # of the motors' range, from which the propellers carry
_ALIKE = 0.25  # of the slope from the command to what the motors show
_SCATTER = (2.0, 0.04)  # units of pidsum, rms, which rounding and a moving throttle make; of rms
_UNLIMITED = 300.0  # units of pidsum, below each limit of the sum
_FEWEST = 200  # samples with all motors between their limits
_AT_END = 0.002  # of a motor's range

Samples = Float[np.ndarray, " samples"]
Motors = Float[np.ndarray, "samples motors"]


def with_mixed_axes(
    columns: Mapping[str, np.ndarray], settings: Mapping[str, str], time: Samples
) -> dict[str, np.ndarray]:
    """The columns, `axisMixed[i]`: the torque that the motors made of `axisSum[i]`, in its unit.

    It is the sum where all motors run alike and within their range, and else what a thrust curve of
    0.5 makes of them behind their lag: less where the sum or a motor is limited. It comes with
    `collective`, the motors' mean over their range, 0 to 1, at the throttle of the moment: where
    the mixer makes room for the axes it is above the throttle that was asked for. Both are
    given where the motors are seen to be mixed as those of a quadrotor X without a thrust curve of
    the firmware's: where none is at an end they must follow `axisSum`.
    """
    names = [f"motor[{k}]" for k in range(4)]
    try:
        low, high = (float(x) for x in settings["motorOutput"].split(",")[:2])
    except (KeyError, ValueError):
        return dict(columns)
    quad = all(name in columns for name in names) and "motor[4]" not in columns
    if not quad or not np.isfinite(high) or not high > low:
        return dict(columns)
    motors = (np.stack([np.asarray(columns[x], float) for x in names], axis=1) - low) / (high - low)
    slopes = {axis: _slope(axis, motors, columns) for axis in _QUAD_X}
    slopes = {axis: slope for axis, slope in slopes.items() if slope}
    if not slopes:
        return dict(columns)
    dt = float(np.median(np.diff(time)))
    # The motors' mean over all samples in flight with about the throttle of each sample.
    mean = motors.mean(axis=1)
    throttle = columns.get("rcCommand[3]", columns.get("setpoint[3]"))
    throttle = np.zeros(mean.size) if throttle is None else np.asarray(throttle, float) / 1000
    level = np.rint((throttle - np.median(throttle)) / _LEVEL).astype(int)
    level -= level.min()
    weight = np.where(mean > _ARMED, 1.0, 1e-9)
    total, count = np.bincount(level, weight * mean), np.bincount(level, weight)
    collective = (total / np.where(count > 0, count, 1.0))[level]
    # The command whose lag has the thrust that the motors have, by a curve behind their lag: with v
    # the lagged command and T its thrust, T(v) + lag dT/dt = T'(v) t + T(v) - T'(v) v.
    lagged = _lagged(motors, _lag_of(columns, motors, slopes, dt), dt)
    thrust = (1 - _CURVE + 2 * _CURVE * lagged) * motors - _CURVE * lagged**2
    gain = 1 - _CURVE + 2 * _CURVE * collective
    mixed = {
        f"axisMixed[{axis}]": 250 * (thrust @ np.array(_QUAD_X[axis])) / (slope * gain)
        for axis, slope in slopes.items()
    }
    return {**columns, **mixed, "collective": collective}


def _lagged(motors: np.ndarray, lag: float, dt: float) -> np.ndarray:
    from scipy.signal import lfilter

    k = 1 - np.exp(-dt / lag)
    return lfilter([k], [1, k - 1], motors, axis=0, zi=(1 - k) * motors[:1])[0]


def _lag_of(
    columns: Mapping[str, np.ndarray], motors: Motors, slopes: Mapping[int, float], dt: float
) -> float:
    """The motors' lag that explains most of an axis' acceleration, of the axis that moved most."""
    from scipy.signal import butter, sosfiltfilt

    rates = {axis: columns.get(f"gyroADC[{axis}]") for axis in slopes if axis < 2}
    moved = {axis: np.asarray(rate, float) for axis, rate in rates.items() if rate is not None}
    if not moved or 1 / dt < 4 * _BAND[1]:
        return _USUAL_LAG
    axis = max(moved, key=lambda axis: float(np.std(moved[axis])))
    sections = butter(2, _BAND, "bandpass", fs=1 / dt, output="sos")
    turned = sosfiltfilt(sections, np.gradient(moved[axis], dt))
    command = sosfiltfilt(sections, slopes[axis] * motors @ np.array(_QUAD_X[axis]))
    shares = []
    for lag in _LAGS:
        torque = _lagged(command, float(lag), dt)
        power = float(torque @ torque) * float(turned @ turned)
        shares.append(float(torque @ turned) ** 2 / power if power > 0 else 0.0)
    best = int(np.argmax(shares))
    return float(_LAGS[best]) if shares[best] > _SHOWN else _USUAL_LAG


def _slope(axis: int, motors: Motors, columns: Mapping[str, np.ndarray]) -> float:
    """By what the motors show of an axis' command, with its sign; 0 where they do not show it.

    It is near 1, and beyond it where the firmware makes up for a battery that sags.
    """
    command = np.asarray(columns.get(f"axisSum[{axis}]", np.empty(0)), float)
    if not command.size:
        return 0.0
    free = np.all((motors > _AT_END) & (motors < 1 - _AT_END), axis=1)
    within = free & (np.abs(command) < _UNLIMITED)
    shown, command = 250 * (motors @ np.array(_QUAD_X[axis]))[within], command[within]
    if shown.size < _FEWEST or not np.any(command):
        return 0.0
    slope = float(shown @ command) / float(command @ command)
    follows = abs(abs(slope) - 1) < _ALIKE
    least, share = _SCATTER
    scatter = float(np.std(shown - slope * command))
    return slope if follows and scatter < max(least, share * float(np.std(command))) else 0.0
