"""Raised-cosine windows, and where they lie in a record."""

import functools as ft

import numpy as np
from jaxtyping import Float


Layout = tuple[tuple[int, tuple[int, ...]], ...]  # length and starts of each set of windows

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


_BLOCKS = (32, 1024)  # samples to a block that windows of several lengths share


@ft.lru_cache(maxsize=64)
def lattice_windows(
    samples: int, lengths: tuple[int, ...], overlap: float, highest: float
) -> Layout:
    """Windows near `lengths` that overlap by about `overlap`, of whole blocks where that pays.

    A block is about 50 rad long at the `highest` frequency (rad per sample). Lengths become
    multiples of it; starts lie on blocks counted from the record's end, but the first window of
    each length starts at the first sample: both ends are reached. Windows shorter than 16 of the
    smallest blocks keep their length and their even spread.
    Raises `ValueError` for an overlap outside [0, 1) or a length that the record does not hold.
    """
    if not 0 <= overlap < 1:
        raise ValueError(f"overlap {overlap} is not in [0, 1): 0.5 or 0.8 are usual")
    for length in lengths:
        if not 2 <= length <= samples:
            raise ValueError(
                f"a window of {length} samples does not fit a record of {samples}: give lengths "
                f"of 2 to {samples} samples"
            )
    long = [length for length in lengths if length >= 16 * _BLOCKS[0]]
    common = 1
    if long:  # the block that divides all lengths, or else changes them by least
        ideal = min(50 / max(highest, 1e-9), min(long) / 8, _BLOCKS[1])
        sizes = np.arange(max(int(ideal / 2), _BLOCKS[0]), max(int(1.5 * ideal), _BLOCKS[0]) + 1)
        change = [max(abs(round(n / b) * b / n - 1) for n in long) for b in sizes]
        best = np.flatnonzero(np.array(change) <= min(change) + 1e-12)
        common = int(sizes[best[np.argmin(np.abs(sizes[best] - ideal))]])
    layout = []
    for length in lengths:
        block = common if length in long else 1
        length = min(round(length / block), samples // block) * block
        step, last = max(int(round(length * (1 - overlap))), 1), samples - length
        ideal = np.linspace(0, last, -(-last // step) + 1)
        starts = last - np.round((last - ideal) / block).astype(int) * block
        layout.append((length, tuple(sorted({max(int(s), 0) for s in (0, *starts[1:])}))))
    return tuple(layout)


_NEAR = 1e-2  # of a pole: its neighbourhood's rounding is below 1e-13


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
    correlation = np.sin(np.pi * cycles) * cycles * ratio / (np.pi * poles)
    close = cycles[near]
    correlation[near] = terms[0] * np.sinc(close)
    for k in (1, 2):
        correlation[near] += terms[k] * (np.sinc(close - k) + np.sinc(close + k))
    return (correlation / terms[0]) ** 2
