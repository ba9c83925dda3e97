"""Betaflight: its parameters, channels, recipe and files."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxquad._core import as_messages, Message, Number
from jaxquad.identify import CurveFirmware
from jaxquad.records import AXES

from .._filters import betaflight_quality, Butterworth, Filter, FilterChain, Notch, PT1, PT2, PT3
from .._firmware import (
    Channels,
    cutoff_of,
    Firmware,
    joined_lines,
    LowPass,
    number_text,
    OuterLoop,
    Parameter,
    Range,
    rows_of_axes,
    Stage,
    Values,
    Words,
)
from .._law import DEGREES, FlownLoop
from ._betaflight_law import (
    BetaflightPID,
    D_SCALE,
    DMax,
    dynamic_cutoff,
    F_SCALE,
    I_SCALE,
    ItermRelax,
    P_SCALE,
    tpa_factor,
)
from ._betaflight_log import LOG


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


class FlownBetaflight(FlownLoop[BetaflightPID]):
    """Betaflight's rate loop of a log, with its dynamic cutoffs and TPA.

    **Arguments:** (those of `FlownLoop`, and)

    - `gyro_dynamic`, `dterm_dynamic`: lowest and highest cutoff in Hz and expo of the first
        low-pass of gyro and D; None where it is static.
    - `tpa`: tpa_rate in percent and the breakpoint's throttle.
    - `tpa_on_p`: whether TPA acts on P too.
    - `anti_gravity`: gain, cutoff in Hz and gain of P, see `surge`; None is off.
    - `windup`: of the mixer's range, above which the integral grows less; 1 is off.
    """

    gyro_dynamic: tuple[float, float, float] | None = eqx.field(static=True, default=None)
    dterm_dynamic: tuple[float, float, float] | None = eqx.field(static=True, default=None)
    tpa: tuple[float, float] = eqx.field(static=True, default=(0.0, 0.35))
    tpa_on_p: bool = eqx.field(static=True, default=False)
    anti_gravity: tuple[float, float, float] | None = eqx.field(static=True, default=None)
    windup: float = eqx.field(static=True, default=1.0)

    def parameters(self) -> dict[str, float]:
        """The values that flew, by the names of `PARAMETERS`, with the dynamic cutoffs."""
        flown = super().parameters()
        for name, cutoffs in (("gyro", self.gyro_dynamic), ("dterm", self.dterm_dynamic)):
            if cutoffs is not None:
                flown[f"{name}_lpf1_dyn_min_hz"], flown[f"{name}_lpf1_dyn_max_hz"] = cutoffs[:2]
        return flown

    def at(
        self,
        throttle: Float[ArrayLike, "..."],
        *,
        surge: Float[ArrayLike, "..."] = 0.0,
        integral_share: Float[ArrayLike, "..."] = 1.0,
    ) -> BetaflightPID:
        """The law at a throttle of 0 to 1: its dynamic cutoffs and TPA, and anti-gravity's part."""
        law, factor = self.law, tpa_factor(throttle, *self.tpa)
        filters = _retuned(law.filters, self.gyro_dynamic, throttle)
        dterm = _retuned(law.dterm, self.dterm_dynamic, throttle)
        on_p = factor if self.tpa_on_p else jnp.ones_like(factor)
        of_level = jnp.where(jnp.asarray(law.integral_factor) == 1, 1.0, 0.0)  # not of yaw
        boost = 0.0 if self.anti_gravity is None else _SURGED_P * self.anti_gravity[2] / 100
        return dataclasses.replace(
            law, filters=filters, dterm=dterm, tpa=factor, tpa_p=on_p,
            accelerator=_SURGED_I * surge * of_level, p_boost=boost * surge * of_level,
            integral_share=integral_share,
        )  # fmt: skip

    def without_gyro_filters(self) -> "FlownBetaflight":
        law = self.law.without_gyro_filters()
        return dataclasses.replace(self, law=law, gyro_dynamic=None)

    def at_sample(self, throttle: Array, surge: Array, integral_share: Array) -> BetaflightPID:
        return self.at(throttle, surge=surge, integral_share=integral_share)

    def surge(self, throttle: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
        from scipy.signal import lfilter

        if self.anti_gravity is None:
            return np.zeros_like(throttle)
        gain, cutoff, _ = self.anti_gravity
        change = np.diff(throttle, prepend=throttle[:1])
        moved = np.abs(change) / self.law.dt * (1 - throttle) ** 2
        moved = np.where(change > 0, 0.5 * (1 - throttle), 1.0) * moved
        for section in PT2(cutoff).sections(1 / self.law.dt):
            pole = [1.0, float(np.asarray(section.a1))]
            moved = lfilter([float(np.asarray(section.b0))], pole, moved)
        return gain * np.asarray(moved)

    def integral_share(
        self, mixer_range: Float[np.ndarray, " samples"]
    ) -> Float[np.ndarray, " samples"]:
        if self.windup >= 1:
            return np.ones_like(mixer_range)
        return np.clip((1 - mixer_range) / (1 - self.windup), 0.0, 1.0)

    def setpoint_speed(
        self, slope: Float[np.ndarray, "samples axes"], fed: Float[np.ndarray, "samples axes"]
    ) -> Float[np.ndarray, "samples axes"]:
        """By the logged F where that has a gain: it is of the sticks, between their samples."""
        weight = np.broadcast_to(F_SCALE * DEGREES * np.asarray(self.law.f), slope.shape[1:])
        weighted = weight > 0
        scaled = fed / np.where(weighted, weight, 1.0)
        return np.where(weighted, scaled, np.where(np.any(fed, axis=0), slope, 0.0))


_SURGED_I, _SURGED_P = 0.34, 0.0034  # what anti-gravity's measure adds to Ki, and to P per percent


def _retuned(
    filters: tuple[Filter, ...],
    range: tuple[float, float, float] | None,
    throttle: Float[ArrayLike, "..."],
) -> tuple[Filter, ...]:
    """The filters with the first one's cutoff at a throttle; None leaves it."""
    if range is None or not isinstance(filters[0], PT1 | PT2 | PT3 | Butterworth):
        return filters
    cutoff = dynamic_cutoff(throttle, *range)
    return (dataclasses.replace(filters[0], cutoff_hz=cutoff), *filters[1:])


def betaflight_loop(
    values: Mapping[str, str], version: Sequence[int], *, throttle: float = 0.3
) -> FlownBetaflight:
    """The rate loop of a Betaflight header.

    Until 4.5 a profile's D is the maximum and d_min the base; from 2025.12 on D is the base.

    **Arguments:**

    - `values`: the header's lines by name, `jq.records.read_settings(path).values`.
    - `version`: of the firmware, (4, 2, 0).
    - `throttle`: 0 to 1, at which the cutoffs of `law` are.

    **Raises:**

    - `ValueError`: the header lacks a gain or the loop's rate.
    """
    read = _Header(values, tuple(version))
    looptime, denominator = read.number("looptime"), read.number("pid_process_denom", default=1.0)
    dt = 1e-6 * looptime * denominator
    gains = np.array([read.numbers(f"{axis}PID") for axis in ("roll", "pitch", "yaw")]).T
    base, ceiling = read.damping(gains[2])
    gyro, gyro_dynamic = read.low_pass(_GYRO_LOW_PASS, 1 / dt)
    dterm, dterm_dynamic = read.low_pass(_DTERM_LOW_PASS, 1 / dt)
    limit = read.number("pidsum_limit", default=500.0)
    limit_yaw = read.number("pidsum_limit_yaw", default=400.0)
    limits = np.array([limit, limit, limit_yaw])
    law = BetaflightPID(
        p=gains[0], i=gains[1], d=base,
        f=read.numbers("feedforward_weight", "ff_weight", default=(0.0, 0.0, 0.0)),
        gyro=FilterChain(read.second_low_pass(_GYRO_SECOND), 1e6 / looptime),
        filters=(*gyro, *read.notches("gyro_notch_hz", "gyro_notch_cutoff")),
        dterm=(
            *dterm, *read.second_low_pass(_DTERM_SECOND),
            *read.notches("dterm_notch_hz", "dterm_notch_cutoff"),
        ),
        integral_factor=[1.0, 1.0, 2.5],
        p_lowpass_hz=[0.0, 0.0, read.number("yaw_lowpass_hz", default=0.0)],
        f_share=1.0 if read.number("feedforward_transition", default=0.0) == 0 else 0.0,
        relax=read.relax(), d_max=read.d_max(base, ceiling), limit=limits,
        integral_limit=read.windup(80.0) * limits if read.version >= (2025,) else 400.0, dt=dt,
    )  # fmt: skip
    start = read.number("tpa_breakpoint", default=1350.0)
    flown = FlownBetaflight(
        law, read.unmodelled(), gyro_dynamic, dterm_dynamic,
        (read.number("tpa_rate", default=0.0), (start - 1000) / 1000),
        read.number("tpa_mode", default=1.0) == 0, read.anti_gravity(),
        1.0 if read.version >= (2025,) else read.windup(85.0),
    )  # fmt: skip
    return dataclasses.replace(flown, law=flown.at(throttle))


def betaflight_low_passes(
    values: Mapping[str, str], version: Sequence[int], throttle: float
) -> Iterator[LowPass]:
    """The low-passes of a header that are on, at a throttle of 0 to 1."""
    read = _Header(values, tuple(version))
    looptime, denominator = read.number("looptime"), read.number("pid_process_denom", default=1.0)
    gyro_hz, loop_hz = 1e6 / looptime, 1e6 / looptime / denominator
    stages: tuple[tuple[Stage, str, tuple, tuple, float], ...] = (
        ("gyro", "gyro", _GYRO_LOW_PASS, _GYRO_SECOND, gyro_hz),
        ("derivative", "dterm", _DTERM_LOW_PASS, _DTERM_SECOND, loop_hz),
    )
    for stage, name, first, second, rate in stages:
        filters, dynamic = read.low_pass(first, loop_hz)
        for low_pass in _retuned(filters, dynamic, throttle):
            ends = (
                {f"{name}_lpf1_static_hz": cutoff_of(low_pass)} if dynamic is None
                else {f"{name}_lpf1_dyn_min_hz": dynamic[0], f"{name}_lpf1_dyn_max_hz": dynamic[1]}
            )  # fmt: skip
            yield LowPass(stage, ends, low_pass, loop_hz)
        for low_pass in read.second_low_pass(second):
            yield LowPass(stage, {f"{name}_lpf2_static_hz": cutoff_of(low_pass)}, low_pass, rate)


_GYRO_LOW_PASS = (
    ("gyro_lpf1_static_hz", "gyro_lowpass_hz"),
    ("gyro_lpf1_dyn_hz", "gyro_lowpass_dyn_hz"),
    ("gyro_lpf1_type", "gyro_lowpass_type"),
    "gyro_lpf1_dyn_expo",
)
_DTERM_LOW_PASS = (
    ("dterm_lpf1_static_hz", "dterm_lowpass_hz"),
    ("dterm_lpf1_dyn_hz", "dterm_lowpass_dyn_hz"),
    ("dterm_lpf1_type", "dterm_filter_type"),
    "dterm_lpf1_dyn_expo",
)
_GYRO_SECOND = (
    ("gyro_lpf2_static_hz", "gyro_lowpass2_hz"),
    ("gyro_lpf2_type", "gyro_lowpass2_type"),
)
_DTERM_SECOND = (
    ("dterm_lpf2_static_hz", "dterm_lowpass2_hz"),
    ("dterm_lpf2_type", "dterm_filter2_type"),
)
_TYPES = {0: PT1, 1: Butterworth, 2: PT2, 3: PT3}


def flies_adrc(values: Mapping[str, str]) -> bool:
    """Whether a Betaflight header is of a flight with the proposed ADRC: pid_type is 1.

    **Arguments:**

    - `values`: the header's lines by name, `jq.records.read_settings(path).values`.
    """
    return values.get("pid_type", "0").strip().upper() in ("1", "ADRC")


class _Header:
    """Numbers of a Betaflight header, whatever the version calls them."""

    def __init__(self, values: Mapping[str, str], version: tuple[int, ...]):
        self.values, self.version = values, version

    def numbers(self, *names: str, default: Sequence[float] | None = None) -> list[float]:
        for name in names:
            if name in self.values:
                return [float(x) for x in self.values[name].split(",")]
        if default is None:
            raise ValueError(
                f"the header has no line {names[0]!r}: is it the beginning of a Betaflight log?"
            )
        return list(default)

    def number(self, *names: str, default: float | None = None) -> float:
        return self.numbers(*names, default=None if default is None else (default,))[0]

    def low_pass(
        self, names: tuple, rate_hz: float
    ) -> tuple[tuple[Filter, ...], tuple[float, float, float] | None]:
        """The first low-pass, and its dynamic range."""
        static, dynamic, kind, expo = names
        kind = _TYPES[int(self.number(*kind, default=0.0))]
        low, high = self.numbers(*dynamic, default=(0.0, 0.0))
        if low > 0 and high > low:
            curve = self.number(expo, default=5.0 if self.version >= (4, 3) else 0.0)
            return (kind(low),), (low, high, curve)
        cutoff = self.number(*static, default=0.0)
        return ((kind(cutoff),) if cutoff > 0 else ()), None

    def second_low_pass(self, names: tuple) -> tuple[Filter, ...]:
        cutoff = self.number(*names[0], default=0.0)
        return (_TYPES[int(self.number(*names[1], default=0.0))](cutoff),) if cutoff > 0 else ()

    def notches(self, centres: str, cutoffs: str) -> tuple[Filter, ...]:
        pairs = zip(
            self.numbers(centres, default=()), self.numbers(cutoffs, default=()), strict=False
        )
        return tuple(Notch(f, betaflight_quality(f, low)) for f, low in pairs if f > low > 0)

    def damping(self, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """D of the base and its maximum."""
        if self.version >= (2025,):
            ceiling = np.array(self.numbers("d_max", default=(0.0, 0.0, 0.0)))
            return d, np.maximum(d, ceiling)
        low = np.array(self.numbers("d_min", default=(0.0, 0.0, 0.0)))
        return np.where((low > 0) & (low < d), low, d), d

    def d_max(self, base: np.ndarray, ceiling: np.ndarray) -> DMax | None:
        if not np.any((ceiling > base) & (base > 0)):
            return None
        gain = self.number("d_max_gain", "d_min_gain", default=0.0)
        advance = self.number("d_max_advance", "d_min_advance", default=0.0)
        if self.version < (4, 3):
            early = (Butterworth(80.0),), (PT1(10.0),)
            return DMax(ceiling, 5e-5 * gain / 10, 5e-5 * gain * advance / 1000, *early)
        by_gain = 1.0 if self.version >= (2025,) else gain / 100
        return DMax(ceiling, 8e-5 * gain / 35, 8e-5 * advance * by_gain / 35)

    def windup(self, default: float) -> float:
        """Of 1; 0 in the header is off."""
        return (self.number("iterm_windup", default=default) or 100.0) / 100

    def anti_gravity(self) -> tuple[float, float, float] | None:
        """Gain, cutoff and gain of P; versions before 4.4 have another law."""
        on = int(self.number("features", default=float(1 << 28))) & 1 << 28
        gain = self.number("anti_gravity_gain", default=0.0)
        if self.version < (4, 4) or not on or gain == 0:
            return None
        cutoff = self.number("anti_gravity_cutoff_hz", default=5.0)
        return gain, cutoff, self.number("anti_gravity_p_gain", default=100.0)

    def relax(self) -> ItermRelax | None:
        mode = int(self.number("iterm_relax", default=0.0))
        if mode == 0:
            return None
        kind = "setpoint" if self.number("iterm_relax_type", default=1.0) == 1 else "gyro"
        share = [1.0, 1.0, 1.0 if mode in (2, 4) else 0.0]
        cutoff = self.number("iterm_relax_cutoff", default=15.0)
        return ItermRelax(cutoff, 40.0, share, kind, mode in (3, 4))

    def unmodelled(self) -> tuple[Message, ...]:
        left_out: list[str] = []
        if self.version < (4, 4):
            text = "anti-gravity: the integral grows faster while the throttle moves"
            left_out.append(Message(text, "anti-gravity"))
        harmonics = self.number("rpm_filter_harmonics", "gyro_rpm_notch_harmonics", default=0.0)
        if harmonics > 0:
            text = f"{harmonics:g} RPM notches per motor on the gyro: they follow the motors"
            left_out.append(Message(text, "notch"))
        if self.number("dyn_notch_count", "dyn_notch_q", default=0.0) > 0:
            left_out.append(
                Message("dynamic notches on the gyro: they follow its spectrum", "notch")
            )
        if (transition := self.number("feedforward_transition", default=0.0)) > 0:
            text = (
                f"feedforward_transition {transition:g}: F grows with the sticks' deflection; the "
                "law is that of centred sticks, without F"
            )
            left_out.append(Message(text, "feedforward"))
        for name, words in _UNUSUAL.items():
            if self.number(name, default=0.0) > 0:
                left_out.append(f"{name}: {words}")
        return as_messages(left_out)


_UNUSUAL = {
    "abs_control_gain": "absolute control moves the set-point",
    "use_integrated_yaw": "the yaw command is integrated",
    "dterm_rpm_notch_harmonics": "RPM notches on the D term",
    "acc_limit": "the set-point's acceleration is limited",
    "tpa_curve_type": "TPA is hyperbolic; the law has the straight one",
    "iterm_rotation": "the integrals turn with the vehicle",
}


FIRMWARE = Betaflight()
