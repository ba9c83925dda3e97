"""Betaflight: its parameters, channels, recipe and files."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from jaxquad._core import Number
from jaxquad.identify import CurveFirmware
from jaxquad.records import AXES

from .._filters import betaflight_quality, Filter, FilterChain, Notch, PT3
from .._firmware import (
    Channels,
    Firmware,
    joined_lines,
    LowPass,
    number_text,
    OuterLoop,
    Parameter,
    Range,
    rows_of_axes,
    Values,
    Words,
)
from .._law import DEGREES, FlownLoop
from ._adrc import flies_adrc
from ._header import betaflight_loop, betaflight_low_passes
from ._law import BetaflightPID, D_SCALE, I_SCALE, P_SCALE
from ._log import LOG


_FILTERS = (
    ("gyro_lpf1_dyn_min_hz", 250), ("gyro_lpf1_dyn_max_hz", 500), ("gyro_lpf2_static_hz", 500),
    ("dterm_lpf1_dyn_min_hz", 75), ("dterm_lpf1_dyn_max_hz", 150), ("dterm_lpf2_static_hz", 150),
    ("gyro_lpf1_static_hz", 250), ("dterm_lpf1_static_hz", 75),
    ("gyro_notch1_hz", 0), ("gyro_notch1_cutoff", 0), ("gyro_notch2_hz", 0),
    ("gyro_notch2_cutoff", 0),
)  # fmt: skip


def _table() -> list[Parameter]:
    of = lambda start: [f"{start}_{axis}" for axis in AXES]
    byte, wide = (0, 250), (0, 1000)
    adrc: tuple[tuple[str, str, Number, Range], ...] = (
        ("adrc_gyro_lpf_hz", "Hz", 150, wide),
        ("adrc_td_hz", "Hz", 0, wide),
        ("adrc_hover_throttle", "%", 35, (5, 100)),
        ("adrc_sigma_decay", "0.1/s", 3, (0, 100)),
    )
    return [
        *rows_of_axes(of("p"), "", (45, 47, 45), byte, "p", integer=True),
        *rows_of_axes(of("i"), "", (80, 84, 80), byte, "i", integer=True),
        *rows_of_axes(of("d"), "", (30, 34, 0), byte, "d", integer=True),
        *rows_of_axes(of("f"), "", (120, 125, 120), wide, "f", integer=True),
        *rows_of_axes(of("d_max"), "", (40, 46, 0), byte, "d_max.ceiling", integer=True),
        Parameter("angle_p_gain", "0.1/s", 50, 0, 200, True, "angle.level"),
        Parameter("thrust_linear", "%", 0, 0, 150, True),
        *(Parameter(name, "Hz", default, *wide, True) for name, default in _FILTERS),
        *rows_of_axes(of("adrc_wc"), "rad/s", (60, 60, 60), (5, 300), "wc", integer=True),
        *rows_of_axes(of("adrc_wo"), "rad/s", (100, 100, 80), (10, 600), "wo", integer=True),
        *rows_of_axes(of("adrc_b0"), "deg/s^3", (2000,) * 3, (100, 65535), "b0", integer=True),
        *(Parameter(name, unit, default, *bound, True) for name, unit, default, bound in adrc),
    ]  # fmt: skip


_LINES = {  # of a header, and the place in it
    "gyro_lpf1_static_hz": (("gyro_lpf1_static_hz", "gyro_lowpass_hz"), 0),
    "gyro_lpf1_dyn_min_hz": (("gyro_lpf1_dyn_hz", "gyro_lowpass_dyn_hz"), 0),
    "gyro_lpf1_dyn_max_hz": (("gyro_lpf1_dyn_hz", "gyro_lowpass_dyn_hz"), 1),
    "gyro_lpf2_static_hz": (("gyro_lpf2_static_hz", "gyro_lowpass2_hz"), 0),
    "dterm_lpf1_static_hz": (("dterm_lpf1_static_hz", "dterm_lowpass_hz"), 0),
    "dterm_lpf1_dyn_min_hz": (("dterm_lpf1_dyn_hz", "dterm_lowpass_dyn_hz"), 0),
    "dterm_lpf1_dyn_max_hz": (("dterm_lpf1_dyn_hz", "dterm_lowpass_dyn_hz"), 1),
    "dterm_lpf2_static_hz": (("dterm_lpf2_static_hz", "dterm_lowpass2_hz"), 0),
    "gyro_notch1_hz": (("gyro_notch_hz",), 0),
    "gyro_notch1_cutoff": (("gyro_notch_cutoff",), 0),
    "gyro_notch2_hz": (("gyro_notch_hz",), 1),
    "gyro_notch2_cutoff": (("gyro_notch_cutoff",), 1),
}
_SMOOTH_HZ = 50.0  # of the set-point in ANGLE mode
_SAME_LOOP = 0.05  # of the interval in the header


class Betaflight(Firmware):
    """Betaflight from 4.2 on, with the ADRC of its pull request 15400."""

    log = LOG
    parameters = {row.name: row for row in _table()}
    unit = "pidsum"
    suffix = "txt"
    follows_throttle = True
    thrust_curve = "thrust_linear"
    keeps_throttle = True
    notches = tuple((f"gyro_notch{k}_hz", f"gyro_notch{k}_cutoff") for k in (1, 2))
    words = True
    has_adrc = True

    def flown_loop(
        self, values: Mapping[str, str], version: Sequence[int], *, throttle: float,
        tracked_hz: Mapping[int, Sequence[float]],
    ) -> FlownLoop:  # fmt: skip
        return betaflight_loop(values, version, throttle=throttle)

    def channels(self, prefix: str, axis: int) -> Channels:
        return Channels(
            unfiltered=[f"{prefix}gyroUnfilt[{k}]" for k in range(3)],
            terms=[f"{prefix}axis{x}[{axis}]" for x in "PIDF"],
            motors=[f"{prefix}motor[{k}]" for k in range(8)],
            output={f"{prefix}axisSum[{axis}]": 1.0},
            stick={f"{prefix}rcCommand[3]": 1.0},
            mixed={f"{prefix}axisMixed[{axis}]": 1.0},
        )

    def what_to_fly(self, axis: str) -> str:
        return (
            "Fly this: set debug_mode = CHIRP, blackbox at 1 kHz or more, and CHIRP on a switch "
            f"(firmware 2025.12 or later; each use takes the next axis, so until {axis}); hover "
            "high and clear, hold the switch for 20 s, release it to end. Without CHIRP: strong "
            f"and quick {axis} stick in acro for 20 s"
        )

    def motor_ends(self, values: Mapping[str, str]) -> tuple[float, float]:
        low, high = (float(x) for x in values.get("motorOutput", "48,2047").split(",")[:2])
        return low, high

    def stick_throttle(
        self, command: Float[np.ndarray, " samples"], values: Mapping[str, str]
    ) -> Float[np.ndarray, " samples"] | None:
        """The throttle before its boost; a limit of the throttle is another one."""
        if float(values.get("throttle_limit_type", 0)):
            return None
        return np.clip((command - 1000) / 1000, 0.0, 1.0)

    def output_limit(self, values: Mapping[str, str], axis: int) -> float:
        name, usual = ("pidsum_limit_yaw", 400.0) if axis == 2 else ("pidsum_limit", 500.0)
        return float(values.get(name, usual))

    def resolution(self, values: Mapping[str, str]) -> tuple[float, float]:
        finer = float(values.get("blackbox_high_resolution", 0)) > 0
        return np.radians(0.1 if finer else 1.0), 1.0

    def with_hold(self, values: Mapping[str, str], hold: float | None) -> Mapping[str, str]:
        if hold is None or "looptime" not in values:
            return values
        looptime = 1e6 * hold / float(values.get("pid_process_denom", 1.0))
        if abs(looptime / float(values["looptime"]) - 1) < _SAME_LOOP:
            return values
        return {**values, "looptime": f"{looptime:.6g}"}

    def levelled(self, loop: FlownLoop) -> FlownLoop:
        """The integral is held from a fifth of the set-point's speed on there."""
        relax = loop.law.relax if isinstance(loop.law, BetaflightPID) else None
        if relax is None:
            return loop
        relax = dataclasses.replace(relax, threshold=0.2 * relax.threshold)
        return dataclasses.replace(loop, law=dataclasses.replace(loop.law, relax=relax))

    def angle_loop(
        self, values: Mapping[str, str], axis: int, dt: float, *, levelled: bool
    ) -> OuterLoop | None:
        level = values.get("levelPID", "").split(",")[0]
        if axis == 2 or not level:
            return None
        smooth = FilterChain((PT3(_SMOOTH_HZ),), 1 / dt)
        flown = {"angle_p_gain": level}
        return OuterLoop.of(flown, "angle_p_gain", 0.1, 0.0, closed=levelled, smooth=smooth)

    def low_passes(
        self, loop: FlownLoop, values: Mapping[str, str], version: Sequence[int], axis: int,
        throttle: float,
    ) -> Iterator[LowPass]:  # fmt: skip
        return betaflight_low_passes(values, version, throttle)

    def notch(self, centre_hz: float, second: float) -> Filter:
        return Notch(centre_hz, betaflight_quality(centre_hz, second))

    def notch_width(self, centre_hz: float, half_width: float) -> float:
        """The lower cutoff."""
        return float(np.rint((1 - half_width) * centre_hz))

    def flown_notches(self, values: Mapping[str, str]) -> list[tuple[float, float]]:
        split = lambda name: [float(x) for x in values.get(name, "").split(",") if x]
        return list(zip(split("gyro_notch_hz"), split("gyro_notch_cutoff"), strict=False))

    def notch_rate_hz(self, loop: FlownLoop) -> float:
        return 1 / loop.law.dt

    def change_filters(
        self, values: Mapping[str, str], parameters: Mapping[str, Number]
    ) -> dict[str, str]:
        changed = dict(values)
        for name, value in parameters.items():
            lines, place = _LINES.get(name, ((), 0))
            line = next((x for x in lines if x in changed), None)
            if line is None:
                raise ValueError(f"the header has no line for {name}, so it cannot be changed.")
            parts = changed[line].split(",")
            parts[place] = f"{value:g}"
            changed[line] = ",".join(parts)
        return changed

    def curve_kind(self, version: Sequence[int]) -> CurveFirmware:
        """Until 2025.12 `thrust_linear` is of another family than the others' parameters."""
        return "betaflight 2025.12" if tuple(version) < (2026, 6) else "betaflight"

    def flies_adrc(self, values: Mapping[str, str]) -> bool:
        return flies_adrc(values)

    def si_scales(self, axis: str) -> tuple[float, float, float]:
        p, i, d = (1e3 / (DEGREES * x) for x in (P_SCALE, I_SCALE, D_SCALE))
        return (p, i / 2.5, d) if axis == "yaw" else (p, i, d)

    def angle_parameters(self, axis: str, p: float) -> dict[str, float]:
        return {"angle_p_gain": 10 * p}

    def no_ladrc(self) -> str:
        return "its proposed ADRC (pull request 15400) is of the rate, not of the angle"

    def parameter_file(
        self, values: Values, title: str, *, version: tuple[int, ...], profile: int | None,
        raised: Sequence[str], words: Words,
    ) -> str:  # fmt: skip
        names = _names_of([row.name for row, *_ in values], version, raised)
        rows = [f"# {line}" for line in title.splitlines()]
        if profile is None:
            rows.append("# select the PID profile that flew first: the log does not name it")
        else:
            rows.append(f"profile {profile}")
        if version >= (4, 3) and not all(name.startswith("adrc_") for name in names):
            # Sliders that stay on would rewrite what is set here.
            rows.append("set simplified_pids_mode = OFF")
            for part in ("gyro", "dterm"):
                if any(row.name.startswith(f"{part}_lpf") for row, *_ in values):
                    rows.append(f"set simplified_{part}_filter = OFF")
        for name, (row, value, other) in zip(names, values, strict=True):
            rows += [f"# {name} was {number_text(other, row.integer)}"]
            rows += [f"set {name} = {number_text(value, row.integer)}"]
        for name, word, other in words:
            rows += [f"# {name} was {other}", f"set {name} = {word}"]
        return joined_lines([*rows, "save"])


def _names_of(names: Sequence[str], version: tuple[int, ...], raised: Sequence[str]) -> list[str]:
    """The parameters as this version calls them."""
    adrc = [name for name in names if name.startswith("adrc_")]
    if adrc and version < (2026,):
        raise ValueError(
            f"{', '.join(adrc)} exist only in builds of pull request 15400: give their version."
        )
    if version >= (2025,):
        return list(names)
    older = {f"d_{axis}": f"d_min_{axis}" for axis in raised}
    older |= {f"d_max_{axis}": f"d_{axis}" for axis in raised}
    if version < (4, 5):
        older["angle_p_gain"] = "p_level"
    if version < (4, 3):
        for part in ("gyro", "dterm"):
            older[f"{part}_lpf1_dyn_min_hz"] = f"dyn_lpf_{part}_min_hz"
            older[f"{part}_lpf1_dyn_max_hz"] = f"dyn_lpf_{part}_max_hz"
            older[f"{part}_lpf1_static_hz"] = f"{part}_lowpass_hz"
            older[f"{part}_lpf2_static_hz"] = f"{part}_lowpass2_hz"
    return [older.get(name, name) for name in names]


FIRMWARE = Betaflight()
