"""Nonlinear least squares for a rational function, in coordinates that stay well conditioned."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.polynomial.polynomial import polyval

from ._rational import assessed, basis, misfit, Rational, Samples


_CONVERGED = 1e-11  # largest relative change of the response that a step still makes
_STUCK = 1e10  # damping from which no step helps any more


class _Tangent(NamedTuple):
    """Which changes of the coefficients are orthonormal changes of the response."""

    over: Float[np.ndarray, "terms terms"]
    under: Float[np.ndarray, "terms terms"]
    jacobian: Float[np.ndarray, "residuals unknowns"]


def descend(samples: Samples, start: Rational, *, steps: int, free_delay: bool) -> Rational:
    """Lower the cost of `start` by damped Gauss-Newton; a delay stops at 0.

    The unknowns are polynomials orthonormal over the grid, made afresh at each step: dP/P for the
    numerator P, dQ/Q for the denominator Q. High orders and many decades then cost no digits.
    """
    best, damping = assessed(samples, start), 1e-2
    tangent = None
    for _ in range(steps):
        if not np.isfinite(best.cost) or damping > _STUCK:
            break
        if tangent is None:
            tangent = _tangent(samples, best, free_delay)
            if not np.all(np.isfinite(tangent.jacobian)):
                break
        step = _step(samples, best, tangent, damping)
        trial = assessed(samples, _moved(samples, best, tangent, step))
        if not trial.cost < best.cost:
            if np.max(np.abs(step)) < _CONVERGED * np.sqrt(2 * samples.s.size):
                break
            damping *= 8
            continue
        best, damping, tangent = trial, max(damping / 10, 1e-12), None
    return best


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


def _step(
    samples: Samples, model: Rational, tangent: _Tangent, damping: float
) -> Float[np.ndarray, " unknowns"]:
    residual, jacobian = misfit(samples, model).reshape(-1), tangent.jacobian
    step, others = _damped(jacobian, residual, damping), _known(tangent)
    if model.delay == 0 and np.any(step[others:] < 0):
        held = _damped(jacobian[:, :others], residual, damping)
        step = np.append(held, 0.0)
    return step


def _known(tangent: _Tangent) -> int:
    return tangent.over.shape[1] + tangent.under.shape[1]


def _damped(
    jacobian: Float[np.ndarray, "residuals unknowns"],
    residual: Float[np.ndarray, " residuals"],
    damping: float,
) -> Float[np.ndarray, " unknowns"]:
    size = np.linalg.norm(jacobian, axis=0)
    size = np.maximum(size, 1e-12 * size.max())
    rows = np.concatenate([jacobian / size, np.sqrt(damping) * np.eye(size.size)])
    return np.linalg.lstsq(rows, -np.pad(residual, (0, size.size)), rcond=None)[0] / size


def _moved(
    samples: Samples, model: Rational, tangent: _Tangent, step: Float[np.ndarray, " unknowns"]
) -> Rational:
    over, under, late = np.split(step, [tangent.over.shape[1], _known(tangent)])
    below = model.below.copy()
    below[:-1] += (tangent.under @ under)[: below.size - 1]
    delay = model.delay + float(late.sum()) / float(samples.omega[-1])
    return Rational(model.above + tangent.over @ over, below, max(delay, 0.0))
