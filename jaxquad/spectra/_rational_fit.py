"""Ratios of polynomials fitted to bins by least squares: their linear parts, and descents.

A row of complex values at the bins counts as that of their real and imaginary parts, of twice the
length: coefficients are real, and so are the products of rows.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int


_STEPS = 20  # of Gauss and Newton
_NEAREST = 1e-9  # size of the denominator, to its terms', so that no pole falls onto a bin
EXACT = 1e-20  # share of the output's power that is rounding
_LEAST_CONDITION = 1e-10  # reciprocal, of normal equations that leave digits enough
_DEPENDENT = 1e-13  # singular value, to the largest, of a direction that is left alone

Vector = Float[np.ndarray, " parameters"]
Rows = Float[np.ndarray, "rows parts"]
Parts = Float[np.ndarray, " parts"]


class Equations(NamedTuple):
    """What relates one output to the inputs at some bins, each times the weight of its bin."""

    x: Complex[np.ndarray, " bins"]  # (exp(-j omega dt) - 1) / scale
    u: Complex[np.ndarray, "inputs bins"]
    own: Float[np.ndarray, "records bins"]  # the weight in the row of the bin's record, else 0
    y: Complex[np.ndarray, " bins"]

    def pick(self, bins: Int[np.ndarray, " some"] | slice) -> "Equations":
        """Some of the bins."""
        return Equations(*(field[..., bins] for field in self))

    def weighted(self, weight: Float[np.ndarray, " bins"]) -> "Equations":
        """Equations whose noise is `weight` times as large."""
        return Equations(self.x, self.u * weight, self.own * weight, self.y * weight)

    def parameters(self, order: int) -> int:
        """Real coefficients of a model of this order, without the common factor."""
        return len(self.u) * (order + 1) + len(self.own) * order + order


class Solved(NamedTuple):
    """Coefficients, and what they leave of the output."""

    denominator: Float[np.ndarray, " powers"]  # of rising powers of x
    linear: Vector  # numerators, input by input; then transients, record by record
    below: Complex[np.ndarray, " bins"]  # the denominator's values
    left: Complex[np.ndarray, " bins"]  # of the output
    cost: float  # sum of squared residuals


class Basis(NamedTuple):
    """What all models of one order have in common."""

    powers: Complex[np.ndarray, "powers bins"]
    columns: Complex[np.ndarray, "parameters bins"]  # of the numerators and transients
    magnitude: Float[np.ndarray, "powers bins"]  # of the powers

    def largest(self, denominator: Float[np.ndarray, " powers"]) -> int:
        """The power whose term is largest over the bins."""
        return int(np.argmax(np.abs(denominator) * np.mean(self.magnitude, axis=1)))


def make_basis(equations: Equations, size: int) -> Basis:
    powers = powers_of(equations.x, size)
    columns = columns_of(powers, equations.u, equations.own)
    return Basis(powers, columns, np.abs(powers))


def powers_of(x: Complex[np.ndarray, " bins"], size: int) -> Complex[np.ndarray, "powers bins"]:
    """From 1 upwards."""
    powers = np.empty((size, len(x)), complex)
    powers[0] = 1.0
    for k in range(1, size):
        np.multiply(powers[k - 1], x, out=powers[k])
    return powers


def columns_of(
    powers: Complex[np.ndarray, "powers bins"],
    u: Complex[np.ndarray, "inputs bins"],
    own: Float[np.ndarray, "records bins"],
) -> Complex[np.ndarray, "parameters bins"]:
    """Powers times inputs, then all powers but the last times records."""
    few = powers[:-1]
    ends = np.cumsum([0, *[len(powers)] * len(u), *[len(few)] * len(own)])
    columns = np.empty((ends[-1], powers.shape[1]), complex)
    pairs = [*((powers, each) for each in u), *((few, each) for each in own)]
    for (factor, values), start, end in zip(pairs, ends[:-1], ends[1:], strict=True):
        np.multiply(factor, values, out=columns[start:end])
    return columns


def descend(
    equations: Equations,
    basis: Basis,
    denominator: Float[np.ndarray, " powers"],
    least_gain: float,
) -> Solved:
    """Gauss-Newton steps of the denominator, until one gains too little; the rest is linear.

    Source: variable projection (Golub and Pereyra, 1973) as simplified by Kaufman (1975).
    """
    solved, span = _project(equations, basis, denominator)
    floor = EXACT * float(np.sum(np.abs(equations.y) ** 2))
    for _ in range(_STEPS):
        fixed = basis.largest(solved.denominator)
        _, rows = span.nearest(parts_of(_turned(equations, basis, solved, fixed)))
        step = np.insert(_least_squares(rows, parts_of(solved.left)), fixed, 0.0)
        trials = (_project(equations, basis, solved.denominator + step / 3**k) for k in range(6))
        better = next((each for each in trials if each[0].cost < solved.cost), None)
        if better is None:
            break
        gain, (solved, span) = 1 - better[0].cost / solved.cost, better
        if gain < least_gain or solved.cost < floor:
            break
    return solved


class _Span(NamedTuple):
    """What rows span, with the Cholesky factor of the products of these rows at unit length.

    That takes a third of the time of a QR decomposition, which there is where the products would
    lose too many digits.
    """

    rows: Rows
    length: Vector
    factor: Float[np.ndarray, "parameters parameters"]  # of Cholesky, or R
    orthonormal: Rows | None  # Q, with R

    def coefficients(
        self, values: Float[np.ndarray, "*some parts"]
    ) -> Float[np.ndarray, "*some parameters"]:
        """Of the sums of rows that lie nearest to `values`."""
        from scipy.linalg.lapack import dpotrs  # pyright: ignore[reportAttributeAccessIssue]

        if self.orthonormal is not None:
            along = self.orthonormal @ values.T
            return np.linalg.lstsq(self.factor, along, rcond=_DEPENDENT)[0].T / self.length
        right = self.rows @ values.T
        found, _ = dpotrs(self.factor, (right.T / self.length).T)
        return found.T / self.length

    def nearest(
        self, values: Float[np.ndarray, "*some parts"]
    ) -> tuple[Float[np.ndarray, "*some parameters"], Float[np.ndarray, "*some parts"]]:
        """The `coefficients`, and what they leave of `values`; of single ones to the last digit."""
        found = self.coefficients(values)
        rest = values - found @ self.rows
        if values.ndim == 2 or self.orthonormal is not None:
            return found, rest
        more = self.coefficients(rest)
        return found + more, rest - more @ self.rows


def _span_of(rows: Rows) -> _Span:
    from scipy.linalg.lapack import dpocon, dpotrf  # pyright: ignore[reportAttributeAccessIssue]

    products = rows @ rows.T
    length = np.sqrt(np.diagonal(products))
    length = np.where(length > 0, length, 1.0)
    products /= np.outer(length, length)
    factor, failed = dpotrf(products)
    condition = 0.0
    if not failed:
        condition, _ = dpocon(factor, np.max(np.sum(np.abs(products), axis=0)))
    if condition < _LEAST_CONDITION:
        return _decomposed(rows, length)
    return _Span(rows, length, factor, None)


def _decomposed(rows: Rows, length: Vector) -> _Span:
    from scipy.linalg.lapack import dgeqrf, dorgqr  # pyright: ignore[reportAttributeAccessIssue]

    qr, tau, *_ = dgeqrf((rows / length[:, None]).T, overwrite_a=True)
    triangle = np.triu(qr[: len(rows)])
    orthonormal, *_ = dorgqr(qr, tau, overwrite_a=True)
    return _Span(rows, length, triangle, orthonormal.T)


def solve_linear(
    equations: Equations, basis: Basis, denominator: Float[np.ndarray, " powers"]
) -> Solved:
    return _project(equations, basis, denominator)[0]


def _project(
    equations: Equations, basis: Basis, denominator: Float[np.ndarray, " powers"]
) -> tuple[Solved, _Span]:
    """The best linear coefficients under a denominator, and what their columns span."""
    below = denominator @ basis.powers
    least = _NEAREST * (np.abs(denominator) @ basis.magnitude)
    below = np.where(np.abs(below) < least, least, below)
    span, y = _span_of(parts_of(basis.columns * (1 / below))), parts_of(equations.y)
    linear, left = span.nearest(y)
    solved = Solved(denominator, linear, below, left.view(complex), float(left @ left))
    return solved, span


def cost_with_pole(
    equations: Equations, basis: Basis, solved: Solved, places: Float[np.ndarray, " places"]
) -> Float[np.ndarray, " places"]:
    """What is left with one more pole, at each of some places on the real axis of x.

    Polynomials over A (1 - x/p) are those of one degree less over A, and a constant over the same.
    """
    _, span = _project(equations, basis, solved.denominator)
    driven = np.concatenate([equations.u, equations.own]) / solved.below
    driven = driven / (1 - equations.x / places[:, None])[:, None]
    _, rows = span.nearest(parts_of(driven.reshape(-1, len(equations.x))))
    rows /= _lengths(rows)[:, None]
    rows = rows.reshape(len(places), -1, rows.shape[1])
    along = rows @ parts_of(solved.left)
    products = rows @ np.swapaxes(rows, 1, 2) + _LEAST_CONDITION * np.eye(rows.shape[1])
    return solved.cost - np.vecdot(along, np.linalg.solve(products, along[:, :, None])[:, :, 0])


def parts_of(rows: Complex[np.ndarray, "*rows bins"]) -> Float[np.ndarray, "*rows parts"]:
    """Real and imaginary parts by turns, a view where it can be."""
    return np.ascontiguousarray(rows).view(float)


def _turned(
    equations: Equations, basis: Basis, solved: Solved, fixed: int
) -> Complex[np.ndarray, "rows bins"]:
    """Derivatives of the fitted output by the denominator's coefficients but the fixed one."""
    fitted = equations.y - solved.left
    return np.delete(basis.powers, fixed, axis=0) * (-fitted / solved.below)


def slopes_of(
    equations: Equations, basis: Basis, solved: Solved, fixed: int
) -> Complex[np.ndarray, "rows bins"]:
    """Derivatives of the fitted output, all coefficients but the fixed one."""
    turned = _turned(equations, basis, solved, fixed)
    return np.concatenate([basis.columns / solved.below, turned])


def _least_squares(rows: Rows, values: Parts) -> Vector:
    """Coefficients of the sum of rows that lies nearest to `values`."""
    joined = np.concatenate([rows, values[None]])
    length = _lengths(joined)
    triangle = _triangle(joined / length[:, None])
    found = np.linalg.lstsq(triangle[:-1, :-1], triangle[:-1, -1], rcond=_DEPENDENT)[0]
    return found * length[-1] / length[:-1]


def _triangle(rows: Rows) -> Float[np.ndarray, "rows rows"]:
    """R of the QR decomposition of the columns that the rows are; numpy's takes twice the time."""
    from scipy.linalg.lapack import dgeqrf  # pyright: ignore[reportAttributeAccessIssue]

    return np.triu(dgeqrf(rows.T, overwrite_a=True)[0][: len(rows)])


def _lengths(rows: Rows) -> Vector:
    """Euclidean norms; 1 for rows of zeros."""
    length = np.sqrt(np.vecdot(rows, rows))
    return np.where(length > 0, length, 1.0)
