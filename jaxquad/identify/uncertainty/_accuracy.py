"""From the derivatives at the solution to covariances, bounds and conditioning (host side)."""

import dataclasses
import functools as ft
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from jaxquad.spectra import FrequencyResponse

from ..frequency_domain._cost import expected_cost, mix, mix_twice, Mixing


Matrix = Float[np.ndarray, "parameters parameters"]


class Block(NamedTuple):
    """One response pair: what the fit lowers, slopes of ln-magnitude and phase, and the error."""

    residual: Float[np.ndarray, "frequencies 2"]
    rows: Float[np.ndarray, "frequencies 2 all"]  # slopes of the residual
    slopes: Float[np.ndarray, "frequencies 2 all"]
    weights: Float[np.ndarray, "frequencies 2"]
    error: Float[np.ndarray, " frequencies"]  # random error relative to the model
    expected: float  # what noise alone leaves of the squared residuals


class PriorRows(NamedTuple):
    """Prior knowledge, in standard errors."""

    misfit: Float[np.ndarray, " priors"]
    slopes: Float[np.ndarray, "priors all"]


def gauss_newton(blocks: list[Block], prior: PriorRows, count: int) -> tuple[Matrix, np.ndarray]:
    """`J'J` and `J'r` of the weighted residuals over the free parameters."""
    jacobian = [prior.slopes[:, :count]]
    residual = [prior.misfit]
    for block in blocks:
        jacobian.append(block.rows[..., :count].reshape(-1, count))
        residual.append(block.residual.reshape(-1))
    j, r = np.concatenate(jacobian), np.concatenate(residual)
    return j.T @ j, j.T @ r


class Noise(NamedTuple):
    """What the noise does: J'W S W J of data and of priors, and its share of the cost."""

    data: Matrix
    priors: Matrix
    cost: float  # expected cost of the noise before any parameter is fitted to it


@dataclasses.dataclass(frozen=True, eq=False)
class ResponseTerm:
    """One frequency response as the fit sees it."""

    frf: FrequencyResponse
    misfit: Float[np.ndarray, "frequencies outputs inputs 2"]
    slopes: Float[np.ndarray, "frequencies outputs inputs 2 all"]
    weights: Float[np.ndarray, "frequencies outputs inputs 2"]
    mixing: Mixing | None
    count: int  # of free parameters, the first of all

    @ft.cached_property
    def pulls(self) -> Float[np.ndarray, "frequencies outputs inputs 2 parameters"]:
        """How far a misfit of each point moves the gradient by each free parameter."""
        rows = self.weights[..., None] * self.slopes[..., : self.count]
        return self.weights[..., None] * mix_twice(self.mixing, rows)

    @ft.cached_property
    def ratio(self) -> Complex[np.ndarray, "frequencies outputs inputs"]:
        """Measurement over model."""
        return np.exp(-self.misfit[..., 0] - 1j * self.misfit[..., 1])

    @ft.cached_property
    def error_exponent(self) -> Float[np.ndarray, "frequencies outputs inputs"]:
        """As in `FrequencyResponse`."""
        return self.frf.error_exponent

    @ft.cached_property
    def error(self) -> Float[np.ndarray, "frequencies outputs inputs"]:
        """Random error relative to the model."""
        off = np.abs(self.ratio) ** self.error_exponent
        return np.asarray(self.frf.random_error) * off


def blocks_of(records: Sequence[ResponseTerm]) -> list[Block]:
    """One block per response pair that has usable frequencies."""
    blocks = []
    for record in records:
        # An exact response would have infinite weight.
        error = np.maximum(record.error, 1e-7)
        weights, used = record.weights, record.weights[..., 0] > 0
        residual = mix(record.mixing, weights * record.misfit)
        rows = mix(record.mixing, weights[..., None] * record.slopes)
        noise = np.where(used, error, 0.0)
        expected = expected_cost(record.mixing, weights * noise[..., None])
        for o, i in np.ndindex(error.shape[1:]):
            at = (slice(None), o, i)
            parts = residual[at], rows[at], record.slopes[at], weights[at], error[at]
            blocks.append(Block(*parts, float(expected[o, i])))
    return [block for block in blocks if np.any(block.weights)]


def noise_effect(
    records: Sequence[ResponseTerm], blocks: list[Block], prior: PriorRows, count: int
) -> Noise:
    """The responses' errors, with all their correlation, seen through weights and slopes."""
    data = np.zeros((count, count))
    for record in records:
        pulls, used = record.pulls, record.weights[..., 0] > 0
        model = np.where(used, np.asarray(record.frf.response) / record.ratio, 1.0)
        off = np.where(used, np.abs(record.ratio), 1.0) ** (1 - record.error_exponent)
        # Magnitude and phase of the misfit are the parts of dT over T.
        columns = (pulls[..., 0, :] + 1j * pulls[..., 1, :]) / (model.conj() * off)[..., None]
        errors = record.frf.errors
        # A bound method of an `eqx.Module` is made like a model.
        data = data + type(errors).project(errors, np.where(used[..., None], columns, 0.0))
    cost = sum(block.expected for block in blocks)
    return Noise(data, prior.slopes[:, :count].T @ prior.slopes[:, :count], cost)


def calibrated_covariance(bread: Matrix, noise: Noise) -> Matrix:
    """Sandwich covariance: (J'WJ)^-1 J'W S W J (J'WJ)^-1, S the covariance of the errors.

    It holds for any weights, and counts neighbouring frequencies that share their noise once only.
    """
    inverse = scaled_inverse(bread)
    return inverse @ (noise.data + noise.priors) @ inverse


def degrees_of_freedom(
    records: Sequence[ResponseTerm], bread: Matrix, noise: Noise, count: int
) -> Float[np.ndarray, " parameters"]:
    """Of the noise estimate behind each parameter's variance; infinite where the noise is known.

    The variance is a sum over frequencies of noise powers, each estimated: with shares p of it and
    L the covariance of the powers' logarithms, 2 / (p'L p). Source: Satterthwaite (1946), "An
    approximate distribution of estimates of variance components".
    """
    inverse = scaled_inverse(bread)
    variance, doubt = np.diagonal(inverse @ noise.priors @ inverse).copy(), np.zeros(count)
    for record in records:
        used = record.weights[..., 0] > 0
        error = np.where(used, record.error, 0.0)
        moved = record.pulls @ inverse
        share = np.sum((error[..., None, None] * moved) ** 2, axis=(2, 3))
        variance += np.sum(share, axis=(0, 1))
        covariance = record.frf.log_noise_covariance
        if covariance is not None:
            doubt += np.einsum("fop,fg,gop->p", share, covariance, share, optimize=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = 2 * variance**2 / doubt
    return np.where(doubt > 0, np.maximum(freedom, 1.0), np.inf)


def misfit_ratio(cost: float, bread: Matrix, noise: Noise) -> float:
    """The data's cost over what noise alone would leave of it: about 1 for the right model."""
    return cost / max(noise.cost - fitted_noise(bread, noise), 1e-300)


def fitted_noise(bread: Matrix, noise: Noise) -> float:
    """Cost that the parameters take off by following the noise: their number, if it were white."""
    return float(np.trace(scaled_inverse(bread) @ noise.data))


def scaled_inverse(matrix: Matrix) -> Matrix:
    """Pseudo-inverse after unit scaling of the diagonal."""
    return _scaled_inverse(matrix.tobytes(), len(matrix))


@ft.lru_cache(maxsize=64)
def _scaled_inverse(elements: bytes, count: int) -> Matrix:
    # Ten parts of an assessment ask for the inverse of the same matrix.
    matrix = np.frombuffer(elements).reshape(count, count)
    scale = np.sqrt(np.diagonal(matrix))
    scale = np.where(scale > 0, scale, 1.0)
    unit = matrix / np.outer(scale, scale)
    return np.linalg.pinv(unit, rcond=1e-13, hermitian=True) / np.outer(scale, scale)


def information_root(blocks: list[Block]) -> Float[np.ndarray, "rows all"]:
    """Slopes over the random error: its singular values say what the record determines."""
    rows = [
        np.where(block.weights > 0, 1 / block.error[:, None], 0.0)[..., None] * block.slopes
        for block in blocks
    ]
    return np.concatenate([row.reshape(-1, row.shape[-1]) for row in rows])


def cramer_rao(bread: Matrix) -> Float[np.ndarray, " parameters"]:
    """CIFER's Cramer-Rao bound 2 sqrt((H^-1)_ii) with H = d2J/dz2 = 2 J'J."""
    return np.sqrt(2 * np.diagonal(scaled_inverse(bread)))


def insensitivity(bread: Matrix) -> Float[np.ndarray, " parameters"]:
    """CIFER's insensitivity 1 / sqrt(H_ii) with H = d2J/dz2 = 2 J'J."""
    return 1 / np.sqrt(np.maximum(2 * np.diagonal(bread), 1e-300))


def condition_number(bread: Matrix) -> float:
    """Condition of the weighted Jacobian with columns of unit length."""
    scale = np.sqrt(np.maximum(np.diagonal(bread), 1e-300))
    values = np.linalg.eigvalsh(bread / np.outer(scale, scale))
    return float(np.sqrt(values[-1] / max(values[0], 1e-30 * values[-1], 1e-300)))


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
