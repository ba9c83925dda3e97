from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from jaxquad._core import Number, require_all_positive, require_band, whole_samples

from ._excitation import Excitation


Lines = Float[np.ndarray, " frequencies"]


def harmonics(
    omega_min: Number,
    omega_max: Number,
    *,
    period: Number,
    lines: int | None = None,
    spacing: Literal["log", "linear"] = "log",
) -> Lines:
    """Choose harmonics of a period for a multisine.

    **Arguments:**

    - `omega_min`, `omega_max`: ends of the band in rad/s.
    - `period`: in s.
    - `lines`: about how many; by default all harmonics in the band. Log spacing gives fewer where
        the lines would be closer than the harmonics.
    - `spacing`: of the lines, `"log"` or `"linear"`.

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
    space = {"log": np.geomspace, "linear": np.linspace}
    if spacing not in space:
        raise ValueError(f"spacing is {spacing!r}: use 'log' or 'linear'.")
    return base * np.unique(np.round(space[spacing](first, last, lines)))


def multisine(
    omega: Lines | Sequence[Number],
    *,
    period: Number,
    periods: int,
    sample_rate: Number,
    amplitude: Number,
) -> Excitation:
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

    **Returns:** an `Excitation`.

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
    return Excitation(
        time,
        np.tile(amplitude / np.abs(wave).max() * wave, periods),
        omega,
        kind="multisine",
        omega_min=float(omega[0]),
        omega_max=float(omega[-1]),
        amplitude=float(amplitude),
        sample_rate=float(sample_rate),
        duration=float(period * periods),
    )


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
