"""What a model leaves unexplained of responses: a Gaussian process, by its restricted likelihood.

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
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxquad._core import invert_definite, pytree_node

from ..frequency_domain._parameters import namespace_of, Numbers
from ._response_term import diagonal, PerFit, PriorRows, ResponseTerm


LENGTHS = (1.0, 3.0, 9.0)  # in ln(omega); 2.3 is a decade
_MEAN = 0.05  # of the prior of the amplitude, neper
_SHAPE = 1.5  # of that prior, a gamma distribution: errors far below its mean are few
SHARES = np.array([0.5, 1.0])  # of the amplitude, in magnitude and in phase
_NONE = 0.85  # the prior's mass at a discrepancy of zero
_AMPLITUDES = 16
_RANK = 16  # of a kernel over a band of two decades: 1 to 6 % of its variance is left, the fastest
_OTHER = 3.0  # times the prior's mean: a width that follows it is the prior's
_DENSE = 256  # frequencies, up to which whole kernels are made


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

    powers: Float[Numbers, "*members lengths"]
    none: PerFit

    @property
    def amplitude(self) -> PerFit:
        return np.sqrt(np.sum(self.powers, axis=-1))


NO_DISCREPANCY = Mixture(np.zeros(len(LENGTHS)), 1.0)


def find_discrepancy(
    records: Sequence[ResponseTerm],
    shared: Sequence[Numbers],
    prior: PriorRows,
    moving: Sequence[int],
) -> tuple[Mixture, Mixture]:
    """The discrepancy of a fit, under the prior and under one of a larger mean. `shared` is that of
    the records' `Points`, and `moving` are the parameters that can take up a misfit: not those that
    a bound holds against it."""
    columns, xp = np.asarray(moving, int), namespace_of(prior.misfit)
    members = prior.misfit.shape[:-1]
    lowest = xp.log(0.1 * _median_error(records, members))
    amplitudes = xp.linspace(lowest, xp.maximum(0.0, lowest + 1.4), _AMPLITUDES, axis=-1)
    amplitudes = xp.exp(amplitudes)
    power = xp.concatenate([np.zeros((*members, 1)), amplitudes], axis=-1)[..., None] ** 2
    # Products of slopes and misfit under noise alone; what a discrepancy takes of them, and the
    # logarithm of the power that it adds, by length and amplitude.
    rows = xp.concatenate([prior.slopes[..., columns], prior.misfit[..., None]], axis=-1)
    products, damped, grown = xp.swapaxes(rows, -1, -2) @ rows, 0.0, 0.0
    for record, repeated in zip(records, shared, strict=True):
        inverse = xp.where(record.used, record.error**-2 / repeated, 0.0)
        rows = xp.concatenate([record.slopes[..., columns], record.misfit[..., None]], axis=-1)
        rows = xp.where(record.used[..., None, None], rows, 0.0)
        weighted = (inverse[..., None, None] * rows).reshape(*members, -1, rows.shape[-1])
        products += xp.swapaxes(weighted, -1, -2) @ rows.reshape(weighted.shape)
        omega = np.asarray(record.frf.omega)
        taken, added = _damping(omega, record.used, inverse, rows, power)
        damped, grown = damped + taken, grown + added
    # Restricted likelihoods by length and amplitude: the parameters' own changes are projected out.
    scale = xp.sqrt(xp.maximum(diagonal(products), 1e-300))
    left = (products[..., None, None, :, :] - damped) / (
        scale[..., None, None, :, None] * scale[..., None, None, None, :]
    ) + 1e-11 * np.eye(products.shape[-1])
    slopes, misfit = left[..., :-1, :-1], left[..., :-1, -1]
    if xp is np:
        step = np.linalg.solve(slopes, misfit[..., None])[..., 0]
        volume = np.linalg.slogdet(slopes)[1]
    else:
        inverse, volume = invert_definite(slopes)
        step = (inverse @ misfit[..., None])[..., 0]
    rest = left[..., -1, -1] - xp.sum(misfit * step, axis=-1)
    rest = rest * scale[..., -1, None, None] ** 2
    likelihoods = -0.5 * (grown + volume + rest)
    highest = xp.max(likelihoods, axis=(-2, -1), keepdims=True)  # on which nothing depends
    if xp is not np:  # its slope is nan where numbers that it is compared with are rounded anew
        highest = jax.lax.stop_gradient(highest)
    relative = xp.exp(likelihoods - highest)

    def mix(mean: float) -> Mixture:
        """The posterior under a mass at zero, and a gamma distribution above it."""
        cell = amplitudes * xp.log(amplitudes[..., 1] / amplitudes[..., 0])[..., None]
        density = cell * amplitudes ** (_SHAPE - 1) * xp.exp(-_SHAPE * amplitudes / mean)
        total = xp.maximum(xp.sum(density, axis=-1, keepdims=True), 1e-300)
        density *= (1 - _NONE) / total / len(LENGTHS)
        none, some = _NONE * relative[..., 0, 0], relative[..., 1:] * density[..., None, :]
        total = none + xp.sum(some.reshape(*members, -1), axis=-1)
        powers = xp.sum(some * amplitudes[..., None, :] ** 2, axis=-1) / total[..., None]
        return Mixture(powers, none / total)

    return mix(_MEAN), mix(_OTHER * _MEAN)


def _median_error(records: Sequence[ResponseTerm], members: tuple[int, ...]) -> PerFit:
    """Of the points in use. `np.median` takes ten times as long for few values."""
    xp, used = namespace_of(records[0].misfit), [record.used for record in records]
    parts = [xp.where(one.used, one.error, np.inf).reshape(*members, -1) for one in records]
    errors = xp.sort(xp.concatenate(parts, axis=-1), axis=-1)
    count = sum(np.sum(mine.reshape(*members, -1), axis=-1) for mine in used)
    first = errors.shape[-1] * np.arange(errors[..., 0].size).reshape(members)
    flat = errors.reshape(-1)
    return 0.5 * (flat[first + count // 2] + flat[first + (count - 1) // 2])


def _damping(
    omega: np.ndarray, used: np.ndarray, inverse: Numbers, columns: Numbers, power: Numbers
) -> tuple[Numbers, Numbers]:
    """What discrepancies of each length and `power` take of products of columns, and add to noise.

    `columns` have the two parts of the misfit, and then the products' rows, on their last axes.
    """
    pairs, xp = np.any(used.reshape(-1, *used.shape[-2:]), axis=0), namespace_of(columns)
    inverse = xp.swapaxes(inverse[..., pairs], -1, -2)
    columns = xp.moveaxis(columns[..., pairs, :, :], -3, -4)  # pair frequency part row
    basis = kernel_basis(omega.tobytes())[:, None]  # length pair frequency rank
    weighted = xp.swapaxes(basis * inverse[..., None, :, :, None], -1, -2)
    lined_up = columns.reshape(*columns.shape[:-4], 1, *columns.shape[-4:-2], -1)
    kernel, along = weighted @ basis, weighted @ lined_up
    if xp is not np:  # eigenvectors have no derivatives where values are equal
        along = along.reshape(*along.shape[:3], *columns.shape[-2:]) * SHARES[:, None]
        along = jnp.swapaxes(along, 2, 3)  # length pair part rank column
        power = power[:, :, None, None, None]
        shares = (SHARES**2)[:, None, None]
        grown = np.eye(len(kernel[0, 0])) + power * shares * kernel[:, None, :, None]
        inverse, volume = invert_definite(grown)
        solved = inverse @ along[:, None]
        taken = power[:, 0, 0] * jnp.einsum("lpsrv,lapsrw->lavw", along, solved)
        return taken, jnp.sum(volume, axis=(2, 3))
    # Components in which noise and discrepancy are both diagonal.
    gains, turned = np.linalg.eigh(kernel)
    along = (np.swapaxes(turned, -1, -2) @ along).reshape(*gains.shape, *columns.shape[-2:])
    along = along * SHARES[:, None]
    products = along[..., :, None] * along[..., None, :]
    lengths, width = gains.shape[:-2], columns.shape[-1]
    gains = (np.maximum(gains, 0.0)[..., None] * SHARES**2).reshape(*lengths, 1, -1)
    power = power[..., None, :, :]
    taken = power / (1 + power * gains) @ products.reshape(*lengths, -1, width**2)
    taken = taken.reshape(*taken.shape[:-1], width, width)
    return taken, np.sum(np.log1p(power * gains), axis=-1)


@ft.lru_cache(maxsize=16)
def kernel_basis(omega: bytes) -> Float[np.ndarray, "lengths frequencies rank"]:
    """Roots of the kernels of all lengths at frequencies (the bytes of their array, rad/s). Only
    neighbours matter to such a process: an inverse kernel has three diagonals."""
    place = np.log(np.frombuffer(omega))
    order = np.argsort(place)
    if place.size <= _DENSE or not np.min(np.diff(place[order])) > 1e-9:
        distance, roots = np.abs(place[:, None] - place[None, :]), []
        for length in LENGTHS:
            values, vectors = np.linalg.eigh(np.exp(-distance / length))
            root = vectors * np.sqrt(np.maximum(values, 0.0))
            roots.append(root[:, ::-1][:, :_RANK])
        return np.stack(roots)
    from scipy.linalg import eigh_tridiagonal

    roots, last = np.empty((len(LENGTHS), place.size, _RANK)), min(_RANK, place.size) - 1
    for root, length in zip(roots, LENGTHS, strict=True):
        gaps = np.diff(place[order]) / length
        passed = -np.exp(-2 * gaps) / np.expm1(-2 * gaps)  # rho^2 / (1 - rho^2) of neighbours
        diagonal = 1 + np.concatenate([passed, [0.0]]) + np.concatenate([[0.0], passed])
        neighbours = np.exp(-gaps) / np.expm1(-2 * gaps)
        values, vectors = eigh_tridiagonal(diagonal, neighbours, select="i", select_range=(0, last))
        root[order] = vectors / np.sqrt(values)
    return roots
