"""Least squares within many windows at once: polynomials, and rational functions."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float


_DEPENDENT = 1e-6  # smallest singular value of the scaled regressors, to the largest
_STEPS = 2  # of Gauss-Newton, after the linear estimate of a denominator
_NEAREST = 1e-3  # size of the denominator, so that no pole falls onto a bin

Places = Float[np.ndarray, "frequencies window"]
Inputs = Complex[np.ndarray, "frequencies window inputs"]
Outputs = Complex[np.ndarray, "frequencies window outputs"]
Own = Bool[np.ndarray, "frequencies window records"]
Columns = Complex[np.ndarray, "frequencies window columns"]


class Solution(NamedTuple):
    """Response at place 0, how each bin's noise enters it, and what is left over."""

    response: Complex[np.ndarray, "frequencies outputs inputs"]
    effect: Complex[np.ndarray, "frequencies inputs window"]
    boost: Float[np.ndarray, "frequencies outputs"]  # of the effect on each output
    residual: Outputs
    freedom: Float[np.ndarray, " frequencies"]  # complex
    fine: Bool[np.ndarray, " frequencies"]  # whether the window determines the response


def solve_polynomial(place: Places, u: Inputs, y: Outputs, own: Own, order: int) -> Solution:
    """Y = sum_s (g_s U + t_s) place^s, t_s of each record its own.

    Source: Pintelon and Schoukens, System Identification, 2nd ed., section 7.2.
    """
    return _least_squares(_regressors(place, u, own, order), y, u.shape[2], order)


def solve_rational(place: Places, u: Inputs, y: Outputs, own: Own, order: int) -> Solution:
    """The same over a denominator 1 + a place, each output its own.

    `a` comes from the linear equation error, then from Gauss-Newton steps on the output's error;
    the last step's regressors tell how the noise enters by way of `a`. Outputs share the effect of
    the first, boosted to their own variance. Source: local rational method, McKelvey and
    Guerin, 2012.
    """
    columns, inputs = _regressors(place, u, own, order), u.shape[2]
    each = [
        _solve_one(place, columns, y[:, :, o : o + 1], inputs, order) for o in range(y.shape[2])
    ]
    gain = np.stack([np.sum(np.abs(one.effect) ** 2, axis=(1, 2)) for one in each], axis=1)
    return Solution(
        np.concatenate([one.response for one in each], axis=1),
        each[0].effect,
        np.sqrt(gain / np.maximum(gain[:, :1], 1e-300)),
        np.concatenate([one.residual for one in each], axis=2),
        each[0].freedom,
        np.all([one.fine for one in each], axis=0),
    )


def _solve_one(place: Places, columns: Columns, y: Outputs, inputs: int, order: int) -> Solution:
    x = place[:, :, None]
    joined = np.concatenate([columns, x * y], axis=2)
    pole = -_coefficients(joined, y)[:, -1:]
    for _ in range(_STEPS):
        denominator = 1 + pole * x
        small = np.abs(denominator) < _NEAREST
        shaped = columns / np.where(small, _NEAREST, denominator)
        fitted = np.sum(shaped * np.swapaxes(_coefficients(shaped, y), 1, 2), axis=2, keepdims=True)
        slope = x * fitted / np.where(small, _NEAREST, denominator)
        joined = np.concatenate([shaped, slope], axis=2)
        pole = pole - _coefficients(joined, y)[:, -1:]
    return _least_squares(joined, y, inputs, order)


def _regressors(place: Places, u: Inputs, own: Own, order: int) -> Columns:
    columns = [np.concatenate([u, own], axis=2)]
    for _ in range(order):
        columns.append(columns[-1] * place[:, :, None])
    return np.stack(columns, axis=3).reshape(*place.shape, -1)


def _decomposed(columns: Columns) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Q and R of columns of unit length, their lengths, and which were empty.

    A record without bins here has empty columns: a row of its own keeps each from mattering.
    """
    length = np.sqrt(np.einsum("fwc,fwc->fc", columns, np.conj(columns)).real)
    empty = length == 0
    length = np.where(empty, 1.0, length)
    spare = empty[:, :, None] * np.eye(empty.shape[1])
    scaled = np.concatenate([columns / length[:, None, :], spare], axis=1)
    q, r = np.linalg.qr(scaled)
    return q[:, : columns.shape[1]], r, length, empty


def _coefficients(
    columns: Columns, y: Outputs
) -> Complex[np.ndarray, "frequencies columns outputs"]:
    q, r, length, _ = _decomposed(columns)
    strength = np.linalg.svd(r, compute_uv=False)
    fine = strength[:, -1] > 1e-14 * strength[:, 0]
    r = np.where(fine[:, None, None], r, np.eye(r.shape[1]))
    return np.linalg.solve(r, _adjoint(q) @ y) / length[:, :, None]


def _least_squares(columns: Columns, y: Outputs, inputs: int, order: int) -> Solution:
    q, r, length, empty = _decomposed(columns)
    strength = np.linalg.svd(r, compute_uv=False)
    size = np.sum(np.any(columns != 0, axis=2), axis=1)
    freedom = size - np.sum(~empty, axis=1).astype(float)
    fine = (strength[:, -1] > _DEPENDENT * strength[:, 0]) & (freedom > 0)
    r = np.where(fine[:, None, None], r, np.eye(r.shape[1]))
    central = np.eye(r.shape[1])[: inputs * (order + 1) : order + 1] / length[:, None, :]
    rows = np.linalg.solve(np.swapaxes(r, 1, 2), np.swapaxes(central, 1, 2))
    effect = np.swapaxes(rows, 1, 2) @ _adjoint(q)
    residual = y - q @ (_adjoint(q) @ y)
    response = np.swapaxes(effect @ y, 1, 2)
    return Solution(
        response, effect, np.ones((len(y), y.shape[2])), residual, np.maximum(freedom, 0.0), fine
    )


def products(
    x: Complex[np.ndarray, "frequencies window channels"],
) -> Complex[np.ndarray, "frequencies channels channels"]:
    """Sums over the window of x_a conj(x_b)."""
    return np.swapaxes(x, 1, 2) @ np.conj(x)


def _adjoint(x: np.ndarray) -> np.ndarray:
    return np.conj(np.swapaxes(x, 1, 2))
