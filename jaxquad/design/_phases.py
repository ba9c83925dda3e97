"""Phases under which no signal exceeds its limit by more than need be."""

import numpy as np
from jaxtyping import Complex, Float, Int


_NORMS = (4, 16, 64, 256)  # each the start of the next; the last is almost the peak
_STEPS = 60  # of each
_STARTS = 4
_COARSE, _FINE = 8, 64  # least points to a cycle of the highest line: to search, and to judge

Phase = Float[np.ndarray, " frequencies"]
Amplitudes = Complex[np.ndarray, "signals frequencies"]


def least_peak_phases(
    orders: Int[np.ndarray, " frequencies"], amplitudes: Amplitudes, *, seed: int
) -> Phase:
    """Phases of the lines that lower the largest peak of several signals at once.

    The signals are sums of `amplitudes` times cos(order 2 pi t + phase), `orders` per period, in
    units of their limits. The p-norm over all of them is lowered for a rising p, from several
    starts. Source: Guillaume, Schoukens, Pintelon and Kollar (1991), for one signal.
    """
    used = np.flatnonzero(amplitudes[0])
    few, heights = orders[used], amplitudes[:, used]
    rng = np.random.default_rng(seed)
    starts = [_schroeder(few, heights[0])]
    starts += [rng.uniform(-np.pi, np.pi, used.size) for _ in range(_STARTS - 1)]
    found = [_lowered(start, few, heights) for start in starts]
    highest = [peaks(few, phase, heights).max() for phase in found]
    phase = np.zeros(orders.size)
    phase[used] = found[int(np.argmin(highest))]
    return phase


def peaks(
    orders: Int[np.ndarray, " frequencies"], phase: Phase, amplitudes: Amplitudes
) -> Float[np.ndarray, " signals"]:
    """The least bound on each signal's peak at any time that its values at many points give.

    Between N points, a signal of order n exceeds them by 1 / cos(pi n / N) at most (Ehlich and
    Zeller, 1964): 0.1 %.
    """
    points = 1 << int(np.ceil(np.log2(_FINE * orders.max())))
    levels = np.abs(waves(orders, phase, amplitudes, points))
    return levels.max(axis=1) / np.cos(np.pi * orders.max() / points)


def waves(
    orders: Int[np.ndarray, " frequencies"], phase: Phase, amplitudes: Amplitudes, points: int
) -> Float[np.ndarray, "signals points"]:
    """One period of each signal, at evenly spaced points."""
    return _waves(orders, amplitudes * np.exp(1j * phase), points)


def _schroeder(
    orders: Int[np.ndarray, " frequencies"], amplitudes: Complex[np.ndarray, " frequencies"]
) -> Phase:
    """Each line's delay in proportion to the power of the lines below it (Schroeder, 1970)."""
    power = np.abs(amplitudes) ** 2
    below = np.concatenate([[0.0], np.cumsum(power)[:-1]]) / power.sum()
    return -2 * np.pi * np.concatenate([[0.0], np.cumsum(below[1:] * np.diff(orders))])


def _lowered(
    phase: Phase, orders: Int[np.ndarray, " frequencies"], amplitudes: Amplitudes
) -> Phase:
    from scipy.optimize import minimize

    points = 1 << int(np.ceil(np.log2(_COARSE * orders.max())))
    for norm in _NORMS:
        lowered = minimize(
            _log_norm, phase, (orders, amplitudes, points, norm),
            jac=True, method="CG", options=dict(maxiter=_STEPS),
        )  # fmt: skip
        phase = lowered.x
    return phase


def _log_norm(
    phase: Phase,
    orders: Int[np.ndarray, " frequencies"],
    amplitudes: Amplitudes,
    points: int,
    norm: int,
) -> tuple[float, Phase]:
    """Logarithm of the norm over all signals and points, and its gradient."""
    turned = amplitudes * np.exp(1j * phase)
    signals = _waves(orders, turned, points)
    top = np.abs(signals).max()
    unit = signals / top
    powers = unit ** (norm - 2)
    total = np.sum(powers * unit**2)
    through = np.fft.rfft(powers * unit / (top * total), axis=1)[:, orders]
    slope = np.real(1j * turned * np.conj(through)).sum(axis=0)
    return float(np.log(total / unit.size) / norm + np.log(top)), slope


def _waves(
    orders: Int[np.ndarray, " frequencies"], amplitudes: Amplitudes, points: int
) -> Float[np.ndarray, "signals points"]:
    spectrum = np.zeros((len(amplitudes), points // 2 + 1), complex)
    spectrum[:, orders] = 0.5 * points * amplitudes
    return np.fft.irfft(spectrum, points, axis=1)
