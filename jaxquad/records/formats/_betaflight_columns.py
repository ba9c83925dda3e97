"""Tables that blackbox_decode makes of blackbox logs, and what the columns of both mean.

What the motors made of each axis' command is one of these: thrust grows faster than a motor's
command, and behind the motor's lag. A motor at an end of its range, or two axes at once, therefore
make another torque than the sum of the PID terms says.
"""

import re
import struct
from collections.abc import Iterable, Mapping
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt

from .._channel import unwrap
from .._log import Log, number_in, ReadError, Table


Columns = Mapping[str, np.ndarray]
_MOST_COLUMNS = 2000
_LONGEST_LINE = 1 << 16  # characters
_HEADED = re.compile(r"([^()]*?)\s*\(([^()]*)\)")
_PER_SECOND = {"": 1e6, "us": 1e6, "ms": 1e3, "s": 1.0}
_CHUNK = 20_000  # lines
_MODES = "flightModeFlags"
_MOST_SETTINGS = 2000
# In the order of the bits. An older blackbox_decode gives the bits of Betaflight, which begin with
# ARM, the names of Cleanflight's: armed reads ANGLE_MODE, and ANGLE reads HORIZON_MODE.
_OLD = "ANGLE_MODE HORIZON_MODE MAG BARO GPS_HOME GPS_HOLD HEADFREE AUTOTUNE PASSTHRU SONAR".split()
_NEW = (
    "ARM ANGLE HORIZON MAG HEADFREE PASSTHRU FAILSAFE GPSRESCUE - ANTIGRAVITY HEADADJ CAMSTAB "
    "BEEPERON LEDLOW CALIB OSD TELEMETRY SERVO1 SERVO2 SERVO3 BLACKBOX AIRMODE 3D FPVANGLEMIX "
    "BLACKBOXERASE CAMERA1 CAMERA2 CAMERA3 FLIPOVERAFTERCRASH PREARM BEEPGPSCOUNT VTXPITMODE"
).split()


def sniff(head: bytes, path: Path) -> bool:
    first = head.removeprefix(b"\xef\xbb\xbf").lstrip(b'"')
    explorer = first.startswith(b"Product") and b"Blackbox flight data" in first[:80]
    return first.startswith(b"loopIteration") or explorer


def load(path: Path) -> Log:
    """The columns with numbers, NaN where there is none; flight modes become the table `slow`."""
    settings, lines, texts, numbers = {}, 0, {}, []
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        while True:
            line = file.readline(_LONGEST_LINE)
            cells = [cell.strip().strip('"') for cell in line.rstrip("\r\n").split(",")]
            if cells[0] == "loopIteration":
                break
            if not line or (lines := lines + 1) > _MOST_SETTINGS:
                raise ReadError(
                    "no line begins with loopIteration: the header of the table is missing"
                )
            settings[cells[0]] = ",".join(cells[1:])
        parts = [match.groups() if (match := _HEADED.fullmatch(c)) else (c, "") for c in cells]
        names, units = [name for name, _ in parts], [unit.strip() for _, unit in parts]
        if len(names) > _MOST_COLUMNS or len(set(names)) < len(names) or "time" not in names:
            raise ReadError(
                f"the header has {len(names)} names: at most {_MOST_COLUMNS} are allowed, none "
                f"twice, and one must be 'time'"
            )
        if not all(name.isprintable() for name in names):
            raise ReadError("a name in the header has characters that cannot be printed")
        columns = [i for i, unit in enumerate(units) if unit != "flags"]
        flags = names.index(_MODES) if _MODES in names else None
        blocks = [np.empty((0, len(columns)))]
        while chunk := list(islice(file, _CHUNK)):
            commas = np.array([line.count(",") for line in chunk])
            blocks.append(np.full((len(chunk), len(columns)), np.nan))
            if flags is not None:  # a line that ends before them has the text ""
                for cell in (line.split(",", flags + 1)[flags : flags + 1] for line in chunk):
                    text = cell[0].strip().strip('"') if cell else ""
                    numbers.append(texts.setdefault(text, len(texts)))
            for count in np.unique(commas[commas > 0]):  # of lines with equally many cells
                rows = np.flatnonzero(commas == count)
                alike = [chunk[i] for i in rows]
                there = [k for k, column in enumerate(columns) if column <= count]
                wanted = [columns[k] for k in there]
                try:
                    block = np.loadtxt(alike, delimiter=",", comments=None, usecols=wanted, ndmin=2)
                except ValueError:
                    block = [[number_in(line.split(",")[i]) for i in wanted] for line in alike]
                blocks[-1][rows[:, None], there] = block
    values, clock = np.concatenate(blocks), columns.index(names.index("time"))
    timed = np.isfinite(values[:, clock])
    remarks = ()
    if not timed.all():
        first = lines + 2 + int((~timed).argmax())
        remarks = (f"{(~timed).sum()} lines without a time were left out, first line {first}",)
        values = values[timed]
    if not values.size:
        raise ReadError(f"no line after line {lines + 1} has an iteration and a time")
    unit = units[columns[clock]]
    if unit not in _PER_SECOND:
        raise ReadError(f"the unit of time is {unit[:20]!r}: us, ms and s are known")
    named = {
        names[i]: values[:, k]
        for k, i in enumerate(columns)
        if not np.isnan(values[:, k]).all() and k != clock
    }
    time = unwrap(values[:, clock])[0] / _PER_SECOND[unit]
    named = with_mixed_axes(with_derived(named), settings, time)
    stated = {name: unit for name, unit in zip(names, units, strict=True) if unit}
    tables = {"": Table(named, time, stated)}
    modes = _flight_modes(texts)
    if modes is not None:
        bits = modes[np.array(numbers, int)[timed]]
        changes = np.flatnonzero(np.diff(bits, prepend=~bits[:1]))
        tables["slow"] = Table({_MODES: bits[changes]}, time[changes])
    return Log(tables, remarks, "betaflight", settings)


def _flight_modes(texts: Iterable[str]) -> UInt[np.ndarray, " texts"] | None:
    """The bits of each text; None where all are empty, or one is no name of a mode."""
    texts = list(texts)
    old = any(name.endswith("_MODE") for text in texts for name in text.split("|"))
    bits = {name: 1 << i for i, name in enumerate(_OLD if old else _NEW)}
    masks = []
    for text in texts:
        if text.isascii() and text.isdecimal() and len(text) < 10:
            masks.append(int(text))
        elif text in ("", "NONE"):
            masks.append(0)
        elif all(name in bits for name in text.split("|")):
            masks.append(sum(bits[name] for name in set(text.split("|"))))
        else:
            return None
    return np.array(masks, np.uint32) if any(texts) else None


_FINE = ("gyroADC", "gyroUnfilt", "rcCommand", "setpoint")  # tenths in high-resolution logs
_TURN = 2 * np.pi * 5e3  # of debug[0] in debug mode CHIRP
_FEWEST_TURNS = 3


def scaled(names: tuple[str, ...], settings: dict[str, str]) -> dict[str, tuple[float, str]]:
    """Factor and unit of the fields for which the header gives them; tenths in high resolution."""
    fine = 0.1 if settings.get("blackbox_high_resolution", "0").strip() == "1" else 1.0
    text = settings.get("gyro_scale", settings.get("gyro.scale", "")).strip()
    try:  # deg/s per count
        if text.lower().startswith("0x"):
            [gyro] = struct.unpack(">f", int(text, 16).to_bytes(4, "big"))
        else:
            gyro = float(text)
    except (ValueError, OverflowError):
        gyro = 0.0
    plausible = np.isfinite(gyro) and 1e-4 < gyro < 10
    text = settings.get("acc_1G", "")
    one_g = float(text) if text.isascii() and text.isdecimal() and len(text) < 9 else 0.0
    factors = {}
    for name in names:
        kind, index = name.partition("[")[::2]
        tenth = fine if kind in _FINE else 1.0
        if kind in ("gyroADC", "gyroUnfilt") and plausible:
            factors[name] = gyro * tenth, "deg/s"
        elif (kind == "setpoint" and index != "3]") or kind == "axisRate":
            factors[name] = tenth, "deg/s"
        elif kind == "accSmooth" and one_g > 0:
            factors[name] = 1 / one_g, "g"
        elif kind == "GPS_coord":
            factors[name] = 1e-7, "deg"
        elif tenth != 1.0:
            factors[name] = tenth, ""
    return factors


def with_derived(columns: Columns) -> dict[str, np.ndarray]:
    """The columns, and what follows from them.

    `axisSum[i]` is the output of the controller of axis i before its limit, the sum of the P, I, D,
    feed-forward (F) and S terms that were logged. `chirp` is the sine of the phase of a sweep,
    5000 a radian in debug[0], where firmware before betaflight pull request 15113 logs nothing else
    of it. Firmware that injects the cosine has the same sweep a quarter of a turn ahead: as the
    external reference of a joint estimate it serves as well.
    """
    derived = dict(columns)
    for axis in range(3):
        terms = [f"axis{term}[{axis}]" for term in "PIDFS"]
        logged = [columns[term] for term in terms if term in columns]
        if logged:
            derived.setdefault(f"axisSum[{axis}]", sum(logged[1:], start=logged[0]))
    # A phase lies within a turn, and jumps back from its end. The other debug channels rest, which
    # later firmware fills.
    debug = [columns[name] for i in range(4) if (name := f"debug[{i}]") in columns]
    if "chirp" in columns or not debug or any(x.ndim != 1 or x.any() for x in debug[1:]):
        return derived
    phase = np.nan_to_num(np.asarray(debug[0], np.float64))
    if phase.size and phase.min() >= 0 and 0.9 * _TURN < phase.max() <= _TURN + 1:
        turns = (phase[:-1] > 0.9 * _TURN) & (phase[1:] < 0.1 * _TURN)
        if turns.sum() >= _FEWEST_TURNS:
            derived["chirp"] = np.sin(phase / 5e3)
    return derived


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


def with_mixed_axes(
    columns: Columns, settings: Mapping[str, str], time: Float[np.ndarray, " samples"]
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
    free = np.all((motors > _AT_END) & (motors < 1 - _AT_END), axis=1)
    # What the motors show of an axis' command, with its sign: near 1, and beyond it where the
    # firmware makes up for a battery that sags.
    slopes: dict[int, float] = {}
    for axis, mix in _QUAD_X.items():
        command = np.asarray(columns.get(f"axisSum[{axis}]", np.zeros(free.size)), float)
        within = free & (np.abs(command) < _UNLIMITED)
        shown, command = 250 * (motors @ np.array(mix))[within], command[within]
        if shown.size < _FEWEST or not np.any(command):
            continue
        slope = float(shown @ command) / float(command @ command)
        scatter = float(np.std(shown - slope * command))
        least, share = _SCATTER
        follows = scatter < max(least, share * float(np.std(command)))
        if follows and abs(abs(slope) - 1) < _ALIKE:
            slopes[axis] = slope
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
    lagged = _lagged(motors, _motor_lag(columns, motors, slopes, dt), dt)
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


def _motor_lag(
    columns: Columns, motors: np.ndarray, slopes: Mapping[int, float], dt: float
) -> float:
    """The lag that explains most of an axis' acceleration, of the axis that moved most."""
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
