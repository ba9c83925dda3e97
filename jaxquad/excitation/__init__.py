"""Sweeps, multisines, doublets and 3-2-1-1, and the rules that they are checked against."""

import dataclasses
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad._core import (
    Number,
    require_all_nonnegative,
    require_all_positive,
    require_band,
    whole_samples,
)


__all__ = [
    "check_guidelines",
    "check_lines",
    "doublet",
    "Excitation",
    "Guideline",
    "Guidelines",
    "harmonics",
    "multisine",
    "sweep",
    "three_two_one_one",
]
Kind = Literal["sweep", "multisine", "doublet", "3-2-1-1"]


@dataclasses.dataclass(frozen=True, eq=False)
class Excitation:
    """A test signal with uniform time stamps from 0 s.

    The band `omega_min` .. `omega_max` is the range of a sweep, the lowest and highest line of a
    multisine, and for a pulse the band around the peak of its spectrum within 3 dB. `duration` is
    that of the excited part, without the zeros before and after it.
    """

    time: Float[np.ndarray, " samples"]  # s
    signal: Float[np.ndarray, " samples"]  # in the unit of the amplitude
    lines: Float[np.ndarray, " frequencies"]  # rad/s, of a multisine; none for the others
    kind: Kind
    omega_min: float  # rad/s
    omega_max: float  # rad/s
    amplitude: float  # peak
    sample_rate: float  # Hz
    duration: float  # s
    lead_in: float = 0.0  # s at omega_min
    lead: float = 0.0  # s of zeros before
    tail: float = 0.0  # s of zeros after

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.time.size

    def __str__(self) -> str:
        return (
            f"{self.kind}: {self.omega_min:.4g} to {self.omega_max:.4g} rad/s "
            f"({self.omega_min / (2 * np.pi):.3g} to {self.omega_max / (2 * np.pi):.3g} Hz), "
            f"amplitude {self.amplitude:.4g}, {self.duration:.6g} s excited of "
            f"{self.time[-1]:.6g} s at {self.sample_rate:.6g} Hz"
        )


Samples = Float[np.ndarray, " samples"]
Lines = Float[np.ndarray, " frequencies"]
_C1, _C2 = 4.0, 0.0187


def sweep(
    omega_min: Number, omega_max: Number, *, duration: Number, sample_rate: Number,
    amplitude: Number, lead_in_cycles: int = 2, fade_in: Number | None = None,
    fade_out: Number | None = None, trim: Number = 3.0,
) -> Excitation:  # fmt: skip
    """Make an exponential sine sweep.

    The frequency is omega_min + K (omega_max - omega_min), K = C2 (exp(C1 t/T) - 1), C1 = 4.0,
    C2 = 0.0187 (Tischler and Remple, "Aircraft and Rotorcraft System Identification", eq. 5.15 to
    5.17), and the phase is its integral in closed form. With the published constants the last
    frequency exceeds omega_max by 0.23 % of the band.

    **Arguments:**

    - `omega_min`, `omega_max`: ends of the band in rad/s.
    - `duration`: T_rec, the lead-in and the sweep together, in s.
    - `sample_rate`: in Hz.
    - `amplitude`: peak value.
    - `lead_in_cycles`: whole cycles at `omega_min` before the sweep.
    - `fade_in`, `fade_out`: lengths of the raised-cosine fades in s; by default half the lead-in,
        and two cycles of `omega_max`, so that the highest frequencies keep their amplitude.
    - `trim`: zeros before and after, in s.

    **Raises:**

    - `ValueError`: for an empty band or one above half the sample rate, and for a duration that the
        lead-in and the fades exceed.

    !!! Example

        ```python
        sweep = jq.sweep(0.3, 12.0, duration=90.0, sample_rate=100.0, amplitude=0.1)
        print(jq.excitation.check_guidelines(sweep))
        ```
    """
    require_band(omega_min, omega_max, sample_rate)
    require_all_positive(duration=duration, amplitude=amplitude)
    require_all_nonnegative(lead_in_cycles=lead_in_cycles, trim=trim)
    if lead_in_cycles != round(lead_in_cycles):
        raise ValueError(f"lead_in_cycles is {lead_in_cycles}: use a whole number of cycles.")
    longest = 2 * np.pi / omega_min
    lead_in = lead_in_cycles * longest
    if lead_in >= duration:
        raise ValueError(
            f"duration {duration:.6g} s leaves no time for the sweep after {lead_in_cycles} "
            f"lead-in cycles of {longest:.6g} s: use at least 4 to 5 cycles of omega_min, "
            f"{4 * longest:.6g} s or more."
        )
    default = min(4 * np.pi / omega_max, duration - lead_in)
    fade_in = lead_in / 2 if fade_in is None else fade_in
    fade_out = default if fade_out is None else fade_out
    require_all_nonnegative(fade_in=fade_in, fade_out=fade_out)
    if fade_in + fade_out > duration:
        raise ValueError(
            f"fade_in {fade_in:.6g} s and fade_out {fade_out:.6g} s do not fit into the duration "
            f"of {duration:.6g} s: use shorter fades."
        )
    time = np.arange(round((duration + 2 * trim) * sample_rate) + 1) / sample_rate
    clock = time - trim
    # The phase is zero where the lead-in, a whole number of cycles, ends.
    span = duration - lead_in
    sweeping = np.clip(clock - lead_in, 0, span)
    grown = span / _C1 * np.expm1(_C1 * sweeping / span) - sweeping
    phase = omega_min * (clock - lead_in) + _C2 * grown * (omega_max - omega_min)
    fades = _ramp(clock, fade_in) * _ramp(duration - clock, fade_out)
    envelope = np.where((clock >= 0) & (clock <= duration), fades, 0.0)
    signal = amplitude * envelope * np.sin(phase)
    numbers = (omega_min, omega_max, amplitude, sample_rate, duration, lead_in, trim, trim)
    return Excitation(time, signal, np.empty(0), "sweep", *map(float, numbers))


def _ramp(clock: Samples, width: Number) -> Samples:
    if width == 0:
        return np.ones_like(clock)
    return 0.5 - 0.5 * np.cos(np.pi * np.clip(clock / width, 0, 1))


def harmonics(
    omega_min: Number, omega_max: Number, *, period: Number, lines: int | None = None
) -> Lines:
    """Choose harmonics of a period for a multisine.

    **Arguments:**

    - `omega_min`, `omega_max`: ends of the band in rad/s.
    - `period`: in s.
    - `lines`: about how many, log-spaced; by default all harmonics in the band. It gives fewer
        where the lines would be closer than the harmonics.

    **Returns:** frequencies in rad/s, increasing. `omega[0::2]` and `omega[1::2]` excite two axes
    at once without influencing each other's lines.

    **Raises:**

    - `ValueError`: where the band holds fewer than two harmonics, or fewer than `lines`.
    """
    require_all_positive(omega_min=omega_min, omega_max=omega_max, period=period)
    base = 2 * np.pi / period
    first = int(np.ceil(omega_min / base - 1e-9))
    last = int(np.floor(omega_max / base + 1e-9))
    if last <= first:
        raise ValueError(
            f"fewer than two harmonics of {base:.6g} rad/s lie between {omega_min:.6g} and "
            f"{omega_max:.6g} rad/s: lengthen the period of {period:.6g} s, or widen the band."
        )
    if lines is None:
        return base * np.arange(first, last + 1)
    if not 2 <= lines <= last - first + 1:
        raise ValueError(
            f"lines is {lines}: the band holds {last - first + 1} harmonics; use 2 to "
            f"{last - first + 1}."
        )
    return base * np.unique(np.round(np.geomspace(first, last, lines)))


def multisine(
    omega: Lines | Sequence[Number], *, period: Number, periods: int, sample_rate: Number,
    amplitude: Number,
) -> Excitation:  # fmt: skip
    """Make a multisine, a periodic sum of sines of equal amplitude with a low crest factor.

    The phases are those of Schroeder (1970), generalised to any spacing of the lines and improved
    by clipping (van der Ouderaa et al., 1988). The period starts at the sample nearest to zero.

    **Arguments:**

    - `omega`: lines in rad/s, increasing; harmonics of the period, as `harmonics` gives them.
    - `period`: in s, a whole number of samples, so that each line is one point of a Fourier
        transform.
    - `periods`: how many of them.
    - `sample_rate`: in Hz.
    - `amplitude`: peak value.

    **Raises:**

    - `ValueError`: for lines that are not harmonics or not below half the sample rate, and for a
        period that is not a whole number of samples.
    """
    omega = np.asarray(omega, dtype=np.float64)
    require_all_positive(period=period, amplitude=amplitude, sample_rate=sample_rate)
    if periods < 1:
        raise ValueError(f"periods is {periods}: use at least 1, and 3 or more to estimate noise.")
    check_lines(omega, period, sample_rate)
    count = whole_samples("period", period, sample_rate)
    time = np.arange(count * periods) / sample_rate
    orders = np.round(omega * period / (2 * np.pi)).astype(int)
    # Schroeder's phases give each line a delay in proportion to the power of the lines below it;
    # the wave is that of the lowest peak of 500, each with the phases of the clipped one before.
    delay = period * np.arange(omega.size - 1) / omega.size
    phase = -np.concatenate([[0.0], np.cumsum(delay * np.diff(omega))])
    spectrum = np.zeros(count // 2 + 1, dtype=np.complex128)
    wave, lowest = np.zeros(count), np.inf
    for _ in range(500):
        spectrum[orders] = np.exp(1j * phase)
        candidate = np.fft.irfft(spectrum, count)
        peak = np.abs(candidate).max()
        if peak < lowest:
            wave, lowest = candidate, peak
        phase = np.angle(np.fft.rfft(np.clip(candidate, -0.8 * peak, 0.8 * peak))[orders])
    wave = np.roll(wave, -int(np.abs(wave).argmin()))
    signal = np.tile(amplitude / np.abs(wave).max() * wave, periods)
    numbers = (omega[0], omega[-1], amplitude, sample_rate, period * periods)
    return Excitation(time, signal, omega, "multisine", *map(float, numbers))


def check_lines(omega: Lines, period: Number, sample_rate: Number) -> None:
    """Raise ValueError unless the lines (rad/s) are increasing harmonics of the period (s)."""
    if omega.size < 2 or not (np.diff(omega) > 0).all():
        raise ValueError(f"{omega.size} lines: give two or more in increasing order, in rad/s.")
    require_band(float(omega[0]), float(omega[-1]), sample_rate)
    order = omega * period / (2 * np.pi)
    off = np.abs(order - np.round(order))
    if off.max() > 1e-6:
        i = off.argmax()
        raise ValueError(
            f"the line {omega[i]:.6g} rad/s is {order[i]:.6g} times the fundamental of the period "
            f"{period:.6g} s, not a whole number: choose lines with jq.excitation.harmonics."
        )


def doublet(
    *, width: Number, amplitude: Number, sample_rate: Number, lead: Number = 1.0, tail: Number = 3.0
) -> Excitation:
    """Make a doublet: up for `width`, then down for `width`.

    It has no net input, and serves to verify a model.

    **Arguments:**

    - `width`: of each half, in s.
    - `amplitude`: peak value.
    - `sample_rate`: in Hz.
    - `lead`, `tail`: zeros before and after, in s.

    **Raises:**

    - `ValueError`: for times that are not whole numbers of samples.
    """
    return _pulses("doublet", [1, -1], width, amplitude, sample_rate, lead, tail)


def three_two_one_one(
    *, width: Number, amplitude: Number, sample_rate: Number, lead: Number = 1.0, tail: Number = 3.0
) -> Excitation:
    """Make a 3-2-1-1: up for three times `width`, down for two, up for one, down for one.

    It excites a wider band than a doublet, and has a net input of `amplitude` times `width`.
    Arguments and errors are those of `doublet`; `width` is that of the shortest pulse.
    """
    steps = [1, 1, 1, -1, -1, 1, -1]
    return _pulses("3-2-1-1", steps, width, amplitude, sample_rate, lead, tail)


def _pulses(
    kind: Kind, steps: Sequence[int], width: Number, amplitude: Number, sample_rate: Number,
    lead: Number, tail: Number,
) -> Excitation:  # fmt: skip
    require_all_positive(width=width, amplitude=amplitude, sample_rate=sample_rate)
    before = whole_samples("lead", lead, sample_rate, fewest=0)
    after = whole_samples("tail", tail, sample_rate, fewest=0)
    shape = np.repeat(
        np.asarray(steps, dtype=np.float64), whole_samples("width", width, sample_rate)
    )
    signal = amplitude * np.pad(shape, (before, after))
    # The band within 3 dB of the peak of the spectrum.
    power = np.abs(np.fft.rfft(shape, 256 * shape.size)) ** 2
    peak = int(power.argmax())
    weak = np.flatnonzero(power < 0.5 * power[peak])
    low = weak[weak < peak].max(initial=-1) + 1
    high = weak[weak > peak].min(initial=power.size) - 1
    spacing = 2 * np.pi * sample_rate / (256 * shape.size)
    band = low * spacing, high * spacing
    numbers = (*band, amplitude, sample_rate, shape.size / sample_rate, 0.0, lead, tail)
    time = np.arange(signal.size) / sample_rate
    return Excitation(time, signal, np.empty(0), kind, *map(float, numbers))


class Guideline(NamedTuple):
    """One rule of test design, checked for one excitation."""

    rule: str
    value: float
    limit: float
    ok: bool
    message: str

    def __str__(self) -> str:
        return f"{'OK  ' if self.ok else 'FAIL'}  {self.message}"


class Guidelines(tuple[Guideline, ...]):
    """All rules that apply to an excitation; `ok` if it follows all of them."""

    @property
    def ok(self) -> bool:
        return all(guideline.ok for guideline in self)

    def __str__(self) -> str:
        return "\n".join(map(str, self))


def check_guidelines(
    excitation: Excitation, *, omega_bandwidth: Number | None = None,
    omega_180: Number | None = None,
) -> Guidelines:  # fmt: skip
    """Check an excitation against the guidelines for identification from frequency sweeps.

    Source: Tischler and Remple, "Aircraft and Rotorcraft System Identification", ch. 5.

    **Arguments:**

    - `excitation`: a sweep or a multisine. Pulses serve for verification, and only their sample
        rate is checked.
    - `omega_bandwidth`, `omega_180`: the expected bandwidth and 180 deg crossover of the response
        in rad/s; each adds a rule for one end of the band.

    **Returns:** `Guidelines`, a tuple of `Guideline`, which prints as one line for each rule.
    """
    low, high, duration = excitation.omega_min, excitation.omega_max, excitation.duration
    rules: list[Guideline] = []

    def check(
        rule: str, value: float, limit: float, said: str, advice: str, *, highest: bool = False
    ) -> None:
        slack = 1e-9 * limit
        ok = value <= limit + slack if highest else value >= limit - slack
        message = said if ok else f"{said}. {advice}"
        rules.append(Guideline(rule, float(value), float(limit), bool(ok), message))

    rate, limit = excitation.sample_rate, 25 * high
    said = f"sample rate {rate:.4g} Hz (rule: at least 25 f_max = {limit / (2 * np.pi):.4g} Hz)"
    check("sample rate", 2 * np.pi * rate, limit, said, "Sample faster, or lower omega_max")
    if excitation.kind in ("sweep", "multisine"):
        longest, shortest = 2 * np.pi / low, 20 * 2 * np.pi / high
        safer = "; longer is safer" if 4 * longest <= duration < 5 * longest else ""
        said = (
            f"record length {duration:.4g} s excited (rule: at least 4 to 5 periods of "
            f"omega_min = {4 * longest:.4g} to {5 * longest:.4g} s){safer}"
        )
        advice = "Lengthen the record, or raise omega_min"
        check("record length", duration, 4 * longest, said, advice)
        said = f"range omega_max / omega_min = {high / low:.4g} (rule: at least 10, a decade)"
        advice = "Widen the band: a narrow band does not determine a model"
        check("range", high / low, 10.0, said, advice)
        said = (
            f"window {duration / 2:.4g} s, half the record "
            f"(rule: at least 20 cycles of omega_max = {shortest:.4g} s)"
        )
        check("window", duration / 2, shortest, said, "Lengthen the record, or raise omega_max")
        in_hertz = lambda omega: f"{omega:.4g} rad/s = {omega / (2 * np.pi):.3g} Hz"
        if omega_bandwidth is not None:
            require_all_positive(omega_bandwidth=omega_bandwidth)
            limit = 0.5 * omega_bandwidth
            said = f"low end {in_hertz(low)} (rule: at most half the bandwidth = {in_hertz(limit)})"
            check("low end", low, limit, said, "Lower omega_min", highest=True)
        if omega_180 is not None:
            require_all_positive(omega_180=omega_180)
            limit = 2.5 * omega_180
            said = f"high end {in_hertz(high)} (rule: at least 2.5 omega_180 = {in_hertz(limit)})"
            check("high end", high, limit, said, "Raise omega_max")
    if excitation.kind == "sweep":
        cycles = excitation.lead_in * low / (2 * np.pi)
        said = f"lead-in {cycles:.3g} cycles of omega_min (rule: at least 2)"
        check("lead-in", cycles, 2.0, said, "Use lead_in_cycles=2")
        zeros = min(excitation.lead, excitation.tail)
        said = f"trim {zeros:.3g} s of zeros at each end (rule: at least 3 s)"
        check("trim", zeros, 3.0, said, "Use trim=3, or record 3 s of trim at each end")
    return Guidelines(rules)
