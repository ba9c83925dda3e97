"""The loop that a log's parameters describe, for Betaflight, PX4 and ArduPilot."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Generic, Literal, NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from jaxquad._core import as_messages, Message

from ._filters import (
    BandwidthNotch,
    betaflight_quality,
    Butterworth,
    Filter,
    FilterChain,
    Notch,
    PT1,
    PT2,
    PT3,
)
from ._parameters import list_parameters
from .ardupilot._harmonic_notch import HarmonicNotch, read_harmonic_notches, Tracking
from .ardupilot._law import ArduPilotRate
from .betaflight._law import (
    BetaflightADRC,
    BetaflightPID,
    DMax,
    dynamic_cutoff,
    ItermRelax,
    tpa_factor,
)
from .px4._firmware import PX4Rate


RateLaw = TypeVar("RateLaw", BetaflightPID, BetaflightADRC, PX4Rate, ArduPilotRate)


class FlownLoop(eqx.Module, Generic[RateLaw]):
    """The rate loop of a log, for roll, pitch and yaw, and what of it is not modelled.

    **Arguments:**

    - `law`: the rate loop at hover (for Betaflight, with throttle-dependent cutoffs at 30 %).
    - `unmodelled`: sentences; their kind is "notch", "anti-gravity", "feedforward" or empty.
    """

    law: RateLaw
    unmodelled: tuple[Message, ...] = eqx.field(static=True, default=())

    def parameters(self) -> dict[str, float]:
        """The values that flew, by the names of `PARAMETERS`."""
        return list_parameters(self.law)


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
        found = list_parameters(self.law)
        for name, range in (("gyro", self.gyro_dynamic), ("dterm", self.dterm_dynamic)):
            if range is not None:
                found[f"{name}_lpf1_dyn_min_hz"], found[f"{name}_lpf1_dyn_max_hz"] = range[:2]
        return found

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
        held = jnp.where(jnp.asarray(law.integral_factor) == 1, 1.0, 0.0)  # not of yaw
        boost = 0.0 if self.anti_gravity is None else _SURGED_P * self.anti_gravity[2] / 100
        return dataclasses.replace(
            law, filters=filters, dterm=dterm, tpa=factor, tpa_p=on_p,
            accelerator=_SURGED_I * surge * held, p_boost=boost * surge * held,
            integral_share=integral_share,
        )  # fmt: skip

    def surge(self, throttle: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
        """Anti-gravity's measure of a moving throttle times its gain, at the loop's samples."""
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
        """Of what the integral grows by, while the motors use this share of the mixer's range."""
        if self.windup >= 1:
            return np.ones_like(mixer_range)
        return np.clip((1 - mixer_range) / (1 - self.windup), 0.0, 1.0)


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


class FlownLowPass(NamedTuple):
    """A low-pass of Betaflight's gyro or D term that is on, with what sets its cutoff, in Hz."""

    stage: Literal["gyro", "derivative"]
    parameters: Mapping[str, float]  # lowest and highest cutoff of a dynamic one
    filter: Filter
    rate_hz: float


def betaflight_low_passes(
    values: Mapping[str, str], version: Sequence[int], *, throttle: float = 0.3
) -> tuple[FlownLowPass, ...]:
    """The low-passes of a Betaflight header that are on, at a throttle of 0 to 1."""
    read = _Header(values, tuple(version))
    looptime, denominator = read.number("looptime"), read.number("pid_process_denom", default=1.0)
    gyro_hz, loop_hz = 1e6 / looptime, 1e6 / looptime / denominator
    found: list[FlownLowPass] = []
    stages: tuple[tuple[Literal["gyro", "derivative"], str, tuple, tuple, float], ...] = (
        ("gyro", "gyro", _GYRO_LOW_PASS, _GYRO_SECOND, gyro_hz),
        ("derivative", "dterm", _DTERM_LOW_PASS, _DTERM_SECOND, loop_hz),
    )
    for stage, name, first, second, rate in stages:
        filters, dynamic = read.low_pass(first, loop_hz)
        for each in _retuned(filters, dynamic, throttle):
            ends = (
                {f"{name}_lpf1_static_hz": _cutoff(each)} if dynamic is None
                else {f"{name}_lpf1_dyn_min_hz": dynamic[0], f"{name}_lpf1_dyn_max_hz": dynamic[1]}
            )  # fmt: skip
            found.append(FlownLowPass(stage, ends, each, loop_hz))
        for each in read.second_low_pass(second):
            found.append(FlownLowPass(stage, {f"{name}_lpf2_static_hz": _cutoff(each)}, each, rate))
    return tuple(found)


def _cutoff(low_pass: Filter) -> float:
    return float(np.ravel(vars(low_pass)["cutoff_hz"])[0])


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
        found: list[str] = []
        if self.version < (4, 4):
            text = "anti-gravity: the integral grows faster while the throttle moves"
            found.append(Message(text, "anti-gravity"))
        harmonics = self.number("rpm_filter_harmonics", "gyro_rpm_notch_harmonics", default=0.0)
        if harmonics > 0:
            text = f"{harmonics:g} RPM notches per motor on the gyro: they follow the motors"
            found.append(Message(text, "notch"))
        if self.number("dyn_notch_count", "dyn_notch_q", default=0.0) > 0:
            found.append(Message("dynamic notches on the gyro: they follow its spectrum", "notch"))
        if (transition := self.number("feedforward_transition", default=0.0)) > 0:
            text = (
                f"feedforward_transition {transition:g}: F grows with the sticks' deflection; the "
                "law is that of centred sticks, without F"
            )
            found.append(Message(text, "feedforward"))
        for name, words in _UNUSUAL.items():
            if self.number(name, default=0.0) > 0:
                found.append(f"{name}: {words}")
        return as_messages(found)


_UNUSUAL = {
    "abs_control_gain": "absolute control moves the set-point",
    "use_integrated_yaw": "the yaw command is integrated",
    "dterm_rpm_notch_harmonics": "RPM notches on the D term",
    "acc_limit": "the set-point's acceleration is limited",
    "tpa_curve_type": "TPA is hyperbolic; the law has the straight one",
    "iterm_rotation": "the integrals turn with the vehicle",
}


def px4_loop(values: Mapping[str, str], *, gyro_rate_hz: float = 8000.0) -> FlownLoop[PX4Rate]:
    """The rate loop of PX4's parameters.

    **Arguments:**

    - `values`: the parameters by name.
    - `gyro_rate_hz`: at which the gyro's filters run, which no parameter says; it is rounded to a
        multiple of the loop's.

    **Raises:**

    - `ValueError`: a gain is missing.
    """
    read = _Parameters(values)
    rate = read.number("IMU_GYRO_RATEMAX", 400.0) or 400.0
    chain: list[Filter] = []
    for k in (0, 1):
        centre = read.number(f"IMU_GYRO_NF{k}_FRQ", 0.0)
        if centre > 0:
            chain.append(BandwidthNotch(centre, read.number(f"IMU_GYRO_NF{k}_BW", 20.0)))
    cutoff = read.number("IMU_GYRO_CUTOFF", 40.0)
    chain += [Butterworth(cutoff)] if cutoff > 0 else []
    per_axis = lambda end: [read.number(f"MC_{x}RATE_{end}") for x in ("ROLL", "PITCH", "YAW")]
    law = PX4Rate(
        p=per_axis("P"), i=per_axis("I"), d=per_axis("D"),
        k=[read.number(f"MC_{x}RATE_K", 1.0) for x in ("ROLL", "PITCH", "YAW")],
        ff=[read.number(f"MC_{x}RATE_FF", 0.0) for x in ("ROLL", "PITCH", "YAW")],
        gyro=FilterChain(tuple(chain), rate * max(1, round(gyro_rate_hz / rate))),
        derivative_hz=read.number("IMU_DGYRO_CUTOFF", 20.0),
        torque_hz=[0.0, 0.0, read.number("MC_YAW_TQ_CUTOFF", 0.0)],
        integral_limit=[read.number(f"MC_{x}R_INT_LIM", 0.3) for x in "RPY"], dt=1 / rate,
    )  # fmt: skip
    unmodelled = []
    if read.number("IMU_GYRO_DNF_EN", 0.0) > 0:
        text = "IMU_GYRO_DNF_EN: dynamic notches follow motors or spectrum"
        unmodelled.append(Message(text, "notch"))
    if read.number("MC_BAT_SCALE_EN", 0.0) > 0:
        text = "MC_BAT_SCALE_EN: the torque is scaled by the battery's voltage"
        unmodelled.append(Message(text))
    return FlownLoop(law, tuple(unmodelled))


class FlownArduPilot(FlownLoop[ArduPilotRate]):
    """ArduPilot's rate loop of a log, with the notches that follow the throttle.

    **Arguments:** (those of `FlownLoop`, and)

    - `tracking`: which of the gyro's filters follow the throttle, and how.
    """

    tracking: tuple[Tracking, ...] = eqx.field(static=True, default=())

    def at(self, throttle: Float[ArrayLike, "..."]) -> ArduPilotRate:
        """The law at a throttle of 0 to 1: where its notches are."""
        filters = list(self.law.gyro.filters)
        for each in self.tracking:
            notch = filters[each.place]
            assert isinstance(notch, HarmonicNotch)
            filters[each.place] = dataclasses.replace(notch, centre_hz=each.centre_hz(throttle))
        chain = FilterChain(tuple(filters), self.law.gyro.rate_hz)
        return dataclasses.replace(self.law, gyro=chain)


def ardupilot_loop(
    values: Mapping[str, str],
    *,
    throttle: float = 0.3,
    tracked_hz: Mapping[int, Sequence[float]] | None = None,
) -> FlownArduPilot:
    """The rate loop of ArduPilot's parameters (Copter).

    **Arguments:**

    - `values`: the parameters by name. The gyro's rate is rounded up to a multiple of the loop's.
    - `throttle`: 0 to 1 of the mixer (`RATE.AOut`), where notches are that follow it.
    - `tracked_hz`: what harmonic notches follow that go by an RPM sensor (2, 5), ESC telemetry (3)
        or the gyro's spectrum (4), in Hz: by INS_HNTCH_MODE, with a number for each source.

    **Raises:**

    - `ValueError`: a gain is missing.
    """
    read = _Parameters(values)
    rate = read.number("SCHED_LOOP_RATE", 400.0)
    gyro_rate = 1000.0 * 2 ** read.number("INS_GYRO_RATE", 0.0)
    gyro_rate = rate * max(1, math.ceil(gyro_rate / rate - 1e-9))
    per_axis = lambda end, default=None: [
        read.number(f"ATC_RAT_{x}_{end}", default) for x in ("RLL", "PIT", "YAW")
    ]
    limit = np.array(per_axis("PDMX", 0.0))
    cutoff = read.number("INS_GYRO_FILTER", 20.0)
    notches = read_harmonic_notches(read.number, tracked_hz or {})
    low_pass = (Butterworth(cutoff),) if cutoff > 0 else ()
    law = ArduPilotRate(
        p=per_axis("P"), i=per_axis("I"), d=per_axis("D"), ff=per_axis("FF", 0.0),
        d_ff=per_axis("D_FF", 0.0), gyro=FilterChain((*notches.filters, *low_pass), gyro_rate),
        target_hz=per_axis("FLTT", 20.0), error_hz=per_axis("FLTE", 0.0),
        derivative_hz=per_axis("FLTD", 20.0), integral_limit=per_axis("IMAX", 0.5),
        pd_limit=np.where(limit > 0, limit, np.inf), dt=1 / rate,
    )  # fmt: skip
    switched = {
        **{f"ATC_RAT_{x}_SMAX": "the slew limiter lowers P and D" for x in ("RLL", "PIT", "YAW")},
        **{
            f"ATC_RAT_{x}_{n}": Message("a notch", "notch")
            for x in ("RLL", "PIT", "YAW")
            for n in ("NTF", "NEF")
        },
        "FSTRATE_ENABLE": "the rate loop runs faster than SCHED_LOOP_RATE",
    }
    found = [
        Message(f"{name}: {what}", Message(what).kind)
        for name, what in switched.items()
        if read.number(name, 0.0) > 0
    ]
    flown = FlownArduPilot(law, (*found, *notches.unmodelled), notches.tracking)
    return dataclasses.replace(flown, law=flown.at(throttle))


class _Parameters:
    """Numbers by their names."""

    def __init__(self, values: Mapping[str, str]):
        self.values = values

    def number(self, name: str, default: float | None = None) -> float:
        if name in self.values:
            return float(self.values[name])
        if default is None:
            raise ValueError(
                f"the log has no parameter {name}: log the parameters of the autopilot."
            )
        return default
