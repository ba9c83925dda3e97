"""What a coloured residual does to least-squares estimates."""

import numpy as np
from jaxtyping import Float


_LEAST = 4  # of the record's own frequencies on either side that are averaged into one
_SHARE = 0.1  # of the frequency, as far as the average reaches above that
_FLOOR = 0.05  # of a frequency that the fit leaves to the noise, at least


def projected_noise(
    columns: Float[np.ndarray, "samples outputs columns"],
    residual: Float[np.ndarray, "samples outputs"],
    basis: Float[np.ndarray, "samples outputs fitted"],
) -> Float[np.ndarray, "columns columns"]:
    """Covariance of `columns`' v, for noise v with the spectrum of the residual.

    The spectrum is the residual's periodogram, averaged over neighbouring frequencies, with what
    the orthonormal `basis` of everything fitted took out of it put back.
    Source: Klein & Morelli, Aircraft System Identification, sec. 6.3, with the residual's
    spectrum in place of its autocorrelation.
    """
    from scipy.fft import next_fast_len

    samples, outputs = residual.shape
    length = int(next_fast_len(2 * samples, real=True) or 2 * samples)
    taken = np.sum(np.abs(np.fft.rfft(basis, length, axis=0)) ** 2, axis=2) / samples
    turned = np.fft.rfft(residual, length, axis=0)
    reach = _reach(len(turned), length / samples)
    left = np.sqrt(np.maximum(1 - _averaged(taken, reach), _FLOOR))
    seen = np.fft.rfft(columns, length, axis=0)
    twice = np.where(np.arange(len(seen)) * 2 % length == 0, 1.0, 2.0) / length
    total = np.zeros((columns.shape[2],) * 2)
    for i, j in np.ndindex(outputs, outputs):
        cross = _averaged(turned[:, i].conj() * turned[:, j] / samples, reach)
        weight = np.reshape(twice * cross / (left[:, i] * left[:, j]), (-1, 1))
        total += np.real((np.conj(seen[:, i]) * np.conj(weight)).T @ seen[:, j])
    return 0.5 * (total + total.T)


def orthonormal(
    columns: Float[np.ndarray, "samples outputs columns"],
) -> Float[np.ndarray, "samples outputs columns"]:
    """An orthonormal basis of what the columns span over all samples and outputs."""
    scale = np.linalg.norm(columns, axis=(0, 1))
    columns = columns / np.where(scale > 1e-12 * np.max(scale, initial=0.0), scale, np.inf)
    return np.linalg.qr(columns.reshape(-1, columns.shape[2]))[0].reshape(columns.shape)


def _reach(bins: int, finer: float) -> np.ndarray:
    return np.ceil(np.maximum(_LEAST * finer, _SHARE * np.arange(bins))).astype(int)


def _averaged(x: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """The mean over `reach` neighbours on either side, mirrored at the ends."""
    bins, furthest = len(x), min(int(reach.max()), len(x) - 1)
    mirrored = np.concatenate([x[furthest:0:-1].conj(), x, x[-2 : -furthest - 2 : -1].conj()])
    sums = np.concatenate([np.zeros((1, *x.shape[1:]), x.dtype), np.cumsum(mirrored, axis=0)])
    reach = np.minimum(reach, furthest)
    centre = np.arange(bins) + furthest
    count = (2 * reach + 1).reshape(-1, *(1,) * (x.ndim - 1))
    return (sums[centre + reach + 1] - sums[centre - reach]) / count
