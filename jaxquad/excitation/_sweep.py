import numpy as np
from jaxtyping import Float

from jaxquad._core import Number, require_all_nonnegative, require_all_positive, require_band

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

    **Returns:** an `Excitation`.

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
        omega_min=float(omega_min),
        omega_max=float(omega_max),
        amplitude=float(amplitude),
        sample_rate=float(sample_rate),
        duration=float(duration),
        lead_in=float(lead_in),
        lead=float(trim),
        tail=float(trim),
    )


def sweep_frequency(excitation: Excitation) -> Samples:
    """Instantaneous frequency of a sweep.

    **Arguments:**

    - `excitation`: made by `sweep`.

    **Returns:** frequency in rad/s for each sample; NaN in the zeros before and after the sweep.

    **Raises:**

    - `ValueError`: for another kind of excitation.
    """
    if excitation.kind != "sweep":
        raise ValueError(
            f"a {excitation.kind} has no instantaneous frequency: use a sweep (jq.sweep)."
        )
    clock = excitation.time - excitation.lead
    span = excitation.duration - excitation.lead_in
    omega = _frequency(clock - excitation.lead_in, excitation.omega_min, excitation.omega_max, span)
    return np.where((clock >= 0) & (clock <= excitation.duration), omega, np.nan)


def _lead_in(cycles: int, omega_min: Number, duration: Number) -> float:
    if cycles != round(cycles):
        raise ValueError(f"lead_in_cycles is {cycles}: use a whole number of cycles.")
    longest = 2 * np.pi / omega_min
    if cycles * longest >= duration:
        raise ValueError(
            f"duration {duration:.6g} s leaves no time for the sweep after {cycles} lead-in cycles "
            f"of {longest:.6g} s: use at least 4 to 5 cycles of omega_min, {4 * longest:.6g} s or "
            f"more."
        )
    return cycles * longest


def _check_fades(fade_in: Number, fade_out: Number, duration: Number) -> None:
    require_all_nonnegative(fade_in=fade_in, fade_out=fade_out)
    if fade_in + fade_out > duration:
        raise ValueError(
            f"fade_in {fade_in:.6g} s and fade_out {fade_out:.6g} s do not fit into the duration "
            f"of {duration:.6g} s: use shorter fades."
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
