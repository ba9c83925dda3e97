"""Blocks that the windows of several lengths share."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ._blocks import rank


_BLOCKS = (32, 1024)  # samples to a block


class Lattice(NamedTuple):
    """Blocks of `block` samples from sample `offset` on, `count` of them."""

    block: int
    offset: int
    count: int

    def holds(self, length: int, start: int) -> bool:
        return length % self.block == 0 and (start - self.offset) % self.block == 0


def choose_lattice(
    samples: int, windows: Sequence[tuple[int, tuple[int, ...]]], angle: Float[np.ndarray, " _"]
) -> Lattice:
    """The block length and offset that need the fewest multiplications for all windows."""
    shortest = min(length for length, _ in windows)
    sizes = range(_BLOCKS[0], min(_BLOCKS[1], shortest) + 1)
    lattices = [_best_offset(samples, windows, block) for block in sizes]
    return min(lattices, key=lambda lattice: _cost(samples, windows, angle, lattice))


def _best_offset(
    samples: int, windows: Sequence[tuple[int, tuple[int, ...]]], block: int
) -> Lattice:
    aligned = [np.array(starts) for length, starts in windows if length % block == 0]
    offset = 0
    if aligned:
        offset = int(np.argmax(np.bincount(np.concatenate(aligned) % block)))
    return Lattice(block, offset, (samples - offset) // block)


def _cost(
    samples: int,
    windows: Sequence[tuple[int, tuple[int, ...]]],
    angle: Float[np.ndarray, " _"],
    lattice: Lattice,
) -> float:
    """Real multiplications for each channel."""
    ranks = rank(lattice.block, angle)
    compressed, cost = samples, 0.0
    for length, starts in windows:
        blocks = -(-length // lattice.block)
        if length % lattice.block == 0:
            astray = np.count_nonzero((np.array(starts) - lattice.offset) % lattice.block)
        else:
            astray = len(starts)
        compressed += astray * blocks * lattice.block
        cost += len(starts) * blocks * 2 * np.sum(ranks)
    return cost + compressed * np.max(ranks)


def lattice_windows(
    samples: int,
    lengths: Sequence[int],
    overlap: float,
    angle: Float[np.ndarray, " frequencies"],
) -> tuple[tuple[int, tuple[int, ...]], ...]:
    """Windows near `lengths` that overlap by about `overlap`, of whole blocks where that pays.

    Lengths become multiples of a block; starts lie on blocks counted from the record's end, but
    the first window of each length starts at the first sample: both ends are reached. Windows
    shorter than 16 of the smallest blocks keep their length and their even spread.
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
    block = _common_block(long, float(np.max(np.abs(angle)))) if long else 1
    return tuple(_spread(samples, n, overlap, block if n in long else 1) for n in lengths)


def _common_block(lengths: Sequence[int], angle: float) -> int:
    """A block of about 50 rad that divides all lengths, or else changes them by least."""
    ideal = min(50 / max(angle, 1e-9), min(lengths) / 8, _BLOCKS[1])
    sizes = np.arange(max(int(ideal / 2), _BLOCKS[0]), max(int(1.5 * ideal), _BLOCKS[0]) + 1)
    change = [max(abs(round(n / b) * b / n - 1) for n in lengths) for b in sizes]
    best = np.flatnonzero(np.array(change) <= min(change) + 1e-12)
    return int(sizes[best[np.argmin(np.abs(sizes[best] - ideal))]])


def _spread(samples: int, length: int, overlap: float, block: int) -> tuple[int, tuple[int, ...]]:
    length = min(round(length / block), samples // block) * block
    step = max(int(round(length * (1 - overlap))), 1)
    count = -(-(samples - length) // step) + 1
    last = samples - length
    ideal = np.linspace(0, last, count)
    starts = last - np.round((last - ideal) / block).astype(int) * block
    return length, tuple(sorted({max(int(start), 0) for start in (0, *starts[1:])}))
