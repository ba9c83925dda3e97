"""Leakage through windows, told from noise.

Behind a window w, y = g * x has the transform sum_n j^n / n! G^(n) X_n, with X_n that of x behind
the n-th derivative of w: the part beyond G X_0 is leakage, of the slope and the curvature of G. It
is the same in each draw of the noise, so the noise is what no combination of X_0, X_1, X_2 explains
over the windows of one length. Y_1 is added to these: poles outlast any series in the slopes of G,
but with them w y' = (w y)' - w' y has a transform that is linear in Y_1.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float


_RIDGE = 1e-12  # of the columns' size, so that empty ones do no harm
_ROUNDING = 1e-7  # of a residual: the square is below rounding
_WITHIN = 1e-6  # of its size: an output's slope that inputs explain so well adds nothing
_FEW = 16  # windows taken at once: few others overlap them

Rows = Complex[np.ndarray, "frequencies _ windows"]
Gram = Complex[np.ndarray, "frequencies columns columns"]
Groups = Float[np.ndarray, "frequencies outputs groups"]
Overlap = Float[np.ndarray, "windows windows"]  # sums of the product of any two windows


class Slopes(NamedTuple):
    """Transforms behind the derivatives of the windows of one length."""

    first: Complex[np.ndarray, "frequencies _ channels"]  # derivative: inputs, then outputs
    second: Complex[np.ndarray, "frequencies _ inputs"]


class Rest(NamedTuple):
    """What is left of the outputs' windows, with what noise does there, for each window length.

    `products` are the sums of `conj(a) b` of what is left, `trace` is the energy that unit noise
    leaves, and `fits` are those of leakage.
    """

    products: Complex[np.ndarray, "frequencies outputs outputs groups"]
    trace: Groups
    freedom: Groups  # complex
    fits: "tuple[Fit, ...]"


class Fit(NamedTuple):
    """Least squares of the outputs on inputs and leakage in windows of one length.

    An output's slope counts only for this output: q is what the common columns A leave of it, of
    unit length. Products with the overlap O of the windows say what noise does.
    """

    solver: Gram
    fitted: Complex[np.ndarray, "frequencies columns both"]  # of the outputs, then of their slopes
    inverse: Float[np.ndarray, "frequencies slopes"]  # of the length of q before
    along: Complex[np.ndarray, "frequencies slopes"]  # coefficients of q
    aa: Gram  # A^H O A
    aq: Complex[np.ndarray, "frequencies columns slopes"]  # A^H O q
    qq: Float[np.ndarray, "frequencies slopes"]  # q^H O q

    def bias(self, outputs: int, inputs: int) -> tuple[np.ndarray, np.ndarray]:
        """What leakage adds to the response, and its mean square under unit noise."""
        # The response took too much of the inputs: the first coefficients of what is left, less
        # `through` times those to its own column.
        taken, through = np.split(np.swapaxes(self.fitted[:, :inputs], 1, 2), [outputs], axis=1)
        through, to_x = through * self.inverse[:, :, None], self.solver[:, :inputs]
        plain = np.real(np.sum((to_x @ self.aa) * np.conj(to_x), axis=2))[:, None]
        if not through.shape[1]:
            return -taken, np.repeat(np.maximum(plain, 0.0), outputs, axis=1)
        mixed = 2 * np.real(np.conj(through) * np.swapaxes(to_x @ self.aq, 1, 2))
        square = plain - mixed + power_of(through) * self.qq[:, :, None]
        return through * self.along[:, :, None] - taken, np.maximum(square, 0.0)


def shows_leakage(windows: int, inputs: int) -> bool:
    """Whether there are enough windows of one length to tell leakage from noise."""
    return windows >= 3 * inputs + 3


def without_leakage(
    windows: Sequence[
        tuple[
            Complex[np.ndarray, "frequencies _ inputs"],
            Complex[np.ndarray, "frequencies _ outputs"],
        ]
    ],
    response: Complex[np.ndarray, "frequencies outputs inputs"],
    slopes: Sequence[Slopes],
    overlap: Overlap,
    resolved: Bool[np.ndarray, "groups frequencies"],
) -> Rest:
    """Outputs less all that inputs and leakage explain, one window length after the other.

    `windows` are the inputs and the outputs of each length, which is looked at where it is
    `resolved`: from a frequency on, and the first everywhere. A length with too few windows for its
    leakage keeps it, as noise; its slopes do not matter.
    """
    parts, first = [], 0
    for pair, derivatives, where in zip(windows, slopes, resolved, strict=True):
        # What a window does not resolve lies below what it does, and has no weight.
        few = slice(int(np.argmax(where)), None)
        x, y, x1, x2 = (np.swapaxes(part[few], 1, 2) for part in (*pair, *derivatives))
        inputs, count = x.shape[1:]
        columns, both = x, y - response[few] @ x
        if shows_leakage(count, inputs):
            columns = np.concatenate([x, x1[:, :inputs], x2], axis=1)
            both = np.concatenate([both, x1[:, inputs:]], axis=1)
        mine = slice(first, first + count)
        columns = np.ascontiguousarray(columns)
        parts.append(_least_squares(both, columns, y.shape[1], overlap[mine, mine]))
        first += count
    *sums, fits = zip(*parts, strict=True)
    products, trace, freedom = (_padded(part, len(response)) for part in sums)
    return Rest(products, np.where(trace > 0, trace, 1.0), np.maximum(freedom, 0.5), fits)


def find_bias(fits: Sequence[Fit], outputs: int, inputs: int) -> tuple[np.ndarray, np.ndarray]:
    """What leakage adds to the response of each length, and its mean square under unit noise.

    Both by frequency, output, input and length.
    """
    parts = [fit.bias(outputs, inputs) for fit in fits]
    frequencies = max(len(fit.solver) for fit in fits)
    bias, square = (_padded(part, frequencies) for part in zip(*parts, strict=True))
    return bias, square


def _padded(parts: Sequence[np.ndarray], frequencies: int) -> np.ndarray:
    """Side by side, with zeros at the lowest frequencies that some lack."""
    joined = np.zeros((frequencies, *parts[0].shape[1:], len(parts)), parts[0].dtype)
    for k, part in enumerate(parts):
        joined[frequencies - len(part) :, ..., k] = part
    return joined


def _least_squares(
    both: Rows,
    columns: Complex[np.ndarray, "frequencies columns windows"],
    outputs: int,
    overlap: Overlap,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Fit]:
    """`Rest` of one length: each output on the columns, and on its own slope, behind it in `both`.

    With P = P0 - q q^H the projection, P0 that of the common columns A, and O the overlap: the
    trace of P O, the degrees of freedom tr(P O)^2 / tr(P O P O).
    """
    count, adjoint = columns.shape[1], np.conj(columns)
    weighed = _times_overlap(columns, overlap)
    # One product of all: many small ones take as long to begin as to make.
    stacked = adjoint @ np.swapaxes(np.concatenate([columns, weighed, both], axis=1), 1, 2)
    gram, aa = stacked[:, :, :count], stacked[:, :, count : 2 * count]
    power = np.real(np.diagonal(gram, axis1=1, axis2=2))
    units = 1 / np.maximum(np.sqrt(power), 1e-100)
    units = units[:, :, None] * units[:, None, :]
    solver = np.linalg.inv(gram * units + _RIDGE * np.eye(count)) * units
    fitted = solver @ stacked[:, :, 2 * count :]
    rest = both - np.swapaxes(fitted, 1, 2) @ columns
    size, left = (np.sqrt(_inner(part, part)) for part in (both, rest))
    # Nearly dependent columns leave a part of themselves: orthogonal to all else, so its square
    # counts.
    least = np.real(np.diagonal(solver, axis1=1, axis2=2)) * power
    if np.any(2e-16 * np.max(least, axis=1, keepdims=True) * size > _ROUNDING * left):
        rest -= np.swapaxes(solver @ (adjoint @ np.swapaxes(rest, 1, 2)), 1, 2) @ columns
        left = np.sqrt(_inner(rest, rest))
    rest, q, length = rest[:, :outputs], rest[:, outputs:], left[:, outputs:]
    inverse = np.where(length > _WITHIN * size[:, outputs:], 1 / np.maximum(length, 1e-300), 0.0)
    q = q * inverse[:, :, None]
    along = np.vecdot(q, rest[:, : q.shape[1]])
    if q.shape[1]:
        rest = rest - q * along[:, :, None]
    weighed_q = _times_overlap(q, overlap)
    products = np.conj(weighed) @ np.swapaxes(np.concatenate([weighed, q], axis=1), 1, 2)
    aa_twice, aq = products[:, :, :count], products[:, :, count:]
    qq, qq_twice = _inner(q, weighed_q), _inner(weighed_q, weighed_q)
    through = solver @ aa
    trace = (np.trace(overlap) - _trace(solver, aa))[:, None]
    square = np.sum(overlap**2) - 2 * _trace(solver, aa_twice)
    square = (square + _trace(through, np.conj(np.swapaxes(through, 1, 2))))[:, None]
    if q.shape[1]:
        crossed = qq_twice - np.sum(np.conj(aq) * (solver @ aq), axis=1).real
        trace, square = trace - qq, square - 2 * crossed + qq**2
    freedom = np.maximum(trace**2 / square, 0.5)
    if not q.shape[1]:
        trace, freedom = (np.repeat(part, outputs, axis=1) for part in (trace, freedom))
    products = np.conj(rest) @ np.swapaxes(rest, 1, 2)
    return products, trace, freedom, Fit(solver, fitted, inverse, along, aa, aq, qq)


def _times_overlap(rows: Rows, overlap: Overlap) -> Rows:
    """Rows times the overlap of the windows, a few windows with those that overlap them."""
    flat = rows.reshape(-1, rows.shape[2])
    weighed = np.empty_like(flat)
    for first in range(0, len(overlap), _FEW):
        few = slice(first, first + _FEW)
        places = np.flatnonzero(np.any(overlap[few], axis=0))
        others = slice(places[0], places[-1] + 1)
        weighed[:, few] = flat[:, others] @ overlap[others, few].astype(complex)
    return weighed.reshape(rows.shape)


def cross_products(
    rows: Complex[np.ndarray, "frequencies windows channels"],
) -> Complex[np.ndarray, "frequencies channels channels"]:
    """Sums of `conj(a) b` over windows."""
    return np.conj(np.swapaxes(rows, 1, 2)) @ rows


def power_of(x: Complex[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The square of the absolute value, which itself takes a library as long as ten products."""
    return np.real(x) ** 2 + np.imag(x) ** 2


def _inner(
    a: Complex[np.ndarray, "*rows terms"], b: Complex[np.ndarray, "*rows terms"]
) -> Float[np.ndarray, "*rows"]:
    """The real part of `conj(a) b`, summed over the last axis."""
    return np.vecdot(a.view(float), b.view(float))


def _trace(a: Gram, b: Gram) -> Float[np.ndarray, " frequencies"]:
    """The real part of the trace of the product of `a` with the adjoint of `b`."""
    a, b = (np.ascontiguousarray(part).reshape(len(part), -1) for part in (a, b))
    return _inner(a, b)
