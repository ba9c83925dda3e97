"""Noise with the spectrum of a residual, as combinations of its samples see it."""

import functools as ft
import itertools

import numpy as np
from jaxtyping import Complex, Float


_LEAST = 4  # of the record's own frequencies on either side that are averaged into one
_SHARE = 0.1  # of the frequency, as far as the average reaches above that
_FLOOR = 0.05  # of a frequency that the fit leaves to the noise, at least
_WELL = 1e-3  # smallest eigenvalue of the products of columns of unit length for two rounds


def projected_noise(
    columns: Float[np.ndarray, "samples outputs columns"],
    residual: Float[np.ndarray, "samples outputs"],
    nuisance: Float[np.ndarray, "samples outputs unknowns"],
    count: int,
) -> Float[np.ndarray, "columns columns"]:
    """Covariance of `columns`' v, for noise v with the spectrum of the residual.

    The spectrum is the residual's periodogram, averaged over neighbouring frequencies, with what
    the fit took out of it put back: orthonormal are the first `count` columns and the `nuisance`.
    Source: Klein & Morelli, Aircraft System Identification, sec. 6.3, with the residual's
    spectrum in place of its autocorrelation.
    """
    from scipy.fft import next_fast_len, rfft

    samples, outputs = residual.shape
    length = int(next_fast_len(2 * samples, real=True) or 2 * samples)
    # Two series at once share the vectors of the processor; more of them only take memory.
    turn = lambda series: np.asarray(rfft(series, length))
    rest, driven, smooth, left = [], [], [], []
    windows = _windows(length // 2 + 1, length / samples)
    for o in range(outputs):
        driven.append(turn(columns[:, o].T))
        others = np.vstack([residual[:, o], nuisance[:, o].T])
        pairs = (turn(others[k : k + 2]) for k in range(0, len(others), 2))
        first = next(pairs)
        rest.append(first[0])
        taken = _power(driven[o][:count]) + _power(first[1:]) + sum(map(_power, pairs))
        smooth.append(_averaged(_power(first[:1]) / samples, windows))
        left.append(np.sqrt(np.maximum(1 - _averaged(taken / samples, windows), _FLOOR)))
    twice = np.full(length // 2 + 1, 2.0 / length)
    twice[0] = 1.0 / length
    twice[-1] /= 2.0 if length % 2 == 0 else 1.0
    total = np.zeros((columns.shape[2],) * 2)
    # The real part of a sum of conj(weight one) other over the bins.
    product = lambda one, weight, other: (weight * one).view(float) @ other.view(float).T
    for o in range(outputs):
        total += product(driven[o], twice * smooth[o] / left[o] ** 2, driven[o])
    for i, j in itertools.permutations(range(outputs), 2):
        cross = _averaged(rest[i].conj() * rest[j] / samples, windows)
        total += product(driven[i], twice * cross / (left[i] * left[j]), driven[j])
    return 0.5 * (total + total.T)


def _power(spectra: Complex[np.ndarray, "series bins"]) -> Float[np.ndarray, " bins"]:
    """The sum of their squares."""
    parts = spectra.view(float)
    squares = np.einsum("sp,sp->p", parts, parts)
    return squares[::2] + squares[1::2]


def orthonormal(
    columns: Float[np.ndarray, "samples outputs columns"],
) -> Float[np.ndarray, "samples outputs columns"]:
    """An orthonormal basis of what the columns span over all samples and outputs."""
    flat = columns.reshape(-1, columns.shape[2])
    scale = np.sqrt([column @ column for column in flat.T])
    shows = scale > 1e-12 * np.max(scale, initial=0.0)
    if not np.all(shows):
        flat = flat / np.where(shows, scale, np.inf)
    return orthogonal_factors(flat)[0].reshape(columns.shape)


def row_products(rows: Float[np.ndarray, "rows samples"]) -> Float[np.ndarray, "rows rows"]:
    """Products of each two of a few long rows.

    By a copy: BLAS's own way for a matrix and its transpose takes two to four times as long here.
    """
    return rows @ rows.copy(order="K").T


def orthogonal_factors(
    columns: Float[np.ndarray, "rows columns"],
) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, "columns columns"]]:
    """Orthonormal columns and the triangle that makes these ones of them.

    By their products, twice, where they are far from dependent: for tall matrices that takes a
    third of the time of reflections, and is as orthogonal.
    Source: Yamamoto et al. (2015), Roundoff error analysis of the CholeskyQR2 algorithm.
    """
    basis = columns.T
    products = row_products(basis)
    scale = np.sqrt(np.diagonal(products))
    if not np.all(scale > 0) or not np.all(np.isfinite(scale)):
        return np.linalg.qr(columns)
    triangle = np.eye(scale.size)
    for last in (False, True):
        unit = products / np.outer(scale, scale)
        if len(columns) < scale.size or np.linalg.eigvalsh(unit)[0] < _WELL:
            return np.linalg.qr(columns)
        upper = np.linalg.cholesky(unit).T * scale
        basis, triangle = np.linalg.inv(upper).T @ basis, upper @ triangle
        if not last:
            products, scale = row_products(basis), np.ones(scale.size)
    return basis.T, triangle


@ft.lru_cache(maxsize=8)
def _windows(bins: int, finer: float) -> tuple[np.ndarray, np.ndarray, int]:
    """Of a moving mean in a mirrored spectrum: first bins, those after the last, bins mirrored."""
    reach = np.ceil(np.maximum(_LEAST * finer, _SHARE * np.arange(bins))).astype(int)
    furthest = min(int(reach.max()), bins - 1)
    reach, centre = np.minimum(reach, furthest), np.arange(bins) + furthest
    return centre - reach, centre + reach + 1, furthest


def _averaged(x: np.ndarray, windows: tuple[np.ndarray, np.ndarray, int]) -> np.ndarray:
    """The mean over the windows around each bin, mirrored at the ends."""
    start, stop, furthest = windows
    mirrored = np.concatenate([x[furthest:0:-1].conj(), x, x[-2 : -furthest - 2 : -1].conj()])
    sums = np.concatenate([np.zeros(1, x.dtype), np.cumsum(mirrored)])
    return (sums[stop] - sums[start]) / (stop - start)
