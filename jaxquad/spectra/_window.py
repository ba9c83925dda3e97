import functools as ft

import numpy as np
from jaxtyping import Float


_SHAPES = {"hann": (0.5, 0.5), "hamming": (0.54, 0.46), "rectangular": (1.0, 0.0)}


def window(name: str, samples: int) -> Float[np.ndarray, " window"]:
    """A periodic raised-cosine window of `samples` points: "hann", "hamming" or "rectangular"."""
    level, cosine, sine = waves(name)
    angle = 2 * np.pi * np.arange(samples) / samples
    return level - cosine * np.cos(angle) - sine * np.sin(angle)


def waves(name: str) -> tuple[float, float, float]:
    """Coefficients of a window with angle a = 2 pi n / samples: level - cosine cos a - sine sin a.

    A prime stands for a derivative by a: "hann'" and "hann''".
    """
    plain = name.rstrip("'")
    level, cosine = coefficients(plain)
    sine = 0.0
    for _ in range(len(name) - len(plain)):
        level, cosine, sine = 0.0, sine, -cosine
    return level, cosine, sine


def coefficients(name: str) -> tuple[float, float]:
    """Level and cosine amplitude of a window: level - cosine cos(2 pi n / samples)."""
    if name not in _SHAPES:
        raise ValueError(f"there is no window {name!r}: use one of {', '.join(_SHAPES)}")
    return _SHAPES[name]


@ft.lru_cache(maxsize=256)
def segment_starts(samples: int, length: int, overlap: float) -> tuple[int, ...]:
    """First samples of windows of `length` that overlap by at least `overlap` and reach both ends.

    The windows are spread evenly over the record, so that its end is not lost: the highest
    frequencies of a sweep are in its last seconds.
    """
    step = max(int(round(length * (1 - overlap))), 1)
    count = -(-(samples - length) // step) + 1
    return tuple(int(start) for start in np.round(np.linspace(0, samples - length, count)))


def leaked_power(
    shape: str, samples: int, angle: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    """Squared correlation of white noise behind a window at frequencies `angle` apart (rad)."""
    level, cosine = coefficients(shape)
    cycles = angle * samples / (2 * np.pi)
    terms = level**2 + cosine**2 / 2, level * cosine, cosine**2 / 4  # of the squared window
    # sinc(c - k) + sinc(c + k) for k = 0, 1, 2 have one sine in common, but poles at whole cycles.
    square = cycles**2
    poles = square * (square - 1) * (square - 4)
    near = np.abs(poles) < _NEAR
    poles = np.where(near, 1.0, poles)
    ratio = terms[0] * (square - 1) * (square - 4)
    ratio += 2 * square * (terms[2] * (square - 1) - terms[1] * (square - 4))
    found = np.sin(np.pi * cycles) * cycles * ratio / (np.pi * poles)
    found[near] = _correlation(terms, cycles[near])
    return (found / terms[0]) ** 2


_NEAR = 1e-2  # of a pole: its neighbourhood's rounding is below 1e-13


def _correlation(
    terms: tuple[float, float, float], cycles: Float[np.ndarray, " places"]
) -> Float[np.ndarray, " places"]:
    found = terms[0] * np.sinc(cycles)
    for k in (1, 2):
        found = found + terms[k] * (np.sinc(cycles - k) + np.sinc(cycles + k))
    return found
