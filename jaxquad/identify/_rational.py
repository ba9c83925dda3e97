"""Rational functions with a delay on a frequency grid, and their linear least squares."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from numpy.polynomial.polynomial import polyval


Grid = Complex[np.ndarray, " frequencies"]
Coefficients = Float[np.ndarray, " _"]
_SK_STEPS = 12


class Samples(NamedTuple):
    """A measured response where it is coherent, in frequencies over `unit`."""

    s: Grid
    response: Grid  # without the integrators that are taken as given
    weights: Float[np.ndarray, "frequencies 2"]  # of the misfit of ln-magnitude and phase
    unit: float  # rad/s

    @property
    def omega(self) -> Float[np.ndarray, " frequencies"]:
        """Over `unit`."""
        return np.imag(self.s)

    @property
    def trust(self) -> Float[np.ndarray, " frequencies"]:
        """One weight for both parts."""
        return np.sqrt(np.mean(self.weights**2, axis=1))


class Rational(NamedTuple):
    """`above(s) / below(s) exp(-delay s)`; coefficients rise in power, `below` is monic."""

    above: Coefficients
    below: Coefficients
    delay: float
    cost: float = np.inf  # weighted squares of the logarithm of its ratio to the samples


def misfit(samples: Samples, model: Rational) -> Float[np.ndarray, "frequencies 2"]:
    """Weighted ln-magnitude and wrapped phase (rad) of model over measurement."""
    ratio = polyval(samples.s, model.above) / polyval(samples.s, model.below) / samples.response
    log = np.log(ratio * np.exp(-model.delay * samples.s))
    return samples.weights * np.stack([np.real(log), np.imag(log)], axis=1)


def assessed(samples: Samples, model: Rational) -> Rational:
    """The same model with its cost, infinite where it has no finite response."""
    with np.errstate(all="ignore"):
        cost = float(np.sum(misfit(samples, model) ** 2))
    return model._replace(cost=cost if np.isfinite(cost) else np.inf)


def basis(
    s: Grid, start: Grid, degree: int
) -> tuple[Complex[np.ndarray, "frequencies terms"], Float[np.ndarray, "terms terms"]]:
    """Polynomials times `start`, orthonormal over the grid and its mirror image.

    Returns their values and, in columns, their coefficients, which are real. Powers of s would be
    dependent to rounding from degree 6 or so. Source: Brubeck, Nakatsukasa and Trefethen,
    Vandermonde with Arnoldi, SIAM Review 63 (2021).
    """
    values = np.zeros((s.size, degree + 1), complex)
    coefficients = np.zeros((degree + 1, degree + 1))
    vector, powers = start, np.eye(degree + 1)[0]
    for k in range(degree + 1):
        if k:
            vector, powers = s * values[:, k - 1], np.append(0.0, coefficients[:-1, k - 1])
        for _ in range(2):
            shared = np.real(values[:, :k].conj().T @ vector)
            vector = vector - values[:, :k] @ shared
            powers = powers - coefficients[:, :k] @ shared
        size = np.linalg.norm(vector)
        values[:, k], coefficients[:, k] = vector / size, powers / size
    return values, coefficients


def sanathanan_koerner(samples: Samples, zeros: int, poles: int, delay: float) -> Rational:
    """The best of a sequence of weighted linear fits, each weighed by the last denominator.

    Each minimises |above - response below| / |response below_last|. Poles and zeros may lie on
    either side. Source: Sanathanan and Koerner, IEEE Trans. Automatic Control 8 (1963), p. 56.
    """
    target = samples.response * np.exp(delay * samples.s)
    corners = np.geomspace(samples.omega[0], samples.omega[-1], poles + 2)[1:-1]
    last = np.prod(samples.s[:, None] + corners, axis=1)
    best = Rational(np.zeros(zeros + 1), np.eye(poles + 1)[-1], delay)
    for _ in range(_SK_STEPS):
        with np.errstate(all="ignore"):
            above, below = _linear_fit(samples, target, last, zeros, poles)
        if not (np.all(np.isfinite(above)) and np.all(np.isfinite(below))):
            break
        found = assessed(samples, Rational(above, below, delay))
        best = min(best, found, key=lambda model: model.cost)
        last = polyval(samples.s, below)
    return best


def _linear_fit(
    samples: Samples, target: Grid, last: Grid, zeros: int, poles: int
) -> tuple[Coefficients, Coefficients]:
    over, from_over = basis(samples.s, samples.trust / (target * last), zeros)
    under, from_under = basis(samples.s, samples.trust / last, poles)
    shared = np.real(over.conj().T @ under)
    rest = under - over @ shared
    parts = np.concatenate([np.real(rest), np.imag(rest)])
    if not np.all(np.isfinite(parts)):
        return np.full(zeros + 1, np.nan), np.full(poles + 1, np.nan)
    # No coefficient can be set to 1 beforehand: any of them may be the one that is 0.
    choice = np.linalg.svd(parts, full_matrices=False)[2][-1]
    above, below = from_over @ (shared @ choice), from_under @ choice
    return above / below[-1], below / below[-1]
