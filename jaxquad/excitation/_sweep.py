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
    return Excitation(
        time,
        amplitude * envelope * np.sin(phase),
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
    sweeping = np.clip(clock - excitation.lead_in, 0, span)
    band = excitation.omega_max - excitation.omega_min
    omega = excitation.omega_min + _C2 * np.expm1(_C1 * sweeping / span) * band
    return np.where((clock >= 0) & (clock <= excitation.duration), omega, np.nan)


def _ramp(clock: Samples, width: Number) -> Samples:
    if width == 0:
        return np.ones_like(clock)
    return 0.5 - 0.5 * np.cos(np.pi * np.clip(clock / width, 0, 1))
