"""Rational functions with a delay near a measured response, without starting values.

Linear fits over a range of delays, the best of them refined, and again with roots reflected or
moved. All by NumPy, in frequencies over their geometric mean.
"""

import functools as ft
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from numpy.polynomial.polynomial import polyfromroots, polyroots, polyval

from jaxquad._core import minimise_on_host


_SK_STEPS = 12
_CONVERGED = 1e-11  # largest relative change of the response that a step still makes
_DELAY_STEP = 0.7  # rad at the highest frequency
_MOST_DELAYS = 60
_PLACES = 5  # frequencies at which an idle pair is tried
_TRIED = 8  # linear starts that are refined
_BRIEF, LONG = 12, 200  # steps of a descent: to compare starts, and to finish

Grid = Complex[np.ndarray, " frequencies"]
Coefficients = Float[np.ndarray, " _"]


class Samples(NamedTuple):
    """A measured response where it is coherent, in frequencies over `unit`."""

    s: Grid
    response: Grid  # without the integrators
    weights: Float[np.ndarray, "frequencies 2"]  # of the misfit of ln-magnitude and phase
    unit: float  # rad/s

    @property
    def omega(self) -> Float[np.ndarray, " frequencies"]:
        return np.imag(self.s)


class Rational(NamedTuple):
    """`above(s) / below(s) exp(-delay s)`; coefficients rise in power, `below` is monic."""

    above: Coefficients
    below: Coefficients
    delay: float
    cost: float = np.inf  # weighted squares of the logarithm of its ratio to the samples

    def misfit(self, samples: Samples) -> Float[np.ndarray, "frequencies 2"]:
        """Weighted ln-magnitude and wrapped phase (rad) of model over measurement."""
        ratio = polyval(samples.s, self.above) / polyval(samples.s, self.below) / samples.response
        log = np.log(ratio * np.exp(-self.delay * samples.s))
        return samples.weights * np.stack([np.real(log), np.imag(log)], axis=1)

    def with_cost(self, samples: Samples) -> "Rational":
        """The same with its cost, infinite where it has no finite response."""
        with np.errstate(all="ignore"):
            cost = float(np.sum(self.misfit(samples) ** 2))
        return self._replace(cost=cost if np.isfinite(cost) else np.inf)


def search(
    samples: Samples, zeros: int, poles: int, delay: float | None,
    extra: tuple[Rational, ...] = (),
) -> Rational:  # fmt: skip
    """The lowest minimum that any start leads to; of infinite cost where none has a response.

    `poles` are those beside the integrators, `delay` is in s, None if it is free.
    Starts are linear fits at delays from 0 to beyond what the phase's slope allows, those in
    `extra`, and the best of them with one root (or pair) reflected to the other half plane, or
    with its outermost zero and pole, which may be idle beyond the band, placed within it.
    """
    free, omega = delay is None, samples.omega
    delays = np.array([0.0 if delay is None else delay * samples.unit])
    if free:  # from 0 to 4 rad at the highest frequency, or beyond the phase's slope
        phase = np.unwrap(np.angle(samples.response))
        slope = -np.diff(phase)[omega.size // 2 :] / np.diff(omega)[omega.size // 2 :]
        limit = 4.0 / omega[-1] + 1.2 * max(float(np.median(slope)), 0.0)
        count = int(np.clip(limit * omega[-1] / _DELAY_STEP + 1, 2, _MOST_DELAYS))
        delays = np.linspace(0.0, limit, count)
    cost = lambda model: model.cost
    starts = [_linear_fit(samples, zeros, poles, float(late)) for late in delays]
    starts = sorted(starts, key=cost)[:_TRIED] + list(extra)
    descend_from = lambda start, steps: descend(samples, start, steps, free)
    best = min((descend_from(start, _BRIEF) for start in starts), key=cost)
    for _ in range(2):
        best = descend_from(best, LONG)
        if not np.isfinite(best.cost):
            return best
        others = _with_other_roots(samples, best)
        better = min((descend_from(other, _BRIEF) for other in others), key=cost, default=best)
        if not better.cost < 0.999 * best.cost:
            return best
        best = better
    return descend_from(best, LONG)


def _basis(
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


def _linear_fit(samples: Samples, zeros: int, poles: int, delay: float) -> Rational:
    """The best of a sequence of linear fits, weighed by the denominator of the one before.

    They minimise |above - response below| / |response below_last|. Poles and zeros may lie on
    either side. Source: Sanathanan and Koerner, IEEE Trans. Automatic Control 8 (1963), p. 56.
    """
    trust = np.sqrt(np.mean(samples.weights**2, axis=1))  # one weight for both parts
    target = samples.response * np.exp(delay * samples.s)
    corners = np.geomspace(samples.omega[0], samples.omega[-1], poles + 2)[1:-1]
    last = np.prod(samples.s[:, None] + corners, axis=1)
    best = Rational(np.zeros(zeros + 1), np.eye(poles + 1)[-1], delay)
    for _ in range(_SK_STEPS):
        with np.errstate(all="ignore"):
            over, from_over = _basis(samples.s, trust / (target * last), zeros)
            under, from_under = _basis(samples.s, trust / last, poles)
            shared = np.real(over.conj().T @ under)
            rest = under - over @ shared
            parts = np.concatenate([np.real(rest), np.imag(rest)])
            if not np.all(np.isfinite(parts)):
                break
            # No coefficient can be set to 1 beforehand: any of them may be the one that is 0.
            choice = np.linalg.svd(parts, full_matrices=False)[2][-1]
            above, below = from_over @ (shared @ choice), from_under @ choice
            above, below = above / below[-1], below / below[-1]
        if not (np.all(np.isfinite(above)) and np.all(np.isfinite(below))):
            break
        candidate = Rational(above, below, delay).with_cost(samples)
        best = min(best, candidate, key=lambda model: model.cost)
        last = polyval(samples.s, below)
    return best


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
    def tangent(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Changes of numerator and denominator that are orthonormal changes of the response, in
        columns; and the slopes of the misfit by the unknowns."""
        samples, model, s = self.samples, self.model, self.samples.s
        poles = model.below.size - 1
        with np.errstate(all="ignore"):
            over, from_over = _basis(s, 1 / polyval(s, model.above), model.above.size - 1)
            under, from_under = _basis(s, 1 / polyval(s, model.below), max(poles - 1, 0))
        under, from_under = under[:, :poles], from_under[:, :poles]
        late = np.reshape(s / samples.omega[-1], (-1, 1))[:, : int(self.free_delay)]
        columns = np.concatenate([over, -under, -late], axis=1)
        parts = np.stack([np.real(columns), np.imag(columns)], axis=1) * samples.weights[:, :, None]
        return from_over, from_under, parts.reshape(2 * s.size, -1)

    def slopes(self) -> tuple[np.ndarray, np.ndarray]:
        jacobian = np.nan_to_num(self.tangent[2])
        residual = self.model.misfit(self.samples).reshape(-1)
        if self.free_delay and self.model.delay == 0 and (jacobian.T @ residual)[-1] > 0:
            last = jacobian.shape[1] - 1
            jacobian = jacobian * (np.arange(last + 1) < last)  # the delay stays at 0
        return jacobian.T @ residual, jacobian.T @ jacobian

    def moved(self, change: Float[np.ndarray, " unknowns"]) -> "_Point":
        model, (from_over, from_under, _) = self.model, self.tangent
        ends = [from_over.shape[1], from_over.shape[1] + from_under.shape[1]]
        over, under, late = np.split(change, ends)
        below = model.below.copy()
        below[:-1] += (from_under @ under)[: below.size - 1]
        delay = model.delay + float(late.sum()) / float(self.samples.omega[-1])
        model = Rational(model.above + from_over @ over, below, max(delay, 0.0))
        return _Point(self.samples, model.with_cost(self.samples), self.free_delay)


def descend(samples: Samples, start: Rational, steps: int, free_delay: bool) -> Rational:
    """Lower the cost of `start` by Levenberg-Marquardt; a delay stops at 0."""
    point = _Point(samples, start.with_cost(samples), free_delay)
    if not (np.isfinite(point.cost) and np.all(np.isfinite(point.tangent[2]))):
        return point.model
    return minimise_on_host(point, _Point.moved, steps, tolerance=_CONVERGED, saving=1e-14)[0].model


def _with_other_roots(samples: Samples, model: Rational) -> list[Rational]:
    """One root, or pair, mirrored in the imaginary axis; the outermost real zero and pole moved."""
    models = []
    for field, coefficients in (("above", model.above), ("below", model.below)):
        roots = polyroots(coefficients)
        for root in roots[roots.imag >= 0]:
            mine = (roots == root) | (roots == root.conj())
            mirrored = np.where(mine, -roots.conj(), roots)
            polynomial = coefficients[-1] * np.real(polyfromroots(mirrored))
            odd = bool(np.sum(mine) % 2)
            if odd and field == "above":
                polynomial = -polynomial
            side = model._replace(**{field: polynomial})
            models += [side, side._replace(above=-side.above)] if odd else [side]
    zeros, poles = polyroots(model.above), polyroots(model.below)
    if not (np.any(zeros.imag == 0) and np.any(poles.imag == 0)):
        return models
    # As a near-cancelling pair within the band.
    zero, pole = (max(roots[roots.imag == 0], key=abs) for roots in (zeros, poles))
    lead = model.above[-1] * np.real((1j - zero) / (1j - pole))
    for place in np.geomspace(samples.omega[0], samples.omega[-1], _PLACES):
        for ratio in (0.8, 1.25):
            above = lead * np.real(polyfromroots(np.where(zeros == zero, -place * ratio, zeros)))
            below = np.real(polyfromroots(np.where(poles == pole, -place, poles)))
            models.append(model._replace(above=above, below=below))
    return models
