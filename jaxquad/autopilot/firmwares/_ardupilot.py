"""ArduPilot (Copter): its rate and angle loops, notches, parameters, channels and files."""

import dataclasses
import itertools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from jaxquad._core import (
    as_float,
    broadcast_gain,
    is_concrete,
    Message,
    per_member,
    require_positive,
)
from jaxquad.control import Reference, Setpoint
from jaxquad.records import AXES

from .._filters import Butterworth, FilterChain, Notch, PT1, Section
from .._firmware import (
    Channels,
    Firmware,
    Numbers,
    OuterLoop,
    Parameter,
    RecipeOption,
    rows_of_axes,
)
from .._law import (
    Advance,
    AngleLoop,
    bounded,
    FlownLoop,
    Memories,
    RateLoop,
    Signal,
    split_reference,
)
from ._logs import ARDUPILOT as LOG


class ArduPilotRate(RateLoop):
    """ArduPilot's rate loop (AC_PID of Copter): rates in rad/s in, ROut of -1 to 1 out.

    The target is low-passed (FLTT), then the error (FLTE), then the derivative of the filtered
    error (FLTD), so the D term acts on the target too. The integral is used at once, and shrinks
    only where the mixer was limited at the last sample (`applied`). Not modelled: SMAX, notches of
    target and error, and the throttle's gain boost. Source: docs/autopilots.md.

    !!! example

        ```python
        law = ArduPilotRate(0.135, 0.135, 0.0036, gyro=FilterChain((Butterworth(20.0),), 2000.0))
        ```

    **Arguments:** (each number is a scalar, one value per axis, or `[axes, *ensemble]`)

    - `p`, `i`, `d`, `ff`, `d_ff`: ATC_RAT_xxx_P, _I, _D, _FF, _D_FF.
    - `gyro`: filters at the gyro's rate: harmonic notches and INS_GYRO_FILTER (20 Hz).
    - `target_hz`, `error_hz`, `derivative_hz`: _FLTT, _FLTE, _FLTD; 0 is off.
    - `integral_limit`: _IMAX; `pd_limit`: _PDMX, of |P + D|, inf is off.
    - `dt`: in s, 1/SCHED_LOOP_RATE.
    """

    firmware: ClassVar[str] = "ardupilot"
    feed_forward: ClassVar[tuple[str, ...]] = ("ff", "d_ff")
    limits: ClassVar[tuple[str, ...]] = (
        "target_hz", "error_hz", "derivative_hz", "integral_limit", "pd_limit",
    )  # fmt: skip
    p: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    i: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    d: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    ff: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    d_ff: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    gyro: FilterChain = FilterChain()
    target_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=20.0)
    error_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    derivative_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=20.0)
    integral_limit: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.5)
    pd_limit: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=float("inf"))
    dt: float = eqx.field(static=True, default=1 / 400)  # s

    def derivative_chain(self, axis: int) -> FilterChain:
        cutoff = float(np.broadcast_to(self.derivative_hz, (3,))[axis])
        return FilterChain((PT1(cutoff),) if cutoff > 0 else (), 1 / self.dt)

    def rest(self, zero: Signal) -> dict[str, PyTree]:
        signals = dict.fromkeys(("target", "error", "slope", "integral"), zero)
        return {"gyro": self.gyro_rest(zero), **signals}

    def advance(
        self, memory: Memories, excess: Signal, reference: Reference, measurement: Signal
    ) -> Advance:
        at = lambda gain: broadcast_gain(gain, measurement)
        r, _ = split_reference(reference, measurement, self.dt)
        gyro, (y, _) = self.filter_gyro(memory["gyro"], measurement)
        target = self.low_passed(self.target_hz, memory["target"], r)
        error = self.low_passed(self.error_hz, memory["error"], target - y)
        raw = (error - memory["error"]) / self.dt
        slope = self.low_passed(self.derivative_hz, memory["slope"], raw)
        growth = at(self.i) * error * self.dt
        # A limited mixer lets the integral shrink only.
        growing = (jnp.abs(excess) > 1e-6) & (memory["integral"] * growth >= 0)
        grown = memory["integral"] + jnp.where(growing, 0.0, growth)
        integral = bounded(grown, self.integral_limit)
        p, d, limit = at(self.p) * error, at(self.d) * slope, at(self.pd_limit)
        both = jnp.abs(p + d)
        scale = jnp.where(both > limit, limit, 1.0) / jnp.where(both > limit, both, 1.0)
        p, d = p * scale, d * scale
        ahead = at(self.ff) * target + at(self.d_ff) * (target - memory["target"]) / self.dt
        terms = {"P": p, "I": integral, "D": d, "F": ahead}
        next = {
            "gyro": gyro, "target": target, "error": error, "slope": slope, "integral": integral,
        }  # fmt: skip
        return next, p + d + integral + ahead, terms


class ArduPilotAttitude(AngleLoop):
    """ArduPilot's angle loop around a rate loop: angles in rad in, ROut out.

    The rate's target is `p` times the error of the angle, beyond a_max/p^2 the root of it that a
    deceleration a_max needs, plus the rate of a `Setpoint` (what input shaping gives); it is used
    one loop later. Source: docs/autopilots.md.

    **Arguments:** (each number is a scalar, one value per axis, or `[axes, *ensemble]`)

    - `rate`: the `ArduPilotRate` inside.
    - `p`: ATC_ANG_xxx_P in 1/s.
    - `acceleration_limit`: half of ATC_ACCEL_x_MAX in rad/s^2; the default is 550 deg/s^2.
    - `rate_limit`: ATC_RATE_x_MAX in rad/s; inf is none.

    **Raises:** `ValueError`: `p` or a limit is not above 0.
    """

    rate: ArduPilotRate
    p: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=4.5)
    acceleration_limit: Float[Array, "..."] = per_member(
        rank=1, converter=as_float, default=np.deg2rad(550.0)
    )
    rate_limit: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=float("inf"))

    def __check_init__(self):
        require_positive("p", self.p, "give 1/s")
        require_positive("acceleration_limit", self.acceleration_limit, "give rad/s^2")

    def outer_rest(self, zero: Signal) -> dict[str, PyTree]:
        return {"wanted": zero}

    def wanted_rate(
        self, memory: Memories, aim: Setpoint, angle: Signal, rate: Signal
    ) -> tuple[dict[str, PyTree], Signal]:
        # The square-root controller: linear for small errors, then the braking parabola.
        p, most = (broadcast_gain(x, angle) for x in (self.p, self.acceleration_limit))
        error, edge = aim.angle - angle, most / p**2
        size = jnp.abs(error)
        far = size > edge
        root = jnp.sqrt(2 * most * (jnp.where(far, size, edge) - edge / 2))
        braking = jnp.sign(error) * jnp.minimum(root, size / self.dt)
        turning = jnp.where(far, braking, jnp.minimum(p, 1 / self.dt) * error)
        wanted = bounded(turning, self.rate_limit) + aim.rate
        return {"wanted": wanted}, memory["wanted"]


Composite = Literal[1, 2, 3, 5]  # notches at each harmonic
_PLACES: dict[Composite, tuple[int, ...]] = {
    1: (0,), 2: (-1, 1), 3: (0, -1, 1), 5: (0, -1, 1, -2, 2),
}  # fmt: skip
_NAMES: dict[Composite, str] = {1: "", 2: "double ", 3: "triple ", 5: "quintuple "}
_HIGHEST = 0.48  # of the sample rate, from which on a harmonic has no notch
_NARROWEST = 0.52  # of the bandwidth: the least frequency that the quality is computed with


class HarmonicNotch(eqx.Module):
    """ArduPilot's harmonic notch: notches at multiples of one frequency, all of one quality.

    A harmonic at or above 0.48 of the sample rate has no notch. See `ardupilot_harmonic_notch` for
    one by the firmware's parameters.

    **Arguments:** (numbers are one value, one per axis, or `[axes, *ensemble]`)

    - `centre_hz`: the first harmonic.
    - `quality`: of each single notch, as of `Notch`; it stays where the centre moves.
    - `residual`: the gain that each single notch leaves at its centre.
    - `spread`: how far the outer notches of a double, triple or quintuple one are from a harmonic,
        as a share of it.
    - `harmonics`: multiples of the centre that have notches.
    - `notches`: 1, 2, 3 or 5 at each harmonic.

    **Raises:** `ValueError`: centre or quality is not above 0, or a multiple is below 1.
    """

    centre_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    quality: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    residual: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    spread: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    harmonics: tuple[int, ...] = eqx.field(static=True, default=(1, 2))
    notches: Composite = eqx.field(static=True, default=1)

    def __check_init__(self):
        require_positive("centre_hz", self.centre_hz, "leave the notch out to switch it off")
        require_positive("quality", self.quality, "give the centre over the width")
        if min(self.harmonics, default=1) < 1:
            raise ValueError(f"harmonics are {self.harmonics}: give multiples of the centre from 1")

    def sections(self, rate_hz: float) -> tuple[Section, ...]:
        sections = []
        for harmonic, place in itertools.product(self.harmonics, _PLACES[self.notches]):
            multiple = harmonic * self.centre_hz
            centre = multiple * (1 + place * self.spread)
            on = (multiple < _HIGHEST * rate_hz) & (centre < rate_hz / 2)  # else all of it passes
            left = jnp.where(on, self.residual, 1.0)
            notch = Notch(jnp.where(on, centre, rate_hz / 4), self.quality, left)
            sections += notch.sections(rate_hz)
        return tuple(sections)

    def in_words(self) -> str:
        kind = f"{_NAMES[self.notches]}harmonic notch"
        if not (is_concrete(self.centre_hz) and is_concrete(self.quality)):
            return kind
        centres = np.unique(np.asarray(self.centre_hz))
        at = ", ".join(f"{k * x:.4g}" for k in self.harmonics for x in centres)
        quality = ", ".join(f"{x:.3g}" for x in np.unique(np.asarray(self.quality)))
        return f"{kind} {at} Hz, Q {quality}"


def ardupilot_harmonic_notch(
    frequency_hz: ArrayLike, bandwidth_hz: ArrayLike, attenuation_db: ArrayLike, *,
    harmonics: Sequence[int] = (1, 2), notches: Composite = 1,
) -> HarmonicNotch:  # fmt: skip
    """ArduPilot's harmonic notch by its parameters, centred on `frequency_hz`.

    Several notches at a harmonic have the bandwidth divided by their number each, and are
    bandwidth / (32 frequency) of it apart. Source: docs/autopilots.md.

    **Arguments:**

    - `frequency_hz`, `bandwidth_hz`, `attenuation_db`: INS_HNTCH_FREQ, _BW and _ATT.
    - `harmonics`: the multiples that INS_HNTCH_HMNCS has bits of.
    - `notches`: 1, or by INS_HNTCH_OPTS 2, 3 or 5.
    """
    frequency, width = as_float(frequency_hz), as_float(bandwidth_hz)
    shaped = jnp.maximum(frequency, _NARROWEST * width)
    edge = shaped - width / (2 * notches)
    over = (shaped / edge) ** 2  # 2^octaves
    residual = 10 ** (-as_float(attenuation_db) / 20)
    return HarmonicNotch(
        frequency, jnp.sqrt(over) / (over - 1), residual, width / (32 * shaped),
        tuple(harmonics), notches,
    )  # fmt: skip


_FOLLOWED = {
    2: "the RPM sensor", 3: "the motors, by ESC telemetry", 4: "the spectrum of the gyro",
    5: "the second RPM sensor",
}  # fmt: skip


class FlownArduPilot(FlownLoop[ArduPilotRate]):
    """ArduPilot's rate loop of a log, with the notches that follow the throttle.

    **Arguments:** (those of `FlownLoop`, and)

    - `tracking`: place of each of the gyro's filters that follows the throttle, with its
        INS_HNTCH_FREQ, _REF and _FM_RAT.
    """

    tracking: tuple[tuple[int, float, float, float], ...] = eqx.field(static=True, default=())

    def at(self, throttle: Float[ArrayLike, "..."]) -> ArduPilotRate:
        """The law at a throttle of 0 to 1: where its notches are."""
        filters: list[Any] = list(self.law.gyro.filters)
        for place, frequency, reference, least in self.tracking:
            share = jnp.maximum(as_float(throttle) / reference, least**2)
            centre = frequency * jnp.sqrt(share)
            filters[place] = dataclasses.replace(filters[place], centre_hz=centre)
        chain = FilterChain(tuple(filters), self.law.gyro.rate_hz)
        return dataclasses.replace(self.law, gyro=chain)


_SHORT = ("RLL", "PIT", "YAW")
_of = lambda end: [f"ATC_RAT_{axis}_{end}" for axis in _SHORT]


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

    **Raises:** `ValueError`: a gain is missing.
    """
    number = Numbers(values).number
    rate = number("SCHED_LOOP_RATE", 400.0)
    gyro_rate = 1000.0 * 2 ** number("INS_GYRO_RATE", 0.0)
    gyro_rate = rate * max(1, math.ceil(gyro_rate / rate - 1e-9))
    per_axis = lambda end, default=None: [number(name, default) for name in _of(end)]
    switched = {
        **dict.fromkeys(_of("SMAX"), "the slew limiter lowers P and D"),
        **{f"ATC_RAT_{x}_{n}": Message("a notch", "notch") for x in _SHORT for n in ("NTF", "NEF")},
        "FSTRATE_ENABLE": "the rate loop runs faster than SCHED_LOOP_RATE",
    }
    unmodelled = [
        Message(f"{name}: {what}", Message(what).kind)
        for name, what in switched.items() if number(name, 0.0) > 0
    ]  # fmt: skip
    filters: list[HarmonicNotch] = []
    tracking: list[tuple[int, float, float, float]] = []
    for name in ("INS_HNTCH", "INS_HNTC2"):
        read = lambda end, default, name=name: number(f"{name}_{end}", default)
        mask = round(read("HMNCS", 3.0))
        if read("ENABLE", 0.0) <= 0 or mask == 0:
            continue
        frequency, reference = read("FREQ", 80.0), read("REF", 0.0)
        mode = round(read("MODE", 1.0)) if reference > 0 else 0
        options = round(read("OPTS", 0.0))  # the double notch goes before the triple one
        notch = ardupilot_harmonic_notch(
            frequency, read("BW", 40.0), read("ATT", 40.0),
            harmonics=[k + 1 for k in range(16) if mask >> k & 1],
            notches=2 if options & 1 else 3 if options & 16 else 5 if options & 64 else 1,
        )  # fmt: skip
        if mode == 1:
            tracking.append((len(filters), frequency, reference, read("FM_RAT", 1.0)))
        if mode not in _FOLLOWED:
            filters.append(notch)
        elif sources := (tracked_hz or {}).get(mode):
            centres = list(sources)  # a notch for each, or one for their mean
            if not options & 2 or mode in (2, 5):
                centres = [(1.0 if mode == 4 else reference) * float(np.mean(sources))]
            lowest = notch.centre_hz
            filters += [
                dataclasses.replace(notch, centre_hz=jnp.maximum(lowest, x)) for x in centres
            ]
        else:
            text = (
                f"{name}_MODE {mode}: the harmonic notch follows {_FOLLOWED[mode]}, from "
                f"{frequency:g} Hz on; give what it followed in Hz (`tracked_hz={{{mode}: [...]}}`)"
            )
            unmodelled.append(Message(text, "notch"))
    limit = np.array(per_axis("PDMX", 0.0))
    cutoff = number("INS_GYRO_FILTER", 20.0)
    low_pass = (Butterworth(cutoff),) if cutoff > 0 else ()
    law = ArduPilotRate(
        p=per_axis("P"), i=per_axis("I"), d=per_axis("D"), ff=per_axis("FF", 0.0),
        d_ff=per_axis("D_FF", 0.0), gyro=FilterChain((*filters, *low_pass), gyro_rate),
        target_hz=per_axis("FLTT", 20.0), error_hz=per_axis("FLTE", 0.0),
        derivative_hz=per_axis("FLTD", 20.0), integral_limit=per_axis("IMAX", 0.5),
        pd_limit=np.where(limit > 0, limit, np.inf), dt=1 / rate,
    )  # fmt: skip
    flown = FlownArduPilot(law, tuple(unmodelled), tuple(tracking))
    return dataclasses.replace(flown, law=flown.at(throttle))


_POST, _BOTH = 4, 8  # of INS_RAW_LOG_OPT: behind the filters, or before and behind them
_GYRO = re.compile(r"(GYR(\d|\[\d\])?)\.GyrX")
_two = lambda level, yaw: (level, level, yaw)
_ROWS = [
    *rows_of_axes(_of("P"), "", (0.135, 0.135, 0.18), _two((0.01, 0.5), (0.1, 2.5)), "p"),
    *rows_of_axes(_of("I"), "1/s", (0.135, 0.135, 0.018), _two((0.01, 2), (0.01, 1)), "i"),
    *rows_of_axes(_of("D"), "s", (0.0036, 0.0036, 0), _two((0, 0.05), (0, 0.02)), "d"),
    *rows_of_axes(_of("FF"), "", (0, 0, 0), (0, 0.5), "ff"),
    *rows_of_axes(_of("D_FF"), "s", (0, 0, 0), (0, 0.02), "d_ff"),
    *rows_of_axes(_of("IMAX"), "", (0.5,) * 3, (0, 1), "integral_limit"),
    *rows_of_axes(_of("FLTT"), "Hz", (20,) * 3, _two((5, 100), (1, 50)), "target_hz"),
    *rows_of_axes(_of("FLTE"), "Hz", (0, 0, 2.5), _two((0, 100), (0, 20)), "error_hz"),
    *rows_of_axes(_of("FLTD"), "Hz", (20,) * 3, _two((5, 100), (5, 50)), "derivative_hz"),
    *rows_of_axes(_of("SMAX"), "", (0,) * 3, (0, 200), ""),
    *rows_of_axes([f"ATC_ANG_{x}_P" for x in _SHORT], "1/s", (4.5,) * 3, (3, 12), "angle.p"),
    Parameter("INS_GYRO_FILTER", "Hz", 20, 0, 256, True, "gyro"),
    Parameter("MOT_THST_EXPO", "", 0.65, -1, 1),
]


_CHIRP = {
    "SID_F_START_HZ": 0.5, "SID_F_STOP_HZ": 20, "SID_T_FADE_IN": 3, "SID_T_REC": 30,
    "SID_T_FADE_OUT": 1,
}  # fmt: skip
# The usual messages, with fast attitude; the main gyro before its filters.
_USUAL_LOGGING = {"LOG_BITMASK": 180222, "INS_RAW_LOG_OPT": 0}
_LOGGING = {"LOG_BITMASK": 180222 + 1, "INS_RAW_LOG_OPT": 1}
_MAGNITUDE = RecipeOption("amplitude", 0.05, 0.01, 0.3, "SID_MAGNITUDE, of the mixer's range")
_POSITION = RecipeOption("switch", 6, 1, 6, "the position of the mode switch for SystemID")


class ArduPilot(Firmware):
    """ArduPilot, Copter; files hold a name and a value in a line, as Mission Planner has them."""

    log = LOG
    parameters = {row.name: row for row in _ROWS}
    unit = "ROut"
    motor_shares = (0.5, 0.5, 0.5)
    follows_throttle = True
    thrust_curve = "MOT_THST_EXPO"
    weighs_setpoint = True

    def flown_loop(self, values, version, *, throttle, tracked_hz):
        return ardupilot_loop(values, throttle=throttle, tracked_hz=tracked_hz)

    def channels(self, prefix: str, axis: int, values: Mapping[str, str]) -> Channels:
        letter, number = "RPY"[axis], Numbers(values).number
        low, high = number("MOT_PWM_MIN", 1000.0), number("MOT_PWM_MAX", 2000.0)
        ends = number("MOT_SPIN_MIN", 0.15), number("MOT_SPIN_MAX", 0.95)
        return Channels(
            terms=[f"PID{letter}.{x}" for x in ("P", "I", "D", "FF")],
            motors=[f"RCOU.C{k}" for k in range(1, 5)],
            motor_ends=(low + ends[0] * (high - low), low + ends[1] * (high - low)),
            output={f"RATE.{letter}Out": 1.0}, slewed={f"PID{letter}.Dmod": 1.0},
            tracked={
                3: r"ESC(\[\d+\])?\.RPM", 2: r"RPM(\.rpm1|\[0\]\.RPM)",
                5: r"RPM(\.rpm2|\[1\]\.RPM)",
            },
        )  # fmt: skip

    def recipe(self, axes, *, amplitude=None, switch=None):
        magnitude, position = _MAGNITUDE.choose(amplitude), int(_POSITION.choose(switch))
        numbers = [10 + AXES.index(axis) for axis in axes]  # of the mixer
        injected = [f"{number} ({axis})" for number, axis in zip(numbers, axes, strict=True)]
        mode = {f"FLTMODE{position}": 25}  # SystemID
        sweep = {"SID_AXIS": numbers[0], "SID_MAGNITUDE": f"{magnitude:g}"} | _CHIRP
        back = _USUAL_LOGGING | dict.fromkeys(mode, 0) | {"SID_AXIS": 0}
        again = f" Repeat it with SID_AXIS {', '.join(injected[1:])}." if numbers[1:] else ""
        paste = sweep | _LOGGING | mode
        lines = lambda values: [f"{x},{value}" for x, value in values.items()]
        return self.make_recipe(
            axes, lines(paste), lines(back), load=(paste, back),
            before="Save all parameters to a file. Load the lines as a file (.param), refresh the "
            "parameters, of which some are hidden while SID_AXIS was 0, and load the file again. "
            "SID_MAGNITUDE is a share of the "
            "mixer's range: begin with a small one, and raise it from flight to flight until the "
            f"vehicle is seen to shake. Position {position} of the mode switch has to be free, and "
            "Stabilize on another one.",
            flight=f"in Stabilize. With SID_AXIS {injected[0]} switch to SystemID (position "
            f"{position}) for {_CHIRP['SID_T_REC'] + 1} s, and back to end. It starts from "
            "Stabilize or Acro alone and holds no height: keep the throttle steady, and correct "
            f"gently.{again}",
            abort="Switch to Stabilize: the chirp ends at once. It also ends where the vehicle "
            "leans beyond its limit.",
            after="Land and download the log. It holds SIDD, whose F goes from 0.5 to 20 Hz, RATE "
            "and PIDR, PIDP or PIDY at the rate of the loop, and GYR, which shows the noise.",
            log="flight.bin",
        )  # fmt: skip

    def unfiltered_gyro(
        self, names: frozenset[str], values: Mapping[str, str], median: Callable[[str], float]
    ) -> Sequence[str]:
        """That of the filter that flew, else the first; none where it is logged behind the filters.

        Its messages are GYR[0], in older logs GYR1 or GYR. Where both kinds are logged, those
        behind the filters have the higher numbers. The filter that flew is XKF4.PI, and each of
        them has an IMU of EK3_IMU_MASK.
        """
        options = int(float(values.get("INS_RAW_LOG_OPT", 0.0)))
        tables = [hit[1] for name in names if (hit := _GYRO.fullmatch(name))]
        if not tables or (options & _POST and not options & _BOTH):
            return []
        mask = int(float(values.get("EK3_IMU_MASK", 3.0)))
        imus, core = [i for i in range(8) if mask >> i & 1], int(median("XKF4[0].PI"))
        used = f"GYR[{imus[core] if core < len(imus) else 0}]"
        table = used if used in tables else min(tables)
        return [f"{table}.Gyr{letter}" for letter in "XYZ"]

    def angle_loop(self, values, axis, dt, *, levelled):
        return OuterLoop.of(values, f"ATC_ANG_{_SHORT[axis]}_P", 1.0, dt, closed=True)


FIRMWARE = ArduPilot()
