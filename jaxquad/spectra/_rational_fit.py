"""Ratios of polynomials fitted to bins by least squares: linear parts, descents, and their order.

A row of complex values at the bins counts as that of their real and imaginary parts, of twice the
length: coefficients are real, and so are the products of rows.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int


_STEPS = 20  # of Gauss and Newton
_NEAREST = 1e-9  # size of the denominator, to its terms', so that no pole falls onto a bin
_EXACT = 1e-20  # share of the output's power that is rounding
_LEAST_CONDITION = 1e-10  # reciprocal, of normal equations that leave digits enough
_DEPENDENT = 1e-13  # singular value, to the largest, of a direction that is left alone
_TRIAL = 1e-3  # relative gain of a step at which a descent ends
_PER_PARAMETER = 6  # real equations
_THOROUGH, _PATIENCE = 6, 4  # least order, and orders in a row no better, that end the search
_DOUBTED = 2  # orders in a row no better that end the search around an order
PRICE = 4.0  # of a parameter: Akaike's is 2, a Bayesian one ln(count), 7 to 8
_PLACES = 5  # at which one more pole is tried

Powers = Float[np.ndarray, " powers"]
Bins = Complex[np.ndarray, " bins"]
Vector = Float[np.ndarray, " parameters"]
Rows = Float[np.ndarray, "rows parts"]


class Equations(NamedTuple):
    """What relates one output to the inputs at some bins, each times the weight of its bin."""

    x: Bins  # (exp(-j omega dt) - 1) / scale
    u: Complex[np.ndarray, "inputs bins"]
    owner: Float[np.ndarray, "records bins"]  # the weight in the row of the bin's record, else 0
    y: Bins

    def pick(self, bins: Int[np.ndarray, " some"] | slice) -> "Equations":
        """Some of the bins."""
        return Equations(*(field[..., bins] for field in self))

    def weighted(self, weight: Float[np.ndarray, " bins"]) -> "Equations":
        """Equations whose noise is `weight` times as large."""
        return Equations(self.x, self.u * weight, self.owner * weight, self.y * weight)

    def parameters(self, order: int) -> int:
        """Real coefficients of a model of this order, without the common factor."""
        return len(self.u) * (order + 1) + len(self.owner) * order + order

    def highest(self, most: int) -> int:
        """The highest order, up to `most`, of which there are equations enough."""
        enough = 2 * len(self.y) / _PER_PARAMETER
        return sum(self.parameters(order) <= enough for order in range(1, most + 1))

    def criterion(self, solved: "Solved") -> float:
        """Of the solution's order: the least is the best."""
        count, parameters = 2 * len(self.y), self.parameters(solved.order) if solved.order else 1
        cost = max(solved.cost + 0.01 * self.rounding, 1e-300)
        return count * np.log(cost / count) + PRICE * parameters

    @property
    def rounding(self) -> float:
        """What rounding may leave of the output's sum of squares."""
        return _EXACT * float(np.sum(np.abs(self.y) ** 2))


class Solved(NamedTuple):
    """Coefficients, and what they leave of the output."""

    denominator: Powers  # of rising powers of x
    linear: Vector  # numerators, input by input; then transients, record by record
    below: Bins  # the denominator's values
    left: Bins  # of the output
    cost: float  # sum of squared residuals

    @property
    def order(self) -> int:
        return len(self.denominator) - 1


class Basis(NamedTuple):
    """What all models of one order have in common."""

    equations: Equations
    powers: Complex[np.ndarray, "powers bins"]
    columns: Complex[np.ndarray, "parameters bins"]  # of the numerators and transients
    magnitude: Float[np.ndarray, "powers bins"]  # of the powers

    @classmethod
    def of(cls, equations: Equations, size: int) -> "Basis":
        powers = powers_of(equations.x, size)
        columns = columns_of(powers, equations.u, equations.owner)
        return cls(equations, powers, columns, np.abs(powers))

    def largest(self, denominator: Powers) -> int:
        """The power whose term is largest over the bins."""
        return int(np.argmax(np.abs(denominator) * np.mean(self.magnitude, axis=1)))

    def solve(self, denominator: Powers) -> "tuple[Solved, _Span]":
        """The best linear coefficients under a denominator, and what their columns span."""
        below = denominator @ self.powers
        least = _NEAREST * (np.abs(denominator) @ self.magnitude)
        below = np.where(np.abs(below) < least, least, below)
        span = _Span.of(parts_of(self.columns * (1 / below)))
        linear, left = span.nearest(parts_of(self.equations.y))
        solved = Solved(denominator, linear, below, left.view(complex), float(left @ left))
        return solved, span

    def slopes(self, solved: Solved, fixed: int) -> Complex[np.ndarray, "rows bins"]:
        """Derivatives of the fitted output by the denominator's coefficients but the fixed one."""
        fitted = self.equations.y - solved.left
        return np.delete(self.powers, fixed, axis=0) * (-fitted / solved.below)


def powers_of(x: Bins, size: int) -> Complex[np.ndarray, "powers bins"]:
    """From 1 upwards."""
    powers = np.empty((size, len(x)), complex)
    powers[0] = 1.0
    for k in range(1, size):
        np.multiply(powers[k - 1], x, out=powers[k])
    return powers


def columns_of(
    powers: Complex[np.ndarray, "powers bins"],
    u: Complex[np.ndarray, "inputs bins"],
    owner: Float[np.ndarray, "records bins"],
) -> Complex[np.ndarray, "parameters bins"]:
    """Powers times inputs, then all powers but the last times records."""
    few = powers[:-1]
    ends = np.cumsum([0, *[len(powers)] * len(u), *[len(few)] * len(owner)])
    columns = np.empty((ends[-1], powers.shape[1]), complex)
    pairs = [*((powers, row) for row in u), *((few, row) for row in owner)]
    for (factor, values), start, end in zip(pairs, ends[:-1], ends[1:], strict=True):
        np.multiply(factor, values, out=columns[start:end])
    return columns


def descend(equations: Equations, denominator: Powers, least_gain: float) -> tuple[Solved, Basis]:
    """Gauss-Newton steps of the denominator, which variable projection leaves alone.

    Source: Golub and Pereyra (1973), as simplified by Kaufman (1975).
    """
    from scipy.linalg.lapack import dgeqrf  # pyright: ignore[reportAttributeAccessIssue]

    basis = Basis.of(equations, denominator.size)
    solved, span = basis.solve(denominator)
    for _ in range(_STEPS):
        fixed = basis.largest(solved.denominator)
        slopes = parts_of(basis.slopes(solved, fixed))
        rows = np.concatenate([span.nearest(slopes)[1], parts_of(solved.left)[None]])
        length = _lengths(rows)
        # R of the QR decomposition of unit columns; numpy's takes twice the time.
        unit = dgeqrf((rows / length[:, None]).T, overwrite_a=True)[0]
        triangle = np.triu(unit[: len(rows)])
        step = np.linalg.lstsq(triangle[:-1, :-1], triangle[:-1, -1], rcond=_DEPENDENT)[0]
        step = np.insert(step * length[-1] / length[:-1], fixed, 0.0)
        trials = (basis.solve(solved.denominator + step / 3**k) for k in range(6))
        better = next((trial for trial in trials if trial[0].cost < solved.cost), None)
        if better is None:
            break
        gain, (solved, span) = 1 - better[0].cost / solved.cost, better
        if gain < least_gain or solved.cost < equations.rounding:
            break
    return solved, basis


class _Span(NamedTuple):
    """What rows span, by Cholesky of products at unit length, or QR where digits are lost."""

    rows: Rows
    length: Vector
    factor: Float[np.ndarray, "parameters parameters"]  # of Cholesky, or R
    orthonormal: Rows | None  # Q, with R

    @classmethod
    def of(cls, rows: Rows) -> "_Span":
        from scipy.linalg import lapack

        products = rows @ rows.T
        length = np.sqrt(np.diagonal(products))
        length = np.where(length > 0, length, 1.0)
        products /= np.outer(length, length)
        factor, failed = lapack.dpotrf(products)  # pyright: ignore[reportAttributeAccessIssue]
        condition = 0.0
        if not failed:
            norm = np.max(np.sum(np.abs(products), axis=0))
            condition, _ = lapack.dpocon(factor, norm)  # pyright: ignore[reportAttributeAccessIssue]
        if condition >= _LEAST_CONDITION:
            return cls(rows, length, factor, None)
        unit = (rows / length[:, None]).T
        qr, tau, *_ = lapack.dgeqrf(unit, overwrite_a=True)  # pyright: ignore
        triangle = np.triu(qr[: len(rows)])
        orthonormal, *_ = lapack.dorgqr(qr, tau, overwrite_a=True)  # pyright: ignore
        return cls(rows, length, triangle, orthonormal.T)

    def coefficients(
        self, values: Float[np.ndarray, "*some parts"]
    ) -> Float[np.ndarray, "*some parameters"]:
        """Of the sums of rows that lie nearest to `values`."""
        from scipy.linalg.lapack import dpotrs  # pyright: ignore[reportAttributeAccessIssue]

        if self.orthonormal is not None:
            along = self.orthonormal @ values.T
            return np.linalg.lstsq(self.factor, along, rcond=_DEPENDENT)[0].T / self.length
        right = self.rows @ values.T
        solution, _ = dpotrs(self.factor, (right.T / self.length).T)
        return solution.T / self.length

    def nearest(
        self, values: Float[np.ndarray, "*some parts"]
    ) -> tuple[Float[np.ndarray, "*some parameters"], Float[np.ndarray, "*some parts"]]:
        """The `coefficients`, and what they leave of `values`; of single ones to the last digit."""
        linear = self.coefficients(values)
        rest = values - linear @ self.rows
        if values.ndim == 2 or self.orthonormal is not None:
            return linear, rest
        more = self.coefficients(rest)
        return linear + more, rest - more @ self.rows


def parts_of(rows: Complex[np.ndarray, "*rows bins"]) -> Float[np.ndarray, "*rows parts"]:
    """Real and imaginary parts by turns, a view where it can be."""
    return np.ascontiguousarray(rows).view(float)


def _lengths(rows: Rows) -> Vector:
    """Euclidean norms; 1 for rows of zeros."""
    length = np.sqrt(np.vecdot(rows, rows))
    return np.where(length > 0, length, 1.0)


class Orders(NamedTuple):
    """Solutions by their order, and the order of the least criterion; 0 where none explains."""

    solved: dict[int, Solved]
    best: int

    @classmethod
    def of(cls, equations: Equations, solved: dict[int, Solved]) -> "Orders":
        return cls(solved, min(solved, key=lambda order: equations.criterion(solved[order])))


def search_orders(equations: Equations, most: int) -> Orders:
    """From 0 upwards, each order from the one below with one pole more."""
    solved = {0: Basis.of(equations, 1).solve(np.ones(1))[0]}
    _climb(equations, solved, most, {}, _THOROUGH, _PATIENCE)
    return Orders.of(equations, solved)


def refine_orders(equations: Equations, before: Orders, most: int) -> Orders:
    """Of the same equations in other weights: orders around the best one `before`."""
    first, starts = before.best, before.solved
    solved = {first: descend(equations, starts[first].denominator, _TRIAL)[0]}
    _climb(equations, solved, most, starts, first, _DOUBTED)
    for order in range(first - 1, 0, -1):
        solved[order] = descend(equations, starts[order].denominator, _TRIAL)[0]
        if Orders.of(equations, solved).best != order:
            break
    return Orders.of(equations, solved)


def _climb(
    equations: Equations,
    solved: dict[int, Solved],
    most: int,
    starts: Mapping[int, Solved],
    thorough: int,
    patience: int,
) -> None:
    """Add orders, from a pole more or from `starts`, until too many have no better criterion."""
    order, worse = max(solved), 0
    least = equations.criterion(solved[order])
    while order < equations.highest(most) and solved[order].cost > equations.rounding:
        if worse >= patience and order >= thorough:
            break
        order += 1
        start = _with_pole(equations, solved[order - 1])
        if order in starts:
            basis = Basis.of(equations, start.size)
            trials = starts[order].denominator, start
            start = trials[int(np.argmin([basis.solve(trial)[0].cost for trial in trials]))]
        solved[order] = descend(equations, start, _TRIAL)[0]
        value = equations.criterion(solved[order])
        worse, least = (0, value) if value < least else (worse + 1, least)


def next_order(equations: Equations, orders: Orders, most: int) -> Powers:
    """Where a descent of the next order begins: a pole at infinity, as a small delay's."""
    best = orders.solved[orders.best]
    if orders.best >= equations.highest(most) or best.cost <= equations.rounding:
        return best.denominator
    return np.pad(best.denominator, (0, 1))


def _with_pole(equations: Equations, solved: Solved) -> Powers:
    """The denominator with a real pole more, at that of a few places where it leaves least."""
    size = np.abs(equations.x)
    places = np.geomspace(np.min(size), np.max(size), _PLACES)
    _, span = Basis.of(equations, len(solved.denominator)).solve(solved.denominator)
    driven = np.concatenate([equations.u, equations.owner]) / solved.below
    driven = driven / (1 - equations.x / places[:, None])[:, None]
    _, rows = span.nearest(parts_of(driven.reshape(-1, len(equations.x))))
    rows /= _lengths(rows)[:, None]
    rows = rows.reshape(_PLACES, -1, rows.shape[1])
    along = rows @ parts_of(solved.left)
    products = rows @ np.swapaxes(rows, 1, 2) + _LEAST_CONDITION * np.eye(rows.shape[1])
    gain = np.vecdot(along, np.linalg.solve(products, along[:, :, None])[:, :, 0])
    return np.convolve(solved.denominator, [1.0, -1.0 / places[np.argmin(solved.cost - gain)]])
