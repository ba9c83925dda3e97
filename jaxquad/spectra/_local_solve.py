"""Least squares in the windows around many frequencies at once: polynomials, and one pole more."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int


_DEPENDENT = 1e-6  # smallest singular value of the scaled regressors, to the largest
_ROUNDING = 1e-14  # added to the products of unit columns, so that they have an inverse
_STEPS = 2  # of Gauss-Newton, after the linear estimate of a denominator
_NEAREST = 1e-3  # size of the denominator, so that no pole falls onto a bin

Places = Float[np.ndarray, "frequencies window"]
Inputs = Complex[np.ndarray, "frequencies window inputs"]
Outputs = Complex[np.ndarray, "frequencies window outputs"]
Own = Bool[np.ndarray, "frequencies window records"]
Columns = Complex[np.ndarray, "frequencies window columns"]


class Solution(NamedTuple):
    """Response at place 0, how the noise of each bin enters it, and the residual."""

    response: Complex[np.ndarray, "frequencies outputs inputs"]
    effect: Complex[np.ndarray, "frequencies inputs window"]
    boost: Float[np.ndarray, "frequencies outputs"]  # of the effect on each output
    residual: Outputs
    freedom: Float[np.ndarray, " frequencies"]  # complex
    fine: Bool[np.ndarray, " frequencies"]  # whether the window determines the response


def solve_polynomial(place: Places, u: Inputs, y: Outputs, own: Own, order: int) -> Solution:
    """Y = sum_s (g_s U + t_s) place^s, with different t_s for each record.

    Source: Pintelon and Schoukens, System Identification, 2nd ed., section 7.2.
    """
    return _least_squares(regressors(place, u, own, order), y, count_used(own), u.shape[2], order)


def solve_rational(place: Places, u: Inputs, y: Outputs, own: Own, order: int) -> Solution:
    """The same over a denominator 1 + a place, with a different `a` for each output.

    `a` is first estimated from the linear equation error, then by Gauss-Newton steps on the output
    error; the regressors of the last step say how the noise enters through `a`. All outputs use the
    effect of the first, scaled to their own variance. Source: local rational method, McKelvey and
    Guerin (2012).
    """
    columns, inputs = regressors(place, u, own, order), u.shape[2]
    normal, moved = normal_equations(columns), place[:, :, None] * y
    poles = _slope(_left(normal, -moved), _left(normal, y))
    each = []
    for o in range(y.shape[2]):
        one = y[:, :, o : o + 1]
        joined = _with_pole(place[:, :, None], columns, one, poles[:, None, o : o + 1])
        each.append(_least_squares(joined, one, count_used(own), inputs, order))
    gains = [np.sum(np.vecdot(one.effect, one.effect).real, axis=1) for one in each]
    gain = np.stack(gains, axis=1)
    return Solution(
        np.concatenate([one.response for one in each], axis=1),
        each[0].effect,
        np.sqrt(gain / np.maximum(gain[:, :1], 1e-300)),
        np.concatenate([one.residual for one in each], axis=2),
        each[0].freedom,
        np.all([one.fine for one in each], axis=0),
    )


def _with_pole(
    x: Float[np.ndarray, "frequencies window 1"],
    columns: Columns,
    y: Outputs,
    pole: Complex[np.ndarray, "frequencies 1 1"],
) -> Complex[np.ndarray, "frequencies window joined"]:
    """Regressors of the last of the Gauss-Newton steps from `pole`, its own as the last one."""
    joined = columns
    for step in range(_STEPS):
        below = 1 + pole * x
        over = 1 / np.where(np.abs(below) < _NEAREST, _NEAREST, below)
        shaped = columns * over
        normal = normal_equations(shaped)
        left = _left(normal, y)
        slope = x * (y - left) * over
        joined = np.concatenate([shaped, slope], axis=2)
        if step + 1 < _STEPS:
            pole = pole - _slope(_left(normal, slope), left)[:, None]
    return joined


def count_used(own: Own) -> Int[np.ndarray, " frequencies"]:
    return np.sum(np.any(own, axis=2), axis=1)


def _slope(x: Outputs, y: Outputs) -> Complex[np.ndarray, "frequencies outputs"]:
    """The multiple of each column of `x` that is nearest to that of `y`."""
    x, y = (np.swapaxes(each, 1, 2) for each in (x, y))
    return np.vecdot(x, y) / np.maximum(np.vecdot(x, x).real, 1e-300)


def regressors(place: Places, u: Inputs, own: Own, order: int) -> Columns:
    """Each input, then each record, times the powers of `place`; a column lies in one piece."""
    moving = np.concatenate([u, own], axis=2)
    rows = np.empty((len(place), moving.shape[2], order + 1, place.shape[1]), complex)
    rows[:, :, 0] = np.swapaxes(moving, 1, 2)
    for power in range(order):
        np.multiply(rows[:, :, power], place[:, None], out=rows[:, :, power + 1])
    return np.swapaxes(rows.reshape(len(place), -1, place.shape[1]), 1, 2)


class Normal(NamedTuple):
    """Normal equations of some columns.

    Their inverse is wrong by the square of the columns' condition. What it gives is corrected once
    by what it leaves, after which it is as good as that of a QR decomposition up to a condition of
    1e4, and good to some 1e-5 where columns are as dependent as is allowed.
    """

    columns: Columns
    adjoint: Complex[np.ndarray, "frequencies columns window"]
    inverse: Complex[np.ndarray, "frequencies columns columns"]
    independent: Bool[np.ndarray, " frequencies"]
    count: Int[np.ndarray, " frequencies"]  # of the columns that are not empty


def normal_equations(columns: Columns) -> Normal:
    """A record without bins here has empty columns, which take no part."""
    adjoint = _adjoint(columns)
    gram = adjoint @ columns
    length = np.sqrt(np.real(np.diagonal(gram, axis1=1, axis2=2)))
    empty = length == 0
    length = np.where(empty, 1.0, length)
    area = length[:, :, None] * length[:, None, :]
    alike = gram / area + (empty[:, :, None] + _ROUNDING) * np.eye(empty.shape[1])
    inverse = np.linalg.inv(alike)
    independent = _independent(alike, inverse)
    return Normal(columns, adjoint, inverse / area, independent, np.sum(~empty, axis=1))


def _independent(
    alike: Complex[np.ndarray, "frequencies columns columns"],
    inverse: Complex[np.ndarray, "frequencies columns columns"],
) -> Bool[np.ndarray, " frequencies"]:
    """Whether unit columns are, whose products are `alike`: by norms, or by their eigenvalues."""
    norms = (np.linalg.norm(each, axis=(1, 2)) for each in (alike, inverse))
    found = np.prod(list(norms), axis=0) < 1 / _DEPENDENT**2
    if not np.all(found):
        value = np.linalg.eigvalsh(alike[~found])
        found[~found] = value[:, 0] > _DEPENDENT**2 * value[:, -1]
    return found


def _left(normal: Normal, y: Outputs) -> Outputs:
    """What the columns do not explain of `y`."""
    for _ in range(2):
        y = y - normal.columns @ (normal.inverse @ (normal.adjoint @ y))
    return y


def _effect(normal: Normal, which: slice) -> Complex[np.ndarray, "frequencies which window"]:
    """How each bin of an output enters some of the columns' coefficients."""
    unit = np.eye(normal.columns.shape[2])[which]
    first = normal.inverse[:, which] @ normal.adjoint
    missing = unit - first @ normal.columns
    return first + missing @ normal.inverse @ normal.adjoint


def _least_squares(
    columns: Columns,
    y: Outputs,
    bins: Int[np.ndarray, " frequencies"],
    inputs: int,
    order: int,
) -> Solution:
    normal = normal_equations(columns)
    freedom = np.maximum(bins - normal.count, 0).astype(float)
    effect = _effect(normal, slice(0, inputs * (order + 1), order + 1))
    response = np.swapaxes(effect @ y, 1, 2)
    boost = np.ones((len(y), y.shape[2]))
    fine = normal.independent & (freedom > 0)
    return Solution(response, effect, boost, _left(normal, y), freedom, fine)


def _adjoint(x: np.ndarray) -> np.ndarray:
    return np.conj(np.swapaxes(x, 1, 2))
