"""Few functions that stand for blocks of samples in sums over a band of frequencies."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float


_TOLERANCE = 6e-14  # of a block's exponentials; leaves 2e-13 of the largest Fourier sum


class Basis(NamedTuple):
    """Functions on a block from one sample to another, each even or odd about its middle.

    Neighbours share the sample between them, which counts half in each: so a block is its own
    mirror image, and so is a window of whole blocks. The functions are orthonormal in such sums.
    The first `ranks[i]` span all exp(-j w n) of the band i and those below; the first two are the
    constant and the ramp.
    """

    samples: int  # of a block; it holds one more
    weights: Float[np.ndarray, "places rank"]  # from samples, or the coefficients of shorter blocks
    signs: Float[np.ndarray, " rank"]  # 1 of even functions, -1 of odd ones
    ranks: tuple[int, ...]
    level: float  # coefficient of the constant 1
    slope: float  # coefficient of the ramp of slope 1
    inner: "Basis | None" = None  # that of the shorter blocks, if any

    @property
    def bands(self) -> tuple[tuple[int, int], ...]:
        """The functions that each band adds, from the first to before the last."""
        return tuple(zip((0, *self.ranks[:-1]), self.ranks, strict=True))

    def spin(self, angle: Float[np.ndarray, " _"]) -> Complex[np.ndarray, "_ rank"]:
        """Coefficients of exp(j angle n), n from the block's first sample."""
        return _spin(self.inner, self.samples, angle) @ self.weights


def sample_basis(samples: int, angles: Sequence[float]) -> Basis:
    """That of blocks of samples, for bands that end at `angles` (rad per sample)."""
    root = np.ones(samples + 1)
    root[[0, -1]] = np.sqrt(0.5)
    ramp = root * (np.arange(samples + 1) - samples / 2)
    return _nested(None, samples, (root, ramp), np.ones((samples + 1, 1)), root, angles)


def merged_basis(inner: Basis, many: int, angles: Sequence[float]) -> Basis:
    """That of `many` blocks of `inner` each, made of their coefficients."""
    samples = many * inner.samples
    constant, ramp = np.zeros((2, many, inner.signs.size))
    constant[:, 0], ramp[:, 1] = inner.level, inner.slope
    ramp[:, 0] = inner.level * ((np.arange(many) + 0.5) * inner.samples - samples / 2)
    signs = np.tile(inner.signs, (many, 1))
    trends = constant.ravel(), ramp.ravel()
    return _nested(inner, samples, trends, signs, np.ones(signs.size), angles)


def _spin(
    inner: Basis | None, samples: int, angle: Float[np.ndarray, " _"]
) -> Complex[np.ndarray, "_ places"]:
    """exp(j angle n) on a block: its samples, or the coefficients of its shorter blocks."""
    if inner is None:
        return np.exp(1j * angle[:, None] * np.arange(samples + 1))
    first = np.arange(0, samples, inner.samples)
    turned = np.exp(1j * angle[:, None] * first)[:, :, None] * inner.spin(angle)[:, None]
    return turned.reshape(angle.size, -1)


def _nested(
    inner: Basis | None,
    samples: int,
    trends: tuple[Float[np.ndarray, " places"], Float[np.ndarray, " places"]],
    signs: Float[np.ndarray, "along across"],  # of the places, which mirror each other along it
    root: Float[np.ndarray, " places"],
    angles: Sequence[float],
) -> Basis:
    """Orthonormal functions of one band after the other, even and odd ones apart."""
    norms = [float(np.linalg.norm(trend)) for trend in trends]
    halves = [_half(signs, sign) for sign in (1.0, -1.0)]
    both = [
        half.T @ trend[:, None] / norm
        for half, trend, norm in zip(halves, trends, norms, strict=True)
    ]
    columns = [half @ each for half, each in zip(halves, both, strict=True)]
    order, ranks = [1.0, -1.0], []
    for angle in angles:
        nodes = int(angle * samples / 2) + 20  # of one sign: their mirror images add nothing
        grid = angle * np.cos(np.pi / 2 * np.arange(nodes) / nodes)
        middle = np.exp(-0.5j * grid * samples)[:, None]
        waves = (_spin(inner, samples, grid) * middle).T * root[:, None]
        scale = float(np.linalg.norm(waves))
        for k, part in enumerate((np.real(waves), np.imag(waves))):
            new = _beyond(both[k], halves[k].T @ part, scale)
            both[k] = np.concatenate([both[k], new], axis=1)
            columns.append(halves[k] @ new)
            order += [1.0 - 2.0 * k] * new.shape[1]
        ranks.append(len(order))
    weights = np.concatenate(columns, axis=1) * root[:, None]
    return Basis(samples, weights, np.array(order), tuple(ranks), norms[0], norms[1], inner)


def _half(
    signs: Float[np.ndarray, "along across"], sign: float
) -> Float[np.ndarray, "places half"]:
    """Orthonormal columns that span what is even (`sign` 1) or odd (-1), to the last digit."""
    number = np.arange(signs.size).reshape(signs.shape)
    mirror, signs = number[::-1].ravel(), signs.ravel()
    number = number.ravel()
    own = number[(mirror == number) & (signs == sign)]
    first = number[number < mirror]
    half = np.zeros((number.size, first.size + own.size))
    half[first, np.arange(first.size)] = np.sqrt(0.5)
    half[mirror[first], np.arange(first.size)] = sign * signs[first] * np.sqrt(0.5)
    half[own, first.size + np.arange(own.size)] = 1.0
    return half


def _beyond(
    basis: Float[np.ndarray, "half _"], waves: Float[np.ndarray, "half _"], scale: float
) -> Float[np.ndarray, "half _"]:
    """Orthonormal columns that span what `basis` lacks of the waves."""
    for _ in range(2):
        waves = waves - basis @ (basis.T @ waves)
    new, sizes, _ = np.linalg.svd(waves, full_matrices=False)
    new = new[:, : min(np.count_nonzero(sizes > _TOLERANCE * scale), len(basis) - basis.shape[1])]
    new = new - basis @ (basis.T @ new)
    return np.linalg.qr(new)[0]
