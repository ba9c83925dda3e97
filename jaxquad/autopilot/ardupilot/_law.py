"""ArduPilot's rate and angle loops."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Literal, NamedTuple

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

from .._filters import FilterChain, Notch, PT1, Section
from .._law import (
    AngleLoop,
    bounded,
    filter_gyro,
    FirmwareLoop,
    gyro_rest,
    low_pass_share,
    RateLoop,
    require_gains,
    require_gyro_rate,
    Signal,
    split_reference,
    Terms,
)


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

    **Raises:**

    - `ValueError`: a gain is not finite, the gyro's rate is no multiple of 1/dt, or a filter lies
        beyond half of its rate.
    """

    firmware: ClassVar[str] = "ardupilot"
    feed_forward: ClassVar[tuple[str, ...]] = ("ff", "d_ff")
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

    def __check_init__(self):
        limits = {
            "target_hz": self.target_hz,
            "error_hz": self.error_hz,
            "derivative_hz": self.derivative_hz,
            "integral_limit": self.integral_limit,
            "pd_limit": self.pd_limit,
        }
        require_gains(self.dt, {**self.gains(), "ff": self.ff, "d_ff": self.d_ff}, limits)
        require_gyro_rate(self.gyro, self.dt)

    def derivative_chain(self, axis: int) -> FilterChain:
        cutoff = float(np.broadcast_to(self.derivative_hz, (3,))[axis])
        return FilterChain((PT1(cutoff),) if cutoff > 0 else (), 1 / self.dt)

    def gains(self) -> dict[str, Array]:
        return {"p": self.p, "i": self.i, "d": self.d}

    def rest(self, zero: Signal) -> dict[str, PyTree]:
        signals = dict.fromkeys(("target", "error", "slope", "integral"), zero)
        return {"gyro": gyro_rest(self.gyro, zero), **signals}

    def advance(
        self,
        memory: Mapping[str, PyTree],
        excess: Signal,
        reference: Reference,
        measurement: Signal,
    ) -> tuple[dict[str, PyTree], Signal, Terms]:
        at = lambda gain: broadcast_gain(gain, measurement)
        share = lambda cutoff: low_pass_share(cutoff, self.dt, measurement)
        r, _ = split_reference(reference, measurement, self.dt)
        gyro, (y, _) = filter_gyro(self.gyro, self.dt, memory["gyro"], measurement)
        target = memory["target"] + share(self.target_hz) * (r - memory["target"])
        error = memory["error"] + share(self.error_hz) * (target - y - memory["error"])
        raw = (error - memory["error"]) / self.dt
        slope = memory["slope"] + share(self.derivative_hz) * (raw - memory["slope"])
        integral = self._integrated(memory["integral"], excess, at(self.i) * error * self.dt)
        p, d = self._within_limit(at(self.p) * error, at(self.d) * slope)
        ahead = at(self.ff) * target + at(self.d_ff) * (target - memory["target"]) / self.dt
        terms = {"P": p, "I": integral, "D": d, "F": ahead}
        next = {
            "gyro": gyro, "target": target, "error": error, "slope": slope, "integral": integral,
        }  # fmt: skip
        return next, p + d + integral + ahead, terms

    def _integrated(self, integral, excess, growth):
        """A limited mixer lets the integral shrink only."""
        limited = jnp.abs(excess) > 1e-6
        growing = limited & (integral * growth >= 0)
        return bounded(integral + jnp.where(growing, 0.0, growth), self.integral_limit)

    def _within_limit(self, p, d):
        limit, both = broadcast_gain(self.pd_limit, p), jnp.abs(p + d)
        beyond = both > limit
        scale = jnp.where(beyond, limit, 1.0) / jnp.where(beyond, both, 1.0)
        return p * scale, d * scale


class ArduPilotAttitude(AngleLoop):
    """ArduPilot's angle loop around a rate loop: angles in rad in, ROut out.

    The rate's target is `p` times the error of the angle, beyond a_max/p^2 the root of it that a
    deceleration a_max needs, plus the rate of a `Setpoint` (what input shaping gives); it is used
    one loop later. The rate that the inner loop sees is the difference of the measured angles over
    a sample. Source: docs/autopilots.md.

    **Arguments:** (each number is a scalar, one value per axis, or `[axes, *ensemble]`)

    - `rate`: the `ArduPilotRate` inside.
    - `p`: ATC_ANG_xxx_P in 1/s.
    - `acceleration_limit`: half of ATC_ACCEL_x_MAX in rad/s^2; the default is 550 deg/s^2.
    - `rate_limit`: ATC_RATE_x_MAX in rad/s; inf is none.

    **Raises:**

    - `ValueError`: `p` or a limit is not above 0.
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

    def outer_gains(self) -> dict[str, Array]:
        return {"p": self.p}

    def inner(self) -> FirmwareLoop:
        return self.rate

    def outer_rest(self, zero: Signal) -> dict[str, PyTree]:
        return {"wanted": zero}

    def wanted_rate(
        self, memory: Mapping[str, PyTree], reference: Reference, angle: Signal, rate: Signal
    ) -> tuple[dict[str, PyTree], Signal]:
        aim = reference.angle if isinstance(reference, Setpoint) else reference
        wanted = bounded(self._rate_of(aim - angle), self.rate_limit)
        if isinstance(reference, Setpoint):
            wanted = wanted + reference.rate
        return {"wanted": wanted}, memory["wanted"]

    def _rate_of(self, error: Signal) -> Signal:
        """The square-root controller: linear for small errors, then the braking parabola."""
        p, most = (broadcast_gain(x, error) for x in (self.p, self.acceleration_limit))
        edge = most / p**2
        size = jnp.abs(error)
        far = size > edge
        root = jnp.sqrt(2 * most * (jnp.where(far, size, edge) - edge / 2))
        braking = jnp.sign(error) * jnp.minimum(root, size / self.dt)
        return jnp.where(far, braking, jnp.minimum(p, 1 / self.dt) * error)


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

    **Raises:**

    - `ValueError`: centre or quality is not above 0, or a multiple is below 1.
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
        return tuple(
            section
            for harmonic in self.harmonics
            for place in _PLACES[self.notches]
            for section in self._notch(harmonic, place, rate_hz).sections(rate_hz)
        )

    def _notch(self, harmonic: int, place: int, rate_hz: float) -> Notch:
        """One of them; that of a harmonic without one leaves everything."""
        multiple = harmonic * self.centre_hz
        centre = multiple * (1 + place * self.spread)
        on = (multiple < _HIGHEST * rate_hz) & (centre < rate_hz / 2)
        left = jnp.where(on, self.residual, 1.0)
        return Notch(jnp.where(on, centre, rate_hz / 4), self.quality, left)

    def in_words(self) -> str:
        kind = f"{_NAMES[self.notches]}harmonic notch"
        if not (is_concrete(self.centre_hz) and is_concrete(self.quality)):
            return kind
        centres = np.unique(np.asarray(self.centre_hz))
        at = ", ".join(f"{k * x:.4g}" for k in self.harmonics for x in centres)
        quality = ", ".join(f"{x:.3g}" for x in np.unique(np.asarray(self.quality)))
        return f"{kind} {at} Hz, Q {quality}"


def ardupilot_harmonic_notch(
    frequency_hz: ArrayLike,
    bandwidth_hz: ArrayLike,
    attenuation_db: ArrayLike,
    *,
    harmonics: Sequence[int] = (1, 2),
    notches: Composite = 1,
) -> HarmonicNotch:
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


class Tracking(NamedTuple):
    """Of a notch of the gyro that follows the throttle.

    **Attributes:**

    - `place`: in the chain of the gyro's filters.
    - `frequency_hz`, `reference`, `least`: INS_HNTCH_FREQ, _REF and _FM_RAT.
    """

    place: int
    frequency_hz: float
    reference: float
    least: float

    def centre_hz(self, throttle: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
        """FREQ sqrt(throttle / REF), not below FM_RAT FREQ."""
        share = jnp.maximum(as_float(throttle) / self.reference, self.least**2)
        return self.frequency_hz * jnp.sqrt(share)


class GyroNotches(NamedTuple):
    """What the parameters say of the gyro's notches: filters, which follow the throttle, words."""

    filters: tuple[HarmonicNotch, ...]
    tracking: tuple[Tracking, ...]
    unmodelled: tuple[Message, ...]


_FOLLOWED = {
    2: "the RPM sensor", 3: "the motors, by ESC telemetry", 4: "the spectrum of the gyro",
    5: "the second RPM sensor",
}  # fmt: skip


def read_harmonic_notches(
    number: Callable[[str, float], float], tracked_hz: Mapping[int, Sequence[float]]
) -> GyroNotches:
    """The notches of INS_HNTCH_* and INS_HNTC2_*, those of the throttle at their reference.

    `number` gives the value of a parameter, or the default; `tracked_hz` what those of each other
    mode follow.
    """
    filters: list[HarmonicNotch] = []
    tracking: list[Tracking] = []
    unmodelled: list[Message] = []
    for name in ("INS_HNTCH", "INS_HNTC2"):
        read = lambda end, default, name=name: number(f"{name}_{end}", default)
        mask = round(read("HMNCS", 3.0))
        if read("ENABLE", 0.0) <= 0 or mask == 0:
            continue
        frequency, reference = read("FREQ", 80.0), read("REF", 0.0)
        mode = round(read("MODE", 1.0)) if reference > 0 else 0
        options = round(read("OPTS", 0.0))
        notch = ardupilot_harmonic_notch(
            frequency, read("BW", 40.0), read("ATT", 40.0),
            harmonics=[k + 1 for k in range(16) if mask >> k & 1], notches=_composite(options),
        )  # fmt: skip
        if mode == 1:
            tracking.append(Tracking(len(filters), frequency, reference, read("FM_RAT", 1.0)))
        if mode not in _FOLLOWED:
            filters.append(notch)
        elif sources := tracked_hz.get(mode):
            filters += _followed(notch, mode, reference, bool(options & 2), sources)
        else:
            text = (
                f"{name}_MODE {mode}: the harmonic notch follows {_FOLLOWED[mode]}, from "
                f"{frequency:g} Hz on; give what it followed in Hz (`tracked_hz={{{mode}: [...]}}`)"
            )
            unmodelled.append(Message(text, "notch"))
    return GyroNotches(tuple(filters), tuple(tracking), tuple(unmodelled))


def _followed(
    notch: HarmonicNotch, mode: int, reference: float, separate: bool, sources: Sequence[float]
) -> list[HarmonicNotch]:
    """A notch for each source, or one for their mean, which REF scales but for the spectrum."""
    centres = list(sources)
    if not separate or mode in (2, 5):
        centres = [(1.0 if mode == 4 else reference) * float(np.mean(sources))]
    lowest = notch.centre_hz
    moved = [jnp.maximum(lowest, centre) for centre in centres]
    return [dataclasses.replace(notch, centre_hz=centre) for centre in moved]


def _composite(options: int) -> Composite:
    """Of INS_HNTCH_OPTS: the double notch goes before the triple one."""
    if options & 1:
        return 2
    if options & 16:
        return 3
    return 5 if options & 64 else 1
