from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from jaxquad._core import check_band, check_positive, Number, whole_samples

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
    """Harmonics of a `period` (s) between `omega_min` and `omega_max`, all in rad/s.

    All of them, or about `lines` distinct ones: where log spacing asks for lines closer than
    the harmonics are, fewer come back. `omega[0::2]` and `omega[1::2]` excite two axes at once
    without either showing in the other.
    """
    check_positive(omega_min=omega_min, omega_max=omega_max, period=period)
    base = 2 * np.pi / period
    first = int(np.ceil(omega_min / base - 1e-9))
    last = int(np.floor(omega_max / base + 1e-9))
    if last <= first:
        raise ValueError(
            f"fewer than two harmonics of {base:.6g} rad/s lie in {omega_min:.6g} .. "
            f"{omega_max:.6g} rad/s: lengthen the period of {period:.6g} s or widen the band."
        )
    if lines is None:
        return base * np.arange(first, last + 1)
    if not 2 <= lines <= last - first + 1:
        raise ValueError(f"{lines} lines: the band holds 2 to {last - first + 1} harmonics.")
    space = {"log": np.geomspace, "linear": np.linspace}
    if spacing not in space:
        raise ValueError(f"spacing {spacing!r}: it is 'log' or 'linear'.")
    return base * np.unique(np.round(space[spacing](first, last, lines)))


def multisine(
    omega: Lines | Sequence[Number],
    *,
    period: Number,
    periods: int,
    sample_rate: Number,
    amplitude: Number,
) -> Excitation:
    """A sum of equal sines at the lines `omega` (rad/s), with peak `amplitude`.

    The lines are harmonics of the `period` (s), which is a whole number of samples and repeated
    `periods` times, so each line falls on one point of a Fourier transform. The phases are
    Schroeder's (1970), here for lines however spaced, improved by clipping (van der Ouderaa et
    al., 1988) to keep the peak low. The period starts at the sample nearest to zero.

    Raises ValueError for lines that are no harmonics, and for a period of no whole samples.
    """
    omega = np.asarray(omega, dtype=np.float64)
    check_positive(period=period, amplitude=amplitude, sample_rate=sample_rate)
    if periods < 1:
        raise ValueError(f"periods is {periods}: at least one is needed, three to judge noise.")
    check_lines(omega, period, sample_rate)
    count = whole_samples("period", period, sample_rate)
    time = np.arange(count * periods) / sample_rate
    orders = np.round(omega * period / (2 * np.pi)).astype(int)
    wave = _least_peak(orders, _schroeder(omega, period), count)
    wave = np.roll(wave, -int(np.abs(wave).argmin()))
    return Excitation(
        time,
        np.tile(amplitude / np.abs(wave).max() * wave, periods),
        omega,
        kind="multisine",
        omega_min=omega[0],
        omega_max=omega[-1],
        amplitude=amplitude,
        sample_rate=sample_rate,
        duration=period * periods,
    )


def _schroeder(omega: Lines, period: Number) -> Lines:
    """Phases that give each line a delay in proportion to the power of the lines below it."""
    delay = period * np.arange(omega.size - 1) / omega.size
    return -np.concatenate([[0.0], np.cumsum(delay * np.diff(omega))])


def _least_peak(
    orders: Int[np.ndarray, " frequencies"], phase: Lines, count: int
) -> Float[np.ndarray, " samples"]:
    """The flattest of 500 waves, each with the phases that clipping the one before left."""
    spectrum = np.zeros(count // 2 + 1, dtype=np.complex128)
    best, lowest = np.zeros(count), np.inf
    for _ in range(500):
        spectrum[orders] = np.exp(1j * phase)
        wave = np.fft.irfft(spectrum, count)
        peak = np.abs(wave).max()
        if peak < lowest:
            best, lowest = wave, peak
        clipped = np.clip(wave, -0.8 * peak, 0.8 * peak)
        phase = np.angle(np.fft.rfft(clipped)[orders])
    return best


def check_lines(omega: Lines, period: Number, sample_rate: Number) -> None:
    if omega.size < 2 or not (np.diff(omega) > 0).all():
        raise ValueError(f"{omega.size} lines: give two or more in rising order, in rad/s.")
    check_band(float(omega[0]), float(omega[-1]), sample_rate)
    order = omega * period / (2 * np.pi)
    off = np.abs(order - np.round(order))
    if off.max() > 1e-6:
        i = off.argmax()
        raise ValueError(
            f"the line {omega[i]:.6g} rad/s is {order[i]:.6g} times the fundamental of the period "
            f"{period:.6g} s, not a whole number: take the lines from jq.excitation.harmonics."
        )
