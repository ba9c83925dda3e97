"""What the raw numbers of a blackbox log mean, as far as its header says."""

import struct
from collections.abc import Mapping

import numpy as np


_FINE = ("gyroADC", "gyroUnfilt", "rcCommand", "setpoint")  # tenths in high-resolution logs


def scaled(names: tuple[str, ...], settings: dict[str, str]) -> dict[str, tuple[float, str]]:
    """Factor and unit of the fields for which the header gives them.

    Rates come in deg/s: gyro by `gyro_scale`, set-points as they are. Accelerations come in g by
    `acc_1G`. Where `blackbox_high_resolution` is set, gyro, set-points and sticks are tenths.
    """
    fine = 0.1 if settings.get("blackbox_high_resolution", "0").strip() == "1" else 1.0
    gyro = _gyro_scale(settings)
    one_g = _number(settings.get("acc_1G", ""))
    known = {}
    for name in names:
        kind, index = name.partition("[")[::2]
        tenth = fine if kind in _FINE else 1.0
        if kind in ("gyroADC", "gyroUnfilt") and gyro:
            known[name] = gyro * tenth, "deg/s"
        elif (kind == "setpoint" and index != "3]") or kind == "axisRate":
            known[name] = tenth, "deg/s"
        elif kind == "accSmooth" and one_g > 0:
            known[name] = 1 / one_g, "g"
        elif kind == "GPS_coord":
            known[name] = 1e-7, "deg"
        elif tenth != 1.0:
            known[name] = tenth, ""
    return known


def with_axis_sums(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns, and `axisSum[i]`: what the controller asks of axis i, before its limit.

    It is the sum of the P, I, D, feed-forward (F) and S terms that were logged.
    """
    sums = {}
    for axis in range(3):
        terms = [f"axis{term}[{axis}]" for term in "PIDFS"]
        logged = [columns[term] for term in terms if term in columns]
        if logged and f"axisSum[{axis}]" not in columns:
            sums[f"axisSum[{axis}]"] = sum(logged[1:], start=logged[0])
    return {**columns, **sums}


def _gyro_scale(settings: dict[str, str]) -> float:
    """deg/s per count, 0 where the header gives none that a gyro could have."""
    text = settings.get("gyro_scale", settings.get("gyro.scale", "")).strip()
    try:
        if text.lower().startswith("0x"):
            [scale] = struct.unpack(">f", int(text, 16).to_bytes(4, "big"))
        else:
            scale = float(text)
    except (ValueError, OverflowError):
        return 0.0
    return scale if np.isfinite(scale) and 1e-4 < scale < 10 else 0.0


def _number(text: str) -> float:
    return float(text) if text.isascii() and text.isdecimal() and len(text) < 9 else 0.0
