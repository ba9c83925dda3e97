"""Windows folded about their middle, and the tables that turn them into Fourier sums.

A raised cosine is even about the middle of its window, half a window after its first sample, and
its derivatives are even or odd. So the real part of a sum takes only the sums of samples that are
mirror images of each other, and the imaginary part their differences: half the products. With
blocks of samples that are even and odd themselves, coefficients are folded instead of samples.
"""

import functools as ft
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from ._basis import Basis
from ._window import waves


class Fold(NamedTuple):
    """How the half windows of one length are made of blocks, from the middle outwards.

    The first block begins at the sample `first` from the middle; at minus half a block, the middle
    one of an odd number, it is its own mirror image.
    """

    length: int
    blocks: int  # to half a window
    first: float
    trends: int  # that are removed: none, the constant, and the ramp

    @property
    def extras(self) -> int:
        """Values ahead of the coefficients: what the ends lack, then the trends."""
        return 1 + self.trends


Columns = Float[np.ndarray, "channels windows columns"]


def fold_of(length: int, block: int, trends: int) -> Fold:
    """That of a window of whole blocks."""
    blocks = length // block
    return Fold(length, (blocks + 1) // 2, -block / 2 if blocks % 2 else 0.0, trends)


def fold_blocks(
    fold: Fold,
    basis: Basis,
    coefficients: Float[np.ndarray, "channels blocks rank"],
    starts: tuple[int, ...],  # in blocks
    ends: Float[np.ndarray, "2 channels windows"],  # first samples, and those after the last
) -> tuple[Columns, Columns]:
    """Sums and differences of the coefficients of mirrored blocks, with their extras.

    The columns of one band follow those of the bands below, block by block.
    """
    channels, _, rank = coefficients.shape
    width = fold.extras + rank * fold.blocks
    sums, differences = (np.empty((channels, len(starts), width)) for _ in range(2))
    mirrored = coefficients * basis.signs
    right = fold.length // basis.samples // 2
    left = right if fold.first else right - 1
    for (run, first, step), (low, high) in itertools.product(_runs(starts), basis.bands):
        into = (channels, run.stop - run.start, fold.blocks, high - low)
        behind = _windows(coefficients, (first + right, low), step, into)
        before = _windows(mirrored, (first + left, low), step, into, direction=-1)
        mine = slice(fold.extras + low * fold.blocks, fold.extras + high * fold.blocks)
        np.add(behind, before, out=sums[:, run, mine].reshape(into))
        np.subtract(behind, before, out=differences[:, run, mine].reshape(into))
    sums[:, :, 0], differences[:, :, 0] = ends[0] - ends[1], ends[0] + ends[1]
    if fold.trends:
        _find_trends(fold, basis, sums, differences)
    return sums, differences


@ft.lru_cache(maxsize=64)
def _runs(starts: tuple[int, ...]) -> list[tuple[slice, int, int]]:
    """Windows with a constant step: which, the first start and the step."""
    runs, steps, begin = [], np.diff(starts).tolist(), 0
    while begin < len(starts):
        end = begin + 1
        while end < len(starts) and steps[end - 1] == steps[begin]:
            end += 1
        runs.append((slice(begin, end), starts[begin], steps[begin] if end > begin + 1 else 1))
        begin = end
    return runs


def _windows(
    coefficients: Float[np.ndarray, "channels blocks rank"],
    first: tuple[int, int],
    step: int,
    shape: tuple[int, ...],
    direction: int = 1,
) -> Float[np.ndarray, "channels windows half taken"]:
    """A view of the blocks from the `first` block and function on, upwards or downwards."""
    down, along, across = coefficients.strides
    strides = (down, step * along, direction * along, across)
    # A tenth of the time that `as_strided` takes.
    return np.ndarray(shape, float, coefficients, first[0] * along + first[1] * across, strides)


def _weights(fold: Fold) -> Float[np.ndarray, " blocks"]:
    """One for each block of half a window; a half where it is its own mirror image."""
    weights = np.ones(fold.blocks)
    weights[0] = 0.5 if fold.first < 0 else 1.0
    return weights


def _middles(fold: Fold, basis: Basis) -> Float[np.ndarray, " blocks"]:
    return fold.first + (np.arange(fold.blocks) + 0.5) * basis.samples


def _find_trends(fold: Fold, basis: Basis, sums: Columns, differences: Columns) -> None:
    """Fill in the mean of each window and the slope, in units of its trend `_ramp`."""
    weights, length, size = _weights(fold), fold.length, basis.ranks[0]
    first = slice(fold.extras, fold.extras + size * fold.blocks, size)
    second = slice(fold.extras + 1, fold.extras + 1 + size * fold.blocks, size)
    lacking, both = sums[:, :, 0], differences[:, :, 0]
    total = sums[:, :, first] @ (basis.level * weights) + lacking / 2
    sums[:, :, 1] = differences[:, :, 1] = total / length
    if fold.trends < 2:
        return
    moment = differences[:, :, first] @ (basis.level * weights * _middles(fold, basis))
    moment += differences[:, :, second] @ (basis.slope * weights)
    moment += total / 2 - length / 4 * both
    sums[:, :, 2] = differences[:, :, 2] = moment * 12 / (length * (length**2 - 1.0))


class Table(NamedTuple):
    """What turns the folded windows into their Fourier sums in one band of frequencies.

    The rows of one taper follow those of the other.
    """

    of_sums: Float[np.ndarray, "rows columns"]
    of_differences: Float[np.ndarray, "rows columns"]
    odd: tuple[bool, ...]  # of each taper: the sums make the imaginary part


def make_tables(
    fold: Fold,
    basis: Basis,
    bands: Sequence[Float[np.ndarray, " _"]],
    shapes: Sequence[str],
) -> tuple[Table, ...]:
    """One table to a band, for all tapers. Phases count from the middle of a window."""
    shift, found = 2 * np.pi / fold.length, []
    for angle, size in zip(bands, basis.ranks, strict=True):
        grids, rows, odd = (angle, angle + shift, angle - shift), [], []
        plain, above, below = (_spins(fold, basis, each, size) for each in grids)
        for shape in shapes:
            level, cosine, sine = waves(shape)  # about the first sample, where the angle is -pi
            raised = level * plain + cosine / 2 * (above + below)
            parts = np.real(raised), -np.imag(raised)
            if sine:  # cos(w n) sin(d n), which is odd, and sin(w n) sin(d n)
                raised = sine / 2 * (above - below)
                parts = np.real(raised), np.imag(raised)
            rows.append(_with_extras(fold, basis, angle, parts, level - cosine))
            odd.append(bool(sine))
        of_sums, of_differences = (np.concatenate(each) for each in zip(*rows, strict=True))
        found.append(Table(of_sums, of_differences, tuple(odd)))
    return tuple(found)


def _spins(
    fold: Fold, basis: Basis, angle: Float[np.ndarray, " frequencies"], size: int
) -> Complex[np.ndarray, "frequencies rank blocks"]:
    """Coefficients of exp(j angle n), n from the middle of a window."""
    first = fold.first + np.arange(fold.blocks) * basis.samples
    along = np.exp(1j * angle[:, None] * first) * _weights(fold)
    return basis.spin(angle)[:, :size, None] * along[:, None]


def _with_extras(
    fold: Fold,
    basis: Basis,
    angle: Float[np.ndarray, " frequencies"],
    parts: tuple[Float[np.ndarray, "frequencies rank blocks"], ...],
    end: float,  # value of the taper at its first sample
) -> list[Float[np.ndarray, "frequencies columns"]]:
    """Tables with columns for the two ends and, negative, the sums of the trends themselves."""
    n, half = fold.length, fold.length / 2
    of_sums, of_differences = parts
    ends = end / 2 * np.cos(angle * half), end / 2 * np.sin(angle * half)
    # A constant has even coefficients, 2 at both ends and 0 between them; a ramp is odd.
    constant = 2 * basis.level * np.sum(of_sums[:, 0], axis=1), 2 * ends[1]
    slant = basis.level * of_differences[:, 0] @ _middles(fold, basis)
    slant = 2 * (slant + basis.slope * np.sum(of_differences[:, 1], axis=1))
    ramp = -n * ends[0] + constant[0] / 2, slant + constant[1] / 2
    return [
        np.concatenate(
            [
                np.stack([e, -c, -r][: fold.extras], axis=1),
                _in_bands(basis, np.swapaxes(part, 1, 2)),
            ],
            axis=1,
        )
        for e, c, r, part in zip(ends, constant, ramp, parts, strict=True)
    ]


def _in_bands(
    basis: Basis, values: Float[np.ndarray, "*many blocks rank"]
) -> Float[np.ndarray, "*many columns"]:
    """The values of one band after the other, block by block."""
    many, rank = values.shape[:-2], values.shape[-1]
    parts = [values[..., low:high].reshape(*many, -1) for low, high in basis.bands if low < rank]
    return np.concatenate(parts, axis=-1)


def fold_samples(
    fold: Fold, basis: Basis, segments: Float[np.ndarray, "channels windows samples"]
) -> tuple[Columns, Columns]:
    """Like `fold_blocks`, of windows that may lie anywhere, without their trends."""
    half, odd = divmod(fold.length, 2)
    padded = (*segments.shape[:2], fold.blocks * basis.samples + 1)
    rank, folded = basis.signs.size, []
    right, left = segments[:, :, half + odd :], segments[:, :, half:0:-1]
    for combine, sign in ((np.add, 1.0), (np.subtract, -1.0)):
        samples = np.zeros(padded)
        combine(right, left, out=samples[:, :, :half])
        samples[:, :, half] = sign * segments[:, :, 0]  # which has no mirror image
        samples[:, :, 0] *= 1.0 + odd  # the first place of a block counts half
        blocks = np.lib.stride_tricks.sliding_window_view(samples, basis.samples + 1, axis=2)
        found = blocks[:, :, :: basis.samples] @ basis.weights
        columns = np.zeros((*padded[:2], fold.extras + rank * fold.blocks))
        columns[:, :, fold.extras :] = _in_bands(basis, found)
        folded.append(columns)
    return folded[0], folded[1]


def fold_anywhere(length: int, block: int, trends: int) -> Fold:
    """That of a window of any number of samples, whose trends are removed before."""
    half, odd = divmod(length, 2)
    return Fold(length, half // block + 1, odd / 2, trends)
