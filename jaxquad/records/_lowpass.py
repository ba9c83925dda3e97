from collections.abc import Callable

import numpy as np
from jaxtyping import Float


Samples = Float[np.ndarray, " samples"]

# Kaiser's formulas for 72 dB over a transition from 0.3 to 0.5 of the sample rate.
_BETA = 0.1102 * (72 - 8.7)
_HALF = 0.5 * (72 - 7.95) / (2.285 * 2 * np.pi * 0.2)  # samples of the target grid
_CUTOFF = 0.4  # of the target rate, where the filter is down by 6 dB


def half_width(sample_rate: float | int) -> float:
    """How far the filter for `sample_rate` (Hz) looks to either side, in s."""
    return (_HALF + 1) / sample_rate


def lowpass(
    curve: Callable[[Samples], Samples],
    span: tuple[float, float],
    time: Samples,
    sample_rate: float | int,
    fastest: float,
) -> Samples:
    """`curve` at the instants `time` (s, at `sample_rate` in Hz), rid of what would alias.

    The curve is known over `span` (s) and goes on beyond it by reflection about its end
    points, which keeps a straight line straight. `fastest` (Hz) is the highest native rate: the
    filter runs on a grid twice as fine as that, the same for all channels.
    """
    fold = int(np.ceil(2 * fastest / sample_rate))
    taps = _taps(fold)
    half = taps.size // 2
    fine = fold * sample_rate
    lowest, highest = -half, (time.size - 1) * fold + half
    first = max(lowest, int(np.ceil((span[0] - time[0]) * fine - 1e-6)))
    last = min(highest, int(np.floor((span[1] - time[0]) * fine + 1e-6)))
    known = curve(np.clip(time[0] + np.arange(first, last + 1) / fine, *span))
    padding = (first - lowest, highest - last)
    padded = np.pad(known, padding, mode="reflect", reflect_type="odd")
    return np.lib.stride_tricks.sliding_window_view(padded, taps.size)[::fold] @ taps


def _taps(fold: int) -> Float[np.ndarray, " taps"]:
    half = int(np.ceil(_HALF * fold))
    position = np.arange(-half, half + 1) / fold
    taps = np.sinc(2 * _CUTOFF * position) * np.kaiser(2 * half + 1, _BETA)
    return taps / taps.sum()
