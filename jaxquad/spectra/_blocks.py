"""Tables of a two-level Fourier transform, made once on the host in NumPy."""

from collections.abc import Sequence
from itertools import combinations_with_replacement

import numpy as np
from jaxtyping import Complex, Float

from ._window import coefficients


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

    Real and imaginary parts apart; the taper and the removal of a trend are in the numbers.
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
    level, cosine = coefficients(shape)
    block = basis.shape[0]
    inner = np.arange(block)
    waves = np.exp(-1j * angle[:, None] * inner)
    turn = 2 * np.pi * inner / length
    weights = np.stack([np.ones(block), np.cos(turn), np.sin(turn)])
    weighted = np.concatenate([basis * each[:, None] for each in weights], axis=1)
    products = np.real(waves) @ weighted + 1j * (np.imag(waves) @ weighted)
    plain, even, odd = np.split(products[:, None, :], 3, axis=2)
    first = np.arange(0, length, block)
    theta = (2 * np.pi * first / length)[None, :, None]
    # cos(theta + turn), so that three products with the basis serve all blocks.
    raised = level * plain - cosine * (np.cos(theta) * even - np.sin(theta) * odd)
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
