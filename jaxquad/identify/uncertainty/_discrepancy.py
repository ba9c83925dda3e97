"""What a model leaves unexplained of a response: its size, and what that does to the parameters.

The logarithm of measurement over model is noise plus a discrepancy: a Gaussian process over the
logarithm of frequency, with one amplitude for all response pairs: in rad of phase, and half of it
in neper of magnitude. It walks at random and is drawn back to zero (Ornstein & Uhlenbeck), as lags,
zeros and modes make it that are missing here and there, each near its own frequency. Smoother ones
take what a band shows for a piece of a wider swing, most of which would be an error of the gain.
Amplitude and length follow from the restricted likelihood, which leaves out what the parameters can
take up themselves.
Source: Kennedy & O'Hagan (2001), Bayesian calibration of computer models; Rasmussen & Williams
(2006), Gaussian Processes for Machine Learning, sec. 4.2.1.
"""

import functools as ft
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from jaxquad._core import pytree_node

from ..frequency_domain._cost import Points
from ._accuracy import Matrix, PriorRows, ResponseTerm, scaled_inverse


LENGTHS = (1.0, 3.0, 9.0)  # in ln(omega); 2.3 is a decade
MEAN = 0.05  # of the prior of the amplitude, neper
_SHAPE = 1.5  # of that prior, a gamma distribution: errors far below its mean are few
SHARES = np.array([0.5, 1.0])  # of the amplitude, in magnitude and in phase
_NONE = 0.85  # the prior's mass at a discrepancy of zero
_AMPLITUDES = 16
_RANK = 16  # of a kernel over a band of two decades: 1 to 6 % of its variance is left, the fastest
_OTHER = 3.0  # times the prior's mean: a width that follows it is the prior's
FOLLOWS = 1.25  # factor by which such a width grows


Widths = Float[np.ndarray, " parameters"]


@pytree_node
class Discrepancy:
    """How far a model is off beyond the noise, in rad of phase; half of it in neper of magnitude.

    **Attributes:**

    - `amplitude`: root mean square of the posterior; 0.1 is 6 deg, and 5 % of magnitude.
    - `length`: over which it changes, in ln(omega).
    - `none`: the probability that the model is right.
    - `widths`: for each parameter what makes its interval as wide as it is: "noise", "data" (the
      response itself shows a discrepancy of this size), or "prior" (it shows none that the
      parameter would not take up: the width follows what models usually leave unexplained).
    """

    amplitude: float
    length: float
    none: float
    widths: tuple[str, ...] = eqx.field(static=True)


class Mixture(NamedTuple):
    """A posterior mean of squared amplitudes by length, and the probability of none."""

    powers: Float[np.ndarray, " lengths"]
    none: float

    @property
    def amplitude(self) -> float:
        return float(np.sqrt(np.sum(self.powers)))


class _Seen(NamedTuple):
    """The data under noise alone, and what of them lies along the kernels' components."""

    whole: Float[np.ndarray, "columns columns"]  # slopes and misfit
    gains: Float[np.ndarray, "lengths components"]  # of unit amplitude over the noise
    along: Float[np.ndarray, "lengths components squares"]  # products of two columns
    typical: float  # random error


def find_discrepancy(
    records: Sequence[ResponseTerm],
    points: Sequence[Points],
    prior: PriorRows,
    moving: Sequence[int],
) -> tuple[Mixture, Mixture]:
    """The discrepancy of a fit, under the prior and under one of a larger mean.

    `moving` are the parameters that can take up a misfit: not those that a bound holds against it.
    """
    seen = _look(records, points, prior, np.asarray(moving, int))
    lowest = np.log(0.1 * seen.typical)
    amplitudes = np.exp(np.linspace(lowest, max(0.0, lowest + 1.4), _AMPLITUDES))
    likelihoods = _restricted_likelihoods(seen, np.concatenate([[0.0], amplitudes]))
    relative = np.exp(likelihoods - np.max(likelihoods))
    one, other = (_mix(relative, amplitudes, mean) for mean in (MEAN, _OTHER * MEAN))
    return one, other


def _look(
    records: Sequence[ResponseTerm],
    points: Sequence[Points],
    prior: PriorRows,
    moving: Int[np.ndarray, " moving"],
) -> _Seen:
    rows = np.concatenate([prior.slopes[:, moving], prior.misfit[:, None]], axis=1)
    whole, gains, along, errors = rows.T @ rows, [], [], []
    for record, counted in zip(records, points, strict=True):
        used = record.weights[..., 0] > 0
        error = np.maximum(record.error, 1e-7)
        inverse = np.where(used, error**-2 / counted.shared, 0.0)
        columns = np.concatenate([record.slopes[..., moving], record.misfit[..., None]], axis=-1)
        columns = np.where(used[..., None, None], columns, 0.0)
        weighted = (inverse[..., None, None] * columns).reshape(-1, len(whole))
        whole += weighted.T @ columns.reshape(-1, len(whole))
        parts = _components(np.asarray(record.frf.omega), used, inverse, columns)
        gains.append(parts[0])
        along.append(parts[1])
        errors.append(error[used])
    middle = _median(np.concatenate(errors))
    return _Seen(whole, np.concatenate(gains, axis=1), np.concatenate(along, axis=1), middle)


def _median(values: Float[np.ndarray, " values"]) -> float:
    """As `np.median`, which takes ten times as long for few values."""
    ordered, half = np.sort(values), values.size // 2
    return float(0.5 * (ordered[half] + ordered[-half - 1]))


def _components(omega, used, inverse, columns) -> tuple[np.ndarray, np.ndarray]:
    """Components of the kernels in which noise and discrepancy are both diagonal."""
    pairs = np.any(used, axis=0)
    inverse, columns = inverse[:, pairs].T, np.moveaxis(columns[:, pairs], 0, 1)
    basis = kernel_basis(omega.tobytes())[:, None]  # length pair frequency rank
    weighted = np.swapaxes(basis * inverse[:, :, None], 2, 3)
    gains, turned = np.linalg.eigh(weighted @ basis)
    seen = weighted @ columns.reshape(*columns.shape[:2], -1)
    seen = (np.swapaxes(turned, 2, 3) @ seen).reshape(*gains.shape, *columns.shape[2:])
    seen = seen * SHARES[:, None]
    products = seen[..., :, None] * seen[..., None, :]
    gains = np.maximum(gains, 0.0)[..., None] * SHARES**2
    lengths, width = len(basis), columns.shape[-1]
    return gains.reshape(lengths, -1), products.reshape(lengths, -1, width**2)


_DENSE = 256  # frequencies, up to which whole kernels are made


@ft.lru_cache(maxsize=16)
def kernel_basis(omega: bytes) -> Float[np.ndarray, "lengths frequencies rank"]:
    """Roots of the kernels of all lengths at frequencies (the bytes of their array, rad/s)."""
    place = np.log(np.frombuffer(omega))
    apart = np.diff(np.sort(place))
    by_inverse = place.size > _DENSE and np.min(apart) > 1e-9
    root = _root_by_inverse if by_inverse else _root_of_kernel
    return np.stack([root(place, length) for length in LENGTHS])


def _root_of_kernel(
    place: Float[np.ndarray, " frequencies"], length: float
) -> Float[np.ndarray, "frequencies rank"]:
    values, vectors = np.linalg.eigh(np.exp(-np.abs(place[:, None] - place[None, :]) / length))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return root[:, ::-1][:, :_RANK]


def _root_by_inverse(
    place: Float[np.ndarray, " frequencies"], length: float
) -> Float[np.ndarray, "frequencies rank"]:
    """The same without the matrix.

    Where an Ornstein-Uhlenbeck process is depends on its two neighbours alone, so the inverse of
    its kernel has three diagonals.
    """
    from scipy.linalg import eigh_tridiagonal

    order = np.argsort(place)
    apart = np.diff(place[order]) / length
    passed = -np.exp(-2 * apart) / np.expm1(-2 * apart)  # rho^2 / (1 - rho^2) between neighbours
    beside = np.exp(-apart) / np.expm1(-2 * apart)
    diagonal = 1 + np.concatenate([passed, [0.0]]) + np.concatenate([[0.0], passed])
    values, vectors = eigh_tridiagonal(
        diagonal, beside, select="i", select_range=(0, min(_RANK, place.size) - 1)
    )
    root = np.empty_like(vectors)
    root[order] = vectors / np.sqrt(values)
    return root


def _restricted_likelihoods(
    seen: _Seen, amplitudes: Float[np.ndarray, " amplitudes"]
) -> Float[np.ndarray, "lengths amplitudes"]:
    """Logarithms, up to a constant; the parameters' own changes are projected out."""
    power = amplitudes**2
    damped = power[None, :, None] / (1 + power[None, :, None] * seen.gains[:, None, :])
    width = len(seen.whole)
    left = seen.whole - np.reshape(damped @ seen.along, (*damped.shape[:2], width, width))
    scale = np.sqrt(np.maximum(np.diagonal(seen.whole), 1e-300))
    left = left / np.outer(scale, scale) + 1e-11 * np.eye(width)
    slopes, misfit = left[..., :-1, :-1], left[..., :-1, -1]
    step = np.linalg.solve(slopes, misfit[..., None])[..., 0]
    rest = (left[..., -1, -1] - np.sum(misfit * step, axis=-1)) * scale[-1] ** 2
    volume = np.linalg.slogdet(slopes)[1]
    grown = np.sum(np.log1p(power[None, :, None] * seen.gains[:, None, :]), axis=-1)
    return -0.5 * (grown + volume + rest)


def _mix(relative: np.ndarray, amplitudes: np.ndarray, mean: float) -> Mixture:
    """The posterior under a mass at zero, and a gamma distribution above it.

    `relative` are the likelihoods over the largest of them.
    """
    cell = amplitudes * np.log(amplitudes[1] / amplitudes[0])
    density = cell * amplitudes ** (_SHAPE - 1) * np.exp(-_SHAPE * amplitudes / mean)
    density *= (1 - _NONE) / max(float(np.sum(density)), 1e-300) / len(relative)
    none, some = _NONE * relative[0, 0], relative[:, 1:] * density
    total = none + np.sum(some)
    return Mixture(np.sum(some * amplitudes**2, axis=1) / total, float(none / total))


def discrepancy_effect(
    records: Sequence[ResponseTerm], count: int
) -> Float[np.ndarray, "lengths parameters parameters"]:
    """J'W D W J of a discrepancy D of unit amplitude, for each length."""
    total = np.zeros((len(LENGTHS), count, count))
    for record in records:
        pulls = np.where(record.weights[..., None] > 0, record.pulls, 0.0)
        basis = kernel_basis(np.asarray(record.frf.omega).tobytes())
        pulls = np.reshape(pulls * SHARES[:, None], (len(pulls), -1))
        along = (np.swapaxes(basis, 1, 2) @ pulls).reshape(len(LENGTHS), -1, count)
        total += np.swapaxes(along, 1, 2) @ along
    return total


def describe_discrepancy(
    found: tuple[Mixture, Mixture], bread: Matrix, noise: Matrix, effect: np.ndarray
) -> tuple[Discrepancy, Matrix]:
    """The discrepancy in words and numbers, and the covariance that it adds to the parameters."""
    inverse = scaled_inverse(bread)
    one, other = (
        inverse @ np.tensordot(mixture.powers, effect, axes=1) @ inverse for mixture in found
    )
    by_noise, with_one, with_other = (
        np.sqrt(np.maximum(np.diagonal(part), 0.0)) for part in (noise, noise + one, noise + other)
    )
    widths = np.where(with_other > FOLLOWS * with_one, "prior", "data")
    widths = np.where(with_one < FOLLOWS * by_noise, "noise", widths)
    mixture = found[0]
    weight = mixture.powers / max(float(np.sum(mixture.powers)), 1e-300)
    length = float(np.exp(weight @ np.log(LENGTHS)))
    return Discrepancy(mixture.amplitude, length, mixture.none, tuple(widths.tolist())), one
