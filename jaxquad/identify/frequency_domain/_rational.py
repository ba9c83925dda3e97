"""Rational functions with a delay on a frequency grid, and their linear least squares."""

import functools as ft
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from numpy.polynomial.polynomial import polyval

from jaxquad._core import minimise_on_host


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


def with_cost(samples: Samples, model: Rational) -> Rational:
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
        found = with_cost(samples, Rational(above, below, delay))
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


_CONVERGED = 1e-11  # largest relative change of the response that a step still makes


class _Tangent(NamedTuple):
    """Which changes of the coefficients are orthonormal changes of the response."""

    over: Float[np.ndarray, "terms terms"]
    under: Float[np.ndarray, "terms terms"]
    jacobian: Float[np.ndarray, "residuals unknowns"]


class _Point:
    """A model on the way down, in coordinates made for it alone.

    The unknowns are polynomials orthonormal over the grid: dP/P for the numerator P, dQ/Q for the
    denominator Q, and the delay. High orders and many decades then cost no digits.
    """

    def __init__(self, samples: Samples, model: Rational, free_delay: bool):
        self.samples, self.model, self.free_delay = samples, model, free_delay
        unknowns = model.above.size + model.below.size - 1 + free_delay
        self.z, self.cost = np.zeros(unknowns), 0.5 * model.cost

    @ft.cached_property
    def tangent(self) -> _Tangent:
        return _tangent(self.samples, self.model, self.free_delay)

    def slopes(self) -> tuple[np.ndarray, np.ndarray]:
        jacobian = np.nan_to_num(self.tangent.jacobian)
        gradient = jacobian.T @ misfit(self.samples, self.model).reshape(-1)
        if self.free_delay and self.model.delay == 0 and gradient[-1] > 0:
            jacobian = jacobian * (np.arange(gradient.size) < gradient.size - 1)  # held at 0
        return jacobian.T @ misfit(self.samples, self.model).reshape(-1), jacobian.T @ jacobian

    def moved(self, change: Float[np.ndarray, " unknowns"]) -> "_Point":
        model = _apply_step(self.samples, self.model, self.tangent, change)
        return _Point(self.samples, with_cost(self.samples, model), self.free_delay)


def descend(samples: Samples, start: Rational, *, steps: int, free_delay: bool) -> Rational:
    """Lower the cost of `start` by Levenberg-Marquardt; a delay stops at 0."""
    point = _Point(samples, with_cost(samples, start), free_delay)
    if not (np.isfinite(point.cost) and np.all(np.isfinite(point.tangent.jacobian))):
        return point.model
    return minimise_on_host(point, _Point.moved, steps, tolerance=_CONVERGED, saving=1e-14)[0].model


def _tangent(samples: Samples, model: Rational, free_delay: bool) -> _Tangent:
    """The derivative of the misfit; columns of numerator, denominator and delay."""
    s, poles = samples.s, model.below.size - 1
    with np.errstate(all="ignore"):
        over, from_over = basis(s, 1 / polyval(s, model.above), model.above.size - 1)
        under, from_under = basis(s, 1 / polyval(s, model.below), max(poles - 1, 0))
    under, from_under = under[:, :poles], from_under[:, :poles]
    late = np.reshape(s / samples.omega[-1], (-1, 1))[:, : int(free_delay)]
    columns = np.concatenate([over, -under, -late], axis=1)
    parts = np.stack([np.real(columns), np.imag(columns)], axis=1) * samples.weights[:, :, None]
    return _Tangent(from_over, from_under, parts.reshape(2 * s.size, -1))


def _apply_step(
    samples: Samples, model: Rational, tangent: _Tangent, step: Float[np.ndarray, " unknowns"]
) -> Rational:
    parts = [tangent.over.shape[1], tangent.over.shape[1] + tangent.under.shape[1]]
    over, under, late = np.split(step, parts)
    below = model.below.copy()
    below[:-1] += (tangent.under @ under)[: below.size - 1]
    delay = model.delay + float(late.sum()) / float(samples.omega[-1])
    return Rational(model.above + tangent.over @ over, below, max(delay, 0.0))
