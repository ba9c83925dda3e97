"""Betaflight: its parameters, channels, recipe and files."""

import dataclasses
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxquad._core import Message
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
    RecipeOption,
    rows_of_axes,
    Stage,
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
    SMOOTH_HZ,
    tpa_factor,
)
from ._betaflight_log import BETAFLIGHT as LOG


Ends = tuple[float, float, float]  # of a dynamic cutoff: lowest and highest in Hz, expo
Ratio = Float[ArrayLike, "..."]
Samples = Float[np.ndarray, " samples"]
Speeds = Float[np.ndarray, "samples axes"]


class FlownBetaflight(FlownLoop[BetaflightPID]):
    """Betaflight's rate loop of a log, with its dynamic cutoffs and TPA.

    **Arguments:** (those of `FlownLoop`, and)

    - `gyro_dynamic`, `dterm_dynamic`: lowest and highest cutoff in Hz and expo of the first
        low-pass of gyro and D; None where it is static.
    - `tpa`: tpa_rate in percent and the breakpoint's throttle.
    - `tpa_on_p`: whether TPA acts on P too.
    - `anti_gravity`: gain, cutoff in Hz and gain of P; None is off.
    - `windup`: of the mixer's range, above which the integral grows less; 1 is off.
    """

    gyro_dynamic: Ends | None = eqx.field(static=True, default=None)
    dterm_dynamic: Ends | None = eqx.field(static=True, default=None)
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
        self, throttle: Ratio, *, surge: Ratio = 0.0, integral_share: Ratio = 1.0
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

    def at_moment(self, *moment: Array) -> BetaflightPID:
        throttle, surge, integral_share = moment
        return self.at(throttle, surge=surge, integral_share=integral_share)

    def moments(
        self, throttle: Samples, before: Samples, mixer_range: Samples | None
    ) -> tuple[Samples, ...]:
        """Throttle, anti-gravity's measure of it times its gain, and of what the integral grows."""
        from scipy.signal import lfilter

        surge, share = np.zeros_like(before), np.ones_like(before)
        if self.anti_gravity is not None:
            gain, cutoff, _ = self.anti_gravity
            change = np.diff(throttle, prepend=throttle[:1])
            moved = np.abs(change) / self.law.dt * (1 - throttle) ** 2
            moved = np.where(change > 0, 0.5 * (1 - throttle), 1.0) * moved
            for section in PT2(cutoff).sections(1 / self.law.dt):
                pole = [1.0, float(np.asarray(section.a1))]
                moved = lfilter([float(np.asarray(section.b0))], pole, moved)
            surge = np.concatenate([[0.0], gain * np.asarray(moved)[:-1]])
        if mixer_range is not None and self.windup < 1:
            share = np.clip((1 - mixer_range) / (1 - self.windup), 0.0, 1.0)
        return before, surge, share

    def setpoint_speed(self, slope: Speeds, fed: Speeds) -> Speeds:
        """By the logged F where that has a gain: it is of the sticks, between their samples."""
        weight = np.broadcast_to(F_SCALE * DEGREES * np.asarray(self.law.f), slope.shape[1:])
        weighted = weight > 0
        scaled = fed / np.where(weighted, weight, 1.0)
        return np.where(weighted, scaled, np.where(np.any(fed, axis=0), slope, 0.0))


_SURGED_I, _SURGED_P = 0.34, 0.0034  # what anti-gravity's measure adds to Ki, and to P per percent


def _retuned(filters: tuple[Filter, ...], ends: Ends | None, throttle: Ratio) -> tuple[Filter, ...]:
    """The filters with the first one's cutoff at a throttle; None leaves it."""
    if ends is None or not filters or not isinstance(filters[0], PT1 | PT2 | PT3 | Butterworth):
        return filters
    cutoff = dynamic_cutoff(throttle, *ends)
    return (dataclasses.replace(filters[0], cutoff_hz=cutoff), *filters[1:])


_OLDER = {  # names of lines of a header, and what versions before 4.3 or 4.5 call them
    "gyro_lpf1_static_hz": "gyro_lowpass_hz", "gyro_lpf1_dyn_hz": "gyro_lowpass_dyn_hz",
    "gyro_lpf1_type": "gyro_lowpass_type", "gyro_lpf2_static_hz": "gyro_lowpass2_hz",
    "gyro_lpf2_type": "gyro_lowpass2_type", "dterm_lpf1_static_hz": "dterm_lowpass_hz",
    "dterm_lpf1_dyn_hz": "dterm_lowpass_dyn_hz", "dterm_lpf1_type": "dterm_filter_type",
    "dterm_lpf2_static_hz": "dterm_lowpass2_hz", "dterm_lpf2_type": "dterm_filter2_type",
    "feedforward_weight": "ff_weight", "d_max_gain": "d_min_gain",
    "d_max_advance": "d_min_advance", "rpm_filter_harmonics": "gyro_rpm_notch_harmonics",
    "dyn_notch_count": "dyn_notch_q",
}  # fmt: skip
_TYPES = {0: PT1, 1: Butterworth, 2: PT2, 3: PT3}
_UNUSUAL = {
    "abs_control_gain": "absolute control moves the set-point",
    "use_integrated_yaw": "the yaw command is integrated",
    "dterm_rpm_notch_harmonics": "RPM notches on the D term",
    "acc_limit": "the set-point's acceleration is limited",
    "tpa_curve_type": "TPA is hyperbolic; the law has the straight one",
    "iterm_rotation": "the integrals turn with the vehicle",
}


class _Header:
    """Numbers of a Betaflight header, whatever the version calls them."""

    def __init__(self, values: Mapping[str, str], version: Sequence[int]):
        self.values, self.version = values, tuple(version)

    def numbers(self, name: str, default: Sequence[float] | None = None) -> list[float]:
        line = name if name in self.values else _OLDER.get(name, name)
        if line in self.values:
            return [float(x) for x in self.values[line].split(",")]
        if default is None:
            raise ValueError(
                f"the header has no line {name!r}: is it the beginning of a Betaflight log?"
            )
        return list(default)

    def number(self, name: str, default: float | None = None) -> float:
        return self.numbers(name, None if default is None else (default,))[0]

    def low_pass(self, name: str) -> tuple[tuple[Filter, ...], Ends | None]:
        """The low-pass "gyro_lpf1", "dterm_lpf2" and so on, and between which ends it moves."""
        kind = lambda hertz: _TYPES[int(self.number(f"{name}_type", 0.0))](hertz)
        low, high = self.numbers(f"{name}_dyn_hz", (0.0, 0.0))
        if low > 0 and high > low:
            expo = self.number(f"{name}_dyn_expo", 5.0 if self.version >= (4, 3) else 0.0)
            return (kind(low),), (low, high, expo)
        cutoff = self.number(f"{name}_static_hz", 0.0)
        return ((kind(cutoff),) if cutoff > 0 else ()), None

    def notches(self, name: str) -> tuple[Filter, ...]:
        ends = (self.numbers(f"{name}_{end}", ()) for end in ("hz", "cutoff"))
        pairs = zip(*ends, strict=False)
        return tuple(Notch(f, betaflight_quality(f, low)) for f, low in pairs if f > low > 0)

    def d_max(self, base: np.ndarray, ceiling: np.ndarray) -> DMax | None:
        if not np.any((ceiling > base) & (base > 0)):
            return None
        gain, advance = self.number("d_max_gain", 0.0), self.number("d_max_advance", 0.0)
        if self.version < (4, 3):
            early = (Butterworth(80.0),), (PT1(10.0),)
            return DMax(ceiling, 5e-5 * gain / 10, 5e-5 * gain * advance / 1000, *early)
        by_gain = 1.0 if self.version >= (2025,) else gain / 100
        return DMax(ceiling, 8e-5 * gain / 35, 8e-5 * advance * by_gain / 35)

    def unmodelled(self) -> tuple[Message, ...]:
        harmonics = self.number("rpm_filter_harmonics", 0.0)
        transition = self.number("feedforward_transition", 0.0)
        said = {
            "anti-gravity: the integral grows faster while the throttle moves":
                (self.version < (4, 4), "anti-gravity"),
            f"{harmonics:g} RPM notches per motor on the gyro: they follow the motors":
                (harmonics > 0, "notch"),
            "dynamic notches on the gyro: they follow its spectrum":
                (self.number("dyn_notch_count", 0.0) > 0, "notch"),
            f"feedforward_transition {transition:g}: F grows with the sticks' deflection; the law "
            "is that of centred sticks, without F":
                (transition > 0, "feedforward"),
            **{f"{x}: {what}": (self.number(x, 0.0) > 0, "") for x, what in _UNUSUAL.items()},
        }  # fmt: skip
        return tuple(Message(text, kind) for text, (is_on, kind) in said.items() if is_on)


def betaflight_loop(
    values: Mapping[str, str], version: Sequence[int], *, throttle: float = 0.3
) -> FlownBetaflight:
    """The rate loop of a Betaflight header.

    Until 4.5 a profile's D is the maximum and d_min the base; from 2025.12 on D is the base.

    **Arguments:**

    - `values`: the header's lines by name, `jq.records.read_settings(path).values`.
    - `version`: of the firmware, (4, 2, 0).
    - `throttle`: 0 to 1, at which the cutoffs of `law` are.

    **Raises:** `ValueError`: the header lacks a gain or the loop's rate.
    """
    read = _Header(values, version)
    number, numbers, new = read.number, read.numbers, read.version >= (2025,)
    looptime, denominator = number("looptime"), number("pid_process_denom", 1.0)
    p, i, d = np.array([numbers(f"{axis}PID") for axis in AXES]).T
    bound = np.array(numbers("d_max" if new else "d_min", (0.0, 0.0, 0.0)))
    base = d if new else np.where((bound > 0) & (bound < d), bound, d)
    gyro, gyro_dynamic = read.low_pass("gyro_lpf1")
    dterm, dterm_dynamic = read.low_pass("dterm_lpf1")
    limit = number("pidsum_limit", 500.0)
    limits = np.array([limit, limit, number("pidsum_limit_yaw", 400.0)])
    mode, relax = int(number("iterm_relax", 0.0)), None
    if mode:
        kind = "setpoint" if number("iterm_relax_type", 1.0) == 1 else "gyro"
        share = [1.0, 1.0, 1.0 if mode in (2, 4) else 0.0]
        relax = ItermRelax(number("iterm_relax_cutoff", 15.0), 40.0, share, kind, mode in (3, 4))
    windup = (number("iterm_windup", 80.0 if new else 85.0) or 100.0) / 100  # 0 is off
    gravity = (
        number("anti_gravity_gain", 0.0), number("anti_gravity_cutoff_hz", 5.0),
        number("anti_gravity_p_gain", 100.0),
    )  # fmt: skip
    on = int(number("features", float(1 << 28))) & 1 << 28 and gravity[0] != 0
    law = BetaflightPID(
        p=p, i=i, d=base, f=numbers("feedforward_weight", (0.0, 0.0, 0.0)),
        gyro=FilterChain(read.low_pass("gyro_lpf2")[0], 1e6 / looptime),
        filters=(*gyro, *read.notches("gyro_notch")),
        dterm=(*dterm, *read.low_pass("dterm_lpf2")[0], *read.notches("dterm_notch")),
        integral_factor=[1.0, 1.0, 2.5], p_lowpass_hz=[0.0, 0.0, number("yaw_lowpass_hz", 0.0)],
        f_share=1.0 if number("feedforward_transition", 0.0) == 0 else 0.0, relax=relax,
        d_max=read.d_max(base, np.maximum(d, bound) if new else d), limit=limits,
        integral_limit=windup * limits if new else 400.0,
        dt=1e-6 * looptime * denominator,
    )  # fmt: skip
    tpa = number("tpa_rate", 0.0), (number("tpa_breakpoint", 1350.0) - 1000) / 1000
    flown = FlownBetaflight(
        law, read.unmodelled(), gyro_dynamic, dterm_dynamic, tpa, number("tpa_mode", 1.0) == 0,
        gravity if on and read.version >= (4, 4) else None,  # until 4.3 it is another law
        1.0 if new else windup,
    )  # fmt: skip
    return dataclasses.replace(flown, law=flown.at(throttle))


def flies_adrc(values: Mapping[str, str]) -> bool:
    """Whether a Betaflight header, as for `betaflight_loop`, is of a flight with the proposed ADRC.

    Its pid_type is 1.
    """
    return values.get("pid_type", "0").strip().upper() in ("1", "ADRC")


_FILTERS = {  # by name: the default, and where a header has it
    "gyro_lpf1_dyn_min_hz": (250, "gyro_lpf1_dyn_hz", 0),
    "gyro_lpf1_dyn_max_hz": (500, "gyro_lpf1_dyn_hz", 1),
    "gyro_lpf2_static_hz": (500, "gyro_lpf2_static_hz", 0),
    "dterm_lpf1_dyn_min_hz": (75, "dterm_lpf1_dyn_hz", 0),
    "dterm_lpf1_dyn_max_hz": (150, "dterm_lpf1_dyn_hz", 1),
    "dterm_lpf2_static_hz": (150, "dterm_lpf2_static_hz", 0),
    "gyro_lpf1_static_hz": (250, "gyro_lpf1_static_hz", 0),
    "dterm_lpf1_static_hz": (75, "dterm_lpf1_static_hz", 0),
    "gyro_notch1_hz": (0, "gyro_notch_hz", 0), "gyro_notch1_cutoff": (0, "gyro_notch_cutoff", 0),
    "gyro_notch2_hz": (0, "gyro_notch_hz", 1), "gyro_notch2_cutoff": (0, "gyro_notch_cutoff", 1),
}  # fmt: skip
_of = lambda start: [f"{start}_{axis}" for axis in AXES]
_BYTE, _WIDE = (0, 250), (0, 1000)
_ROWS = [
    *rows_of_axes(_of("p"), "", (45, 47, 45), _BYTE, "p", integer=True),
    *rows_of_axes(_of("i"), "", (80, 84, 80), _BYTE, "i", integer=True),
    *rows_of_axes(_of("d"), "", (30, 34, 0), _BYTE, "d", integer=True),
    *rows_of_axes(_of("f"), "", (120, 125, 120), _WIDE, "f", integer=True),
    *rows_of_axes(_of("d_max"), "", (40, 46, 0), _BYTE, "d_max.ceiling", integer=True),
    Parameter("angle_p_gain", "0.1/s", 50, 0, 200, True, "angle.level"),
    Parameter("thrust_linear", "%", 0, 0, 150, True),
    *(Parameter(name, "Hz", default, *_WIDE, True) for name, (default, *_) in _FILTERS.items()),
    *rows_of_axes(_of("adrc_wc"), "rad/s", (60, 60, 60), (5, 300), "wc", integer=True),
    *rows_of_axes(_of("adrc_wo"), "rad/s", (100, 100, 80), (10, 600), "wo", integer=True),
    *rows_of_axes(_of("adrc_b0"), "deg/s^3", (2000,) * 3, (100, 65535), "b0", integer=True),
    Parameter("adrc_gyro_lpf_hz", "Hz", 150, *_WIDE, True),
    Parameter("adrc_td_hz", "Hz", 0, *_WIDE, True),
    Parameter("adrc_hover_throttle", "%", 35, 5, 100, True),
    Parameter("adrc_sigma_decay", "0.1/s", 3, 0, 100, True),
]
_RECORDED = ("pids", "rc", "setpoint", "gyro", "gyrounfilt", "debug", "motors")
_CHIRP = {
    "debug_mode": "CHIRP", "blackbox_sample_rate": "1/4",
    **{f"blackbox_disable_{x}": "OFF" for x in _RECORDED},
    "chirp_lag_freq_hz": 3, "chirp_lead_freq_hz": 30, "chirp_frequency_start_deci_hz": 5,
    "chirp_frequency_end_deci_hz": 600, "chirp_time_seconds": 20,
}  # fmt: skip
_USUAL = {  # of the firmware, where that differs
    "debug_mode": "NONE", "chirp_frequency_start_deci_hz": 2, "chirp_frequency_end_deci_hz": 6000,
    "chirp_amplitude_roll": 230, "chirp_amplitude_pitch": 230, "chirp_amplitude_yaw": 180,
}  # fmt: skip
_AMPLITUDE = RecipeOption("amplitude", 150, 20, 300, "the amplitude of the chirp in deg/s")
_AUX = RecipeOption("switch", 4, 1, 14, "the AUX channel of the switch")
_SAME_LOOP = 0.05  # of the interval in the header


class Betaflight(Firmware):
    """Betaflight from 4.2 on, with the ADRC of its pull request 15400."""

    log = LOG
    parameters = {row.name: row for row in _ROWS}
    unit = "pidsum"
    suffix = "txt"
    follows_throttle = True
    thrust_curve = "thrust_linear"
    keeps_throttle = True
    notches = tuple((f"gyro_notch{k}_hz", f"gyro_notch{k}_cutoff") for k in (1, 2))
    words = True
    has_adrc = True
    no_ladrc = "its proposed ADRC (pull request 15400) is of the rate, not of the angle"

    def flown_loop(self, values, version, *, throttle, tracked_hz):
        return betaflight_loop(values, version, throttle=throttle)

    def channels(self, prefix: str, axis: int, values: Mapping[str, str]) -> Channels:
        number = lambda name, usual: float(values.get(name, usual))
        limit, usual = ("pidsum_limit_yaw", 400.0) if axis == 2 else ("pidsum_limit", 500.0)
        low, high = (float(x) for x in values.get("motorOutput", "48,2047").split(",")[:2])
        finer = number("blackbox_high_resolution", 0.0) > 0
        # The throttle before its boost; a limit of the throttle is another one.
        limited = number("throttle_limit_type", 0.0)
        return Channels(
            unfiltered=[f"{prefix}gyroUnfilt[{k}]" for k in range(3)],
            terms=[f"{prefix}axis{x}[{axis}]" for x in "PIDF"],
            motors=[f"{prefix}motor[{k}]" for k in range(8)], motor_ends=(low, high),
            output={f"{prefix}axisSum[{axis}]": 1.0}, output_limit=number(limit, usual),
            stick={} if limited else {f"{prefix}rcCommand[3]": 1.0}, stick_ends=(1000.0, 2000.0),
            mixed={f"{prefix}axisMixed[{axis}]": 1.0},
            resolution=(float(np.radians(0.1 if finer else 1.0)), 1.0),
        )  # fmt: skip

    def recipe(self, axes, *, amplitude=None, switch=None):
        amplitude, aux = _AMPLITUDE.choose(amplitude), int(_AUX.choose(switch))
        sizes = {f"chirp_amplitude_{x}": f"{amplitude * (x in axes):.0f}" for x in AXES}
        uses = [x if x in axes else f"{x} (not excited: 1 s is enough)" for x in AXES]
        last = max(map(AXES.index, axes))
        lines = lambda values, mode: [
            *(f"set {x} = {value}" for x, value in values.items()), f"aux 19 {mode} 0 0", "save",
        ]  # fmt: skip
        return self.make_recipe(
            axes, lines(_CHIRP | sizes, f"55 {aux - 1} 1700 2100"), lines(_USUAL, "0 0 900 900"),
            before="Betaflight 2025.12 or later, built with the option CHIRP. (With another one "
            "give strong and quick sticks in acro, one axis at a time, 20 s each.) Save the output "
            "of diff all. Select the PID profile to be tuned, then paste the lines into the CLI. "
            f"AUX {aux} and mode slot 19 have to be free. The log needs 1 kHz: where the PID loop "
            "runs below 4 kHz (see status), set blackbox_sample_rate to 1/2.",
            flight=f"in acro (ANGLE off). Hold the switch (AUX {aux}, mode CHIRP) for "
            f"{_CHIRP['chirp_time_seconds']} s, correct gently with the sticks, and release it to "
            "end. Each use takes the next axis, counted from power-on: "
            f"{', then '.join(uses[: last + 1])}.",
            abort="Release the switch: the chirp ends at once. The sticks work all the time.",
            after="Land, disarm and download the log. During a chirp debug[0], its phase, moves; "
            "from 2026.6 on debug[1] is the axis, 0 to 2, and debug[2] rises from 5 to 600 dHz.",
            log="flight.bbl",
        )  # fmt: skip

    def with_hold(self, values: Mapping[str, str], hold: float | None) -> Mapping[str, str]:
        if hold is None or "looptime" not in values:
            return values
        looptime = 1e6 * hold / float(values.get("pid_process_denom", 1.0))
        if abs(looptime / float(values["looptime"]) - 1) < _SAME_LOOP:
            return values
        return {**values, "looptime": f"{looptime:.6g}"}

    def angle_loop(self, values, axis, dt, *, levelled):
        level = values.get("levelPID", "").split(",")[0]
        if axis == 2 or not level:
            return None
        smooth = FilterChain((PT3(SMOOTH_HZ),), 1 / dt)
        flown = {"angle_p_gain": level}
        return OuterLoop.of(flown, "angle_p_gain", 0.1, 0.0, closed=levelled, smooth=smooth)

    def low_passes(self, loop, values, version, axis, throttle):
        read = _Header(values, version)
        gyro_hz = 1e6 / read.number("looptime")
        loop_hz = gyro_hz / read.number("pid_process_denom", 1.0)
        stages: tuple[tuple[Stage, str, float], ...] = (
            ("gyro", "gyro_lpf1", loop_hz), ("gyro", "gyro_lpf2", gyro_hz),
            ("derivative", "dterm_lpf1", loop_hz), ("derivative", "dterm_lpf2", loop_hz),
        )  # fmt: skip
        for stage, name, rate in stages:
            filters, ends = read.low_pass(name)
            for low_pass in _retuned(filters, ends, throttle):
                cutoffs = {f"{name}_static_hz": cutoff_of(low_pass)}
                if ends is not None:
                    cutoffs = {f"{name}_dyn_min_hz": ends[0], f"{name}_dyn_max_hz": ends[1]}
                yield LowPass(stage, cutoffs, low_pass, rate)

    def notch(self, centre_hz: float, half_width: float) -> tuple[float, Filter]:
        lower = float(np.rint((1 - half_width) * centre_hz))
        return lower, Notch(centre_hz, betaflight_quality(centre_hz, lower))

    def flown_notches(self, values: Mapping[str, str]) -> list[tuple[float, float]]:
        split = lambda name: [float(x) for x in values.get(name, "").split(",") if x]
        return list(zip(split("gyro_notch_hz"), split("gyro_notch_cutoff"), strict=False))

    def notch_rate_hz(self, loop: FlownLoop) -> float:
        return 1 / loop.law.dt

    def change_filters(self, values, parameters):
        changed = dict(values)
        for name, value in parameters.items():
            _, line, place = _FILTERS.get(name, (0, "", 0))
            line = line if line in changed else _OLDER.get(line, "")
            if line not in changed:
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

    def parameter_file(self, values, title, *, version, profile, raised, words):
        adrc = [row.name for row, *_ in values if row.name.startswith("adrc_")]
        if adrc and version < (2026,):
            raise ValueError(
                f"{', '.join(adrc)} exist only in builds of pull request 15400: give their version."
            )
        older: dict[str, str] = {}  # names of this version
        if version < (2025,):
            older |= {f"d_{axis}": f"d_min_{axis}" for axis in raised}
            older |= {f"d_max_{axis}": f"d_{axis}" for axis in raised}
        if version < (4, 5):
            older["angle_p_gain"] = "p_level"
        for part in ("gyro", "dterm") if version < (4, 3) else ():
            older[f"{part}_lpf1_dyn_min_hz"] = f"dyn_lpf_{part}_min_hz"
            older[f"{part}_lpf1_dyn_max_hz"] = f"dyn_lpf_{part}_max_hz"
            for name in (f"{part}_lpf1_static_hz", f"{part}_lpf2_static_hz"):
                older[name] = _OLDER[name]
        rows = [f"# {line}" for line in title.splitlines()]
        if profile is None:
            rows.append("# first select the PID profile that flew: the log does not name it")
        else:
            rows.append(f"profile {profile}")
        if version >= (4, 3) and len(adrc) < len(values):
            # Sliders that stay on would rewrite what is set here.
            rows.append("set simplified_pids_mode = OFF")
            for part in ("gyro", "dterm"):
                if any(row.name.startswith(f"{part}_lpf") for row, *_ in values):
                    rows.append(f"set simplified_{part}_filter = OFF")
        for row, value, flown in values:
            name = older.get(row.name, row.name)
            rows += [f"# the flight had {name} {number_text(flown, row.integer)}"]
            rows += [f"set {name} = {number_text(value, row.integer)}"]
        for name, word, flown in words:
            rows += [f"# the flight had {name} {flown}", f"set {name} = {word}"]
        return joined_lines([*rows, "save"])


FIRMWARE = Betaflight()
