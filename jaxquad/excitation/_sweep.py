import numpy as np
from jaxtyping import Float

from jaxquad._core import check_band, check_not_negative, check_positive, Number

from ._excitation import Excitation


Samples = Float[np.ndarray, " samples"]
_C1, _C2 = 4.0, 0.0187


def sweep(
    omega_min: Number,
    omega_max: Number,
    *,
    duration: Number,
    sample_rate: Number,
    amplitude: Number,
    lead_in_cycles: int = 2,
    fade_in: Number | None = None,
    fade_out: Number | None = None,
    trim: Number = 3.0,
) -> Excitation:
    """Exponential sine sweep from `omega_min` to `omega_max` (rad/s).

    The frequency is omega_min + K (omega_max - omega_min), K = C2 (exp(C1 t/T) - 1), C1 = 4.0,
    C2 = 0.0187 (Tischler & Remple, eq. 5.15-5.17), and the phase is its integral in closed form.
    With the constants as published the last frequency is 0.23 % of the band above omega_max.

    `duration` (s) is T_rec: the lead-in cycles at omega_min and the sweep, which gets what they
    leave of it. `trim` (s) of zeros stands before and after. The raised-cosine fades last
    `fade_in` (s, by default the first half of the lead-in) and `fade_out` (s, by default two
    cycles at omega_max, so that the highest frequencies keep their amplitude).

    Raises ValueError for values that make no sweep.
    """
    check_band(omega_min, omega_max, sample_rate)
    check_positive(duration=duration, amplitude=amplitude)
    check_not_negative(lead_in_cycles=lead_in_cycles, trim=trim)
    lead_in = _lead_in(lead_in_cycles, omega_min, duration)
    default = min(4 * np.pi / omega_max, duration - lead_in)
    fade_in = lead_in / 2 if fade_in is None else fade_in
    fade_out = default if fade_out is None else fade_out
    _check_fades(fade_in, fade_out, duration)
    time = np.arange(round((duration + 2 * trim) * sample_rate) + 1) / sample_rate
    clock = time - trim
    wave = np.sin(_phase(clock - lead_in, omega_min, omega_max, duration - lead_in))
    return Excitation(
        time,
        amplitude * _envelope(clock, duration, fade_in, fade_out) * wave,
        np.empty(0),
        kind="sweep",
        omega_min=omega_min,
        omega_max=omega_max,
        amplitude=amplitude,
        sample_rate=sample_rate,
        duration=duration,
        lead_in=lead_in,
        lead=trim,
        tail=trim,
    )


def sweep_frequency(excitation: Excitation) -> Samples:
    """Instantaneous frequency of a sweep in rad/s; NaN in the zeros before and after it."""
    if excitation.kind != "sweep":
        raise ValueError(f"a {excitation.kind} has no one frequency at a time, only a sweep has.")
    clock = excitation.time - excitation.lead
    span = excitation.duration - excitation.lead_in
    omega = _frequency(clock - excitation.lead_in, excitation.omega_min, excitation.omega_max, span)
    return np.where((clock >= 0) & (clock <= excitation.duration), omega, np.nan)


def _lead_in(cycles: int, omega_min: Number, duration: Number) -> float:
    if cycles != round(cycles):
        raise ValueError(f"lead_in_cycles is {cycles}: whole cycles start at zero, so round it.")
    longest = 2 * np.pi / omega_min
    if cycles * longest >= duration:
        raise ValueError(
            f"duration {duration:.6g} s leaves no sweep after {cycles} lead-in cycles of "
            f"{longest:.6g} s: take 4 to 5 cycles of omega_min, {4 * longest:.6g} s or more."
        )
    return cycles * longest


def _check_fades(fade_in: Number, fade_out: Number, duration: Number) -> None:
    check_not_negative(fade_in=fade_in, fade_out=fade_out)
    if fade_in + fade_out > duration:
        raise ValueError(
            f"fade_in {fade_in:.6g} s and fade_out {fade_out:.6g} s do not fit into the duration "
            f"of {duration:.6g} s: shorten them."
        )


def _frequency(clock: Samples, omega_min: Number, omega_max: Number, span: Number) -> Samples:
    sweeping = np.clip(clock, 0, span)
    return omega_min + _C2 * np.expm1(_C1 * sweeping / span) * (omega_max - omega_min)


def _phase(clock: Samples, omega_min: Number, omega_max: Number, span: Number) -> Samples:
    """Integral of the frequency; zero where the lead-in, a whole number of cycles, ends."""
    sweeping = np.clip(clock, 0, span)
    grown = span / _C1 * np.expm1(_C1 * sweeping / span) - sweeping
    return omega_min * clock + _C2 * grown * (omega_max - omega_min)


def _envelope(clock: Samples, duration: Number, fade_in: Number, fade_out: Number) -> Samples:
    rise = _ramp(clock, fade_in)
    fall = _ramp(duration - clock, fade_out)
    return np.where((clock >= 0) & (clock <= duration), rise * fall, 0.0)


def _ramp(clock: Samples, width: Number) -> Samples:
    if width == 0:
        return np.ones_like(clock)
    return 0.5 - 0.5 * np.cos(np.pi * np.clip(clock / width, 0, 1))
