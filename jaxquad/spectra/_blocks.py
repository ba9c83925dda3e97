"""Blocks of samples that windows of several lengths share, and windows made of whole blocks."""

import functools as ft
from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float


def rank(block: int, angle: Float[np.ndarray, " frequencies"]) -> Float[np.ndarray, " _"]:
    """About how many real functions span exp(-j w n), |w| <= `angle`, over a block to 1e-13.

    The Landau-Widom law for prolate functions: 2 c / pi + O(log c) with c = angle block / 2.
    """
    c = angle * block / 2
    return np.minimum(2 * c / np.pi + 6 + 6.4 * np.log1p(c), block)


def band_edges(ranks: Float[np.ndarray, " frequencies"]) -> tuple[int, ...]:
    """Ends of up to three bands of ascending frequencies, each of which gets its own rank."""
    total = ranks.size
    first, second = np.triu_indices(total)
    ends = np.stack([first + 1, second + 1, np.full(first.size, total)])
    counts = np.diff(ends, axis=0, prepend=0)
    # Each function of a band is copied once a window, which costs about ten frequencies.
    cost = np.sum(np.where(counts > 0, ranks[ends - 1] * (counts + 10), 0), axis=0)
    return tuple(sorted(set(ends[:, np.argmin(cost)].tolist())))


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


class Level(NamedTuple):
    """So `many` blocks of a lattice taken together, from block `offset` on."""

    many: int
    offset: int

    def holds(self, blocks: int, starts: Sequence[int]) -> bool:
        """Whether windows of so many blocks that start there are made of whole ones."""
        return blocks % self.many == 0 and all((s - self.offset) % self.many == 0 for s in starts)


_LEVELS = 2  # of longer blocks, at most


def choose_levels(
    lattice: Lattice,
    windows: Sequence[tuple[int, tuple[int, ...]]],
    angle: Float[np.ndarray, " frequencies"],
) -> tuple[Level, ...]:
    """The single blocks, and the longer ones that need the fewest multiplications for all windows.

    A long block takes fewer functions to a sample.
    """
    groups = []
    for length, starts in windows:
        on = [s for s in starts if lattice.holds(length, s)]
        if on and angle.size:
            first = [(s - lattice.offset) // lattice.block for s in on]
            groups.append((length // lattice.block, first))
    if not groups:
        return (_SINGLE,)
    steps = [np.gcd.reduce([blocks, *np.diff(first)]) for blocks, first in groups]
    found = {
        Level(many, first[0] % many)
        for step, (_, first) in zip(steps, groups, strict=True)
        for many in range(2, step + 1)
        if step % many == 0
    }
    each = {
        level: np.array([_level_cost(lattice, level, angle, *group) for group in groups])
        for level in (_SINGLE, *found)
    }
    choices = [few for count in range(_LEVELS + 1) for few in combinations(sorted(found), count)]

    def cost(levels: tuple[Level, ...]) -> float:
        made = sum(_merging_cost(lattice, level, angle) for level in levels)
        return made + np.sum(np.min([each[level] for level in (_SINGLE, *levels)], axis=0))

    return (_SINGLE, *min(choices, key=cost))


_SINGLE = Level(1, 0)


def _level_cost(
    lattice: Lattice,
    level: Level,
    angle: Float[np.ndarray, " _"],
    blocks: int,
    starts: Sequence[int],
) -> float:
    """Real multiplications for each channel, of folded windows."""
    if not level.holds(blocks, starts):
        return np.inf
    ranks = rank(level.many * lattice.block, angle)
    # Two tapers, mostly; to fold a coefficient takes about as long as 80 products.
    return len(starts) * blocks / level.many * (2 * np.sum(ranks) + 80 * np.max(ranks))


def _merging_cost(lattice: Lattice, level: Level, angle: Float[np.ndarray, " _"]) -> float:
    one, all_ = (rank(many * lattice.block, angle[-1:])[0] for many in (1, level.many))
    return lattice.count * one * (all_ + 10)


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
    long = tuple(length for length in lengths if length >= 16 * _BLOCKS[0])
    block = _common_block(long, float(np.max(np.abs(angle)))) if long else 1
    return tuple(_spread(samples, n, overlap, block if n in long else 1) for n in lengths)


@ft.lru_cache(maxsize=64)
def _common_block(lengths: tuple[int, ...], angle: float) -> int:
    """A block of about 50 rad that divides all lengths, or else changes them by least."""
    ideal = min(50 / max(angle, 1e-9), min(lengths) / 8, _BLOCKS[1])
    sizes = np.arange(max(int(ideal / 2), _BLOCKS[0]), max(int(1.5 * ideal), _BLOCKS[0]) + 1)
    change = [max(abs(round(n / b) * b / n - 1) for n in lengths) for b in sizes]
    best = np.flatnonzero(np.array(change) <= min(change) + 1e-12)
    return int(sizes[best[np.argmin(np.abs(sizes[best] - ideal))]])


@ft.lru_cache(maxsize=256)
def _spread(samples: int, length: int, overlap: float, block: int) -> tuple[int, tuple[int, ...]]:
    length = min(round(length / block), samples // block) * block
    step = max(int(round(length * (1 - overlap))), 1)
    count = -(-(samples - length) // step) + 1
    last = samples - length
    ideal = np.linspace(0, last, count)
    starts = last - np.round((last - ideal) / block).astype(int) * block
    return length, tuple(sorted({max(int(start), 0) for start in (0, *starts[1:])}))
