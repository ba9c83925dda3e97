"""The filters of flight controllers' firmware, as each builds them, and chains of them."""

import functools as ft
import operator
from collections.abc import Sequence
from types import ModuleType
from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float

from jaxquad._core import as_float, broadcast_gain, is_concrete, per_member, require_positive


class Section(NamedTuple):
    """y[n] = b0 u[n] + b1 u[n-1] + b2 u[n-2] - a1 y[n-1] - a2 y[n-2]; or without b2 and a2."""

    b0: Float[Array, "..."]
    b1: Float[Array, "..."]
    a1: Float[Array, "..."]
    b2: Float[Array, "..."] | None = None
    a2: Float[Array, "..."] | None = None


Frequencies = Float[Array | np.ndarray, " frequencies"] | Sequence[float]  # Hz
Memory = tuple[tuple[Array, ...], ...]  # of each section, in its transposed form


@runtime_checkable
class Filter(Protocol):
    """A filter that runs at a fixed rate: `PT1`, `Butterworth`, `Notch`, or your own."""

    def sections(self, rate_hz: float) -> tuple[Section, ...]:
        """Its difference equations at so many samples a second, one after the other."""
        ...

    def in_words(self) -> str:
        """Kind and cutoff, for tables."""
        ...


_PT2, _PT3 = 1.553773974, 1.961459177  # cutoff of each pole over that of the whole, at -3 dB


def _first_order(cutoff_hz: Float[Array, "..."], rate_hz: float) -> Section:
    """x += k (u - x) with k = w/(w + 1), w = 2 pi cutoff/rate; PX4's and ArduPilot's alpha is k."""
    w = 2 * np.pi * cutoff_hz / rate_hz
    k = w / (w + 1)
    return Section(k, jnp.zeros_like(k), k - 1)


class _LowPass(eqx.Module):
    cutoff_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    kind: ClassVar[str]
    may_be_off: ClassVar[bool] = False  # with a cutoff of 0

    def __check_init__(self):
        if not self.may_be_off:
            require_positive("cutoff_hz", self.cutoff_hz, "leave the filter out to switch it off")

    def in_words(self) -> str:
        return f"{self.kind} {_listed(self.cutoff_hz)} Hz"


class PT1(_LowPass):
    """A first-order low-pass by backward differences: Betaflight's pt1, PX4's AlphaFilter.

    ArduPilot's FLTT, FLTE and FLTD are the same. A cutoff of 0 lets everything pass.

    **Arguments:**

    - `cutoff_hz`: one value, one per axis, or `[axes, *ensemble]`; 0 is off.
    """

    kind = "pt1"
    may_be_off = True

    def sections(self, rate_hz: float) -> tuple[Section, ...]:
        on = self.cutoff_hz > 0
        section = _first_order(jnp.where(on, self.cutoff_hz, 1.0), rate_hz)
        b0 = jnp.where(on, section.b0, 1.0)
        return (section._replace(b0=b0, a1=b0 - 1),)


class PT2(_LowPass):
    """Two equal first-order low-passes, together -3 dB at `cutoff_hz`: Betaflight's pt2."""

    kind = "pt2"

    def sections(self, rate_hz: float) -> tuple[Section, ...]:
        return (_first_order(_PT2 * self.cutoff_hz, rate_hz),) * 2


class PT3(_LowPass):
    """Three equal first-order low-passes, together -3 dB at `cutoff_hz`: Betaflight's pt3."""

    kind = "pt3"

    def sections(self, rate_hz: float) -> tuple[Section, ...]:
        return (_first_order(_PT3 * self.cutoff_hz, rate_hz),) * 3


class Butterworth(_LowPass):
    """The second-order Butterworth low-pass by the bilinear transform, exact at its cutoff.

    It is PX4's, ArduPilot's and the Crazyflie's LowPassFilter2p, and Betaflight's biquad (quality
    1/sqrt(2)) and state-variable low-pass.
    """

    kind = "Butterworth 2"

    def sections(self, rate_hz: float) -> tuple[Section, ...]:
        _require_below_nyquist("cutoff_hz", self.cutoff_hz, rate_hz)
        w = jnp.tan(np.pi * self.cutoff_hz / rate_hz)
        c = 1 + np.sqrt(2.0) * w + w**2
        b0 = w**2 / c
        a1, a2 = 2 * (w**2 - 1) / c, (1 - np.sqrt(2.0) * w + w**2) / c
        return (Section(b0, 2 * b0, a1, b0, a2),)


class Notch(eqx.Module):
    """A notch by the bilinear transform: Betaflight's notches, and ArduPilot's.

    **Arguments:** (each one value, one per axis, or `[axes, *ensemble]`)

    - `centre_hz`: where it attenuates most.
    - `quality`: the centre over the width between its -3 dB points; see `betaflight_quality`
        and `ardupilot_notch`.
    - `residual`: the gain that is left at the centre; Betaflight's RPM notches have 1 - weight.
    """

    centre_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    quality: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    residual: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)

    def __check_init__(self):
        require_positive("centre_hz", self.centre_hz, "leave the notch out to switch it off")
        require_positive("quality", self.quality, "give the centre over the width")

    def sections(self, rate_hz: float) -> tuple[Section, ...]:
        _require_below_nyquist("centre_hz", self.centre_hz, rate_hz)
        w = 2 * np.pi * self.centre_hz / rate_hz
        return (_notch(jnp.cos(w), jnp.sin(w) / (2 * self.quality), self.residual),)

    def in_words(self) -> str:
        return f"notch {_listed(self.centre_hz)} Hz, Q {_listed(self.quality)}"


class BandwidthNotch(eqx.Module):
    """PX4's notch: about -3 dB at half of `bandwidth_hz` on both sides of `centre_hz`."""

    centre_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    bandwidth_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float)

    def __check_init__(self):
        require_positive("centre_hz", self.centre_hz, "leave the notch out to switch it off")
        require_positive("bandwidth_hz", self.bandwidth_hz, "give the width at -3 dB")

    def sections(self, rate_hz: float) -> tuple[Section, ...]:
        _require_below_nyquist("centre_hz", self.centre_hz, rate_hz)
        width = jnp.tan(np.pi * self.bandwidth_hz / rate_hz)
        cosine = jnp.cos(2 * np.pi * self.centre_hz / rate_hz)
        return (_notch(cosine, width, jnp.zeros_like(width)),)

    def in_words(self) -> str:
        return f"notch {_listed(self.centre_hz)} Hz, {_listed(self.bandwidth_hz)} Hz wide"


def _notch(cosine: Array, width: Array, residual: Array) -> Section:
    over, middle = 1 + width, -2 * cosine / (1 + width)
    b0, b2 = (1 + width * residual) / over, (1 - width * residual) / over
    return Section(b0, middle, middle, b2, (1 - width) / over)


def betaflight_quality(centre_hz: ArrayLike, lower_hz: ArrayLike) -> Float[Array, "..."]:
    """The quality of a Betaflight notch with this centre and lower cutoff, in Hz."""
    centre, lower = as_float(centre_hz), as_float(lower_hz)
    return centre * lower / (centre**2 - lower**2)


def ardupilot_notch(centre_hz: ArrayLike, bandwidth_hz: ArrayLike, attenuation_db: float) -> Notch:
    """ArduPilot's notch (INS_HNTCH_BW, INS_HNTCH_ATT): `attenuation_db` deep at its centre."""
    centre, width = as_float(centre_hz), as_float(bandwidth_hz)
    octaves = 2 * jnp.log2(centre / (centre - width / 2))
    quality = jnp.sqrt(2.0**octaves) / (2.0**octaves - 1)
    return Notch(centre, quality, 10 ** (-attenuation_db / 20))


class FilterShare(NamedTuple):
    """What one filter of a chain does, or the whole chain."""

    name: str
    response: Complex[Array, " frequencies"]
    delay_ms: Float[Array, " frequencies"]  # phase over angular frequency


class FilterChain(eqx.Module):
    """Filters one after the other, all run at `rate_hz`.

        chain = FilterChain((PT1(500.0), Notch(180.0, 5.0), PT1(350.0)), rate_hz=8000.0)
        for share in chain.shares([10.0, 50.0]): print(share.name, share.delay_ms)

    **Arguments:**

    - `filters`: see `Filter`; those that are switched off are left out.
    - `rate_hz`: samples a second.

    **Raises:**

    - `ValueError`: the rate is not above 0, or a filter lies beyond half of it.
    """

    filters: tuple[Filter, ...] = ()
    rate_hz: float = eqx.field(static=True, default=1000.0)

    def __check_init__(self):
        require_positive("rate_hz", self.rate_hz, "give samples per second")
        self.sections()

    def sections(self) -> tuple[Section, ...]:
        """The difference equations of all filters."""
        return tuple(x for filter in self.filters for x in filter.sections(self.rate_hz))

    def response(self, frequency_hz: Frequencies) -> Complex[Array, " frequencies"]:
        """The complex response at these frequencies in Hz."""
        _, parts = self._section_responses(as_float(frequency_hz))
        return jnp.asarray(ft.reduce(operator.mul, parts))

    def delay_ms(self, frequency_hz: Frequencies) -> Float[Array, " frequencies"]:
        """The phase delay in ms at these frequencies in Hz, which are above 0."""
        at = as_float(frequency_hz)
        xp, parts = self._section_responses(at)
        # The phase of each section stays within half a turn, that of a chain does not.
        phase = ft.reduce(operator.add, map(xp.angle, parts))
        return jnp.asarray(-1e3 * phase / (2 * np.pi * xp.asarray(at)))

    def shares(self, frequency_hz: Frequencies) -> tuple[FilterShare, ...]:
        """Response and delay of each filter alone, and last of the whole chain.

        The responses multiply to that of the whole, and the delays add up to its delay.
        """
        parts = [(x.in_words(), FilterChain((x,), self.rate_hz)) for x in self.filters]
        return tuple(
            FilterShare(name, chain.response(frequency_hz), chain.delay_ms(frequency_hz))
            for name, chain in [*parts, ("all", self)]
        )

    def init(self, like: Float[Array, "..."]) -> Memory:
        """At rest, for signals shaped as `like`."""
        return rest_of(self.sections(), like)

    def step(self, memory: Memory, sample: Float[Array, "..."]) -> tuple[Memory, Array]:
        """The filtered `sample`."""
        return run_sections(self.sections(), memory, sample)

    def _section_responses(
        self, frequency_hz: Array
    ) -> tuple[ModuleType, list[Array | np.ndarray]]:
        """Ones, and the response of each section, and what has computed them.

        NumPy computes it unless something is traced: XLA would compile for each size.
        """
        sections, rate_hz = self.sections(), self.rate_hz
        numbers = [x for section in sections for x in section if x is not None]
        if any(x.size > 1 for x in numbers):
            raise ValueError(
                "the filter has one cutoff per axis or member: take one axis before asking for its "
                "response."
            )
        if all(map(is_concrete, (*numbers, frequency_hz))):
            xp, back = np, np.exp(-2j * np.pi * np.asarray(frequency_hz) / rate_hz)
        else:
            turn = 2 * np.pi * frequency_hz / rate_hz
            xp, back = jnp, jax.lax.complex(jnp.cos(turn), -jnp.sin(turn))
        parts = [0 * back + 1]
        for section in sections:
            b0, b1, a1, b2, a2 = (
                0.0 if x is None else xp.asarray(x).reshape(()).astype(back.dtype) for x in section
            )
            parts.append((b0 + back * (b1 + back * b2)) / (1 + back * (a1 + back * a2)))
        return xp, parts


def rest_of(sections: Sequence[Section], like: Array) -> Memory:
    """What sections remember that have seen nothing but zeros."""
    return tuple((jnp.zeros_like(like),) * (1 if section.b2 is None else 2) for section in sections)


def run_sections(
    sections: Sequence[Section], memory: Memory, sample: Array
) -> tuple[Memory, Array]:
    after = []
    for section, state in zip(sections, memory, strict=True):
        b0, b1, a1 = (broadcast_gain(x, sample) for x in section[:3])
        passed = b0 * sample + state[0]
        first = b1 * sample - a1 * passed
        if section.b2 is None or section.a2 is None:
            after.append((first,))
        else:
            b2, a2 = broadcast_gain(section.b2, sample), broadcast_gain(section.a2, sample)
            after.append((first + state[1], b2 * sample - a2 * passed))
        sample = passed
    return tuple(after), sample


def _require_below_nyquist(name: str, value: Array, rate_hz: float) -> None:
    if is_concrete(value) and not np.all(np.asarray(value) < rate_hz / 2):
        raise ValueError(
            f"{name} is {_listed(value)} Hz, but at {rate_hz:g} Hz it must be below "
            f"{rate_hz / 2:g} Hz: lower it, or leave the filter out as the firmware does."
        )


def _listed(value: Array) -> str:
    if not is_concrete(value):
        return "?"
    return ", ".join(f"{x:g}" for x in np.unique(np.asarray(value)))
