"""ArduPilot's harmonic notches: their equations, and what a log's parameters make of them."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxquad._core import as_float, is_concrete, Message, per_member, require_positive

from .._filters import Notch, Section


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
    notch: HarmonicNotch, mode: int, reference: float, apart: bool, sources: Sequence[float]
) -> list[HarmonicNotch]:
    """A notch for each source, or one for their mean, which REF scales but for the spectrum."""
    centres = list(sources)
    if not apart or mode in (2, 5):
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
