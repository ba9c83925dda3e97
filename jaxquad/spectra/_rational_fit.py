"""Ratios of polynomials fitted to bins by least squares: linear estimates, and descents."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int


_RELAXATIONS, _STEPS = 12, 20  # of Sanathanan and Koerner, of Gauss and Newton
_NEAREST = 1e-9  # size of the denominator, to its largest, so that no pole falls onto a bin
EXACT = 1e-20  # share of the output's power that is rounding

Vector = Float[np.ndarray, " parameters"]
Powers = Complex[np.ndarray, "bins powers"]


class Equations(NamedTuple):
    """What relates one output to the inputs at some bins, each row times its weight."""

    x: Complex[np.ndarray, " bins"]  # (exp(-j omega dt) - 1) / scale
    u: Complex[np.ndarray, "bins inputs"]
    own: Float[np.ndarray, "bins records"]  # the weight in the column of the bin's record, else 0
    y: Complex[np.ndarray, " bins"]

    def pick(self, rows: Int[np.ndarray, " rows"] | slice) -> "Equations":
        """Some of the bins."""
        return Equations(*(field[rows] for field in self))

    def weighted(self, weight: Float[np.ndarray, " bins"]) -> "Equations":
        """Equations whose noise is `weight` times as large."""
        column = weight[:, None]
        return Equations(self.x, self.u * column, self.own * column, self.y * weight)

    def parameters(self, order: int) -> int:
        """Real coefficients of a model of this order, without the common factor."""
        inputs, records = self.u.shape[1], self.own.shape[1]
        return inputs * (order + 1) + records * order + order


class Solved(NamedTuple):
    """Coefficients, and what they leave of the output."""

    denominator: Float[np.ndarray, " powers"]  # of rising powers of x
    linear: Vector  # numerators, input by input; then transients, record by record
    below: Complex[np.ndarray, " bins"]  # the denominator's values
    fitted: Complex[np.ndarray, " bins"]
    cost: float  # sum of squared residuals


class Basis(NamedTuple):
    """What all models of one order have in common; each column lies in one piece of memory."""

    powers: Powers
    columns: Complex[np.ndarray, "bins parameters"]  # of the numerators and transients
    size: Float[np.ndarray, " powers"]  # mean over the bins

    def largest(self, denominator: Float[np.ndarray, " powers"]) -> int:
        """The power whose term is largest over the bins."""
        return int(np.argmax(np.abs(denominator) * self.size))


def make_basis(equations: Equations, size: int) -> Basis:
    powers = equations.x[:, None] ** np.arange(size)
    columns = regressors(powers, equations.u, equations.own)
    one_piece = np.asfortranarray(powers), np.asfortranarray(columns)
    return Basis(*one_piece, np.mean(np.abs(powers), axis=0))


def relax(equations: Equations, basis: Basis) -> Float[np.ndarray, " powers"]:
    """The denominator by repeated linear least squares, each weighted by the one before."""
    moved = basis.powers * equations.y[:, None]
    weight, best = np.ones((len(moved), 1)), None
    for _ in range(_RELAXATIONS):
        joined = stacked(basis.columns * weight, moved * weight)
        denominator = _null_vector(joined, basis.columns.shape[1])
        solved = solve_linear(equations, basis, denominator)
        if best is not None and solved.cost > 0.999 * best.cost:
            break
        best = solved if best is None or solved.cost < best.cost else best
        weight = 1 / np.abs(solved.below)[:, None]
    assert best is not None
    return best.denominator


def _null_vector(matrix: Float[np.ndarray, "rows columns"], first: int) -> Vector:
    """Coefficients of the columns from `first` on, of unit length, that others explain best."""
    length = _lengths(matrix)
    corner = _triangle(matrix / length)[first:, first:]
    return np.linalg.svd(corner)[2][-1] / length[first:]


def descend(
    equations: Equations,
    basis: Basis,
    denominator: Float[np.ndarray, " powers"],
    least_gain: float,
) -> Solved:
    """Gauss-Newton steps of the denominator, until one gains too little; the rest is linear."""
    solved, reduced = _project(equations, basis, denominator)
    floor = EXACT * float(np.sum(np.abs(equations.y) ** 2))
    for _ in range(_STEPS):
        fixed, left = basis.largest(solved.denominator), equations.y - solved.fitted
        further = stacked(_turned(basis, solved, fixed), left[:, None])
        change = _least_squares(*_extended(reduced, further))[len(solved.linear) :]
        step = np.insert(change, fixed, 0.0)
        trials = (_project(equations, basis, solved.denominator + step / 3**k) for k in range(6))
        better = next((each for each in trials if each[0].cost < solved.cost), None)
        if better is None:
            break
        gain, (solved, reduced) = 1 - better[0].cost / solved.cost, better
        if gain < least_gain or solved.cost < floor:
            break
    return solved


class _Reduced(NamedTuple):
    """Columns of unit length as LAPACK's QR decomposition leaves them."""

    qr: Float[np.ndarray, "rows columns"]
    tau: Float[np.ndarray, " columns"]
    length: Float[np.ndarray, " columns"]  # that they had


def solve_linear(
    equations: Equations, basis: Basis, denominator: Float[np.ndarray, " powers"]
) -> Solved:
    return _project(equations, basis, denominator)[0]


def _project(
    equations: Equations, basis: Basis, denominator: Float[np.ndarray, " powers"]
) -> tuple[Solved, _Reduced]:
    """The best linear coefficients under a denominator; and their columns, then the output."""
    below = basis.powers @ denominator
    least = _NEAREST * np.max(np.abs(below))
    below = np.where(np.abs(below) < least, least, below)
    joined = stacked(basis.columns * (1 / below)[:, None], equations.y[:, None])
    reduced, rows = _reduce(joined), len(below)
    linear = _least_squares(np.triu(reduced.qr[: joined.shape[1]]), reduced.length)
    fitted = joined[:, :-1] @ linear
    cost = float(np.sum((joined[:, -1] - fitted) ** 2))
    solved = Solved(denominator, linear, below, fitted[:rows] + 1j * fitted[rows:], cost)
    return solved, reduced


def _turned(basis: Basis, solved: Solved, fixed: int) -> Complex[np.ndarray, "bins parameters"]:
    """Derivatives of the fitted output by the denominator's coefficients but the fixed one."""
    return (-solved.fitted / solved.below)[:, None] * np.delete(basis.powers, fixed, axis=1)


def slopes_of(basis: Basis, solved: Solved, fixed: int) -> Complex[np.ndarray, "bins parameters"]:
    """Derivatives of the fitted output, all coefficients but the fixed one."""
    columns = basis.columns / solved.below[:, None]
    return np.concatenate([columns, _turned(basis, solved, fixed)], axis=1)


def regressors(powers: Powers, u: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Powers times inputs, then all powers but the last times records."""
    parts = (u[:, :, None] * powers[:, None, :], own[:, :, None] * powers[:, None, :-1])
    return np.concatenate([part.reshape(len(u), -1) for part in parts], axis=1)


def _least_squares(
    triangle: Float[np.ndarray, "columns columns"], length: Float[np.ndarray, " columns"]
) -> Vector:
    """Coefficients of all columns but the last, which they fit, by the R of unit columns."""
    found = np.linalg.lstsq(triangle[:-1, :-1], triangle[:-1, -1], rcond=1e-13)[0]
    return found * length[-1] / length[:-1]


def _lengths(columns: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, " columns"]:
    """Euclidean norms; 1 for columns of zeros."""
    length = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    return np.where(length > 0, length, 1.0)


def _reduce(joined: Float[np.ndarray, "rows columns"]) -> _Reduced:
    """numpy.linalg.qr takes twice the time, for copies."""
    from scipy.linalg.lapack import dgeqrf  # pyright: ignore[reportAttributeAccessIssue]

    length = _lengths(joined)
    qr, tau, *_ = dgeqrf(joined / length, overwrite_a=True)
    return _Reduced(qr, tau, length)


def _triangle(matrix: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "columns columns"]:
    """R of the QR decomposition."""
    from scipy.linalg.lapack import dgeqrf  # pyright: ignore[reportAttributeAccessIssue]

    return np.triu(dgeqrf(matrix, overwrite_a=True)[0][: matrix.shape[1]])


def _extended(
    reduced: _Reduced, further: Float[np.ndarray, "rows columns"]
) -> tuple[Float[np.ndarray, "all all"], Float[np.ndarray, " all"]]:
    """R and lengths of all columns that are reduced, but the last, and of `further` ones."""
    from scipy.linalg.lapack import dormqr  # pyright: ignore[reportAttributeAccessIssue]

    count, length = len(reduced.tau) - 1, _lengths(further)
    kept, size = reduced.qr[:, :count], count + further.shape[1]
    work = 64 * further.shape[1]
    turned, *_ = dormqr(
        "L", "T", kept, reduced.tau[:count], further / length, work, overwrite_c=True
    )
    triangle = np.zeros((size, size))
    triangle[:count, :count], triangle[:count, count:] = np.triu(kept[:count]), turned[:count]
    triangle[count:, count:] = _triangle(turned[count:])
    return triangle, np.concatenate([reduced.length[:count], length])


def stacked(
    *parts: Complex[np.ndarray, "rows _"],
) -> Float[np.ndarray, "stacked columns"]:
    """Columns side by side, real above imaginary parts, in the order that LAPACK takes."""
    rows, ends = len(parts[0]), np.cumsum([0, *(part.shape[1] for part in parts)])
    joined = np.empty((2 * rows, ends[-1]), order="F")
    for part, start, end in zip(parts, ends[:-1], ends[1:], strict=True):
        joined[:rows, start:end], joined[rows:, start:end] = np.real(part), np.imag(part)
    return joined
