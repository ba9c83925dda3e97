"""Tables of a two-level Fourier transform, made once on the host in NumPy."""

import functools as ft
from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from ._window import waves


_TOLERANCE = 6e-14  # of a block's exponentials; leaves 2e-13 of the largest Fourier sum
_BANDS = 3


def rank(block: int, angle: Float[np.ndarray, " frequencies"]) -> Float[np.ndarray, " _"]:
    """About how many real functions span exp(-j w n), |w| <= `angle`, over a block to 1e-13.

    The Landau-Widom law for prolate functions: 2 c / pi + O(log c) with c = angle block / 2.
    """
    c = angle * block / 2
    return np.minimum(2 * c / np.pi + 6 + 6.4 * np.log1p(c), block)


def band_edges(ranks: Float[np.ndarray, " frequencies"]) -> tuple[int, ...]:
    """Ends of up to three bands of ascending frequencies, each of which gets its own rank."""
    total = ranks.size
    splits = [s + (total,) for s in combinations_with_replacement(range(1, total + 1), _BANDS - 1)]

    def cost(ends: tuple[int, ...]) -> float:
        counts = np.diff((0, *ends))
        # Each function of a band is copied once a window, which costs about ten frequencies.
        return sum(ranks[e - 1] * (n + 10) for e, n in zip(ends, counts, strict=True) if n)

    return tuple(sorted(set(min(splits, key=cost))))


def nested_basis(
    block: int, angles: Sequence[float]
) -> tuple[Float[np.ndarray, "block rank"], tuple[int, ...]]:
    """Orthonormal columns whose first `ranks[i]` span all exp(-j w n) with |w| <= `angles[i]`.

    The first two are the constant and the ramp.
    """
    place = np.arange(block) - (block - 1) / 2
    basis = np.stack([np.ones(block), place], axis=1)
    basis /= np.linalg.norm(basis, axis=0)
    ranks = []
    for angle in angles:
        nodes = int(angle * block) + 32
        grid = angle * np.sin(np.pi / 2 * (np.arange(nodes) + 0.5) / nodes)
        phase = place[:, None] * grid
        waves = np.concatenate([np.cos(phase), np.sin(phase)], axis=1)
        scale = np.linalg.norm(waves)
        for _ in range(2):
            waves -= basis @ (basis.T @ waves)
        new, sizes, _ = np.linalg.svd(waves, full_matrices=False)
        new = new[:, : min(np.count_nonzero(sizes > _TOLERANCE * scale), block - basis.shape[1])]
        new -= basis @ (basis.T @ new)
        basis = np.concatenate([basis, np.linalg.qr(new)[0]], axis=1)
        ranks.append(basis.shape[1])
    return basis, tuple(ranks)


def window_tables(
    length: int,
    shape: str,
    detrend: str,
    bands: Sequence[Float[np.ndarray, " _"]],
    basis: Float[np.ndarray, "block rank"],
    ranks: Sequence[int],
) -> list[Float[np.ndarray, "2 frequencies blocks_times_rank"]]:
    """What turns the compressed blocks of a window into its Fourier sums, one table to a band.

    Real and imaginary parts are separate; the taper and the removal of a trend are included.
    """
    tables = []
    for angle, size in zip(bands, ranks, strict=True):
        table = _tapered(length, shape, angle, basis[:, :size])
        table = _without_trend(table, length, detrend, basis[:, :size])
        flat = table.reshape(angle.size, -1)
        tables.append(np.stack([np.real(flat), np.imag(flat)]))
    return tables


def _tapered(
    length: int,
    shape: str,
    angle: Float[np.ndarray, " frequencies"],
    basis: Float[np.ndarray, "block rank"],
) -> Complex[np.ndarray, "frequencies blocks rank"]:
    level, cosine, sine = waves(shape)
    block = basis.shape[0]
    inner = np.arange(block)
    spins = np.exp(-1j * angle[:, None] * inner)
    turn = 2 * np.pi * inner / length
    weights = np.stack([np.ones(block), np.cos(turn), np.sin(turn)])
    weighted = np.concatenate([basis * each[:, None] for each in weights], axis=1)
    products = np.real(spins) @ weighted + 1j * (np.imag(spins) @ weighted)
    plain, even, odd = np.split(products[:, None, :], 3, axis=2)
    first = np.arange(0, length, block)
    theta = (2 * np.pi * first / length)[None, :, None]
    # cos(theta + turn), so that three products with the basis serve all blocks.
    raised = level * plain - cosine * (np.cos(theta) * even - np.sin(theta) * odd)
    raised = raised - sine * (np.sin(theta) * even + np.cos(theta) * odd) if sine else raised
    return np.exp(-1j * angle[:, None] * first)[:, :, None] * raised


def _without_trend(
    table: Complex[np.ndarray, "frequencies blocks rank"],
    length: int,
    detrend: str,
    basis: Float[np.ndarray, "block rank"],
) -> Complex[np.ndarray, "frequencies blocks rank"]:
    """Fourier sums less those of the trend, whose coefficients are linear in the samples too."""
    shapes = {"none": 0, "constant": 1, "linear": 2}[detrend]
    blocks, block = table.shape[1], basis.shape[0]
    sample = np.arange(blocks * block)
    for trend in (np.ones(sample.size), 2 * sample / (length - 1) - 1)[:shapes]:
        inside = np.where(sample < length, trend, 0)
        sums = np.tensordot(table, inside.reshape(blocks, block) @ basis, 2)
        functional = trend.reshape(blocks, block) @ basis / np.sum(inside**2)
        table = table - sums[:, None, None] * functional
    return table


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
