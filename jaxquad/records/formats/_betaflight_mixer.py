"""What the mixer of a Betaflight quadrotor carried out of each axis' command."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float


_QUAD_X = {  # by motor: rear right, front right, rear left, front left
    0: (-1.0, -1.0, 1.0, 1.0),
    1: (1.0, -1.0, 1.0, -1.0),
    2: (1.0, -1.0, -1.0, 1.0),  # or the other way, with reversed motors
}
_ALIKE = 0.02  # of the slope from the command to what the motors show
_SCATTER = 2.0  # units of pidsum, rms, which rounding and a moving throttle make
_UNLIMITED = 300.0  # units of pidsum, below each limit of the sum
_FEWEST = 200  # samples with all motors between their limits
_MEAN = 0.5  # s
_AT_END = 0.002  # of a motor's range


def with_mixed_axes(
    columns: Mapping[str, np.ndarray],
    settings: Mapping[str, str],
    time: Float[np.ndarray, " samples"],
) -> dict[str, np.ndarray]:
    """The columns, `axisMixed[i]`: how much of `axisSum[i]` the motors had, and `collective`.

    The latter is the mean of the motors over their range, 0 to 1, as a running mean over 0.5 s:
    where the mixer makes room for the axes it is not the throttle that was asked for.

    It is less where the sum is limited, and where the motors are at an end of their range. It is
    given where the motors show that they are mixed as those of a quadrotor X without a thrust
    curve: where none is at an end they must follow `axisSum`.
    """
    ends = _ends(settings)
    names = [f"motor[{k}]" for k in range(4)]
    if ends is None or any(name not in columns for name in names) or "motor[4]" in columns:
        return dict(columns)
    low, high = ends
    motors = np.stack([np.asarray(columns[name], float) for name in names], axis=1)
    near = _AT_END * (high - low)
    free = np.all((motors > low + near) & (motors < high - near), axis=1)
    mixed: dict[str, np.ndarray] = {}
    for axis, signs in _QUAD_X.items():
        command = columns.get(f"axisSum[{axis}]")
        if command is None:
            continue
        shown = 1000 * (motors @ np.array(signs)) / (4 * (high - low))
        side = _side(shown[free], np.asarray(command, float)[free])
        if side:
            mixed[f"axisMixed[{axis}]"] = side * shown
    if mixed:
        mixed["collective"] = _running_mean((motors.mean(axis=1) - low) / (high - low), time)
    return {**columns, **mixed}


def _running_mean(
    values: Float[np.ndarray, " samples"], time: Float[np.ndarray, " samples"]
) -> Float[np.ndarray, " samples"]:
    """Over half a second around each sample."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    first = np.searchsorted(time, time - _MEAN / 2)
    last = np.searchsorted(time, time + _MEAN / 2, side="right")
    return (total[last] - total[first]) / (last - first)


def _side(shown: Float[np.ndarray, " samples"], command: Float[np.ndarray, " samples"]) -> float:
    """1 or -1 where the motors show the command, or its negative; 0 where they do not."""
    within = np.abs(command) < _UNLIMITED
    shown, command = shown[within], command[within]
    if shown.size < _FEWEST or not np.any(command):
        return 0.0
    slope = float(shown @ command) / float(command @ command)
    side = float(np.sign(slope))
    follows = abs(abs(slope) - 1) < _ALIKE
    return side if follows and np.std(side * shown - command) < _SCATTER else 0.0


def _ends(settings: Mapping[str, str]) -> tuple[float, float] | None:
    """Lowest and highest command of a motor."""
    try:
        low, high = (float(x) for x in settings["motorOutput"].split(",")[:2])
    except (KeyError, ValueError):
        return None
    return (low, high) if np.isfinite(high) and high > low else None
